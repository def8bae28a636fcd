"""The whole loop, from recordings and a declared model to a new config: `driftlab explain`."""

from __future__ import annotations

import io
from collections import deque
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.commands.console import print_verdict, say, terminal
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Units, config_of, recordings_of
from driftlab.commands.result import Result, in_folder
from driftlab.config import Config, load_config, paths_of, with_recording
from driftlab.evaluation.limits import LimitResult, least_kept, verdict
from driftlab.evaluation.overview import ScoredRun, scored
from driftlab.evaluation.scores import moving_average
from driftlab.evaluation.summary import jumps, mispredicted, remarks
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.identification.candidates import check_kinds
from driftlab.identification.config_edit import calibrated, clamped, declared_effects, the_map, with_map
from driftlab.identification.model import explained_config, explained_map
from driftlab.identification.records import Progress, gather
from driftlab.identification.result import Identification, Outcome, closed, investigate
from driftlab.maps.fit import fit_map
from driftlab.recordings.epochs import epochs
from driftlab.recordings.identity import identity, span_of
from driftlab.recordings.overlap import SAME, SMALL, TWICE, Contents
from driftlab.recordings.screening import read
from driftlab.reports.explain import prediction_chart, tables, write_report
from driftlab.reports.figures import figure_of
from driftlab.reports.provenance import Sheet, sheet_of
from driftlab.storage.json import write_json
from driftlab.units import tracked_unit
from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect, FittedMap, ThermalMap
from fusion_core.errors import ConfigError
from fusion_core.escaping import comment
from fusion_core.faults import Faults
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry
from fusion_core.threads import one_thread

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PREDICTED = ("reference", "before", "after", "before_sigma", "after_sigma")


class ExplainResult(Result):
    """The verdict on a declared model, the new config, and the predictions of both models for the test recordings.

    Arrays are those of `prediction.h5`, one test recording after the other: `t` (N,), `reference`, `before`,
    `after`, `before_sigma`, `after_sigma` (N, d), and `recording` (N,), the number of the recording.

    Attributes
    ----------
    verdict : str
        `explained`, `nothing_missing`, `unexplained`, `ambiguous` or `refuted`.
    config : str
        The new config, as YAML; the map that it names is among the files that `save` writes.
    closed : Identification
        Everything that the loop found.
    files : dict of str to bytes
        What `save` writes.
    """

    command = "explain"

    def __init__(self, closed: Identification, files: dict[str, bytes], read: Collection[Path]) -> None:
        self.closed, self.verdict, self.summary = closed, closed.verdict.word, closed.content
        self.config = files["explained.yaml"].decode()
        self.files, self._read = files, read
        outcomes, evidence = closed.outcomes, closed.search.columns.evidence
        self.name = f"{self.verdict.replace('_', ' ')}, judged on {', '.join(o.name for o in outcomes)}"
        self._columns = {name: np.concatenate([getattr(o, name) for o in outcomes]) for name in ("t", *PREDICTED)}
        self._columns["recording"] = np.repeat(np.arange(len(outcomes)), [len(o.t) for o in outcomes])
        self.units = {"t": "s", **dict.fromkeys(PREDICTED, evidence.unit.si)}
        self.labels = dict.fromkeys(PREDICTED, tuple(evidence.axes))

    def lines(self) -> list[str]:
        """Return the findings, a sentence each."""
        return list(self.closed.lines)

    def plot(self, k: int = 0) -> Figure:
        """Draw the prediction of the k-th test recording, before and after, and its errors."""
        return figure_of(prediction_chart(self.closed.outcomes[k], self.closed.search.columns.evidence.axes))

    def _write(self, folder: Path) -> None:
        for name, content in self.files.items():
            (folder / name).write_bytes(content)


