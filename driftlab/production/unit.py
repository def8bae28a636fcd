"""What is done to one unit: its own map, what its soaks say in the family's basis, a coast, figures and verdicts.

A unit that cannot be used is a record that says why; nothing is raised for it.

What is done to a unit where it is asked for: the loop, and the pages of its run and its map.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
import time
import traceback
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab import __version__
from driftlab.config import Config, part_of, products, understood
from driftlab.family.record import UnitRecord
from driftlab.family.rows import rows_of, soaked_of
from driftlab.jobs.explain_in_memory import explained
from driftlab.production.remote import as_given, local
from driftlab.production.unit_map import coasted, figures_of, fit_unit_map
from driftlab.recordings.identity import identity, sha256
from driftlab.reports.provenance import map_facts, sheet_of
from driftlab.storage.map_file import write_page
from fusion_core.errors import ConfigError, FusionError, UnreadableFile, told
from fusion_core.faults import Faults
from fusion_core.host.config import document_of
from fusion_core.host.provenance import participants

if TYPE_CHECKING:
    from driftlab.family.unit_information import UnitInformation
    from driftlab.family.unit_noise import Densities
    from driftlab.production.unit_map import CoastResult, UnitMap


CALIBRATION, TRAIN, TESTS = "calibration", "train", ("test", "holdout")  # roles


@dataclass(frozen=True)
class Task:
    """One unit, and what is to be done to it.

    Attributes
    ----------
    unit, lot, date : str
        As the manifest has them.
    more : mapping of str to str
        Its other columns.
    recordings : mapping of str to tuple of str
        By role (`calibration`, `train`, `test`, `holdout`): `PATH` or `PATH::START:STOP`, or a URL in place
        of the path.
    config : str
        The whole config, as YAML.
    folder : str
        What relative paths are relative to.
    explain : bool
        Whether the loop is closed, where there are recordings for it.
    page : bool
        Whether the pages of run and map are written.
    """

    unit: str
    recordings: Mapping[str, tuple[str, ...]]
    config: str
    lot: str = ""
    date: str = ""
    more: Mapping[str, str] = field(default_factory=dict)
    folder: str = "."
    explain: bool = False
    page: bool = False


@dataclass(frozen=True)
class UnitResult:
    """What was found of a unit: its record, and the contents of its other files by their names in its folder."""

    record: UnitRecord
    files: dict[str, bytes]


def work(task: Task) -> UnitResult:
    """Do what is to be done to a unit.

    What is wrong with its recordings, its config, or with a plugin is in the record; nothing is raised for it.
    """
    begun = time.process_time()
    key, known, names = "", _described(task, task), dict[str, str]()
    with ExitStack() as until_done:
        try:
            names = until_done.enter_context(local(_recordings(task)))
            here = _at_hand(task, names)
            _check_kept(here)
            known = _described(task, here)
            key = _key_of(here)
            found, files = _done(here)
        except Exception as error:
            if os.environ.get("DRIFTLAB_DEBUG", "0") != "0":
                traceback.print_exc(file=sys.stderr)
            said = str(error) if isinstance(error, FusionError) else told(error)
            found, files = {"state": "failed", "error": said}, {}
    took = time.process_time() - begun
    record = UnitRecord(key=key, seconds=took, driftlab=__version__, **known, **found)
    if any(name != copy for name, copy in names.items()):  # copies that nobody has heard of, and that are gone now
        said = as_given(record.model_dump_json(by_alias=True), names, task.folder)
        record = UnitRecord.model_validate_json(said)
        for name in [name for name in files if name.endswith((".json", ".html"))]:
            files[name] = as_given(files[name].decode(), names, task.folder).encode()
    return UnitResult(record, files)


def key_of(task: Task) -> str:
    """Return what tells whether a unit was done already: a hash of its recordings' contents, config and versions.

    Neither its name, its lot, its date nor whether it has a page is part of it: that what was found stays the same.

    Raises
    ------
    ConfigError
        If the config is wrong.
    UnreadableFile
        If a recording behind a URL cannot be fetched.
    """
    with local(_recordings(task)) as names:
        return _key_of(_at_hand(task, names))


def _key_of(task: Task) -> str:
    config = config_of(task.config, task.folder)
    content = {
        "config": task.config,
        "recordings": {
            role: [[_hash(name), part_of(name)[1]] for name in _placed(task, role)] for role in sorted(task.recordings)
        },
        "maps": [sha256(path) for path in config.files_to_fit() if path.is_file()],
        "explain": task.explain,
        "driftlab": __version__,
        "plugins": participants(config),
    }
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=float).encode()).hexdigest()


@lru_cache(maxsize=8)
def config_of(text: str, folder: str) -> Config:
    """Return the config of a YAML text, with paths relative to a folder; once a process."""
    document = document_of(text, products())
    document.path = Path(folder) / "config.yaml"
    return understood(document)


def _done(task: Task) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Return the rest of the record of a unit that was done, and its files."""
    config, faults = config_of(task.config, task.folder), Faults()
    soaks = _placed(task, CALIBRATION)
    if not soaks:
        raise ConfigError(f"unit {task.unit}: has no recording of the role calibration; name one in the manifest")
    own = fit_unit_map(config, soaks, faults)
    fitted, rows = own.fitted, rows_of(own.found, own.channel)
    soaked, densities = soaked_of(task.unit, own.axes, rows)
    run = coasted(own, [name for role in TESTS for name in _placed(task, role)], soaks, soaked.walk)
    files = {"unit.npz": soaked.to_bytes(), own.file: own.content()}
    good = own.verdict.good
    record: dict[str, Any] = {
        "state": "done",
        "channel": fitted.record.channel,
        "bias_unit": fitted.record.unit,
        "axes": own.axes,
        "domain": fitted.domain,
        "hours": sum(float(part.span.sum()) for part in rows) / 3600,
        "samples": len(own.found.T),
        "figures": {**figures_of(fitted, soaked, densities), **run.figures},
        "coast_of": os.path.relpath(run.name, task.folder) if run.name else "",
        "coast_in_sample": run.in_sample,
        "map_sigma": None if good is None else tuple(good.tolist()),
        "map_file": own.file,
        "verdict": own.verdict.sentences(own.unit),
        "limits": run.limits,
        "notes": [*faults.lines(), *_wandering(soaked, densities), *run.notes],
        "plugins": participants(own.config),
    }
    if task.page:
        add_pages(own, run, soaks, faults.lines(), files)
    if task.explain:
        holdout = [name for role in TESTS for name in _placed(task, role)]
        record["loop"] = loop_of(config, soaks, _placed(task, TRAIN), holdout, files)
    return record, files


