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

from typing import Annotated

import numpy as np
from numpy.polynomial import Polynomial, chebyshev

from fusion_core.chunk import Array
from fusion_core.contracts import Exporter, FittedMap
from fusion_core.errors import ConfigError
from fusion_core.units import Unit

OUTSIDE = 1e-3  # weight where it does not fly: an error there may be some 30 times that where it does
PLACES = 2001  # at which map and polynomial are compared


class Cubic(Exporter):
    """An exporter to firmware that holds a polynomial of temperature: its settings say where the vehicle flies."""

    flies_from: Annotated[float, Unit("degC", example="10 degC")] | None = None
    """Lowest temperature of the sensor in use; below it the fit counts little. The map's own lowest by default."""
    flies_to: Annotated[float, Unit("degC", example="50 degC")] | None = None
    """Highest temperature of the sensor in use. The map's own highest by default."""

    def flown(self, domain: tuple[float, float]) -> tuple[float, float]:
        """Return where it flies within the map's domain.

        Raises
        ------
        ConfigError
            If nothing of the domain is left.
        """
        low = domain[0] if self.flies_from is None else max(float(self.flies_from), domain[0])
        high = domain[1] if self.flies_to is None else min(float(self.flies_to), domain[1])
        if not low < high:
            raise ConfigError(
                f"flies_from {self.flies_from}, flies_to {self.flies_to}: nothing is left of the map's domain "
                f"({domain[0]:.6g}, {domain[1]:.6g}) degC; give temperatures within it"
            )
        return low, high


def polynomial(fitted: FittedMap, order: int, T_ref: float, flown: tuple[float, float]) -> Array:
    """Return coefficients (n, d) of powers of T - `T_ref` that follow the map best where it flies."""
    low, high = fitted.domain
    T = np.linspace(low, high, PLACES)
    x = (2 * T - (low + high)) / (high - low)
    root = np.sqrt(np.where((flown[0] <= T) & (flown[1] >= T), 1.0, OUTSIDE))[:, None]
    c = np.linalg.lstsq(root * chebyshev.chebvander(x, order), root * fitted.bias(T), rcond=None)[0]
    scale = 2 / (high - low)  # x = scale (T - T_ref) + offset
    inner = Polynomial([scale * T_ref - (low + high) / (high - low), scale])
    powers = [chebyshev.Chebyshev(column).convert(kind=Polynomial)(inner) for column in c.T]
    return np.stack([np.pad(p.coef, (0, order + 1 - len(p.coef))) for p in powers], axis=1)
