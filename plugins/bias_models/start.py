"""How little is known of a bias before the first sample."""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array

WIDE = 1.0  # SI unit of the bias: far beyond any sensor's, so the first seconds at rest overrule it


def deviation(sigma_0: float | None, d: int) -> Array:
    """Return the deviations (d,) before the first sample: `sigma_0` where it is declared, else `WIDE`."""
    return np.full(d, WIDE if sigma_0 is None else sigma_0)
