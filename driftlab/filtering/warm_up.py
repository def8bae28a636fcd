"""A run on made-up samples, so that the first real one finds every loop compiled and every map loaded."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from driftlab.config import Config
from driftlab.filtering.run import Run, needed_channels
from driftlab.filtering.stretch import Journal
from driftlab.filtering.tracker import FEW
from driftlab.samples.epochs import epochs
from driftlab.samples.screening import read
from driftlab.zupt.earth import gravity
from fusion_core.chunk import Chunk
from fusion_core.faults import Faults
from fusion_core.units import along_axes


def rehearse(config: Config) -> None:
    """Run a config on a unit at rest, up to and past its alignment; a device would not wait for a compiler."""
    run = Run(config, Journal())
    settings, rng = run.settings, np.random.default_rng(0)
    interval = settings.update_interval
    N = int(settings.align / interval) + 4 * FEW
    channels = {name: np.zeros(N) for name in needed_channels(settings)}
    channels["temperature"] = np.full(N, np.mean(run.maps[0].domain) if run.maps else 20.0)
    for name, section in (("gyro", settings.gyro), ("accel", settings.accel)):
        if section is not None:
            density = along_axes(section.noise, len(section.bias.axes))
            channels[name] = rng.normal(size=(N, len(density))) * density / np.sqrt(interval)
    if settings.accel is not None:
        channels["accel"][:, -1] += gravity(config.latitude)
    whole = Chunk(np.arange(N, dtype=np.float64) * interval, channels)
    parts = [whole.part(0, N - 2), whole.part(N - 2, N - 1), whole.part(N - 1, N)]  # many at once, and one by one
    with suppress(Exception):  # what is wrong with it, a plugin's own defects too, the run itself will say
        for _ in run.over(epochs(read(config, Faults(), stream=parts), interval)):
            pass
