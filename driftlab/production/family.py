"""The analysis of a fleet's units: their shared effects, their family, the outliers among them, and the line.

The units' soaks with the shared effects in the model are computed once, where the units are, and gone through often.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from driftlab.config import Config
from driftlab.family.band_calibration import measure_bands, sample_of
from driftlab.family.bands import deviation
from driftlab.family.file import load_family
from driftlab.family.mixed_model import Family, fit_family
from driftlab.family.outliers import LotOutlier, Outlier, Outliers, find_outliers, of_doubts
from driftlab.family.partitions import FamilyUnits, Partitions, UnitOfLot, in_partitions
from driftlab.family.record import figure_name
from driftlab.family.shared_effect import SharedEffect, UnitDensities, without_effects
from driftlab.family.shared_effects import SharedEffects, find_common, sentences
from driftlab.family.terms import fit_terms
from driftlab.family.thermometers import with_odd_thermometers
from driftlab.production.summary import FleetProgress, Stage
from driftlab.production.units_pass import FleetStatus
from driftlab.recordings.identity import sha256
from driftlab.spc.charts import LEVEL, InControl, LineReport
from driftlab.spc.line import baseline_of, line_of, reconcile
from driftlab.units import BiasUnit, tracked_unit
from driftlab.units import units as counted
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError, quote

NOTHING = SharedEffects()


@dataclass(frozen=True, eq=False)
class FamilyAnalysis:
    """The family of a fleet's units, and each unit and the line against it.

    Attributes
    ----------
    family : Family or None
        None where there are too few units.
    common : SharedEffects
    odd : mapping of str to sequence of Outlier
        By unit, of those that stand out.
    line : LineReport
    lines : list of str
        A summary of the family in sentences.
    lots : tuple of LotOutlier
        Lots that are off the others as a whole.
    judged : bool
        Whether outliers were looked for.
    """

    family: Family | None
    common: SharedEffects
    odd: Mapping[str, Sequence[Outlier]]
    line: LineReport
    lines: list[str] = field(default_factory=list)
    lots: tuple[LotOutlier, ...] = ()
    judged: bool = False

    @property
    def reasons(self) -> dict[str, list[str]]:
        """The reasons of each unit that stands out."""
        return {unit: [outlier.sentence for outlier in outliers] for unit, outliers in self.odd.items() if outliers}


def analyse(
    units: Partitions[Sequence[UnitOfLot]],
    doubted: Partitions[Sequence[UnitOfLot]],
    status: FleetStatus,
    config: Config,
    known: Path | None,
    progress: FleetProgress,
    rules: str | None = None,
    by: Sequence[str] = (),
) -> FamilyAnalysis:
    """Fit the family of the units that are done, or compare them with one that is `known`.

    `units` are the sound ones of the status, `rules` run rules of the line's charts, `by` columns by whose groups its
    figures may differ. Those that are `doubted` are held against the family as new units: their recordings may be of
    something else.

    Raises
    ------
    ConfigError, MapError
        If the known family cannot be used for these units.
    """
    unit, records, why = tracked_unit(config.filter), status.sound, ""
    if known is None:
        family, common, apart, why = _fitted(units, status, progress)
    else:
        family, common = _read(known, units, status) if records else (None, NOTHING)
        apart = _kept(units, common)
    progress(Stage("what the line did"))
    levels, before = (None, None) if family is None else (_levels(family, apart), family.baseline if known else None)
    line = line_of(records, config.limits, unit=unit, levels=levels, baseline=before, rules=rules, by=by)
    if family is None:
        odd, lines = _doubted(doubted, status, None, common, unit)
        return FamilyAnalysis(None, common, odd, line, [*([f"no family: {why}"] if why else []), *lines])
    progress(Stage("units that stand out"))
    outliers = find_outliers(family, apart, records, shown=unit, fitted=known is None)
    lots: tuple[LotOutlier, ...] = ()
    if known is None:
        lots, line = reconcile(outliers.lots, line)
        baseline = baseline_of(line, _level_law(family))
        more = {"laws": outliers.laws, "baseline": baseline, "terms": fit_terms(records)}
        family = family.model_copy(update=more)
    odd, about = _doubted(doubted, status, family, common, unit)
    lines = [
        _spread(family, unit, known), *sentences(common, unit, family.axes),
        *(lot.sentence[0].upper() + lot.sentence[1:] + "." for lot in lots),
        *about, *_judged_by(family, len(units), known), *outliers.remarks,
        *([] if known else _frozen_after_changes(line)),
    ]  # fmt: skip
    odd |= with_odd_thermometers(outliers.odd, line.units, line.domains, before)
    judged = outliers.laws is not None and bool(outliers.laws.curves)
    return FamilyAnalysis(family, common, odd, line, lines, tuple(lots), judged)


def _doubted(
    units: Partitions[Sequence[UnitOfLot]],
    status: FleetStatus,
    family: Family | None,
    common: SharedEffects,
    unit: BiasUnit,
) -> tuple[dict[str, tuple[Outlier, ...]], list[str]]:
    """Return the reasons of each unit in doubt, its doubts first, and sentences on these units."""
    found, records = Outliers({}), status.doubted
    if family is not None and family.laws is not None and family.laws.curves and len(units):
        apart = _kept(units, common)
        found = find_outliers(family, apart, records, shown=unit, fitted=False)
    about = f"{counted(len(units))} in doubt: not in the family, not on the charts; held against the family as new"
    odd = {record.unit: (*of_doubts(record), *found.odd.get(record.unit, ())) for record in records}
    return odd, [*([about] if odd else []), *found.remarks]


def _frozen_after_changes(line: LineReport) -> list[str]:
    """Return in a sentence the figures whose frozen limits are not those of all units."""
    changed = [f"{one.axis} {figure_name(one.quantity)}" for one in line.controls if one.changes or one.trend]
    now = "those of the last units without a change, of a trend its middle"
    return [f"Limits that are frozen of {', '.join(changed)} are {now}."] if changed else []


def _judged_by(family: Family, count: int, known: Path | None) -> list[str]:
    """Return in a sentence the reference of units that are compared with a known family."""
    if known is None or family.laws is None or family.baseline is None:
        return []
    of = "one new unit" if count == 1 else f"{count:,} new units"
    alone = f"Each unit alone is judged by what is usual of the {counted(family.units)} in {known}"
    if all(limits.quantity == LEVEL for limits in family.baseline.limits):
        return [
            f"{alone}, and levels are charted about theirs; other charts, changes and limits of the line are of {of}, "
            "and do not say whether the line has moved since: the family has no limits of other charts."
        ]
    return [
        f"{alone}, and charted against limits that are frozen there (SHA-256 {sha256(known)[:12]}); changes of the "
        f"line are looked for among {of}."
    ]


def _fitted(
    units: Partitions[Sequence[UnitOfLot]], status: FleetStatus, progress: FleetProgress
) -> tuple[Family | None, SharedEffects, Partitions[Sequence[UnitOfLot]], str]:
    """Return the family of units, their common effects and the units without them; or why there is none."""
    try:
        progress(Stage("effects that the units share"))
        common = find_common(units, bias_unit=status.bias_unit)
        places = sample_of(len(units))
        apart = _kept(units, common, status.sound.units, places)
        progress(Stage("the family"))
        family = fit_family(apart, channel=status.channel, bias_unit=status.bias_unit)
    except ValueError as error:
        return None, NOTHING, units, str(error)
    progress(Stage("the family, units left out"))
    return family.model_copy(update={"bands": measure_bands(family, apart.chosen(places))}), common, apart, ""


def _read(path: Path, units: Partitions[Sequence[UnitOfLot]], status: FleetStatus) -> tuple[Family, SharedEffects]:
    family = load_family(path, channel=status.channel, bias_unit=status.bias_unit)
    try:
        family.information_of(next(units.read())[0])
        common = NOTHING if family.common_effects is None else SharedEffects.model_validate(family.common_effects)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise ConfigError(
            f"--family {path}: common_effects.{'.'.join(map(str, first['loc']))}: {quote(first['msg'])}; install the "
            "plugin that the family was fitted with, or fit it again with driftlab fleet"
        ) from None
    except ValueError as error:
        raise ConfigError(f"--family {path}: {error}") from None
    return family, common


def _levels(family: Family, units: FamilyUnits) -> Array:
    """Return the mean bias (n, d) of units over the family's range, which no figure has, and a lot may differ in."""
    return np.concatenate([*in_partitions(units).map(partial(_means, family, _mean_over_range(family)))])


