"""The level of the map of each unit: its bias at one temperature that most of them saw, as it was measured.

No family is in it, so that a shift of the line is not drawn towards what was usual before. d axes.
"""

from __future__ import annotations

from collections import Counter

import numpy as np

from driftlab.family.knots import STEP
from driftlab.family.law import Units
from fusion_core.chunk import Array


def levels_of(units: Units) -> tuple[float, dict[str, Array]]:
    """Return a temperature (degC), and by unit the mean bias (d,), SI, that was measured within half a step of it.

    The temperature is the middle one of those that most units saw; a unit that did not see it has no level. NaN, and
    no levels, where there are no units.
    """
    seen: Counter[int] = Counter()
    means: dict[str, tuple[Array, Array]] = {}
    for soaked, _ in units:
        rows = soaked.recordings[0]  # of a further one the level is its own
        cell = np.round(rows.T / STEP).astype(int)
        cells, place = np.unique(cell, return_inverse=True)
        sums = np.stack([np.bincount(place, rows.bias[:, k]) for k in range(rows.bias.shape[1])], axis=1)
        means[soaked.unit] = (cells, (sums / np.bincount(place)[:, None]).astype(np.float32))
        seen.update(cells.tolist())
    if not seen:
        return float("nan"), {}
    most = max(seen.values())
    common = sorted(cell for cell, count in seen.items() if count == most)
    middle = common[len(common) // 2]
    found = {
        unit: mean[cells == middle][0].astype(np.float64) for unit, (cells, mean) in means.items() if middle in cells
    }
    return middle * STEP, found
