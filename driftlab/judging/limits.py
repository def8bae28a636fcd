"""Whether a unit keeps the limits of its config, and how sure that is.

What was measured passes where its worst axis is at most the limit (simple acceptance). The verdict also says whether
its 95 % interval, two standard deviations to either side, lies on the same side of the limit; where it does not, the
verdict is `within its uncertainty`. These are the four statements of ILAC-G8:09/2019, 4.2.3: pass, conditional pass,
conditional fail, fail, with a guard band of the expanded uncertainty. What is not known, or stands on too little time,
has no verdict.

d axes; all values in SI.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from driftlab.units import BiasUnit

if TYPE_CHECKING:
    from driftlab.declared_limits import Limits
    from fusion_core.chunk import Array

Verdict = Literal["pass", "fail", "not measured"]
MEASURED_BY = {
    "bias_instability": "driftlab allan",
    "residual": "driftlab fit-map",
    "coast": "driftlab run",
    "swing": "driftlab fit-map",
    "noise": "driftlab allan",
}
NAMES = {
    "bias_instability": "bias instability",
    "residual": "residual of the map",
    "coast": "coast, rms over 10 min",
    "swing": "swing of the map",
    "noise": "white noise",
}


@dataclass(frozen=True)
class Measured:
    """What was measured of a limited quantity.

    Attributes
    ----------
    values : (d,) array
        One value an axis.
    axes : tuple of str
        Their names.
    low, high : (d,) arrays or None
        The 95 % interval, as two standard deviations to either side; None where the uncertainty is not known.
        A value of zero is one that does not show, and is judged by `high`.
    stands_on : str
        What the values were measured on, for the table.
    missing : str
        Why they must not be judged; empty where they may.
    """

    values: Array
    axes: Sequence[str]
    low: Array | None = None
    high: Array | None = None
    stands_on: str = ""
    missing: str = ""


@dataclass(frozen=True)
class Judged:
    """One limit, what was measured, and the verdict.

    Attributes
    ----------
    name : str
        Of the limit, as the config has it.
    limit, measured, sigma : float
        In SI; `measured` is of the worst axis, NaN where there is none; `sigma` is a quarter of the 95 % interval, NaN
        where that is not known.
    axis : str
        The worst axis.
    verdict : str
        `pass`, `fail` or `not measured`.
    sure : bool or None
        Whether the whole 95 % interval of every axis is on the verdict's side of the limit; None: it is not known.
    at_most : bool
        Whether `measured` is the upper end of what does not show.
    note : str
        What the value stands on, or why there is none.
    """

    name: str
    limit: float
    measured: float
    sigma: float
    axis: str
    verdict: Verdict
    sure: bool | None
    at_most: bool = False
    note: str = ""

    @property
    def words(self) -> str:
        """The verdict as the tables say it."""
        return f"{self.verdict}, within its uncertainty" if self.sure is False else self.verdict

    def unit(self, unit: BiasUnit) -> BiasUnit:
        """Return the unit of the limit, of a sensor whose bias is in `unit`."""
        if self.name != "noise":
            return unit
        return BiasUnit(f"{unit.si}/sqrt(Hz)", f"{unit.shown}/sqrt(Hz)")

    def as_json(self, unit: BiasUnit) -> dict[str, Any]:
        """Return the row as `summary.json` has it, in SI."""
        found = {"name": self.name, "unit": self.unit(unit).si, "limit": self.limit, "measured": self.measured}
        found |= {"sigma": self.sigma, "axis": self.axis or None, "at_most": self.at_most}
        return {**found, "verdict": self.verdict, "sure": self.sure, "note": self.note}

    def cells(self, unit: BiasUnit) -> list[str]:
        """Return name, limit, measured with its sigma, axis, verdict and note as texts, units beside the numbers."""
        own = self.unit(unit)
        measured = ""
        if np.isfinite(self.measured):
            sigma = f" ± {self.sigma * own.factor:.2g}" if np.isfinite(self.sigma) and not self.at_most else ""
            measured = f"{'≤ ' if self.at_most else ''}{self.measured * own.factor:.4g}{sigma} {own.shown}"
        limit = f"{self.limit * own.factor:.6g} {own.shown}"
        return [NAMES[self.name], limit, measured or "–", self.axis or "–", self.words, self.note]


def judge(limits: Limits | None, measured: Mapping[str, Measured]) -> list[Judged]:
    """Hold what was measured against the limits that are set, in the order of the config's keys.

    A limit of which nothing is in `measured` has the verdict `not measured`, and its note names the command that
    measures it.
    """
    declared = {} if limits is None else limits.declared
    return [_judged(name, limit, measured.get(name)) for name, limit in declared.items()]


def verdict(rows: Sequence[Judged]) -> str:
    """Return the verdict of all limits in one line; empty where there are none.

    It is `pass` only where every limit was measured and kept.
    """
    if not rows:
        return ""
    by = {kind: [NAMES[row.name] for row in rows if row.verdict == kind] for kind in ("pass", "fail", "not measured")}
    unsure = [NAMES[row.name] for row in rows if row.sure is False]
    parts = [f"not measured: {', '.join(by['not measured'])}"] if by["not measured"] else []
    parts += [f"within its uncertainty: {', '.join(unsure)}"] if unsure else []
    more = "".join(f"; {part}" for part in parts)
    count = f"{len(by['pass'])} of {len(rows)} limit{'s' * (len(rows) > 1)} kept"
    if by["fail"]:
        return f"FAIL: {', '.join(by['fail'])} ({count}{more})"
    return f"{'INCOMPLETE' if by['not measured'] else 'PASS'}: {count}{more}"


def _judged(name: str, limit: float, found: Measured | None) -> Judged:
    if found is None:
        return _missing(name, limit, f"not measured here: `{MEASURED_BY[name]}` does")
    if found.missing:
        return _missing(name, limit, found.missing)
    values, axes = np.asarray(found.values, dtype=np.float64), list(found.axes)
    unknown = [axis for axis, value in zip(axes, values, strict=True) if not np.isfinite(value)]
    if unknown or not len(values):
        whose = f" of {', '.join(unknown)}" if unknown else ""
        return _missing(name, limit, f"has no value{whose}")
    low, high = _interval(found, values)
    hidden = values == 0
    upper = np.where(hidden, high, values)
    k = int(np.argmax(np.where(np.isfinite(upper), upper, np.inf)))
    if hidden[k] and not upper[k] <= limit:
        if not np.any(values > limit):
            return _missing(name, limit, _hidden(axes[k], upper[k] / limit))
        k = int(np.argmax(values))
    passes = bool(upper[k] <= limit)
    sure = None
    if np.all(np.isfinite(high)):
        sure = bool(np.all(high <= limit)) if passes else bool(np.any(low > limit))
    at_most = bool(hidden[k])
    sigma = float("nan") if at_most else float(high[k] - low[k]) / 4
    kept: Verdict = "pass" if passes else "fail"
    return Judged(name, limit, float(upper[k]), sigma, axes[k], kept, sure, at_most, found.stands_on)


def _interval(found: Measured, values: Array) -> tuple[Array, Array]:
    if found.low is None or found.high is None:
        none = np.full(len(values), np.nan)
        return none, none
    return np.asarray(found.low, dtype=np.float64), np.asarray(found.high, dtype=np.float64)


def _hidden(axis: str, ratio: float) -> str:
    reach = f"may be up to {ratio:.2g} times the limit" if np.isfinite(ratio) else "has no upper limit"
    return f"{axis} does not show above the other noise, and {reach}; record longer"


def _missing(name: str, limit: float, note: str) -> Judged:
    return Judged(name, limit, float("nan"), float("nan"), "", "not measured", None, note=note)
