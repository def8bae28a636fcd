"""`driftlab explain`: the whole loop, from recordings and a declared model to files."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.config import Config, load_config, part_of, with_recording
from driftlab.fit import fit_map
from driftlab.folders import output_folder
from driftlab.loop.declared import calibrated, declared_effects, the_map, with_map
from driftlab.loop.evidence import Progress, gather
from driftlab.loop.explained import explained_config, explained_map
from driftlab.loop.record import as_json
from driftlab.loop.regression import Regression
from driftlab.loop.search import Search, search
from driftlab.loop.verdict import Verdict, judge, summary
from driftlab.outputs import write_json
from driftlab.overview import overview_of
from driftlab.replaceable import files_of
from driftlab.run import Run
from driftlab.stretch import Journal, joined
from driftlab.summary import remarks, summarise
from driftlab.yardsticks import moving_average
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError, UnreadableFile
from fusion_core.faults import Faults

PREDICTED = ("reference", "before", "after", "before_sigma", "after_sigma")


@dataclass(frozen=True)
class Outcome:
    """One holdout recording through the declared and the explained config."""

    name: str
    t: Array
    temperature: Array
    reference: Array
    before: Array
    after: Array
    before_sigma: Array
    after_sigma: Array
    summaries: tuple[dict[str, Any], dict[str, Any]]


@dataclass(frozen=True)
class Closed:
    """What `explain` leaves: the content of its files."""

    search: Search
    verdict: Verdict
    outcomes: tuple[Outcome, ...]
    lines: tuple[str, ...]
    content: dict[str, Any]


def explain(
    config: Config,
    calibration: Sequence[str],
    train: Sequence[str],
    holdout: Sequence[str],
    out: Path,
    progress: Progress = lambda text: None,
    *,
    estimate: bool = False,
    read: Collection[Path] = (),
) -> Closed:
    """Find what the declared model lacks, add it, and measure the error before and after on the holdout.

    Parameters
    ----------
    config : Config
        The declared model; the map that it names is fitted on the calibration.
    calibration, train, holdout : lists of `PATH` or `PATH::START:STOP`
        Recordings at rest. The holdout is opened last, once everything has been decided.
    out : Path
        Folder; it appears when all files are whole.
    estimate : bool
        Whether the effects go on being estimated by the filter of the new config.
    read : collection of Path
        Files that are needed beside the recordings: none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If the config or a recording cannot be used.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    settings = the_map(config)
    recordings = {"calibration": calibration, "train": train, "holdout": holdout}
    _distinct(**recordings)
    # the matrices are small: fits side by side are faster than divided matrices
    used = [*read, *files_of(config), *(part_of(name)[0] for name in (*calibration, *train, *holdout))]
    with output_folder(out, "explain", used) as folder, threadpool_limits(1):
        progress("fitting the declared map on the calibration")
        declared_map = fit_map(config, calibration, settings.kind, Faults())
        path = folder / f"declared{settings.suffix}"
        declared_map.save(path)
        declared = with_map(config, path=path)
        evidence = gather(calibrated(declared), calibration, train, progress)
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        regression = Regression(evidence, settings.basis((float(T.min()), float(T.max()))))
        found = search(regression, progress, declared_effects(calibrated(config)))
        verdict = judge(found, progress)
        name = f"explained{settings.suffix}"
        if verdict.findings:
            explained_map(regression, found.fit, settings, [*calibration, *train]).save(folder / name)
            new = explained_config(config, regression, found.fit, Path(name), estimate=estimate)
        else:
            declared_map.save(folder / name)
            new = with_map(config, path=Path(name))
        lines = tuple(summary(found, verdict))
        _write_config(folder / "explained.yaml", new, verdict.word, lines)
        progress("opening the holdout")
        # a holdout that leaves the map's domain is judged all the same, and not refused after all the work
        both = [with_map(c, outside="clamp") for c in (declared, load_config(folder / "explained.yaml"))]
        outcomes = tuple(_outcome(both[0], both[1], recording, progress) for recording in holdout)
        lines += tuple(f"{o.name}: {remark}" for o in outcomes for remark in remarks(o.summaries[1]))
        _write_prediction(folder / "prediction.h5", outcomes)
        named = {role: [_identity(name) for name in names] for role, names in recordings.items()}
        content = as_json(found, verdict, named, [o.summaries for o in outcomes])
        write_json(folder / "loop.json", content)
        progress("drawing the report")
        from driftlab.loop.report import write_report

        text = (folder / "explained.yaml").read_text(encoding="utf-8")
        write_report(folder / "report.html", found, verdict, outcomes, named, lines, text)
        regression.forget()
    return Closed(found, verdict, outcomes, lines, content)


