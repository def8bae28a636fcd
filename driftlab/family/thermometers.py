"""Units whose temperatures are not those that the line was soaked over: degrees of Fahrenheit, or another thermometer.

Units of a line go through one program of a chamber. The ends of most of them say which; a unit of which both ends are
off in the same way has another thermometer, or another unit of it, and a map over temperatures that it never had.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from driftlab.family.baseline import Baseline
from driftlab.family.outliers import Outlier
from fusion_core.chunk import Array

THERMOMETER = "thermometer"
MIN_UNITS = 8  # that say which program most go through
NEAR, ALONE = 1.0, 5.0  # K, at least: ends as far apart are the same; of too few units to show how the line's scatter
FAR = 6.0  # times the robust deviation of the line's ends


def with_odd_thermometers(
    odd: Mapping[str, tuple[Outlier, ...]], units: Sequence[str], domains: Array, baseline: Baseline | None = None
) -> dict[str, tuple[Outlier, ...]]:
    """Return the odd units, those among them whose temperatures are others than the line's, with the reason first.

    Parameters
    ----------
    odd : mapping of str to tuple of Outlier
    units : sequence of str
        Of the line.
    domains : (n, 2) array
        Lowest and highest temperature of the soaks of each, degC; NaN where not known.
    baseline : Baseline, optional
        Of the family that they are held against, whose range counts; by default the medians of these.
    """
    known = None if baseline is None else baseline.domain
    some = domains[np.all(np.isfinite(domains), axis=1)]
    if known is None and len(some) < MIN_UNITS:
        return dict(odd)
    ends = np.median(some, axis=0) if known is None else np.array(known)
    spread = 1.4826 * np.median(np.abs(some - np.median(some, axis=0)), axis=0) if len(some) >= MIN_UNITS else 0.0
    near = np.maximum(FAR * spread, NEAR if len(some) >= MIN_UNITS else ALONE) * np.ones(2)
    found = dict(odd)
    for k in np.flatnonzero(np.any(np.abs(domains - ends) > near, axis=1)).tolist():
        low, high = own = domains[k]
        off = own - ends
        said = f"its temperatures go from {low:.3g} to {high:.3g} °C, the line's from {ends[0]:.3g} to {ends[1]:.3g}"
        if np.all(np.abs(own - (1.8 * ends + 32)) <= 1.8 * near):
            why = f"{said}, which is the same in °F; correct the unit of the temperature"
        elif np.all(np.abs(off) > near) and abs(off[1] - off[0]) <= float(np.max(near)):
            why = f"{said}: both ends are off by {np.mean(off):+.3g} K, as of another thermometer; compare the two"
        else:
            continue  # a soak over another range
        reason = Outlier(units[k], THERMOMETER, "", 0.0, float(np.mean(off)), None, why, ())
        found[units[k]] = (reason, *found.get(units[k], ()))
    return found
