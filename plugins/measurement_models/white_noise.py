"""How much white noise a stretch of epochs has, beside what is declared."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Sensor


def noise_ratios(window: Chunk, sensors: Sequence[Sensor]) -> dict[str, Array]:
    """Return the scatter of the epochs over what the declared noise makes of it, for each sensor (d,).

    The scatter is taken from differences of neighbours (a drift over the stretch does not count); 1 where there are
    none.
    """
    ratios = {}
    for sensor in sensors:
        values = window[sensor.channel]
        if len(values) < 2:
            ratios[sensor.channel] = np.ones(values.shape[1])
            continue
        spread = np.diff(values, axis=0) / np.sqrt(1 / window["tau"][1:] + 1 / window["tau"][:-1])[:, None]
        ratios[sensor.channel] = np.sqrt(np.mean(spread**2, axis=0)) / sensor.noise
    return ratios
