"""The report of the loop: for people as tables on the terminal and as one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.summary import error_table
from driftlab.loop.gates import CHANCE
from driftlab.loop.predicted import to_show
from driftlab.loop.record import figures as errors_of
from driftlab.loop.record import parameters
from driftlab.loop.state import Trial, name_of
from driftlab.loop.words import described
from driftlab.reports.loop_plots import bias_figure, error_figure, left_out_figure, loop_figure, ratio_figure
from driftlab.reports.pages import drawing, write_page
from driftlab.reports.plots import svg
from driftlab.units import RATE, BiasUnit

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.loop.closed import Closed
    from driftlab.loop.outcome import Outcome
    from fusion_core.chunk import Array
    from fusion_core.contracts import Effect

MEANING = {
    "explained": "What the declared model lacks has been found and added.",
    "nothing_missing": "Nothing significant is missing: the config is returned unchanged.",
    "unexplained": "Something significant is left that no installed effect explains.",
    "ambiguous": "These recordings cannot tell some explanations apart.",
}


def tables(closed: Closed) -> list[Table]:
    """Return the table of each holdout recording: the coast's error before and after."""
    evidence = closed.search.columns.evidence
    titles = [f"holdout {Path(o.name).name}, predicted from the alignment on" for o in closed.outcomes]
    return [
        error_table(title, ["before", "after"], _rows(o), evidence.axes, evidence.unit)
        for title, o in zip(titles, closed.outcomes, strict=True)
    ]


def _rows(outcome: Outcome) -> list[tuple[str, list[Array]]]:
    before, after = outcome.summaries
    found = []
    for name in errors_of(before, "coast_rmse"):
        for label, key in ((f"coast, {name}", "coast_rmse"), ("  its sigma", "coast_sigma")):
            found.append((label, [np.asarray(errors_of(s, key)[name], dtype=float) for s in (before, after)]))
    whole = [np.asarray(errors_of(s, "filter_rmse")["whole"], dtype=float) for s in (before, after)]
    return [*found, ("filter, all", whole)]


def write_report(path: Path, closed: Closed, config: str) -> None:
    """Write `report.html`; `config` is the text of the new one."""
    verdict, outcomes, evidence = closed.verdict, closed.outcomes, closed.search.columns.evidence
    axes, unit = evidence.axes, evidence.unit
    drawings = [_drawings(o, axes) for o in outcomes]
    taught = [
        (Path(name).name, drawing(svg(left_out_figure(parts, axes, unit))))
        for name, parts in to_show(closed.left_out).items()
    ]
    write_page(
        path,
        "explain",
        word=verdict.word.replace("_", " "),
        meaning=MEANING[verdict.word],
        lines=closed.lines,
        axes=axes,
        unit=unit.shown,
        channel=evidence.channel,
        known="Earth rate" if unit == RATE else "its known input",
        effects=[_effect(finding.effect) for finding in verdict.findings],
        errors=[(Path(o.name).name, _cells(o)) for o in outcomes],
        drawings=drawings,
        taught=taught,
        ratios_svg=drawing(svg(ratio_figure(verdict))),
        rejected=[_rejected(trial) for trial in verdict.rejected],
        left=verdict.left,
        experiments=verdict.experiments,
        tried=closed.search.tried,
        recordings=[
            (role, r["name"], f"{r['bytes']:,}", r["sha256"])
            for role, rs in closed.content["recordings"].items()
            for r in rs
        ],
        config=config,
    )


def _drawings(outcome: Outcome, axes: Sequence[str]) -> tuple[str, str, str, str]:
    """Return the name of a holdout recording and its figures: bias, error, and error over temperature."""
    return (
        Path(outcome.name).name,
        drawing(svg(bias_figure(outcome, axes))),
        drawing(svg(error_figure(outcome, axes))),
        "" if outcome.temperature is None else drawing(svg(loop_figure(outcome, axes))),
    )


def _rejected(trial: Trial) -> tuple[str, str, str, str, str]:
    e = trial.evidence
    return (
        described(trial.term.effect),
        f"{100 * (float(np.sqrt(e.ratio)) - 1):+.0f} %",
        f"{e.chance:.1f}",
        f"{e.price + CHANCE:.1f}",
        trial.reason or "passes, and what was added passes better",
    )


def _effect(effect: Effect) -> tuple[str, str, str]:
    given = ", ".join(f"{name} {text}" for name, text in parameters(effect).items())
    return name_of(effect), given, effect.explanation


def _cells(outcome: Outcome) -> list[tuple[str, list[str], list[str], str]]:
    """Return a label, the errors before and after as they are shown, and the change of their norm."""
    cells = []
    for label, (before, after) in _rows(outcome):
        change = np.linalg.norm(after) / np.linalg.norm(before) - 1
        text = f"{100 * change:+.0f} %" if np.isfinite(change) else "–"
        cells.append((label, _numbers(before, outcome.unit), _numbers(after, outcome.unit), text))
    return cells


def _numbers(values: Array, unit: BiasUnit) -> list[str]:
    return [f"{value * unit.factor:{unit.digits}}" if np.isfinite(value) else "–" for value in values]