def explain(
    config: ConfigLike,
    calibration: DataLike,
    train: DataLike,
    holdout: DataLike,
    *,
    units: Units | None = None,
    out: Place | None = None,
    channel: str | None = None,
    estimate: bool = False,
    without: Sequence[str] = (),
    progress: Callable[[str], None] | None = None,
) -> ExplainResult:
    """Find what the declared model lacks, and add it.

    Shows the error before and after on recordings that are opened last.

    Parameters
    ----------
    config : as that of `run`
        The declared model; the map that it names, if it does, is fitted on the calibration.
    calibration : as `data` of `run`, or a list of them
        The soak; may be repeated.
        All recordings are at rest. Recordings are compared by their samples, those in memory too.
    train : as `calibration`
        To find effects on; may be repeated.
    holdout : as `calibration`
        To judge on, opened last; may be repeated.
    units, channel : as those of `run`
    out : path, optional
        Folder for the results.
        They are `loop.json`, `explained.yaml`, the maps, `prediction.h5` and `report.html`.
    estimate : bool
        Let the new config go on estimating the effects' coefficients.
    without : sequence of str
        Effects not to try; may be repeated.
    progress : callable, optional
        Called with texts.

    Returns
    -------
    ExplainResult
        `verdict`, `config` (the new one), and `t` (N,), `reference`, `before`, `after` (N, d) of the test recordings.

    Raises
    ------
    DataError, ConfigError, UnitError
        If the config or a recording cannot be used.
    """
    given = {"calibration": calibration, "train": train, "holdout": holdout}
    recordings = {role: recordings_of(data, units, role) for role, data in given.items()}
    understood = config_of(config).tracking(channel)
    used = [*understood.files(), *paths_of(name for names in recordings.values() for name in names)]

    def explained() -> ExplainResult:
        # the matrices are small: fits side by side are faster than divided matrices
        with TemporaryDirectory(prefix="driftlab-") as folder, one_thread():
            told = progress or (lambda text: None)
            whole = _closed(understood, recordings, Path(folder), told, without, estimate=estimate)
            return ExplainResult(whole, {path.name: path.read_bytes() for path in sorted(Path(folder).iterdir())}, used)

    return in_folder(out, "explain", used, explained)


def _closed(
    config: Config,
    recordings: Mapping[str, Sequence[str]],
    folder: Path,
    progress: Progress,
    without: Collection[str],
    *,
    estimate: bool,
) -> Identification:
    """Close the loop, and write its files into a folder."""
    settings = the_map(config)
    check_kinds(without)
    calibration, train = distinct(config, recordings)
    declared, fitted = _declared(config, settings, calibration, folder, progress)
    evidence = gather(calibrated(declared), calibration, train, progress)
    explanation = investigate(evidence, settings, declared_effects(config), progress, without)
    new = _explained(config, explanation, fitted, settings, [*calibration, *train], folder, estimate)
    _write_config(folder / "explained.yaml", new, explanation.verdict.word, explanation.lines)
    progress("opening the test recording")
    # a test recording that leaves the map's domain is judged all the same, and not refused after all the work
    both = [clamped(c) for c in (declared, load_config(folder / "explained.yaml"))]
    compared = both if explanation.anything else both[:1]
    outcomes = [outcome_of(compared, recording, progress) for recording in recordings["holdout"]]
    identities = {role: list(map(identity, names)) for role, names in recordings.items()}
    whole = closed(explanation, outcomes, identities)
    if whole.refuted:
        _refute(folder, config, new, whole)
    chosen = 0 if whole.refuted else 1
    whole.content["plugins"] = participants((declared, new), *registry().classes(Effect).values())
    limits = least_kept(outcome.runs[chosen].judged for outcome in outcomes)
    rows = [row.as_json(tracked_unit(new.filter)) for row in limits]
    whole.content.update(serial=config.serial, limits=rows, limits_verdict=verdict(limits))
    write_prediction(folder / "prediction.h5", whole.outcomes)
    write_json(folder / "loop.json", whole.content)
    progress("drawing the report")
    text = (folder / "explained.yaml").read_text(encoding="utf-8")
    write_report(folder / "report.html", whole, text, _sheet(both[chosen], whole, limits))
    return whole


def _declared(
    config: Config, settings: ThermalMap | None, calibration: Sequence[str], folder: Path, progress: Progress
) -> tuple[Config, FittedMap | None]:
    """Return the declared config with its map fitted on the calibration, and the map; None where it has none."""
    if settings is None:
        return config, None
    progress("fitting the declared map on the calibration")
    fitted = fit_map(config, calibration, settings.kind, Faults())
    path = folder / f"declared{settings.suffix}"
    fitted.save(path)
    return with_map(config, path=path), fitted


