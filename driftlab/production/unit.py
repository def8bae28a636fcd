"""The work on one unit: its map, its soaks' information in the family's basis, a prediction, figures and verdicts.

A unit that cannot be used is a record that says why; nothing is raised for it. Where they are asked for, the loop and
the pages of run and map are part of the work.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.commands.explain import explain
from driftlab.config import Config, part_of, paths_of, products, understood
from driftlab.evaluation.limits import LimitResult, Measured
from driftlab.evaluation.measurements import normal, of_map
from driftlab.family.record import RepeatedSoak, UnitRecord
from driftlab.family.unit_noise import Densities, soaked_of
from driftlab.production.manifest import ManifestEntry
from driftlab.production.remote import local
from driftlab.production.unit_map import coasted, figures_of, fit_unit_map, repeated
from driftlab.recordings.identity import identity, sha256
from driftlab.reports.certificate import Certificate
from driftlab.reports.provenance import map_facts, sheet_of
from driftlab.storage.in_memory import CopyName
from driftlab.storage.map_file import read_map
from driftlab.storage.ownership import is_as
from driftlab.units import tracked_unit
from fusion_core.errors import ConfigError, FusionError, MapError, UnreadableFile, describe_error
from fusion_core.faults import Faults, in_doubt
from fusion_core.host.config import document_of
from fusion_core.host.provenance import participants

if TYPE_CHECKING:
    from driftlab.family.unit_information import UnitInformation
    from driftlab.production.unit_map import CoastResult, UnitMap
    from driftlab.reports.provenance import Sheet

CALIBRATION, TRAIN, HOLDOUT, STIMULUS = "calibration", "train", "holdout", "stimulus"  # roles
MISSING = "has no recordings of the roles train and holdout; name one of each in the manifest"
Recordings = Mapping[str, Sequence[str]]  # by role


@dataclass(frozen=True)
class Task(ManifestEntry):
    """The work on one unit of a manifest.

    A recording is `PATH` or `PATH::START:STOP`, or a URL in place of the path.
    """

    config: str = ""  # the whole, as YAML
    folder: str = "."  # that relative paths are relative to
    explain: bool = False  # whether the loop is closed, where there are recordings for it
    page: bool = False  # whether the pages of run and map are written

    @property
    def names(self) -> list[str]:
        """The recordings of all roles."""
        return [name for names in self.recordings.values() for name in names]

    def placed(self, copies: Mapping[str, str]) -> dict[str, list[str]]:
        """Return the recordings with paths from where we are; those with another name in `copies` are read there."""

        def place(name: str) -> str:
            copy = copies.get(name, name)
            return os.path.join(self.folder, name) if copy == name else CopyName(name, copy)

        return {role: list(map(place, names)) for role, names in self.recordings.items()}


@dataclass(frozen=True)
class UnitResult:
    """The record of a unit, and the contents of its other files by their names in its folder."""

    record: UnitRecord
    files: dict[str, bytes]


def work(task: Task) -> UnitResult:
    """Return the result of the work on a unit.

    Mistakes in its recordings, its config, or of a plugin are in the record; nothing is raised for them.
    """
    begun = time.process_time()
    key, files, recordings = "", dict[str, bytes](), task.placed({})
    described = _described(task, recordings)
    with ExitStack() as until_done:
        try:
            recordings = task.placed(until_done.enter_context(local(task.names)))
            _check_regular(recordings)
            _check_copies(recordings)
            described = _described(task, recordings)
            key = _key_of(task, recordings)
            outcome, files = _calibrated(task, recordings)
        except Exception as error:
            if os.environ.get("DRIFTLAB_DEBUG", "0") != "0":
                traceback.print_exc(file=sys.stderr)
            outcome = {"state": "failed", "error": _message(error, recordings)}
    took = time.process_time() - begun
    return UnitResult(UnitRecord(key=key, seconds=took, driftlab=__version__, **described, **outcome), files)


def _message(error: Exception, recordings: Recordings) -> str:
    return _with_urls(str(error) if isinstance(error, FusionError) else describe_error(error), recordings)


def _with_urls(text: str, recordings: Recordings) -> str:
    """Return a text, which may name copies that are soon gone, with the URLs in their place."""
    for name in (name for names in recordings.values() for name in names if isinstance(name, CopyName)):
        text = text.replace(str(part_of(name)[0]), name.url)
    return text


def key_of(task: Task) -> str:
    """Return the key of a unit's work: a hash of its recordings' contents, config and versions.

    Neither its name, its lot, its date nor whether it has a page is part of it: they do not change the results.

    Raises
    ------
    ConfigError
        If the config is wrong.
    UnreadableFile
        If a recording behind a URL cannot be fetched.
    """
    with local(task.names) as copies:
        return _key_of(task, task.placed(copies))


def _key_of(task: Task, recordings: Recordings) -> str:
    config = config_of(task.config, task.folder)
    content = {
        "config": task.config,
        "recordings": {
            role: [[_hash(name), part_of(name)[1]] for name in recordings[role]] for role in sorted(recordings)
        },
        "maps": [sha256(path) for path in config.files_to_fit() if path.is_file()],
        "explain": task.explain,
        "driftlab": __version__,
        "plugins": participants(config),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=float).encode()).hexdigest()


def _hash(name: str) -> str:
    """Return the hash of a recording; of one that cannot be read none, so that it is done once it can."""
    with suppress(UnreadableFile):
        return str(identity(name)["sha256"])
    return ""


@lru_cache(maxsize=8)
def config_of(text: str, folder: str) -> Config:
    """Return the config of a YAML text, with paths relative to a folder; once a process."""
    document = document_of(text, products())
    document.path = Path(folder) / "config.yaml"
    return understood(document)


def _calibrated(task: Task, recordings: Recordings) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the rest of the record of a unit that was done, and its files."""
    config, faults = config_of(task.config, task.folder), Faults()
    soaks = recordings.get(CALIBRATION, ())
    if not soaks:
        raise ConfigError(f"unit {task.unit}: has no recording of the role calibration; name one in the manifest")
    unit = fit_unit_map(config, soaks, faults, recordings.get(STIMULUS, ()))
    fitted, rows = unit.fitted, unit.soak.rows(unit.fitted.record.channel)
    soaked, densities = soaked_of(task.unit, unit.axes, rows)
    run = coasted(unit, recordings.get(HOLDOUT, ()), soaks, soaked.walk)
    files = {"unit.npz": soaked.to_bytes(), unit.file: unit.content()}
    good, repeats, notes = unit.verdict.good, list[RepeatedSoak](), list[str]()
    if len(soaks) > 1:
        names = dict(zip(task.recordings[CALIBRATION], soaks, strict=True))
        repeats, notes = repeated(config, names, recordings.get(HOLDOUT, ()))
    notes = [*faults.lines(), *_excess_walk(soaked, densities), *run.notes, *notes]
    record: dict[str, Any] = {
        "state": "done",
        "channel": fitted.record.channel,
        "bias_unit": fitted.record.unit,
        "axes": unit.axes,
        "domain": fitted.domain,
        "hours": sum(float(part.span.sum()) for part in rows) / 3600,
        "samples": len(unit.soak.T),
        "figures": {**figures_of(fitted, soaked, densities), **run.figures, **unit.terms()},
        "parabolas": unit.parabolas(),
        "coast_of": _relative(run.name, task.folder),
        "coast_in_sample": run.in_sample,
        "repeats": repeats,
        "map_sigma": None if good is None else tuple(good.tolist()),
        "map_file": unit.file,
        "verdict": unit.sentences(),
        "limits": run.limits,
        **_without_copies(recordings, notes=notes, doubts=_doubts(faults.doubts, run)),
        "plugins": participants(unit.config),
    }
    if task.page:
        files |= pages_of(unit, run, soaks, faults.lines(doubts=False), files[unit.file])
    if task.explain:
        record["loop"] = loop_of(config, recordings, files)
    return record, files