def _distinct(calibration: Sequence[str], train: Sequence[str], holdout: Sequence[str]) -> None:
    for option, names in (("--calibration", calibration), ("--train", train), ("--holdout", holdout)):
        if not names:
            raise ConfigError(f"{option} is missing; name at least one recording")
    for name in holdout:
        for other in (*calibration, *train):
            if _overlap(name, other):
                raise ConfigError(
                    f"--holdout {name}: overlaps {other}, which was given for fitting, and cannot judge it; "
                    "name another recording"
                )


def _overlap(name: str, other: str) -> bool:
    """Return whether two recordings of the command line have samples in common."""
    (content, start, stop), (other_content, other_start, other_stop) = _span(name), _span(other)
    return content == other_content and start < other_stop and other_start < stop


def _span(name: str) -> tuple[str, float, float]:
    path, span = part_of(name)
    start, stop = span.get("start"), span.get("stop")
    return _digest(path), -np.inf if start is None else start, np.inf if stop is None else stop


def _identity(name: str) -> dict[str, Any]:
    """Return what tells a recording from others: its name, and length and hash of its file."""
    path, _ = part_of(name)
    return {"name": name, "bytes": path.stat().st_size, "sha256": _digest(path)}


@lru_cache(maxsize=64)
def _digest(path: Path) -> str:
    """Return the hash of a file: the same recording under another name is the same recording."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name an existing file") from None


def _write_config(path: Path, config: Config, word: str, lines: Sequence[str]) -> None:
    head = [f"# driftlab {__version__} explain: {word}", *(f"# {line}" for line in lines)]
    head.append("# coefficients and sigma of effects are in SI units")
    path.write_text("\n".join(head) + "\n" + config.as_yaml(), encoding="utf-8")


def _outcome(declared: Config, explained: Config, recording: str, progress: Progress) -> Outcome:
    """Run one holdout recording through both configs."""
    found, runs = [], []
    for what, config in (("declared", declared), ("explained", explained)):
        progress(f"running {recording} through the {what} config")
        journal = Journal()
        run = Run(with_recording(config, recording), journal)
        found.append(joined(run))
        runs.append((run, journal))
    first, second = found
    before, after = (
        summarise(overview_of(columns, run.model, journal.alignments[0]), run.model, journal)
        for columns, (run, journal) in zip((first, second), runs, strict=True)
    )
    reference = moving_average(first["t"], first["rate"], first["tau"], first["still"])
    coasting = np.isfinite(first["coast"][:, 0])
    t, T, old, old_sigma = (first[name][coasting] for name in ("t", "temperature", "coast", "coast_sigma"))
    new, new_sigma = (second[name][coasting] for name in ("coast", "coast_sigma"))
    return Outcome(recording, t, T, reference[coasting], old, new, old_sigma, new_sigma, (before, after))


def _write_prediction(path: Path, outcomes: Sequence[Outcome]) -> None:
    import h5py

    whole = io.BytesIO()  # HDF5 itself does not survive a full disk
    with h5py.File(whole, "w") as file:
        for outcome in outcomes:
            stem = Path(outcome.name.partition("::")[0]).stem
            name, k = stem, 2
            while name in file:
                name, k = f"{stem}_{k}", k + 1
            group = file.create_group(name)
            group.attrs["recording"] = Path(outcome.name).name
            columns = (
                ("t", outcome.t, "s"),
                *((n, getattr(outcome, n), "rad/s") for n in PREDICTED),
            )
            for column, values, unit in columns:
                group.create_dataset(column, data=values).attrs["unit"] = unit
    path.write_bytes(whole.getbuffer())
