"""Gauge R&R: the share of the measurement in the spread of a figure, from units that were soaked twice or more.

The analysis of variance of AIAG, Measurement Systems Analysis, 4th edition (2010), chapter III B. Units are the parts;
with p of them, each soaked r times on each of a appraisers (chambers, operators), of the mean squares MS of parts P,
appraisers A, their interaction PA and repeated soaks E::

    EV^2 = MS_E                     repeatability
    INT^2 = (MS_PA - MS_E) / r      interaction
    AV^2 = (MS_A - MS_PA) / (p r)   reproducibility
    PV^2 = (MS_P - MS_PA) / (a r)   parts
    GRR^2 = EV^2 + INT^2 + AV^2,  TV^2 = GRR^2 + PV^2,  ndc = 1.41 PV / GRR

Where p of the interaction is above 0.25 it is pooled with the repeated soaks; of one soak on each appraiser it cannot
be distinguished from them. Without appraisers PV^2 = (MS_P - MS_E) / r, where units differ in r of its mean for that
(Searle, Casella and McCulloch, Variance Components, 1992, section 3.6). What comes out negative is 0.

Intervals are generalised (Hamada and Weerahandi 2000): each mean square is divided by draws of chi-squared over its
degrees of freedom. All values in SI.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftlab.config import Limits
from driftlab.family.record import FIGURES, PER, UnitRecord, figure_name
from driftlab.spc.charts import LEVEL
from fusion_core.chunk import Array

POOLED = 0.25  # p of the interaction from which on it is pooled
MIN_UNITS = 5  # that are soaked twice or more: the spread of fewer is not known
MIN_FREEDOM = 5  # degrees of freedom of the repeatability
GOOD, POOR = 0.1, 0.3  # GRR of TV: AIAG takes a gauge below the one, none above the other
DRAWS = 20_000
RECORD = "soak 10 units or more twice on each of 2 or more chambers or operators"


@dataclass(frozen=True)
class GaugeComponents:
    """Standard deviations of a study, with the 95 % intervals of GRR and of its share of TV.

    Attributes
    ----------
    parts, appraisers, soaks : int
        Numbers in the analysis; 1 appraiser: they are taken together.
    ev, av, interaction, grr, pv, tv : float
    grr_95, share_95 : (low, high)
    p_interaction : float or None
        None where there is no such test.
    pooled : bool
    mean : float
        Of all soaks.
    """

    parts: int
    appraisers: int
    soaks: int
    ev: float
    av: float
    interaction: float
    pv: float
    grr_95: tuple[float, float]
    share_95: tuple[float, float]
    p_interaction: float | None
    pooled: bool
    mean: float

    @property
    def grr(self) -> float:
        """Gauge R&R."""
        return float(np.hypot(np.hypot(self.ev, self.av), self.interaction))

    @property
    def tv(self) -> float:
        """Total variation."""
        return float(np.hypot(self.grr, self.pv))

    @property
    def share(self) -> float:
        """GRR of TV, 1."""
        return self.grr / self.tv

    @property
    def ndc(self) -> int:
        """Distinct categories, 1 at least."""
        return max(int(1.41 * self.pv / self.grr), 1)


@dataclass(frozen=True)
class GaugeRow:
    """A figure of an axis: its study, and 6 GRR of the tolerance.

    `tolerance` is None where there is no limit, or where the mean is above it. Limits are upper ones: it is 3 GRR over
    the limit less the mean.
    """

    quantity: str
    axis: str
    unit: str
    found: GaugeComponents
    tolerance: float | None = None

    @property
    def name(self) -> str:
        """Axis and figure, for people."""
        return f"{self.axis} {figure_name(self.quantity)}"

    @property
    def verdict(self) -> str:
        """AIAG's class of the whole interval of GRR of TV; empty where it is in more than one."""
        low, high = self.found.share_95
        between = "acceptable for some uses" if low >= GOOD and high <= POOR else ""
        return "acceptable" if high < GOOD else "not acceptable" if low > POOR else between

    def shares(self, about: str = "") -> str:
        """Return GRR of TV with its interval, in words: `34 % (24 to 55 %)`."""
        share, low, high = (
            f"{100 * v:.0f}" if v >= 0.0995 else f"{100 * v:.2g}" for v in (self.found.share, *self.found.share_95)
        )
        return f"{share} % ({about}{low} to {high} %)"

    def as_json(self) -> dict[str, Any]:
        """Return it as `fleet.json` has it."""
        one = self.found
        return {
            "quantity": self.quantity, "axis": self.axis, "unit": self.unit, "units": one.parts,
            "appraisers": one.appraisers, "soaks": one.soaks, "ev": one.ev, "av": one.av,
            "interaction": one.interaction, "grr": one.grr, "pv": one.pv, "tv": one.tv, "grr_95": [*one.grr_95],
            "grr_of_tv": one.share, "grr_of_tv_95": [*one.share_95], "ndc": one.ndc,
            "grr_of_tolerance": self.tolerance, "interaction_p": one.p_interaction, "pooled": one.pooled,
            "verdict": self.verdict,
        }  # fmt: skip


