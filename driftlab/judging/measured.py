"""What a map, and an Allan analysis, say of the quantities that a config limits (`driftlab.judging.limits`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.limits import Measured
from driftlab.maps.fit import axes_of
from driftlab.noise.model import KEYS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.noise.fit import Coefficients
    from fusion_core.contracts import FittedMap

POINTS = 1000  # temperatures at which a map's largest and smallest bias are looked for
WHITE, FLOOR = KEYS.index("white"), KEYS.index("bias_instability")


def of_map(fitted: FittedMap) -> dict[str, Measured]:
    """Return residual and swing of a fitted map.

    The residual is the rms of the samples of the fit about the curve, white noise included; how sure it is, no map
    says. The swing is as sure as the curve's change between the two temperatures.
    """
    record, axes = fitted.record, axes_of(fitted)
    low, high = record.domain
    where = f"{low:.4g} to {high:.4g} degC"
    if record.residual is None:
        residual = Measured(np.full(record.d, np.nan), axes, missing="the map's file does not say its residual")
    else:
        count = f"{record.samples:,} samples, " if record.samples else ""
        residual = Measured(np.asarray(record.residual), axes, stands_on=f"rms of {count}{where}")
    T = np.linspace(low, high, POINTS)
    bias = fitted.bias(T)
    top, bottom = np.argmax(bias, axis=0), np.argmin(bias, axis=0)
    swing = np.ptp(bias, axis=0)
    if record.error is None:
        return {"residual": residual, "swing": Measured(swing, axes, stands_on=f"the curve, {where}")}
    pairs = zip(top, bottom, strict=True)
    sigma = np.array([fitted.sigma(T[[k]], float(T[j]))[0, axis] for axis, (k, j) in enumerate(pairs)])
    reach = 2 * sigma
    found = Measured(swing, axes, swing - reach, swing + reach, f"the curve, {where}")
    return {"residual": residual, "swing": found}


def of_allan(
    coefficients: Sequence[Coefficients], axes: Sequence[str], span: float, *, of: str = ""
) -> dict[str, Measured]:
    """Return noise and bias instability of the d axes of a sensor, from the fit to its Allan curves.

    `span` is the length of what was used, s; `of` says what the curves are of, where it is not the sensor itself.
    A bias instability that does not show is judged by its upper limit.
    """
    stands_on = f"Allan deviation of {of}{span:.4g} s"
    found = {}
    for name, k in (("noise", WHITE), ("bias_instability", FLOOR)):
        value, low, high = (np.array([getattr(c, end)[k] for c in coefficients]) for end in ("value", "low", "high"))
        found[name] = Measured(value, axes, low, high, stands_on)
    return found