def _without_copies(recordings: Recordings, **texts: Sequence[str]) -> dict[str, list[str]]:
    """Return texts by name, each of them once and with URLs in the place of copies."""
    return {name: [_with_urls(text, recordings) for text in dict.fromkeys(own)] for name, own in texts.items()}


def _doubts(of_soaks: list[str], run: CoastResult) -> list[str]:
    """Return the doubts about a unit; a run over its soak repeats those about it."""
    if run.in_sample:
        return of_soaks or run.doubts
    return [*of_soaks, *(f"its holdout: {text}" for text in run.doubts)]


def _relative(name: str, folder: str) -> str:
    """Return the name of a recording relative to a folder; that of a copy, and none, as it is."""
    return str(name) if isinstance(name, CopyName) or not name else os.path.relpath(name, folder)


def _check_regular(recordings: Recordings) -> None:
    """Raise UnreadableFile where a recording is a pipe or a device, which may never end."""
    for path in paths_of(name for names in recordings.values() for name in names):
        if path.exists() and not (path.is_file() or path.is_dir()):
            raise UnreadableFile(f"{path}: is a pipe or a device, a file was expected; record it to one first")


def _check_copies(recordings: Recordings) -> None:
    """Raise ConfigError where one soak stands in for two, or judges a map or a model that it was fitted on."""
    for fitted in (CALIBRATION, TRAIN):
        names = [(role, name) for role in (fitted, HOLDOUT) for name in recordings.get(role, ())]
        seen: dict[tuple[str, str], tuple[str, str]] = {}
        for role, name in names if len(names) > 1 else ():
            content = _hash(name)
            first, other = seen.setdefault((content, str(part_of(name)[1])), (role, name))
            if content and other != name:
                raise ConfigError(
                    f"{name} ({role}): has the content of {other} ({first}), another recording was expected; correct "
                    "the path, or take one of them out of the manifest"
                )


