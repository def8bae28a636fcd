"""`driftlab explain`: the whole loop, from recordings and a declared model to files."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.config import Config, load_config, paths_of
from driftlab.files.estimates import write_json
from driftlab.files.folders import output_folder
from driftlab.judging.summary import remarks
from driftlab.loop.declared import calibrated, clamped, declared_effects, the_map, with_map
from driftlab.loop.evidence import Evidence, Progress, gather
from driftlab.loop.explained import Joint, explained_config, explained_map, joint
from driftlab.loop.outcome import Outcome, outcome_of, write_prediction
from driftlab.loop.predicted import LeftOut, check_length, left_out, rms
from driftlab.loop.record import as_json
from driftlab.loop.recordings import distinct, identity, once
from driftlab.loop.search import search
from driftlab.loop.state import Search
from driftlab.loop.verdict import Verdict, judge
from driftlab.loop.words import summary
from driftlab.maps.fit import fit_map
from fusion_core.contracts import Basis, FittedMap, ThermalMap
from fusion_core.faults import Faults


@dataclass(frozen=True)
class Closed:
    """What `explain` leaves: the content of its files."""

    search: Search
    verdict: Verdict
    left_out: tuple[LeftOut, ...]
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
        The declared model; the map that it names, if it does, is fitted on the calibration.
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
    distinct(calibration, train, holdout)
    recordings = {"calibration": calibration, "train": train, "holdout": holdout}
    calibration, train = once(calibration, train)
    used = [*read, *config.files(), *paths_of((*calibration, *train, *holdout))]
    # the matrices are small: fits side by side are faster than divided matrices
    with output_folder(out, "explain", used) as folder, threadpool_limits(1):
        declared, fitted = _declared(config, settings, calibration, folder, progress)
        evidence = gather(calibrated(declared), calibration, train, progress)
        check_length(evidence)
        found = search(evidence, _basis(settings, evidence), progress, declared_effects(config))
        parts = left_out(found)
        verdict = judge(found, rms(parts)[1], progress)
        fit = joint(found)
        new = _explained(config, found, fit, fitted, settings, [*calibration, *train], folder, estimate)
        lines = tuple(summary(found, verdict))
        _write_config(folder / "explained.yaml", new, verdict.word, lines)
        progress("opening the holdout")
        # a holdout that leaves the map's domain is judged all the same, and not refused after all the work
        both = [clamped(c) for c in (declared, load_config(folder / "explained.yaml"))]
        outcomes = tuple(outcome_of(both[0], both[1], recording, progress) for recording in holdout)
        lines += tuple(f"{o.name}: {remark}" for o in outcomes for remark in remarks(o.summaries[1]))
        write_prediction(folder / "prediction.h5", outcomes)
        named = {role: [identity(name) for name in names] for role, names in recordings.items()}
        content = as_json(found, verdict, fit, parts, named, [o.summaries for o in outcomes])
        write_json(folder / "loop.json", content)
        closed = Closed(found, verdict, parts, outcomes, lines, content)
        progress("drawing the report")
        from driftlab.reports.loop import write_report

        write_report(folder / "report.html", closed, (folder / "explained.yaml").read_text(encoding="utf-8"))
    return closed


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


def _basis(settings: ThermalMap | None, evidence: Evidence) -> Basis | None:
    if settings is None:
        return None
    T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
    return settings.basis((float(T.min()), float(T.max())))


def _explained(
    config: Config,
    found: Search,
    fit: Joint,
    fitted: FittedMap | None,
    settings: ThermalMap | None,
    names: list[str],
    folder: Path,
    estimate: bool,
) -> Config:
    """Write the new map, and return the new config; where nothing was added, those that were declared."""
    path = None if settings is None else Path(f"explained{settings.suffix}")
    if found.model == found.declared:
        if fitted is None or path is None:
            return config
        fitted.save(folder / path)
        return with_map(config, path=path)
    if settings is not None and fitted is not None and path is not None:
        explained_map(found, fit, fitted, settings, names).save(folder / path)
    return explained_config(config, fit, path, estimate=estimate)


def _write_config(path: Path, config: Config, word: str, lines: Sequence[str]) -> None:
    head = [f"# driftlab {__version__} explain: {word}", *(f"# {line}" for line in lines)]
    head.append("# coefficients and sigma of effects are in SI units")
    path.write_text("\n".join(head) + "\n" + config.as_yaml(), encoding="utf-8")