def _explained(
    config: Config,
    explanation: Identification,
    fitted: FittedMap | None,
    settings: ThermalMap | None,
    names: list[str],
    folder: Path,
    estimate: bool,
) -> Config:
    """Write the new map, and return the new config; where nothing was added, those that were declared."""
    path = None if settings is None else Path(f"explained{settings.suffix}")
    if settings is not None and fitted is not None and path is not None:
        if explanation.anything:
            fitted = explained_map(explanation.search, explanation.fit, fitted, settings, names)
        fitted.save(folder / path)
    if not explanation.anything:
        return config if path is None else with_map(config, path=path)
    unit = explanation.search.columns.evidence.unit
    return explained_config(config, unit, explanation.fit, path, estimate=estimate)


def _refute(folder: Path, declared: Config, candidate: Config, whole: Identification) -> None:
    """Move the identified effects to the candidate's files, and leave config and map as they were declared."""
    for declared_map in folder.glob("declared.*"):
        explained = folder / f"explained{declared_map.suffix}"
        candidate = with_map(candidate, path=Path(explained.rename(folder / f"candidate{explained.suffix}").name))
        explained.write_bytes(declared_map.read_bytes())
    _write_config(folder / "candidate.yaml", candidate, whole.verdict.word, whole.lines)
    readable = declared.file is not None and declared.file.is_file()
    text = declared.file.read_bytes() if readable else declared.as_yaml().encode()  # type: ignore[union-attr]
    (folder / "explained.yaml").write_bytes(text)


def _write_config(path: Path, config: Config, word: str, lines: Sequence[str]) -> None:
    head = [f"driftlab {__version__} explain: {word}", *lines]
    releases = (f"{p['kind']} ({p['distribution']} {p['version']})" for p in participants(config))
    head.append(f"plugins: {', '.join(releases)}")
    head.append("coefficients and sigma of effects are in SI units")
    path.write_text("\n".join(map(comment, head)) + "\n" + config.as_yaml(), encoding="utf-8")


def _sheet(config: Config, whole: Identification, limits: Sequence[LimitResult]) -> Sheet:
    """Return the provenance sheet: recordings with the role of each, maps by the names that they have beside it."""
    sheet = sheet_of(config, [], judged=limits, plugins=whole.content["plugins"])
    roles = whole.content["recordings"].items()
    recordings = [{**one, "name": f"{one['name']} ({role})"} for role, identities in roles for one in identities]
    maps = [{**one, "file": Path(one["file"]).name} for one in sheet.maps]
    return replace(sheet, recordings=recordings, maps=maps)


def outcome_of(compared: Sequence[Config], recording: str, progress: Progress) -> Outcome:
    """Run one test recording, which is read once, through both configs side by side, and return their predictions.

    Those of one config, where nothing was added to it.
    """
    config, faults = with_recording(compared[0], recording), Faults()
    stream = list(epochs(read(config, faults), config.filter.update_interval if config.filter else 1.0))
    progress(f"running {recording} through the declared config{' and the explained one' * (len(compared) > 1)}")
    with ThreadPoolExecutor(len(compared)) as pool:
        runs = [pool.submit(_run, with_recording(c, recording), stream, deepcopy(faults)) for c in compared]
        (first, before), (second, after) = runs[0].result(), runs[-1].result()
    coasting = np.isfinite(first["coast"][:, 0])
    off = jumps(after, second)
    return Outcome(
        name=recording,
        unit=tracked_unit(config.filter),
        t=first["t"][coasting],
        temperature=next((c["temperature_raw"][coasting] for c in (first, second) if "temperature_raw" in c), None),
        reference=moving_average(first["t"], first["rate"], first["tau"], first["still"])[coasting],
        before=first["coast"][coasting],
        after=second["coast"][coasting],
        before_sigma=first["coast_sigma"][coasting],
        after_sigma=second["coast_sigma"][coasting],
        runs=(before, after),
        remarks=(*off, *remarks(after)),
        off=(*off, *mispredicted(after)),
    )


