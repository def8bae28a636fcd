"""The limits of a config, held against what was measured and its uncertainty: pass, fail or undecided.

The decision rule is that of ISO 14253-1 and of ILAC-G8:09/2019 (4.2.2, guarded acceptance and guarded rejection): what
was measured passes where value plus guard is within the limit, fails where value less guard is beyond it, and is
undecided between. The guard is the expanded uncertainty of one side, 95 %: of units that are beyond a limit at most 5 %
pass, of those within it at most 5 % an axis fail. A limit passes where every axis does and fails where one does.

Guards fall as 1 / sqrt(time), so what is undecided says how much more time would decide it, if the value stays.

d axes; all values in SI.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from driftlab.config import Limits
from driftlab.units import BiasUnit, with_uncertainty
from fusion_core.chunk import Array
from fusion_core.faults import in_doubt

Decision = Literal["pass", "fail", "undecided"]
RISK = 0.05  # of the units beyond a limit, that may pass
SIDE = 1.645  # standard deviations of a guard: so much of a normal law is above all but RISK of it
MAX_TIMES = 100.0  # times the time that was measured: more is no advice
RULE = (
    "Decided by ISO 14253-1 and ILAC-G8:09/2019: pass where value plus guard is within the limit, fail where value "
    "less guard is beyond it, else undecided. The guard is the expanded uncertainty of one side, "
    f"{100 * (1 - RISK):.0f} %: at most {100 * RISK:.0f} % of the units that are beyond a limit pass."
)
EXIT = {"pass": 0, "fail": 1, "undecided": 3, "unknown": 3}  # with --enforce-limits, by the outcome
VERDICTS = ("fail", "not measured", "undecided", "pass")  # the first of these among a unit's rows is the unit's
NAMES = {
    "bias_instability": "bias instability",
    "residual": "residual of the map",
    "coast": "prediction over 10 min (rms)",
    "swing": "swing of the map",
    "noise": "white noise",
    "hysteresis": "hysteresis",
    "scale": "error of the scale factor",
    "misalignment": "misalignment",
}
OF_M = {"scale": BiasUnit("1", "ppm"), "misalignment": BiasUnit("rad", "mrad")}
MEASURED_BY = {"bias_instability": "driftlab allan", "noise": "driftlab allan", "coast": "driftlab run"}
MEASURED_BY |= dict.fromkeys(("scale", "misalignment"), "driftlab fit-map --terms")
MEASURED_BY |= dict.fromkeys(("residual", "swing", "hysteresis"), "driftlab fit-map")


@dataclass(frozen=True)
class Measured:
    """A measurement of a limited quantity, a value an axis; one of zero does not show, and is judged by `high`."""

    values: Array  # (d,), SI
    axes: Sequence[str]  # their names
    low: Array | None = None  # (d,) the true value is above it with 95 %; None where the uncertainty is not known
    high: Array | None = None  # (d,) the true value is below it with 95 %
    stands_on: str = ""  # what the values were measured on, for the table
    missing: str = ""  # why they must not be judged; empty where they may
    seconds: float = float("nan")  # time they stand on, s; NaN where more of it would not tell more
    otherwise: str = ""  # what would decide where time does not
    beside: str = ""  # remark beside the verdict where no limit is set for it


@dataclass(frozen=True)
class LimitResult:
    """One limit, what was measured, and the decision; in SI."""

    name: str  # of the limit, as the config has it
    limit: float
    value: float = float("nan")  # of the axis that decides; NaN where there is none
    guard: float = float("nan")  # what is added to it or taken off; NaN where that is not known
    axis: str = ""  # that decides
    decision: Decision = "undecided"  # `pass`, `fail` or `undecided`
    measured: bool = True  # whether there is a value that may be judged
    note: str = ""  # what the value stands on, or why there is none
    needs: str = ""  # what would decide it; empty where it is decided
    # time that would, beside what was measured, s; NaN where none would, or that is not known
    more: float = float("nan")
    beside: str = ""  # remark beside the verdict on all limits, since none is set for it; the first row has it

    @property
    def verdict(self) -> str:
        """The decision, or `not measured`."""
        return self.decision if self.measured else "not measured"

    @property
    def at_most(self) -> bool:
        """True where the value does not show, and `guard` is its upper limit."""
        return self.value == 0

    def unit(self, unit: BiasUnit) -> BiasUnit:
        """Return the unit of the limit, of a sensor whose bias is in `unit`."""
        if self.name in OF_M:
            return OF_M[self.name]
        if self.name != "noise":
            return unit
        return BiasUnit(f"{unit.si}/sqrt(Hz)", f"{unit.shown}/sqrt(Hz)")

    def as_json(self, unit: BiasUnit) -> dict[str, Any]:
        """Return the row as `summary.json` has it, in SI."""
        return {
            "name": self.name,
            "unit": self.unit(unit).si,
            "limit": self.limit,
            "value": self.value,
            "guard": self.guard,
            "decision": self.decision,
            "axis": self.axis or None,
            "measured": self.guard if self.at_most else self.value,
            "at_most": self.at_most,
            "sigma": float("nan") if self.at_most else self.guard / SIDE,
            "verdict": self.verdict,
            "note": self.note,
            "would_decide": self.needs,
            "more_hours": self.more / 3600,
            **({"beside": self.beside} if self.beside else {}),
        }

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> LimitResult:
        """Return the row that `as_json` has written."""
        numbers = {k: np.nan if row[k] is None else row[k] for k in ("value", "guard", "more_hours")}
        measured, beside = row["verdict"] != "not measured", row.get("beside", "")
        return cls(
            row["name"], row["limit"], numbers["value"], numbers["guard"], row["axis"] or "", row["decision"], measured,
            row["note"], row["would_decide"], 3600 * numbers["more_hours"], beside,
        )  # fmt: skip

    def cells(self, unit: BiasUnit) -> list[str]:
        """Return name, limit, value with its guard, axis, verdict and note as texts, units beside the numbers."""
        shown = self.unit(unit)
        measured = "–"
        if self.at_most:
            measured = f"≤ {self.guard * shown.factor:.3g} {shown.shown}"
        elif np.isfinite(self.value):
            measured = f"{with_uncertainty(self.value * shown.factor, self.guard * shown.factor)} {shown.shown}"
        limit = f"{self.limit * shown.factor:.6g} {shown.shown}"
        note = "; ".join(filter(None, (self.note, self.needs)))
        return [NAMES[self.name], limit, measured, self.axis or "–", self.verdict, note]

    def line(self, unit: BiasUnit) -> str:
        """Return the row in a line: the limit, the value with its guard, the verdict and what it stands on."""
        name, limit, measured, axis, verdict, note = self.cells(unit)
        value = measured if axis == "–" else f"{axis} {measured}"
        return f"{name}, at most {limit}: {value}, {verdict} ({note})"


def check_limits(
    limits: Limits | None, measured: Mapping[str, Measured], doubts: Sequence[str] = ()
) -> list[LimitResult]:
    """Hold what was measured against the limits that are set, in the order of the config's keys.

    Where there are `doubts` whether the recording is what its config says (`Faults.doubts`), nothing passes.

    A limit of which nothing is in `measured` has the verdict `not measured`, and its note names the command that
    measures it.
    """
    declared = {} if limits is None else limits.declared
    rows = [_result(name, limit, measured.get(name)) for name, limit in declared.items()]
    beside = [one.beside for name, one in measured.items() if one.beside and name not in declared]
    if doubts:
        beside += in_doubt(doubts[:1])
        why = "the recording, or its map, is in doubt"
        rows = [replace(row, decision="undecided", needs=why) if row.decision == "pass" else row for row in rows]
    return [replace(row, beside="; ".join(beside) if row is rows[0] else "") for row in rows]


def verdict(rows: Sequence[LimitResult]) -> str:
    """Return the verdict of all limits in one line; empty where there are none.

    It is `PASS` only where every limit was measured and passes. What is seen and has no limit stands behind it.
    """
    if not rows:
        return ""
    by = {word: [NAMES[row.name] for row in rows if row.verdict == word] for word in VERDICTS}
    more = "".join(f"; {word}: {', '.join(by[word])}" for word in ("undecided", "not measured") if by[word])
    beside = "".join(f"; {row.beside}" for row in rows if row.beside)
    count = f"{len(by['pass'])} of {len(rows)} limit{'s' * (len(rows) > 1)} kept"
    if by["fail"]:
        return f"FAIL: {', '.join(by['fail'])} ({count}{more}){beside}"
    if by["not measured"]:
        return f"INCOMPLETE: {count}{more}{beside}"
    return f"{'UNDECIDED' if by['undecided'] else 'PASS'}: {count}{more}{beside}"


def worst(rows: Sequence[Mapping[str, Any]]) -> str | None:
    """Return the verdict on a unit of the rows of its limits as JSON has them; None where there are none."""
    verdicts = [row.get("verdict") for row in rows]
    return next((word for word in VERDICTS if word in verdicts), None)


def least_kept(runs: Iterable[Sequence[LimitResult]]) -> list[LimitResult]:
    """Return each limit of one config as the run that keeps it least has it: by verdict, then by value."""
    return [min(rows, key=lambda row: (VERDICTS.index(row.verdict), -row.value)) for rows in zip(*runs, strict=True)]


def verdict_of_units(units: Iterable[Sequence[Mapping[str, Any]]]) -> str:
    """Return the number of units that pass, fail or are undecided, and by which limits; empty where none is set.

    Of each unit, `units` has the rows of its limits as JSON has them.
    """
    counts, by = Counter[str](), Counter[tuple[str, str]]()
    for rows in units:
        if (word := worst(rows)) is not None:
            counts[word] += 1
            by.update((word, NAMES[row["name"]]) for row in rows if row["verdict"] == word != "pass")
    parts = []
    for word in ("pass", "fail", "undecided", "not measured"):
        names = ", ".join(f"{name} {count:,}" for (of, name), count in by.most_common() if of == word)
        parts += [f"{counts[word]:,} {word}{f' ({names})' * bool(names)}"] if counts[word] or word == "pass" else []
    return f"limits: {'; '.join(parts)}" if counts else ""


def outcome(line: str) -> str:
    """Return `pass`, `fail`, `undecided` or `unknown` of a verdict in one line."""
    first = line.partition(":")[0].lower()
    return first if first in EXIT else "unknown"


def _result(name: str, limit: float, measured: Measured | None) -> LimitResult:
    if measured is None:
        return LimitResult(name, limit, measured=False, note=f"`{MEASURED_BY[name]}` measures it")
    if measured.missing:
        return LimitResult(name, limit, measured=False, note=measured.missing)
    values, axes = np.asarray(measured.values, dtype=np.float64), list(measured.axes)
    blank = LimitResult(name, limit, note=measured.stands_on)
    if measured.otherwise and np.all(np.isnan(values)):
        return replace(blank, needs=measured.otherwise)
    unknown = [axis for axis, value in zip(axes, values, strict=True) if not np.isfinite(value)]
    if unknown or not len(values):
        whose = f" of {', '.join(unknown)}" if unknown else ""
        return LimitResult(name, limit, measured=False, note=f"has no value{whose}")
    if measured.low is None or measured.high is None:
        k = int(np.argmax(values))
        why = measured.otherwise or "its uncertainty is not known"
        return replace(blank, value=float(values[k]), axis=axes[k], needs=why)
    low, high = _about(values, measured.low, measured.high)
    decision: Decision = "undecided"
    if np.all(high <= limit):
        decision, k = "pass", int(np.argmax(high))
    elif np.any(low > limit):
        decision, k = "fail", int(np.argmax(low))
    else:
        k = int(np.argmax(np.where(high > limit, values, -np.inf)))
    value = float(values[k])
    guard = float(value - low[k] if value > limit else high[k] - value)
    result = replace(blank, value=value, guard=guard, axis=axes[k], decision=decision)
    return result if decision != "undecided" else _undecided(result, measured)


def _about(values: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """Return limits about values (d,): one beyond its own limits is as uncertain as on the other side."""
    below, above = np.maximum(values - low, 0.0), np.maximum(high - values, 0.0)
    return values - np.where(below > 0, below, above), values + np.where(above > 0, above, below)


def _undecided(row: LimitResult, measured: Measured) -> LimitResult:
    """Return the row with what would decide it: guards fall as 1 / sqrt(time)."""
    gap = abs(row.limit - row.value)
    times = (row.guard / gap) ** 2 if gap > 0 else np.inf
    more = (times - 1) * measured.seconds
    if np.isnan(more):
        needs = measured.otherwise or "no longer recording would decide it"
    elif times > MAX_TIMES:
        needs = f"no longer recording would decide it: {row.axis} is too near to the limit"
        more = float("nan")
    else:
        beyond = "below" if row.value <= row.limit else "above"
        size = f"{more / 3600:.2g} h" if more >= 0.95 * 3600 else f"{max(more / 60, 1):.2g} min"
        needs = f"about {size} more would decide it, if {row.axis} stays {beyond} the limit by as much"
    return replace(row, needs=needs, more=float(more))
