"""What the filter answers, checked: a defect never becomes an estimate. Of plugins, `fusion_core.contracts.answers`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts.answers import check_prior, check_transition
from fusion_core.errors import BadValue
from fusion_core.model import Estimates

__all__ = ["check_prior", "check_transition", "finite"]


def finite(run: Callable[[], Estimates], t: Array) -> Estimates:
    """Run the filter over the samples at t (N,) in s; raises BadValue where its estimates are not finite numbers."""
    try:
        found = run()
        good = np.all(np.isfinite(found.x) & np.isfinite(found.sigma), axis=1)
        first = -1 if np.all(good) else int(np.argmin(good))
    except np.linalg.LinAlgError:
        first = 0
    if first >= 0:
        raise BadValue(
            f"filter: the estimate is not a finite number at t = {t[first]:.6g} s; check noise, walk and sigma_0 in "
            "the config, and the samples there"
        )
    return found