@dataclass(frozen=True)
class GaugeStudy:
    """Gauge R&R of the figures of a line.

    Attributes
    ----------
    rows : tuple of GaugeRow
        Figure by figure, none where `why_not` says why.
    appraiser : str
        Column of the manifest; empty: appraisers are taken together.
    why_not : str
    remark : str
        What was left out.
    """

    rows: tuple[GaugeRow, ...] = ()
    appraiser: str = ""
    why_not: str = ""
    remark: str = ""

    def as_json(self) -> dict[str, Any]:
        """Return it as `fleet.json` has it."""
        rows = [row.as_json() for row in self.rows]
        return {"appraiser": self.appraiser, "why_not": self.why_not, "remark": self.remark, "rows": rows}

    def sentences(self) -> list[str]:
        """Return the worst axis of each figure; or what to record."""
        if self.why_not:
            return [f"gauge R&R: {self.why_not}"]
        worst: dict[str, GaugeRow] = {}
        for row in self.rows:
            if row.quantity not in worst or row.found.share > worst[row.quantity].found.share:
                worst[row.quantity] = row
        each = []
        for row in worst.values():
            tolerance = "" if row.tolerance is None else f", {100 * row.tolerance:.3g} % of the tolerance"
            each.append(f"{row.name} {row.shares('95 %: ')}, ndc {row.found.ndc}{tolerance}")
        of = f"{self.rows[0].found.parts} units, {self.rows[0].found.soaks} soaks"
        of += f" by {self.appraiser}" if self.appraiser and self.rows[0].found.appraisers > 1 else ""
        rest = f"; {self.remark}" if self.remark else ""
        return [f"gauge R&R of {of}, of the total variation, worst axes: {'; '.join(each)}{rest}."]


@dataclass
class _Soaks:
    """Figures of repeated soaks: values (n, figures, d), with the unit and the appraiser of each."""

    units: list[str] = field(default_factory=list)
    appraisers: list[str] = field(default_factory=list)
    values: list[Array] = field(default_factory=list)