def _means(family: Family, B: Array, units: Sequence[UnitOfLot]) -> Array:
    return np.array([family.posterior(soaked, lot).c @ B for soaked, lot in units])


def _level_law(family: Family) -> list[InControl]:
    """Return mean and deviation of levels in control, by a known family: of units of a new lot."""
    B, before = _mean_over_range(family), family.marginal()
    return [
        InControl(float(c @ B), float(np.sqrt(B @ C @ B))) for c, C in zip(before.c, before.covariance, strict=True)
    ]


def _mean_over_range(family: Family) -> Array:
    """Return the weights (q,) of coefficients in the mean of a curve over the family's range."""
    return np.asarray(family.knots.grid(4)[1].mean(axis=0))


def _spread(family: Family, unit: BiasUnit, known: Path | None) -> str:
    """Return the spread of the family, in a sentence."""
    (low, high), (_, B) = family.knots.domain, family.knots.grid(4)
    mean, whole = (
        np.sqrt(np.mean(deviation(B, C) ** 2, axis=0)) for C in (family.mu_covariance, family.Sigma + family.Lambda)
    )

    def listed(values: Array) -> str:
        texts = (f"{axis} {v * unit.factor:.3g}" for axis, v in zip(family.axes, values, strict=True))
        return f"{', '.join(texts)} {unit.shown}"

    of = f"the family of {counted(family.units)}" if known is None else f"{known}, a family of {counted(family.units)}"
    return (
        f"{of}, {low:g} to {high:g} °C: they spread by {listed(whole)} about a mean map that is known to "
        f"{listed(mean)} (1 sigma, rms over the range)"
    )


def _kept(
    units: Partitions[Sequence[UnitOfLot]], common: SharedEffects, names: Sequence[str] = (), whole: Sequence[int] = ()
) -> Partitions[Sequence[UnitOfLot]]:
    """Return units with the effects in the model, by `names` beside their noise; their rows stay at the places `whole`.

    Who fits a family needs no rows.
    """
    noise = [common.noise.get(name) for name in names] or [None] * len(units)
    return units.keep("apart", partial(_apart, common.effects), noise, np.isin(np.arange(len(units)), whole))


def _apart(
    effects: Sequence[SharedEffect], units: Sequence[UnitOfLot], noise: Sequence[UnitDensities | None],
    whole: Sequence[bool],
) -> list[UnitOfLot]:  # fmt: skip
    """Return units with the effects in the model, each drawn from its law, beside their noise; some with their rows."""
    kept = []
    for (soaked, lot), own, rows in zip(units, noise, whole, strict=True):
        apart = without_effects(soaked, lot, effects, own) if effects else soaked
        kept.append((apart if rows else replace(apart, recordings=()), lot))
    return kept
