"""What a map, an Allan analysis and a run say of the quantities that a config limits (`driftlab.judging.limits`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from driftlab.judging.limits import Measured
from driftlab.judging.yardsticks import HORIZONS, WINDOW
from driftlab.maps.fit import axes_of
from driftlab.noise.model import KEYS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.judging.yardsticks import Yardsticks
    from driftlab.noise.fit import Coefficients
    from fusion_core.chunk import Array
    from fusion_core.contracts import Alignment, FittedMap, Sensor

COAST = "10 min"  # the horizon that a limit is about
ENOUGH = 0.9  # of it that must have been measured at rest
POINTS = 1000  # temperatures at which a map's largest and smallest bias are looked for
WHITE, FLOOR = KEYS.index("white"), KEYS.index("bias_instability")


def of_map(fitted: FittedMap) -> dict[str, Measured]:
    """Return residual and swing of a fitted map.

    The residual is the rms of averages of the fit's samples about the curve, in which white noise hardly counts; how
    sure it is, no map says. The swing is as sure as the curve's change between the two temperatures.
    """
    record, axes = fitted.record, axes_of(fitted)
    low, high = record.domain
    where = f"{low:.4g} to {high:.4g} degC"
    if record.averaged_residual is None:
        residual = Measured(
            np.full(record.d, np.nan), axes, missing="the map's file does not say its residual in averages; fit it anew"
        )
    else:
        averages = f"{record.averaged_over:g} s averages, {record.samples:,} samples, {where}"
        residual = Measured(np.asarray(record.averaged_residual), axes, stands_on=averages)
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


def of_coast(yardsticks: Yardsticks, length: float, noise: Array) -> Measured:
    """Return the coast of a run: the rms of its error over the first 10 minutes; the rest is as of `coast_over`."""
    return coast_over(COAST, yardsticks, length, noise)


def coast_over(horizon: str, yardsticks: Yardsticks, length: float, noise: Array) -> Measured:
    """Return the rms of a prediction's error over one of HORIZONS.

    `length` is of what there is after the alignment, s; `noise` (d,) the density of the white noise. The uncertainty is
    that of the reference, an average over 30 s whose white noise is `s^2 = noise^2 / 30 s`. With M the mean square of
    error and noise over T::

        Var M = 4 e^2 s^2 (30 s / T) + 2 s^4 (20 s / T),    e^2 = M - s^2,    sigma of rms = sqrt(Var M) / (2 rms)

    since a moving average over W of white noise has the correlation 1 - |lag| / W, which adds up to W, and its square
    to 2 W / 3.
    """
    ends = HORIZONS[horizon]
    T, values, share = min(ends, length), yardsticks.coast[horizon], yardsticks.share[horizon]
    axes, first = yardsticks.axes, f"the first {horizon}" if np.isfinite(ends) else "all that follows the alignment"
    if np.isfinite(ends) and length < ends * (1 - 1e-9):
        text = f"there are {length / 60:.3g} min after the alignment; record {ends / 60:g} or more"
        return Measured(values, axes, missing=text)
    if not share >= ENOUGH:
        text = f"{100 * share:.0f} % of {first} were measured at rest; {100 * ENOUGH:.0f} % are needed"
        return Measured(values, axes, missing=text)
    s2 = noise**2 / WINDOW
    e2 = np.maximum(values**2 - s2, 0.0)
    variance = (4 * e2 * s2 * WINDOW + 2 * s2**2 * 2 * WINDOW / 3) / T
    sigma = np.sqrt(variance) / (2 * np.where(values > 0, values, np.nan))
    at_rest = f"{first}, {100 * share:.0f} % at rest"
    return Measured(values, axes, values - 2 * sigma, values + 2 * sigma, at_rest)


def of_alignment(sensor: Sensor, alignment: Alignment, align: float) -> Measured:
    """Return the white noise of a sensor over the alignment, which lasted `align` s.

    It is the scatter of differences of n neighbours; those overlap, so `(sigma of noise / noise)^2 = 3 / (4 n)`.
    """
    noise = sensor.noise * alignment.noise_ratio[sensor.channel]
    n = max(round(align / alignment.dt) - 1, 1)
    reach = 2 * noise * np.sqrt(0.75 / n)
    return Measured(noise, sensor.axes, noise - reach, noise + reach, f"the alignment, {align:.4g} s")
