"""What the filter answers, checked before it is believed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import BadValue
from fusion_core.model import Estimates


def check_finite(found: Estimates, t: Array, when: Callable[[float], str]) -> None:
    """Raise BadValue where the estimates at t (N,) in s are not finite numbers; `when` words a time."""
    if np.isfinite(np.vdot(found.x, found.x) + np.vdot(found.sigma, found.sigma)):
        return  # nearly always, and in one pass; what overflows is looked at below
    good = np.all(np.isfinite(found.x) & np.isfinite(found.sigma), axis=1)
    if not np.all(good):
        raise not_finite(t[int(np.argmin(good))], when)


def not_finite(t: float, when: Callable[[float], str]) -> BadValue:
    """Return the error of an estimate that is not a finite number at t, s."""
    return BadValue(
        f"filter: the estimate is not a finite number at {when(t)}; check noise, walk and sigma_0 in "
        "the config, and the samples there"
    )