def _run(config: Config, stream: Sequence[Chunk], faults: Faults) -> tuple[dict[str, Any], ScoredRun]:
    """Return the columns of a run over epochs, and itself."""
    run = Run(config, RunLog(faults))
    columns = joined(run.over(stream))
    return columns, scored(run, columns)


def write_prediction(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write `prediction.h5`: what was predicted of each test recording, in a group named by its file's stem."""
    import h5py

    whole = io.BytesIO()  # HDF5 itself does not survive a full disk
    with h5py.File(whole, "w") as file:
        file.attrs["driftlab"] = __version__
        for outcome in outcomes:
            stem = Path(outcome.name.partition("::")[0]).stem
            name, k = stem, 2
            while name in file:
                name, k = f"{stem}_{k}", k + 1
            group = file.create_group(name)
            group.attrs["recording"] = Path(outcome.name).name
            group.create_dataset("t", data=outcome.t).attrs["unit"] = "s"
            group["t"].attrs["first_row"] = outcome.runs[0].overview.first_row
            for column in PREDICTED:
                group.create_dataset(column, data=getattr(outcome, column)).attrs["unit"] = outcome.unit.si
    path.write_bytes(whole.getbuffer())


def distinct(config: Config, recordings: Mapping[str, Sequence[str]]) -> tuple[list[str], list[str]]:
    """Return calibration and train under one name each: what serves as both is called alike.

    Recordings are compared by their samples: parts of one file by their seconds, others by what they hold, so one that
    was packed otherwise, cut or shifted in time is still the same.

    Raises
    ------
    ConfigError
        If a part has no recording, samples are in one twice, or some that teach are to judge.
    """
    calibration, train, holdout = (recordings[role] for role in ("calibration", "train", "holdout"))
    for role, names in recordings.items():
        if not names:
            raise ConfigError(f"--{role} is missing; name at least one recording")
    alike = "overlaps {}, which was given for calibration, and would count twice; give the same part as both, or parts "
    alike += "that do not overlap"
    fresh = "overlaps {}, which was given for fitting, and cannot judge it; name another recording"
    pairs = [
        *((role, k, names[:k], TWICE, np.inf) for role, names in recordings.items() for k in range(len(names))),
        *(("train", k, calibration, alike, SAME) for k in range(len(train))),
        *(("holdout", k, [*calibration, *train], fresh, np.inf) for k in range(len(holdout))),
    ]
    contents = _contents(config, list(dict.fromkeys(name for names in recordings.values() for name in names)))
    for role, k, others, problem, same in pairs:
        name = recordings[role][k]
        for other in others:
            if SMALL < contents.share(name, other) < same:
                raise ConfigError(f"--{role} {name}: {problem.format(other)}")
    names = [next((c for c in calibration if contents.share(name, c) >= SAME), name) for name in train]
    return list(calibration), names


def _contents(config: Config, names: Sequence[str]) -> Contents:
    """Return the contents of recordings, read side by side; they are not read where all are parts of one file."""
    assert config.filter is not None
    contents = Contents(config.filter.tracked.channel)

    def take(name: str) -> None:
        deque(contents.along(name, read(with_recording(config, name), Faults())), 0)

    if len({span_of(name)[0] for name in names}) > 1:
        with ThreadPoolExecutor(2) as pool:
            list(pool.map(take, names))
    return contents


def show(result: ExplainResult, given: Mapping[str, Any]) -> None:
    """Print the verdict, the findings and their tables."""
    from rich.text import Text

    console, closed = terminal(), result.closed
    console.print(Text.assemble("verdict: ", (result.verdict.replace("_", " "), "bold")))
    for line in result.lines():
        console.print(f"  {line}", soft_wrap=True)
    print_verdict(closed.content["limits_verdict"], "limits: ")
    for table in tables(closed):
        console.print()
        console.print(table)
    configs = "explained.yaml, candidate.yaml" if closed.refuted else "explained.yaml"
    say(f"written to {given['out']}: loop.json, {configs}, prediction.h5, report.html, and the maps\n")
