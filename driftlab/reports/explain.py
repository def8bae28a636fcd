"""The report of the loop: for people as tables on the terminal and as one HTML file.

The figures of the loop, each said once; drawn from at most a few thousand points, however long the recordings.

N times, n of them drawn, d axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.evaluation.overview import thin
from driftlab.evaluation.summary import error_table
from driftlab.identification.acceptance import CHANCE, FAST, SLOW
from driftlab.identification.prediction_errors import to_show
from driftlab.identification.result import described, parameters, size
from driftlab.identification.result import figures as errors_of
from driftlab.identification.state import Trial, name_of
from driftlab.reports.charts import Chart, Line, Panel, clock, legible, marked
from driftlab.reports.pages import write_page
from driftlab.units import RATE, BiasUnit

if TYPE_CHECKING:
    from rich.table import Table

    from driftlab.identification.diagnosis import Diagnosis
    from driftlab.identification.prediction_errors import LeftOut
    from driftlab.identification.result import Identification, Outcome
    from driftlab.reports.provenance import Sheet
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


def tables(closed: Identification) -> list[Table]:
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


def write_report(path: Path, closed: Identification, config: str, sheet: Sheet) -> None:
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
class EffectBar:
    """An effect: by how much the error on left-out recordings changes with it, and whether it was added."""

    name: str
    added: bool
    change: str
    width: float  # of the bar, %
    beyond: bool


NEEDED = (("enough where it is seen at fast times too", FAST), ("enough at slow times alone", SLOW))


def bars(verdict: Diagnosis) -> list[EffectBar]:
    """Return every effect that was tried, what was added first, then by what it gains."""
    added = [(finding.effect, finding.trial, True) for finding in verdict.findings]
    others = sorted(verdict.rejected, key=lambda trial: trial.evidence.ratio)
    found = []
    for effect, trial, kept in [*added, *((trial.term.effect, trial, False) for trial in others)]:
        ratio = float(np.sqrt(trial.evidence.ratio))
        found.append(EffectBar(name_of(effect), kept, _percent(ratio), 100 * min(ratio, MOST) / MOST, ratio > MOST))
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


BEFORE, AFTER = "series:1", "series:0"
STRETCHES = 600  # of an error, whose smallest and largest value are drawn


def prediction_chart(outcome: Outcome, axes: Sequence[str]) -> Chart:
    """Return what was measured and predicted of each axis, before and after, the errors below, and temperature."""
    rows = thin(len(outcome.t))
    at, unit = clock(outcome.summaries[0]["t"]["first_row_s"], float(outcome.t[-1]))
    t, shades = at(outcome.t), marked(outcome.summaries[1], at, "refused, after")
    panels = []
    for k, axis in enumerate(axes):
        lines = tuple(_bias(outcome, t, rows, k))
        panels.append(Panel(lines, f"bias {axis} [{outcome.unit.shown}]", shades, height=1.2, span=legible(lines)))
        lines = tuple(_errors(outcome, t, rows, k))
        panels.append(Panel(lines, f"error {axis} [{outcome.unit.shown}]", shades, span=legible(lines)))
    if outcome.temperature is not None:
        line = Line(t[rows], outcome.temperature[rows], "temperature", "temperature")
        panels.append(Panel((line,), "temperature [°C]", shades, height=0.7))
    return Chart(tuple(panels), f"time from the first row [{unit}]", "Measured and predicted, before and after")


def _sides(outcome: Outcome) -> Iterator[tuple[str, Array, Array, str]]:
    yield "before", outcome.before, outcome.before_sigma, BEFORE
    yield "after", outcome.after, outcome.after_sigma, AFTER


def _bias(outcome: Outcome, t: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    yield Line(t[rows], outcome.reference[rows, axis] * factor, "measured", "reference")
    for name, values, sigma, role in _sides(outcome):
        middle, reach = values[rows, axis] * factor, 2 * sigma[rows, axis] * factor
        yield Line(t[rows], middle, f"{name}, ± 2σ", role, middle - reach, middle + reach)


def _errors(outcome: Outcome, t: Array, rows: Array, axis: int) -> Iterator[Line]:
    factor = outcome.unit.factor
    for name, _, sigma, role in _sides(outcome):
        reach = 2 * sigma[rows, axis] * factor
        yield Line(t[rows], None, f"{name}, ± 2σ", role, -reach, reach)
    for name, values, _, role in _sides(outcome):
        error = (values - outcome.reference)[:, axis] * factor
        own = _extremes(error)
        yield Line(t[own], error[own], f"{name}, ± 2σ", role)


def _extremes(values: Array) -> NDArray[np.int64]:
    """Return the rows of the smallest and the largest value of each stretch: no spike is left out."""
    if len(values) <= 2 * STRETCHES:
        return np.arange(len(values))
    filled: Array = np.where(np.isfinite(values), values, 0.0)
    parts = np.linspace(0, len(values), STRETCHES + 1).astype(int)
    found = [start + f(filled[start:stop]) for start, stop in pairwise(parts) for f in (np.argmin, np.argmax)]
    return np.unique(np.array(found, dtype=np.int64))


def loop_chart(outcome: Outcome, axes: Sequence[str]) -> Chart:
    """Return the error over temperature, before and after in one scale, warming up and cooling down apart."""
    assert outcome.temperature is not None
    rows = thin(len(outcome.t))
    t, T = outcome.t[rows], outcome.temperature[rows]
    warming = np.gradient(T, t) >= 0 if len(t) > 1 else np.ones(len(t), dtype=bool)
    panels = []
    for k, axis in enumerate(axes):
        errors = [(values - outcome.reference)[rows, k] * outcome.unit.factor for _, values, *_ in _sides(outcome)]
        for name, error in zip(("before", "after"), errors, strict=True):
            lines = []
            for text, role, own in (("warming up", "warming", warming), ("cooling down", "cooling", ~warming)):
                order = np.flatnonzero(own)[np.argsort(T[own], kind="stable")]
                lines.append(Line(T[order], error[order], text, role, style="points"))
            both = tuple(Line(T, one, "") for one in errors)
            panels.append(Panel(tuple(lines), f"error {axis} {name} [{outcome.unit.shown}]", span=legible(both)))
    caption = "A loop between warming up and cooling down is hysteresis or lag; a curve that both follow is the map's."
    return Chart(tuple(panels), "temperature [°C]", "Error over temperature", caption)


def left_out_chart(parts: Sequence[LeftOut], axes: Sequence[str], shown: BiasUnit) -> Chart:
    """Return the errors of what was left out of one recording, of the declared model and of the final one."""
    ends = np.array([end for part in parts for end in (part.t[0], part.t[-1])])
    at, unit = clock(float(ends.min()), float(ends.max()))
    panels = []
    for k, axis in enumerate(axes):
        lines = []
        for part in parts:
            for name, values, role in (("before", part.before, BEFORE), ("after", part.after, AFTER)):
                error = values[:, k] * shown.factor
                rows = _extremes(error)
                lines.append(Line(at(part.t[rows]), error[rows], name, role))
        panels.append(Panel(tuple(lines), f"error {axis} [{shown.shown}]"))
    return Chart(tuple(panels), f"time [{unit}]", f"Left out of {parts[0].name}")
