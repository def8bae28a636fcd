"""Earth rate and gravity at a latitude.

WGS 84: National Geospatial-Intelligence Agency, NGA.STND.0036 (2014), tables 3.1 and 3.6, eq. (4-1) (Somigliana).
"""

from __future__ import annotations

import math

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import ConfigError

RATE = 7.292115e-5  # rad/s
STANDARD_GRAVITY = 9.80665  # m/s^2


def gravity(latitude: float | None) -> float:
    """Return the magnitude of gravity on the ellipsoid in m/s^2; the standard value without a latitude (rad)."""
    if latitude is None:
        return STANDARD_GRAVITY
    s2 = math.sin(latitude) ** 2
    return 9.7803253359 * (1 + 0.00193185265241 * s2) / math.sqrt(1 - 0.00669437999014 * s2)


def known_gravity(latitude: float | None) -> tuple[float, float]:
    """Return gravity in m/s^2 and the deviation of that: some 500 m of height, or any latitude where it is None."""
    return gravity(latitude), 0.0015 if latitude is not None else 0.015


def earth_rate(up: Array, latitude: float, heading: float | None, x_level: Array | None = None) -> Array:
    """Return the Earth's rotation rate (3,) in rad/s in the axes of the unit.

    Parameters
    ----------
    up : (3,) array
        Unit vector that points up, in the axes of the unit.
    latitude : float
        In rad.
    heading : float or None
        Of the x axis, from north, clockwise seen from above, in rad. Without it only the vertical part is returned.
    x_level : (3,) array or None
        Unit vector that has the heading: level, in the axes of the unit. By default the level part of the x axis.

    Raises
    ------
    ConfigError
        If a heading is given, `x_level` is not, and the x axis is vertical.
    """
    vertical: Array = RATE * math.sin(latitude) * up
    if heading is None:
        return vertical
    if x_level is None:
        x_level = np.array([1.0, 0.0, 0.0]) - up[0] * up
        length = math.sqrt(x_level @ x_level)
        if length < 1e-3:
            raise ConfigError("heading: the x axis stands vertical and has none; leave heading out")
        x_level /= length
    (a, b, c), (x, y, z) = up.tolist(), x_level.tolist()
    across = np.array([b * z - c * y, c * x - a * z, a * y - b * x])  # up x x_level
    return np.asarray(vertical + RATE * math.cos(latitude) * (math.cos(heading) * x_level + math.sin(heading) * across))
