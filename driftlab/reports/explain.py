"""The report of the loop: tables for the terminal, and one HTML file.

Charts are drawn from at most a few thousand points, however long the recordings. N times, n of them drawn, d axes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from driftlab.evaluation.overview import thin
from driftlab.evaluation.summary import Rows, error_rows
from driftlab.identification.acceptance import CHANCE, FAST, SLOW
from driftlab.identification.diagnosis import Diagnosis
from driftlab.identification.result import Identification, Outcome, described, parameters, size
from driftlab.identification.state import LeftOut, name_of, to_show
from driftlab.reports import charts
from driftlab.reports.charts import Chart, Clock, Line, Panel
from driftlab.reports.pages import write_page
from driftlab.reports.provenance import Sheet
from driftlab.reports.run import event_shades
from driftlab.reports.tables import error_table
from driftlab.units import RATE, BiasUnit, formatted
from fusion_core.chunk import Array, Integers

if TYPE_CHECKING:
    from rich.table import Table

MAX_RATIO = 1.5  # ratio of errors up to which a bar is drawn
OUTCOME = {"explained": "pass", "nothing_missing": "pass", "unexplained": "unknown", "ambiguous": "unknown",
           "refuted": "fail"}  # fmt: skip
WORSE = "But the error on the test recording grows, though by no more than chance may do: record another before use."
MEANING = {
    "explained": "Effects that the declared model lacks are added.",
    "nothing_missing": "Nothing significant is missing: the config is returned unchanged.",
    "unexplained": "Something significant is left that no installed effect explains well enough, or the test "
    "recordings do not confirm the result.",
    "refuted": "The identified effects predict the test recording worse than the declared model: that stays as it "
    "is, and candidate.yaml has them.",
    "ambiguous": "These recordings cannot tell some explanations apart.",
}


USE = {
    "explained": "run with explained.yaml in place of the declared config.",
    "nothing_missing": "keep the declared config.",
    "unexplained": "explained.yaml is the best that is known; its sigma does not cover what is left.",
    "refuted": "keep the declared config; candidate.yaml is for study.",
    "ambiguous": "explained.yaml predicts as recorded; make the recording that is proposed before relying on a name.",
}


def tables(closed: Identification) -> list[Table]:
    """Return the table of each holdout recording: the prediction's error before and after."""
    evidence = closed.search.columns.evidence
    sides = ["before", "after"] if closed.anything else ["declared"]  # where nothing was added both are the same
    return [
        error_table(f"test recording {Path(o.name).name}", sides, evidence.unit, (evidence.axes, _rows(o, len(sides))))
        for o in closed.outcomes
    ]


def _rows(outcome: Outcome, sides: int = 2) -> Rows:
    """Return the rows of a holdout's table, the decisive one first: a label, and the errors before and after (d,)."""
    return error_rows([run.yardsticks for run in outcome.runs[:sides]])


def write_report(path: Path, closed: Identification, config: str, sheet: Sheet) -> None:
    """Write `report.html`; `config` is the text of the new one."""
    verdict, evidence = closed.verdict, closed.search.columns.evidence
    axes, unit = evidence.axes, evidence.unit
    worse = closed.worse and not closed.refuted
    left_out = to_show(closed.left_out).items()
    write_page(
        path,
        "explain",
        closed=closed,
        word=verdict.word.replace("_", " "),
        outcome="unknown" if worse else OUTCOME[verdict.word],
        use="keep the declared config until another recording is predicted better." if worse else USE[verdict.word],
        changed=closed.anything,
        meaning=f"{MEANING[verdict.word]} {WORSE if worse else ''}".strip(),
        unit=unit.shown,
        known="Earth rate" if unit == RATE else "its known input",
        effects=[(finding.effect, size(closed.fit, finding, evidence)) for finding in verdict.findings],
        parameters=parameters,
        name_of=name_of,
        holdouts=[(Path(outcome.name).name, outcome) for outcome in closed.outcomes],
        decisive=_decisive,
        cells=_cells,
        prediction_chart=prediction_chart,
        loop_chart=loop_chart,
        taught=[(Path(name).name, left_out_chart(parts, axes, unit)) for name, parts in left_out if closed.anything],
        bars=bars(verdict),
        needed=[(text, 100 * float(np.sqrt(ratio)) / MAX_RATIO) for text, ratio in NEEDED],
        rejected=[(trial, _percent(float(np.sqrt(trial.evidence.ratio)))) for trial in verdict.rejected],
        described=described,
        chance=CHANCE,
        sheet=sheet,
        config=config,
    )


def _decisive(outcome: Outcome) -> str:
    """Return in a sentence what the change does to the prediction: the norm of its errors to the end."""
    before, after = (float(np.linalg.norm(values)) * outcome.unit.factor for values in _rows(outcome)[0][1])
    change = 100 * (after / before - 1) if before > 0 else float("nan")
    if not np.isfinite(change):
        return "the error of the prediction to the end is not known"
    how = "stays as it is" if abs(change) < 0.5 else f"{'falls' if change < 0 else 'grows'} by {abs(change):.0f} %"
    many = ", norm of the axes" if outcome.before.shape[1] > 1 else ""
    sizes = f"{before:.3g} to {after:.3g} {outcome.unit.shown}"
    return f"the error of the prediction to the end {how}: {sizes} rms{many}"


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
    result = []
    for effect, trial, accepted in [*added, *((trial.term.effect, trial, False) for trial in others)]:
        ratio = float(np.sqrt(trial.evidence.ratio))
        width = 100 * min(ratio, MAX_RATIO) / MAX_RATIO
        result.append(EffectBar(name_of(effect), accepted, f"{_percent(ratio)} %", width, ratio > MAX_RATIO))
    return result


