"""What the family says of each unit: its part of the table, its curve for the report, and its `family_map.json`.

d axes, q coefficients, G temperatures.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from driftlab.family.common_effects import CommonEffects
from driftlab.family.each import Each, alone
from driftlab.family.law import Family
from driftlab.family.short_soak import band_of, family_map, informed_where_unknown, sigma
from driftlab.fleets.folder import NEW
from driftlab.fleets.kept import UNITS, record_of, soaked_of
from fusion_core.chunk import Array

MAP = "family_map.json"
AT_ONCE = 25  # units that a process is given at once, with the family


@dataclass(frozen=True, eq=False)
class OfTheFamily:
    """What the family says of a unit.

    Attributes
    ----------
    unit : str
    knots : (q,) array
        Where the splines peak, degC.
    c, sigma : (d, q) arrays
        Coefficients of the unit's map with the family, and their deviations.
    curve : (d, G) array
        That map over `temperatures`, in single precision.
    map_sigma : (d,) array
        Rms of its deviation over the family's domain.
    distance : (d,) array
        Of its coefficients from the mean of its lot, in deviations: 1 is usual.
    common, common_sigma : (d,) arrays or None
        First coefficient of the first common effect in this unit.
    """

    unit: str
    knots: Array
    c: Array
    sigma: Array
    curve: Array
    map_sigma: Array
    distance: Array
    common: Array | None = None
    common_sigma: Array | None = None


def temperatures(family: Family) -> Array:
    """Return temperatures (G,) over the family's domain, degC."""
    return np.linspace(*family.knots.domain, 2 * family.knots.intervals + 1)


def posteriors(
    folder: Path, units: Sequence[tuple[str, str]], family: Family, common: CommonEffects, each: Each = alone
) -> Iterator[OfTheFamily]:
    """Yield what the family says of each unit, in their order, and write the units' maps.

    Raises
    ------
    DataError
        If a unit's file is damaged, or belongs to another family.
    """
    return each(
        partial(_of_unit, folder, family), ((name, lot, common.of_unit(name)) for name, lot in units), at_once=AT_ONCE
    )


def _of_unit(folder: Path, family: Family, unit: tuple[str, str, CommonEffects]) -> OfTheFamily:
    name, lot, common = unit
    place = folder / UNITS / name
    soaked = common.apart(soaked_of(place), lot)
    record = record_of(place)
    if record is not None and not common.effects:
        soaked = informed_where_unknown(soaked, family, record)
    posterior, band = family.posterior(soaked, lot), band_of(family, soaked)
    T = temperatures(family)
    new = place / f".{MAP}{NEW}"
    family_map(family, posterior, band, soaked=soaked, provenance={"unit": name, "lot": lot}).save(new)
    os.replace(new, place / MAP)
    before = family.marginal(lot)
    off = [np.linalg.solve(C, c) @ c for C, c in zip(before.covariance, posterior.c - before.c, strict=True)]
    sizes = common.of_units.get(name, ())
    return OfTheFamily(
        name, family.knots.peaks, posterior.c, np.sqrt(np.diagonal(posterior.covariance, axis1=1, axis2=2)),
        (family.knots.values(T) @ posterior.c.T).T.astype(np.float32),
        np.sqrt(np.mean(sigma(family, posterior, band, T) ** 2, axis=0)),
        np.sqrt(np.array(off) / family.knots.q),
        sizes[0].c[:, 0] if sizes else None, sizes[0].sigma[:, 0] if sizes else None,
    )  # fmt: skip