def gauge_study(
    records: Iterable[UnitRecord], limits: Limits | None = None, appraiser: str = "",
    columns: Mapping[str, Sequence[Mapping[str, str]]] | None = None,
) -> GaugeStudy | None:  # fmt: skip
    """Return the gauge R&R of units that were soaked twice or more; None where no unit was, and none is asked for.

    Parameters
    ----------
    records : iterable of UnitRecord
        Gone through once; of those without repeated soaks nothing is kept.
    limits : Limits, optional
        Of the config.
    appraiser : str, optional
        Column of the manifest whose values are the appraisers.
    columns : mapping of str to sequence of mapping of str to str, optional
        By unit, of each of its soaks, the values of the manifest's columns.
    """
    soaks, axes, si, names = _Soaks(), tuple[str, ...](), "", (*FIGURES, LEVEL)
    for record in records:
        if len(record.repeats) > 1:
            axes, si = axes or record.axes, si or record.bias_unit
            given = (columns or {}).get(record.unit, ())
            for soak in record.repeats:
                soaks.units.append(record.unit)
                soaks.appraisers.append(given[soak.place].get(appraiser, "") if soak.place < len(given) else "")
                soaks.values.append(soak.table(names, len(axes))[0])
    if not soaks.units and not appraiser:
        return None
    count = len(set(soaks.units))
    if count < MIN_UNITS:
        few = "no unit was" if not count else "1 unit was" if count == 1 else f"{count} units were"
        return GaugeStudy(
            appraiser=appraiser, why_not=f"{few} soaked twice or more over the same range; {RECORD} (recordings of the "
            "role calibration of one unit)",
        )  # fmt: skip
    declared = {} if limits is None else limits.declared
    units, who, table = np.array(soaks.units), np.array(soaks.appraisers), np.stack(soaks.values)
    rows, used = [], len(units)
    for i, name in enumerate(names):
        for k, axis in enumerate(axes):
            found, used_now = components(units, who, table[:, i, k])
            used = min(used, used_now) if found else used
            if found is not None:
                room = declared.get(name, np.nan) - found.mean
                share = 3 * found.grr / room if room > 0 else None
                rows.append(GaugeRow(name, axis, si + PER.get(name, ""), found, share))
    if not rows:
        few = "too few soaks are repeated on one appraiser" if appraiser else "no figure differs between soaks"
        return GaugeStudy(appraiser=appraiser, why_not=f"{few}; {RECORD}")
    return GaugeStudy(tuple(rows), appraiser, remark=_remark(rows, appraiser, used, len(units)))


def _remark(rows: Sequence[GaugeRow], appraiser: str, used: int, soaks: int) -> str:
    """Return the soaks that are left out, and the part that is not known."""
    remarks = []
    if appraiser and rows[0].found.appraisers == 1:
        remarks.append(f"no reproducibility: too few units were soaked on two of {appraiser}, {RECORD}")
    if used < soaks:
        remarks.append(f"{soaks - used} of {soaks} soaks are beyond the balanced part and left out")
    return "; ".join(remarks)


def components(units: Any, appraisers: Any, values: Array) -> tuple[GaugeComponents | None, int]:
    """Return the components of values (n,) by unit (n,) and appraiser (n,), and the number of soaks that they stand on.

    Crossed, of the largest balanced part, where two appraisers or more soaked enough of the same units; else of one
    factor, soaks of a unit on its own appraiser (units on more than one: on the one with most of its soaks). None where
    too few soaks are repeated, or none differs.
    """
    known = np.isfinite(values)
    units, appraisers, values = np.asarray(units)[known], np.asarray(appraisers)[known], values[known]
    cells: dict[tuple[str, str], list[float]] = {}
    for unit, who, value in zip(units.tolist(), appraisers.tolist(), values.tolist(), strict=True):
        cells.setdefault((unit, who), []).append(value)
    if (x := _balanced(cells)) is not None:
        return _crossed(x), x.size
    groups: dict[str, list[float]] = {}
    for (unit, _), of_cell in cells.items():
        groups[unit] = max(groups.get(unit, []), of_cell, key=len)
    repeated = [of_unit for of_unit in groups.values() if len(of_unit) > 1]
    return _one_factor(repeated), sum(map(len, repeated))


def _balanced(cells: Mapping[tuple[str, str], list[float]]) -> Array | None:
    """Return the largest balanced part (p, a, r) of the cells, of the appraisers with most units; None of too few."""
    by: dict[str, set[str]] = {}
    for unit, who in cells:
        by.setdefault(who, set()).add(unit)
    order = sorted((who for who in by if who), key=lambda who: -len(by[who]))
    best: Array | None = None
    for a in range(2, len(order) + 1):
        parts = sorted(set.intersection(*(by[who] for who in order[:a])))
        if len(parts) < MIN_UNITS:
            break  # one appraiser more has no more of them
        counts = sorted({len(cells[unit, who]) for unit in parts for who in order[:a]})
        for r in counts:
            full = [unit for unit in parts if all(len(cells[unit, who]) >= r for who in order[:a])]
            if len(full) >= MIN_UNITS and (best is None or len(full) * a * r > best.size):
                best = np.array([[cells[unit, who][:r] for who in order[:a]] for unit in full])
    return best