def _percent(ratio: float) -> str:
    change = f"{100 * (ratio - 1):+.0f}"
    return "0" if change in ("+0", "-0") else change


def _cells(outcome: Outcome) -> list[tuple[str, list[str], list[str], str]]:
    """Return a label, the errors before and after as they are shown, and the change of their norm."""
    cells = []
    for label, errors in _rows(outcome):
        before, after = ([outcome.unit.number(value, "–") for value in values] for values in errors)
        change = float(100 * (np.linalg.norm(errors[1]) / np.linalg.norm(errors[0]) - 1))
        cells.append((label, before, after, "" if label.startswith(" ") else formatted(change, "+.0f")))
    return cells


BEFORE, AFTER = "series:1", "series:0"
STRETCHES = 600  # of an error, whose smallest and largest value are drawn


def prediction_chart(outcome: Outcome, axes: Sequence[str], changed: bool = True) -> Chart:
    """Return the measured and the predicted bias of each axis, before and after, the errors below, and temperature."""
    rows, factor, unit = thin(len(outcome.t)), outcome.unit.factor, outcome.unit.shown
    before, after = outcome.runs
    clock = Clock(before.overview.first_row, float(outcome.t[-1]))
    t, shades = clock(outcome.t), event_shades(after.journal, clock, "refused, after" if changed else "refused")
    sides = _sides(outcome, changed)

    def biases(k: int) -> Iterator[Line]:
        yield Line(t[rows], outcome.reference[rows, k] * factor, "measured", "reference")
        for name, values, sigma, role in sides:
            yield charts.band(t[rows], values[rows, k] * factor, 2 * sigma[rows, k] * factor, f"{name}, ± 2σ", role)

    def errors(k: int) -> Iterator[Line]:
        for name, _, sigma, role in sides:
            yield charts.band_alone(t[rows], 2 * sigma[rows, k] * factor, f"{name}, ± 2σ", role)
        for name, values, _, role in sides:
            yield _extreme_line(t, (values - outcome.reference)[:, k] * factor, f"{name}, ± 2σ", role)

    above = charts.axis_panels(axes, biases, "bias", unit, legibly=True, shades=shades, height=1.2)
    below = charts.axis_panels(axes, errors, "error", unit, legibly=True, shades=shades)
    panels = [panel for pair in zip(above, below, strict=True) for panel in pair]
    if outcome.temperature is not None:
        panels.append(charts.temperature_panel(t[rows], outcome.temperature[rows], shades, height=0.7))
    return Chart(tuple(panels), clock.label, f"Measured and predicted{', before and after' if changed else ''}")


def _sides(outcome: Outcome, changed: bool = True) -> list[tuple[str, Array, Array, str]]:
    """Return the predictions that are drawn: both, or the declared model's alone where nothing was added."""
    if not changed:
        return [("declared", outcome.before, outcome.before_sigma, AFTER)]
    before = ("before", outcome.before, outcome.before_sigma, BEFORE)
    return [before, ("after", outcome.after, outcome.after_sigma, AFTER)]


def _extreme_line(t: Array, values: Array, name: str, role: str) -> Line:
    """Return a line through the smallest and the largest value of each stretch: no spike is left out."""
    rows: Integers = np.arange(len(values))
    if len(values) > 2 * STRETCHES:
        filled: Array = np.where(np.isfinite(values), values, 0.0)
        parts = np.linspace(0, len(values), STRETCHES + 1).astype(int)
        extremes = [start + f(filled[start:stop]) for start, stop in pairwise(parts) for f in (np.argmin, np.argmax)]
        rows = np.unique(np.array(extremes, dtype=np.int64))
    return Line(t[rows], values[rows], name, role)


def loop_chart(outcome: Outcome, axes: Sequence[str], changed: bool = True) -> Chart:
    """Return the error over temperature, before and after in one scale, warming up and cooling down apart."""
    assert outcome.temperature is not None
    rows = thin(len(outcome.t))
    t, T = outcome.t[rows], outcome.temperature[rows]
    warming = np.gradient(T, t) >= 0 if len(t) > 1 else np.ones(len(t), dtype=bool)
    panels, sides = [], _sides(outcome, changed)
    for k, axis in enumerate(axes):
        errors = [(values - outcome.reference)[rows, k] * outcome.unit.factor for _, values, *_ in sides]
        span = charts.legible(Line(T, error, "") for error in errors)
        for (name, *_), error in zip(sides, errors, strict=True):
            lines = []
            for text, role, way in (("warming up", "warming", warming), ("cooling down", "cooling", ~warming)):
                order = np.flatnonzero(way)[np.argsort(T[way], kind="stable")]
                lines.append(Line(T[order], error[order], text, role, style="points"))
            panels.append(Panel(tuple(lines), f"error {axis} {name} [{outcome.unit.shown}]", span=span))
    caption = "A loop between warming up and cooling down is hysteresis or lag; a curve that both follow is the map's."
    return Chart(tuple(panels), "temperature [°C]", "Error over temperature", caption)


def left_out_chart(parts: Sequence[LeftOut], axes: Sequence[str], shown: BiasUnit) -> Chart:
    """Return the errors of the parts left out of one recording, of the declared model and of the final one."""
    ends = np.array([end for part in parts for end in (part.t[0], part.t[-1])])
    clock = Clock(float(ends.min()), float(ends.max()))

    def lines(k: int) -> Iterator[Line]:
        for part in parts:
            yield _extreme_line(clock(part.t), part.before[:, k] * shown.factor, "before", BEFORE)
            yield _extreme_line(clock(part.t), part.after[:, k] * shown.factor, "after", AFTER)

    panels = charts.axis_panels(axes, lines, "error", shown.shown)
    return Chart(panels, f"time [{clock.unit}]", f"Left out of {parts[0].name}")
