"""`driftlab explain`: the whole loop, from recordings and a declared model to files."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.config import Config, load_config, paths_of
from driftlab.evaluation.limits import LimitResult, Measured, check_limits, verdict
from driftlab.evaluation.measurements import of_map
from driftlab.evaluation.run_limits import map_of
from driftlab.identification.candidates import check_kinds
from driftlab.identification.config_edit import calibrated, clamped, declared_effects, the_map, with_map
from driftlab.identification.model import explained_config, explained_map
from driftlab.identification.records import Progress, gather
from driftlab.identification.result import Identification, closed, investigate
from driftlab.jobs.holdout import outcome_of
from driftlab.jobs.prediction import write_prediction
from driftlab.jobs.recordings import Recordings
from driftlab.maps.fit import fit_map
from driftlab.recordings.identity import identity
from driftlab.reports.provenance import Sheet, sheet_of
from driftlab.storage.folders import output_folder
from driftlab.storage.json import write_json
from driftlab.units import tracked_unit
from fusion_core.contracts import Effect, FittedMap, ThermalMap
from fusion_core.escaping import comment
from fusion_core.faults import Faults
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry


def explain(
    config: Config,
    calibration: Sequence[str],
    train: Sequence[str],
    holdout: Sequence[str],
    out: Path,
    progress: Progress = lambda text: None,
    *,
    estimate: bool = False,
    without: Collection[str] = (),
    read: Collection[Path] = (),
) -> Identification:
    """Find what the declared model lacks, add it, and measure the error before and after on the holdout.

    Parameters
    ----------
    config : Config
        The declared model; the map that it names, if it does, is fitted on the calibration.
    calibration, train, holdout : lists of `PATH` or `PATH::START:STOP`
        Recordings at rest. The holdout is opened last, once everything has been decided.
    out : Path
        Folder; it appears when all files are whole.
    estimate : bool
        Whether the effects go on being estimated by the filter of the new config.
    without : collection of str
        Kinds of effects that are not tried.
    read : collection of Path
        Files that are needed beside the recordings, the config's first: none of them may be in `out`.

    Raises
    ------
    DataError, ConfigError
        If the config or a recording cannot be used.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    settings = the_map(config)
    check_kinds(without)
    recordings = {"calibration": calibration, "train": train, "holdout": holdout}
    calibration, train = Recordings(config).distinct(**recordings)
    used = [*read, *config.files(), *paths_of((*calibration, *train, *holdout))]
    # the matrices are small: fits side by side are faster than divided matrices
    with output_folder(out, "explain", used) as folder, threadpool_limits(1):
        declared, fitted = _declared(config, settings, calibration, folder, progress)
        evidence = gather(calibrated(declared), calibration, train, progress)
        found = investigate(evidence, settings, declared_effects(config), progress, without)
        new = _explained(config, found, fitted, settings, [*calibration, *train], folder, estimate)
        _write_config(folder / "explained.yaml", new, found.verdict.word, found.lines)
        progress("opening the holdout")
        # a holdout that leaves the map's domain is judged all the same, and not refused after all the work
        both = [clamped(c) for c in (declared, load_config(folder / "explained.yaml"))]
        judged = [outcome_of(both[0], both[1], recording, progress) for recording in holdout]
        whole = closed(found, [outcome for outcome, _ in judged], _known_as(recordings))
        if whole.refuted:
            _refute(folder, config, new, whole, read)
        kept = 0 if whole.refuted else 1
        whole.content["plugins"] = participants((declared, new), *registry().classes(Effect).values())
        limits = _judged(both[kept], [measured[kept] for _, measured in judged])
        rows = [row.as_json(tracked_unit(new.filter)) for row in limits]
        whole.content.update(serial=config.serial, limits=rows, limits_verdict=verdict(limits))
        _write(folder, whole, _sheet(both[kept], whole, limits), progress)
    return whole


def _known_as(recordings: Mapping[str, Sequence[str]]) -> dict[str, list[dict[str, Any]]]:
    return {role: list(map(identity, names)) for role, names in recordings.items()}


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
    found: Identification,
    fitted: FittedMap | None,
    settings: ThermalMap | None,
    names: list[str],
    folder: Path,
    estimate: bool,
) -> Config:
    """Write the new map, and return the new config; where nothing was added, those that were declared."""
    path = None if settings is None else Path(f"explained{settings.suffix}")
    if settings is not None and fitted is not None and path is not None:
        if found.anything:
            fitted = explained_map(found.search, found.fit, fitted, settings, names)
        fitted.save(folder / path)
    if not found.anything:
        return config if path is None else with_map(config, path=path)
    unit = found.search.columns.evidence.unit
    return explained_config(config, unit, found.fit, path, estimate=estimate)


def _refute(folder: Path, declared: Config, found: Config, whole: Identification, read: Collection[Path]) -> None:
    """Move what was found to the candidate's files, and leave config and map as they were declared, to the byte."""
    for declared_map in folder.glob("declared.*"):
        own = folder / f"explained{declared_map.suffix}"
        found = with_map(found, path=Path(own.rename(folder / f"candidate{own.suffix}").name))
        own.write_bytes(declared_map.read_bytes())
    _write_config(folder / "candidate.yaml", found, whole.verdict.word, whole.lines)
    texts = [path.read_bytes() for path in read if path.is_file()]
    (folder / "explained.yaml").write_bytes(texts[0] if texts else declared.as_yaml().encode())


def _write_config(path: Path, config: Config, word: str, lines: Sequence[str]) -> None:
    head = [f"driftlab {__version__} explain: {word}", *lines]
    releases = (f"{p['kind']} ({p['distribution']} {p['version']})" for p in participants(config))
    head.append(f"plugins: {', '.join(releases)}")
    head.append("coefficients and sigma of effects are in SI units")
    path.write_text("\n".join(map(comment, head)) + "\n" + config.as_yaml(), encoding="utf-8")


def _judged(config: Config, measured: Sequence[dict[str, Measured]]) -> list[LimitResult]:
    """Hold the worst holdout, and the map, against the limits of the config."""
    if config.limits is None:
        return []
    worst = max(measured, key=lambda one: float(np.max(one["coast"].values)))
    fitted = map_of(config)
    return check_limits(
        config.limits, worst if fitted is None else {**worst, **of_map(fitted, tracked_unit(config.filter))}
    )


def _sheet(config: Config, whole: Identification, limits: Sequence[LimitResult]) -> Sheet:
    """Return what the page stands on: recordings with what each is for, maps by the names that they have beside it."""
    sheet = sheet_of(config, [], judged=limits, plugins=whole.content["plugins"])
    roles = whole.content["recordings"].items()
    recordings = [{**one, "name": f"{one['name']} ({role})"} for role, found in roles for one in found]
    maps = [{**one, "file": Path(one["file"]).name} for one in sheet.maps]
    return replace(sheet, recordings=recordings, maps=maps)


def _write(folder: Path, whole: Identification, sheet: Sheet, progress: Progress) -> None:
    """Write what programs read, and the report; `explained.yaml` is there already."""
    from driftlab.reports.explain import write_report

    write_prediction(folder / "prediction.h5", whole.outcomes)
    write_json(folder / "loop.json", whole.content)
    progress("drawing the report")
    write_report(folder / "report.html", whole, (folder / "explained.yaml").read_text(encoding="utf-8"), sheet)