def _crossed(x: Array) -> GaugeComponents | None:
    """Return the components of values (p, a, r) of units, appraisers and repeated soaks."""
    from scipy.stats import f as law

    p, a, r = x.shape
    mean, part, who, cell = x.mean(), x.mean(axis=(1, 2)), x.mean(axis=(0, 2)), x.mean(axis=2)
    squares = {
        "P": a * r * np.sum((part - mean) ** 2), "A": p * r * np.sum((who - mean) ** 2),
        "PA": r * np.sum((cell - part[:, None] - who + mean) ** 2), "E": np.sum((x - cell[:, :, None]) ** 2),
    }  # fmt: skip
    freedom = {"P": p - 1, "A": a - 1, "PA": (p - 1) * (a - 1), "E": p * a * (r - 1)}
    chance = None
    if r > 1 and squares["E"] > 0:
        ratio = squares["PA"] / freedom["PA"] / (squares["E"] / freedom["E"])
        chance = float(law.sf(ratio, freedom["PA"], freedom["E"]))
    pooled = r == 1 or chance is None or chance > POOLED
    if pooled:
        squares["E"], freedom["E"] = squares["E"] + squares.pop("PA"), freedom["E"] + freedom.pop("PA")
    between = "E" if pooled else "PA"

    def variances(ms: Mapping[str, Any]) -> tuple[Any, Any, Any, Any]:
        interaction = 0 * ms["E"] if pooled else (ms["PA"] - ms["E"]) / r
        return ms["E"], (ms["A"] - ms[between]) / (p * r), interaction, (ms["P"] - ms[between]) / (a * r)

    return _study((p, a, x.size), squares, freedom, variances, (chance, pooled, float(mean)))


def _one_factor(groups: Sequence[Sequence[float]]) -> GaugeComponents | None:
    """Return the components of repeated soaks of units, a sequence each."""
    n = np.array([len(of_unit) for of_unit in groups])
    if len(n) < MIN_UNITS:
        return None
    means, soaks = np.array([np.mean(of_unit) for of_unit in groups]), int(np.sum(n))
    mean = float(np.sum(n * means) / soaks)
    within = sum(float(np.sum((np.array(one) - m) ** 2)) for one, m in zip(groups, means, strict=True))
    squares = {"P": np.sum(n * (means - mean) ** 2), "E": within}
    freedom, r = {"P": len(n) - 1, "E": soaks - len(n)}, (soaks - np.sum(n**2) / soaks) / (len(n) - 1)

    def variances(ms: Mapping[str, Any]) -> tuple[Any, Any, Any, Any]:
        return ms["E"], 0 * ms["E"], 0 * ms["E"], (ms["P"] - ms["E"]) / r

    return _study((len(n), 1, soaks), squares, freedom, variances, (None, False, mean))


def _study(
    counts: tuple[int, int, int], squares: Mapping[str, Any], freedom: Mapping[str, int], variances: Any,
    rest: tuple[float | None, bool, float],
) -> GaugeComponents | None:  # fmt: skip
    """Return the components of sums of squares with their degrees of freedom, and the intervals."""
    if freedom["E"] < MIN_FREEDOM or not squares["E"] > 0:
        return None
    rng = np.random.default_rng(0)
    drawn = {key: squares[key] / rng.chisquare(freedom[key], DRAWS) for key in squares}
    found, spread = (
        np.maximum(np.array(variances(ms)), 0.0)
        for ms in ({key: squares[key] / freedom[key] for key in squares}, drawn)
    )
    grr = np.sqrt(np.sum(spread[:3], axis=0))
    intervals = [
        tuple(np.quantile(one, [0.025, 0.975]).tolist()) for one in (grr, grr / np.sqrt(np.sum(spread, axis=0)))
    ]
    ev, av, interaction, pv = np.sqrt(found).tolist()
    return GaugeComponents(*counts, ev, av, interaction, pv, intervals[0], intervals[1], *rest)