def _recordings(task: Task) -> list[str]:
    return [name for names in task.recordings.values() for name in names]


def _at_hand(task: Task, names: Mapping[str, str]) -> Task:
    """Return the same task with the names that its recordings have here."""
    return replace(task, recordings={role: tuple(names[n] for n in given) for role, given in task.recordings.items()})


def _check_kept(task: Task) -> None:
    """Raise UnreadableFile where a recording is a pipe or a device, which may never end."""
    for role in task.recordings:
        for path in (Path(part_of(name)[0]) for name in _placed(task, role)):
            if path.exists() and not (path.is_file() or path.is_dir()):
                raise UnreadableFile(f"{path}: is a pipe or a device, a file was expected; record it to one first")


def _wandering(soaked: UnitInformation, densities: Densities) -> list[str]:
    """Return which axes wander by more than their walk says, from pass to pass."""
    more = soaked.walk / densities.likely
    each = [f"{axis} {times:.2g} times" for axis, times in zip(soaked.axes, more, strict=True) if times > 1]
    if not each:
        return []
    text = "passes through the same temperatures differ by more than white noise and walk say"
    return [f"{text}: what the soak says of the map is reckoned with a larger walk ({', '.join(each)})"]


def _described(task: Task, here: Task) -> dict[str, Any]:
    """Return what the manifest says, with length and hash of each recording that can be read."""
    recordings: dict[str, list[dict[str, Any]]] = {}
    for role, names in task.recordings.items():
        recordings[role] = []
        for name, placed in zip(names, _placed(here, role), strict=True):
            try:
                recordings[role].append({**identity(placed), "name": name})
            except FusionError:
                recordings[role].append({"name": name})
    return {"unit": task.unit, "lot": task.lot, "date": task.date, "more": dict(task.more), "recordings": recordings}


def _placed(task: Task, role: str) -> list[str]:
    """Return the recordings of a role, with paths from where we are."""
    return [os.path.join(task.folder, name) for name in task.recordings.get(role, ())]


def _hash(name: str) -> str:
    """Return the hash of a recording; of one that cannot be read none, so that it is done once it can."""
    with suppress(UnreadableFile):
        return str(identity(name)["sha256"])
    return ""


MISSING = "has no recordings of the roles train and holdout; name one of each in the manifest"


def loop_of(
    config: Config, calibration: Sequence[str], train: Sequence[str], holdout: Sequence[str], files: dict[str, bytes]
) -> dict[str, Any]:
    """Close the loop on the recordings of a unit, and add what it writes to `files`.

    Return its verdict and effects as `loop.json` has them, or why there are none.
    """
    if not train or not holdout:
        return {"why_not": MISSING}
    recordings = {"calibration": calibration, "train": train, "holdout": holdout}
    with tempfile.TemporaryDirectory(prefix="driftlab-") as scratch:
        out = Path(scratch) / "explained"
        try:
            found = explained(config, recordings, out, None)
        except FusionError as error:
            return {"why_not": str(error)}
        files.update({f"explained/{path.name}": path.read_bytes() for path in sorted(out.iterdir())})
    return {"verdict": found.verdict, "effects": found.summary["effects"]}


def add_pages(own: UnitMap, run: CoastResult, soaks: Sequence[str], notes: list[str], files: dict[str, bytes]) -> None:
    """Add the pages of map and run to `files`, which has the map."""
    from driftlab.reports.map import page_of
    from driftlab.reports.run import write_report

    with tempfile.TemporaryDirectory(prefix="driftlab-") as folder:
        place, page = Path(folder) / own.file, Path(folder) / "report.html"
        place.write_bytes(files[own.file])
        facts = [{**map_facts(own.fitted, own.unit, place), "file": own.file}]
        sheet = replace(sheet_of(own.config, soaks, plugins=participants(own.settings)), maps=facts)
        write_page(page, page_of(own.verdict, own.unit, notes, sheet, None))
        files["page/map.report.html"] = page.read_bytes()
        if run.result is None:
            return
        result = run.result
        config = result.config
        sheet = replace(sheet_of(config, judged=result.judged, plugins=result.summary["plugins"]), maps=facts)
        write_report(
            page, result.overview, result.summary, title=result.name, config=config.as_yaml(), model=result.model,
            journal=result.journal, sheet=sheet, fitted=own.fitted,
        )  # fmt: skip
        files["page/report.html"] = page.read_bytes()
