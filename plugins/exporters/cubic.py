"""A polynomial of low order fitted to a map with weights where it flies, for firmware that holds nothing else.

::

    b(T) ~ sum_i c_i (T - T_ref)^i,    i = 0 .. order
    c = argmin sum_k w_k |b(T_k) - sum_i c_i (T_k - T_ref)^i|^2

T_k are dense and even over the map's domain; w_k is 1 where it flies and `OUTSIDE` elsewhere, so that what it flies
through decides, and the rest stays bounded. The fit is solved in Chebyshev polynomials of the domain, which is well
conditioned, and only then written in powers of T - T_ref. Cutting a better map down to its first terms would keep the
error of what was cut. N samples, n = order + 1 coefficients, d axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.polynomial import Polynomial, chebyshev

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Exporter, FittedMap, SensorLoss, beyond_a_map, causes, warm_up
from fusion_core.contracts.calibrated import TEMPERATURES
from fusion_core.errors import ConfigError
from fusion_core.units import Unit

TRIAD = ("x", "y", "z")
OUTSIDE = 1e-3  # weight where it does not fly: an error there may be some 30 times that where it does


class Cubic(Exporter):
    """An exporter to firmware that holds a polynomial of temperature: its settings say where the vehicle flies."""

    flies_from: Annotated[float, Unit("degC", example="10 degC")] | None = None
    """Lowest temperature of the sensor in use; below it the fit counts little. The map's own lowest by default."""
    flies_to: Annotated[float, Unit("degC", example="50 degC")] | None = None
    """Highest temperature of the sensor in use. The map's own highest by default."""

    def flown(self, domain: tuple[float, float]) -> tuple[float, float] | None:
        """Return where it flies within the map's domain; None where nothing is said of it.

        Raises
        ------
        ConfigError
            If nothing of the domain is left.
        """
        if self.flies_from is None and self.flies_to is None:
            return None
        low = domain[0] if self.flies_from is None else max(float(self.flies_from), domain[0])
        high = domain[1] if self.flies_to is None else min(float(self.flies_to), domain[1])
        if not low < high:
            raise ConfigError(
                f"flies_from, flies_to: {low:.6g} to {high:.6g} °C is nothing of the map's domain ({domain[0]:.6g}, "
                f"{domain[1]:.6g}); give temperatures within it"
            )
        return low, high


def places(kind: str, sensor: Calibrated) -> list[int]:
    """Return which of a firmware's axes x, y, z the map's axes are.

    Raises
    ------
    ConfigError
        If one of them is none of those.
    """
    if not set(sensor.axes) <= set(TRIAD):
        raise ConfigError(
            f"export {kind}: {sensor.channel} has the axes {', '.join(sensor.axes)}, expected some of x, y, z, those "
            "of the sensor; name the axes so"
        )
    return [TRIAD.index(axis) for axis in sensor.axes]


def uncorrected(sensor: Calibrated) -> tuple[str, ...]:
    """Return in words what becomes of axes that the map does not have."""
    missing = [axis for axis in TRIAD if axis not in sensor.axes]
    return (f"{sensor.channel}: the map has no {', '.join(missing)}, which stay uncorrected",) if missing else ()


def polynomial(fitted: FittedMap, order: int, T_ref: float, flown: tuple[float, float] | None) -> Array:
    """Return coefficients (n, d) of powers of T - `T_ref` that follow the map best where it flies."""
    low, high = fitted.domain
    T = np.linspace(low, high, TEMPERATURES)
    bias = fitted.bias(T)
    x = (2 * T - (low + high)) / (high - low)
    first, last = flown or (low, high)
    root = np.sqrt(np.where((first <= T) & (last >= T), 1.0, OUTSIDE))[:, None]
    c = np.linalg.lstsq(root * chebyshev.chebvander(x, order), root * bias, rcond=None)[0]
    scale = 2 / (high - low)  # x = scale (T - T_ref) + offset
    inner = Polynomial([scale * T_ref - (low + high) / (high - low), scale])
    columns = [chebyshev.Chebyshev(column).convert(kind=Polynomial)(inner) for column in c.T]
    return np.stack([np.pad(p.coef, (0, order + 1 - len(p.coef))) for p in columns], axis=1)


def powers(T: Array, T_ref: float, c: Array) -> Array:
    """Return the polynomial (N, d) of coefficients c (n, d) at T (N,), in double precision."""
    return np.asarray(np.polynomial.polynomial.polyval(T - T_ref, c).T)


def measured(
    sensor: Calibrated,
    exact: Callable[[Array], Array],
    clipped: Callable[[Array], Array],
    target: Callable[[Array], Array],
    renewed: Callable[[Chunk], Array],
    flown: tuple[float, float] | None,
) -> tuple[SensorLoss, tuple[str, ...]]:
    """Measure what a polynomial in firmware loses, and from what; and return in words what it leaves out.

    Parameters
    ----------
    exact, clipped, target : functions of T (N,) -> (N, d)
        The polynomial in double precision, the same within the firmware's limits, and what the firmware makes of it.
    renewed : function of a Chunk -> (N, d)
        What is in use over a recording, where the firmware does not renew it at once.
    flown : (float, float) or None
        Where it flies.
    """
    seen, left_out = beyond_a_map(sensor)
    recording = warm_up(sensor.fitted.domain)
    T = recording["temperature"]
    steps = {
        "truth": seen.bias(recording),
        "effects beyond a map": sensor.fitted.bias(T),
        "the polynomial in place of the map": exact(T),
        "the limits of temperature": clipped(T),
        "single precision": target(T),
        "its renewal in stairs": renewed(recording),
    }
    return SensorLoss.measured(seen, target, renewed, causes(steps), flown), left_out
