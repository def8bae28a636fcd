"""The report of the loop: for people as tables on the terminal and as one HTML file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.summary import error_table
from driftlab.loop.gates import CHANCE, FAST, SLOW
from driftlab.loop.predicted import to_show
from driftlab.loop.record import figures as errors_of
from driftlab.loop.record import parameters
from driftlab.loop.state import Trial, name_of
from driftlab.loop.words import described, size
from driftlab.reports.charts import Chart
from driftlab.reports.loop_charts import left_out_chart, loop_chart, prediction_chart
from driftlab.reports.pages import write_page
from driftlab.units import RATE, BiasUnit

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.loop.closed import Closed
    from driftlab.loop.outcome import Outcome
    from driftlab.loop.verdict import Verdict
    from driftlab.reports.sheet import Sheet
    from fusion_core.chunk import Array
    from fusion_core.contracts import Effect

MOST = 1.5  # ratio of errors up to which a bar is drawn
OUTCOME = {"explained": "pass", "nothing_missing": "pass", "unexplained": "unknown", "ambiguous": "unknown",
           "refuted": "fail"}  # fmt: skip
WORSE = "But the error on the test recording grows, though by no more than chance may do: record another before use."
MEANING = {
    "explained": "What the declared model lacks has been found and added.",
    "nothing_missing": "Nothing significant is missing: the config is returned unchanged.",
    "unexplained": "Something significant is left that no installed effect explains.",
    "refuted": "What was found predicts the test recording worse than the declared model: that stays as it is, "
    "and candidate.yaml has what was found.",
    "ambiguous": "These recordings cannot tell some explanations apart.",
}


def tables(closed: Closed) -> list[Table]:
    """Return the table of each holdout recording: the coast's error before and after."""
    evidence = closed.search.columns.evidence
    titles = [f"holdout {Path(o.name).name}" for o in closed.outcomes]
    return [
        error_table(title, ["before", "after"], _rows(o), evidence.axes, evidence.unit)
        for title, o in zip(titles, closed.outcomes, strict=True)
    ]


def _rows(outcome: Outcome) -> list[tuple[str, list[Array]]]:
    """Return the rows of a holdout's table, the decisive one first: a label, and the errors before and after (d,)."""
    before, after = outcome.summaries
    found = []
    for name in reversed(errors_of(before, "coast_rmse")):
        for label, key in ((f"coast, {name}", "coast_rmse"), ("  its sigma", "coast_sigma")):
            found.append((label, [np.asarray(errors_of(s, key)[name], dtype=float) for s in (before, after)]))
    whole = [np.asarray(errors_of(s, "filter_rmse")["whole"], dtype=float) for s in (before, after)]
    return [*found, ("filter, all", whole)]


@dataclass(frozen=True)
class Holdout:
    """What the page shows of one holdout recording."""

    name: str
    decisive: str
    rows: list[tuple[str, list[str], list[str], str]]
    prediction: Chart
    loop: Chart | None


def write_report(path: Path, closed: Closed, config: str, sheet: Sheet) -> None:
    """Write `report.html`; `config` is the text of the new one."""
    verdict, evidence = closed.verdict, closed.search.columns.evidence
    axes, unit = evidence.axes, evidence.unit
    worse = closed.worse and not closed.refuted
    write_page(
        path,
        "explain",
        word=verdict.word.replace("_", " "),
        outcome="unknown" if worse else OUTCOME[verdict.word],
        meaning=f"{MEANING[verdict.word]} {WORSE if worse else ''}".strip(),
        lines=closed.lines,
        axes=axes,
        unit=unit.shown,
        channel=evidence.channel,
        known="Earth rate" if unit == RATE else "its known input",
        effects=[_effect(finding.effect, size(closed.search, finding, closed.fit)) for finding in verdict.findings],
        holdouts=[_holdout(o, axes) for o in closed.outcomes],
        taught=[
            (Path(name).name, left_out_chart(parts, axes, unit)) for name, parts in to_show(closed.left_out).items()
        ],
        bars=bars(verdict),
        needed=[(text, 100 * float(np.sqrt(ratio)) / MOST) for text, ratio in NEEDED],
        rejected=[_rejected(trial) for trial in verdict.rejected],
        left=verdict.left,
        experiments=verdict.experiments,
        tried=closed.search.tried,
        sheet=sheet,
        config=config,
    )