def _excess_walk(soaked: UnitInformation, densities: Densities) -> list[str]:
    """Return a note on the axes that wander by more than their walk, from sweep to sweep."""
    more = soaked.walk / densities.likely
    each = [f"{axis} {times:.2g} times" for axis, times in zip(soaked.axes, more, strict=True) if times > 1]
    if not each:
        return []
    text = "passes through the same temperatures differ by more than white noise and walk say"
    return [f"{text}: what the soak says of the map is reckoned with a larger walk ({', '.join(each)})"]


def _described(task: Task, recordings: Recordings) -> dict[str, Any]:
    """Return the manifest's part of the record, with length and hash of each recording that can be read."""
    known: dict[str, list[dict[str, Any]]] = {}
    for role, names in task.recordings.items():
        known[role] = [{"name": name} for name in names]
        for entry, placed in zip(known[role], recordings[role], strict=True):
            with suppress(FusionError):
                entry |= {**identity(placed), **entry}
    return {"unit": task.unit, "lot": task.lot, "date": task.date, "more": dict(task.more), "recordings": known}


def loop_of(config: Config, recordings: Recordings, files: dict[str, bytes]) -> dict[str, Any]:
    """Close the loop on the recordings of a unit, and add its files to `files`.

    Return its verdict and effects as `loop.json` has them, or why there are none.
    """
    if not recordings.get(TRAIN) or not recordings.get(HOLDOUT):
        return {"why_not": MISSING}
    try:
        result = explain(config, recordings[CALIBRATION], recordings[TRAIN], recordings[HOLDOUT])
    except FusionError as error:
        return {"why_not": _message(error, recordings)}
    files.update({f"explained/{name}": content for name, content in result.files.items()})
    return {"verdict": result.verdict, "effects": result.summary["effects"]}


def pages_of(
    unit: UnitMap, run: CoastResult, soaks: Sequence[str], notes: list[str], content: bytes
) -> dict[str, bytes]:
    """Return the pages of map and run; `content` is the map's file."""
    from driftlab.reports import map
    from driftlab.reports import run as run_report

    facts = {**map_facts(unit.fitted, unit.bias_unit), "file": unit.file, "sha256": hashlib.sha256(content).hexdigest()}
    sheet = replace(sheet_of(unit.config, soaks, plugins=participants(unit.settings)), maps=[facts])
    pages = {"map.report.html": map.page_of(unit.verdict, unit.bias_unit, notes, sheet)}
    if run.result is not None:
        result = run.result
        sheet = replace(sheet_of(result.config, judged=result.judged, plugins=result.summary["plugins"]), maps=[facts])
        pages["report.html"] = run_report.page_of(
            result.run, result.summary, title=result.name, sheet=sheet, fitted=unit.fitted
        )
    return {f"page/{name}": page.encode() for name, page in pages.items()}


def certificate_of(record: UnitRecord, path: Path, config: Config, sheet: Sheet) -> Certificate:
    """Return the certificate of a unit that is done, from its record and the file of its map.

    `config` and `sheet` are those of the fleet. Raises MapError where the map is not the one that was written.
    """
    known = record.written.get(record.map_file, "")
    if not is_as(path, known):
        raise MapError(f"{path}: was changed since `driftlab fleet` wrote it; give --force to make it anew")
    fitted, unit = read_map(path), tracked_unit(config.filter)
    judged = [LimitResult.from_json(row) for row in record.limits]
    own = replace(
        sheet,
        serial=record.more.get("serial", ""),
        date=record.date,
        dated="manifest" if record.date else "page",
        recordings=[one for part in record.recordings.values() for one in part],
        versions={"driftlab": record.driftlab},
        plugins=record.plugins,
        maps=[{**map_facts(fitted, unit), "file": record.map_file, "sha256": known}],
    )
    beside = {"noise", "coast"} - {row.name for row in judged}  # a limit is held against a measurement of its own
    measured = {name: _measured(record, name) for name in sorted(beside)} | of_map(fitted, unit)
    in_sample = "the prediction is of the soak that the map was fitted on"
    return Certificate(
        "fleet", config, own, judged, measured, fitted, seconds=3600 * record.hours, name=record.unit,
        remarks=[*in_doubt(record.doubts), *[in_sample] * record.coast_in_sample],
    )  # fmt: skip


def _measured(record: UnitRecord, name: str) -> Measured:
    """Return a figure of a unit's record as a measurement."""
    values, sigma = record.table([name], len(record.axes))[:, 0]
    if np.all(np.isnan(values)):
        return Measured(values, record.axes, missing="there is no such recording, or it is too short")
    figure = Measured(values, record.axes, stands_on=record.coast_of if name == "coast" else "")
    return normal(figure, sigma, float("nan")) if np.all(np.isfinite(sigma)) else figure
