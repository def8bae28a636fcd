"""A run on made-up samples, so that the first real one finds every loop compiled and every map loaded."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from driftlab.config import Config
from driftlab.filtering.needs import needed_channels
from driftlab.filtering.run import Run
from driftlab.filtering.stretch import Journal
from driftlab.samples.epochs import epochs
from driftlab.samples.screening import read
from fusion_core.chunk import Chunk
from fusion_core.faults import Faults
from fusion_core.kalman import SHORT


def warm_up(config: Config) -> None:
    """Run a config on a unit at rest, up to and past its alignment; a device would not wait for a compiler."""
    run = Run(config, Journal())
    model, rng = run.model, np.random.default_rng(0)
    interval = model.update_interval
    N = int(model.align / interval) + 2 * SHORT
    channels = {name: np.zeros(N) for name in needed_channels(model)}
    channels["temperature"] = np.full(N, np.mean(run.maps[0].domain) if run.maps else 20.0)
    channels.update(model.simulated(N, config.site, rng))
    whole = Chunk(np.arange(N, dtype=np.float64) * interval, channels)
    parts = [whole.part(0, N - 2), whole.part(N - 2, N - 1), whole.part(N - 1, N)]  # many at once, and one by one
    with suppress(Exception):  # what is wrong with it, a plugin's own defects too, the run itself will say
        for _ in run.over(epochs(read(config, Faults(), stream=parts), interval)):
            pass