def _holdout(outcome: Outcome, axes: Sequence[str]) -> Holdout:
    loop = None if outcome.temperature is None else loop_chart(outcome, axes)
    return Holdout(Path(outcome.name).name, _decisive(outcome), _cells(outcome), prediction_chart(outcome, axes), loop)


def _sizes(outcome: Outcome) -> list[float]:
    """Return the norm of the errors to the end, before and after, as they are shown."""
    _, (before, after) = _rows(outcome)[0]
    return [float(np.linalg.norm(values)) * outcome.unit.factor for values in (before, after)]


def _change(outcome: Outcome) -> float:
    """Return by how many percent the error of the prediction to the end changes; NaN where that is not known."""
    before, after = _sizes(outcome)
    return 100 * (after / before - 1) if before > 0 else float("nan")


def _decisive(outcome: Outcome) -> str:
    """Return in a sentence what the change does to the prediction."""
    size, change = _sizes(outcome), _change(outcome)
    if not np.isfinite(change):
        return "the error to the end of the coast is not known"
    how = "stays as it is" if abs(change) < 0.5 else f"{'falls' if change < 0 else 'grows'} by {abs(change):.0f} %"
    many = ", norm of the axes" if outcome.before.shape[1] > 1 else ""
    numbers = " to ".join(f"{value:.3g}" for value in size)
    return f"the error of the prediction to the end {how}: {numbers} {outcome.unit.shown} rms{many}"


@dataclass(frozen=True)
class Bar:
    """An effect: by how much the error on left-out recordings changes with it, and whether it was added."""

    name: str
    added: bool
    change: str
    width: float  # of the bar, %
    beyond: bool


NEEDED = (("enough where it is seen at fast times too", FAST), ("enough at slow times alone", SLOW))


def bars(verdict: Verdict) -> list[Bar]:
    """Return every effect that was tried, what was added first, then by what it gains."""
    added = [(finding.effect, finding.trial, True) for finding in verdict.findings]
    others = sorted(verdict.rejected, key=lambda trial: trial.evidence.ratio)
    found = []
    for effect, trial, kept in [*added, *((trial.term.effect, trial, False) for trial in others)]:
        ratio = float(np.sqrt(trial.evidence.ratio))
        found.append(Bar(name_of(effect), kept, _percent(ratio), 100 * min(ratio, MOST) / MOST, ratio > MOST))
    return found


def _percent(ratio: float) -> str:
    change = f"{100 * (ratio - 1):+.0f}"
    return "0 %" if change in ("+0", "-0") else f"{change} %"


def _rejected(trial: Trial) -> tuple[str, str, str, str, str]:
    e = trial.evidence
    return (
        described(trial.term.effect),
        _percent(float(np.sqrt(e.ratio))).removesuffix(" %"),
        f"{e.chance:.1f}",
        f"{e.price + CHANCE:.1f}",
        trial.reason or "passes, and what was added passes better",
    )


def _effect(effect: Effect, size: str) -> tuple[str, str, str]:
    given = ", ".join([*(f"{name} {text}" for name, text in parameters(effect).items()), size])
    return name_of(effect), given, effect.explanation


def _cells(outcome: Outcome) -> list[tuple[str, list[str], list[str], str]]:
    """Return a label, the errors before and after as they are shown, and the change of their norm."""
    cells = []
    for label, (before, after) in _rows(outcome):
        change = np.linalg.norm(after) / np.linalg.norm(before) - 1
        text = f"{100 * change:+.0f}" if np.isfinite(change) else "–"
        text = "" if label.startswith(" ") else text
        cells.append((label, _numbers(before, outcome.unit), _numbers(after, outcome.unit), text))
    return cells


def _numbers(values: Array, unit: BiasUnit) -> list[str]:
    return [f"{value * unit.factor:{unit.digits}}" if np.isfinite(value) else "–" for value in values]
