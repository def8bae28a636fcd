"""Input of a triad as a config's recordings show it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.filtering.setup import corrected, other_calibrations
from driftlab.recordings.screening import read
from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import Sensor, TriadInput
from fusion_core.errors import ConfigError, MissingChannel
from fusion_core.faults import Faults

ROOM = 25.0  # degC, where there is no thermometer


@dataclass(frozen=True)
class Gathered:
    """The input of a triad, its number of samples, and the sensor that it is of."""

    stimulus: TriadInput
    rows: int
    sensor: Sensor


def stimulus_of(config: Config, recordings: Sequence[str], faults: Faults) -> Gathered:
    """Return the stimulus that a config describes, as its recordings hold it.

    Raises
    ------
    ConfigError, DataError
        If the config describes none, a table cannot be read, or the recordings do not hold it.
    """
    model, settings = config.filter, config.stimulus
    if model is None or len(model.tracked.axes) != 3:
        raise ConfigError("--terms: scale and misalignment are those of a triad; describe one under filter")
    if settings is None:
        raise ConfigError(
            "stimulus: is missing, so the input of the triad is not known; add `stimulus: {kind: positions}` to the "
            "config, or rate_table with its segments, or name one with --stimulus"
        )
    sensor = model.tracked
    configs = [with_recording(config, item) for item in recordings] or [config]
    chunks = [_samples(own, faults) for own in configs]
    known = settings.inputs(chunks, sensor.channel, config.site, model.length_of_input(config.site))
    return Gathered(known, sum(map(len, chunks)), sensor)


def _samples(config: Config, faults: Faults) -> Chunk:
    """Return all samples of a recording, the other sensors calibrated; without a thermometer at room temperature."""
    model = config.filter
    assert model is not None, "stimulus_of has seen to it"
    whole = concatenate(read(config, faults))
    if model.tracked.channel not in whole.channels:
        have = ", ".join(sorted(whole.channels))
        raise MissingChannel(
            f"channel '{model.tracked.channel}' is needed and the recording has {have}; name it under source.channels"
        )
    others = {name: fitted for name, fitted in other_calibrations(model).items() if name in whole.channels}
    if "temperature" not in whole.channels:
        faults.note(f"no thermometer: all samples are taken to be at {ROOM:g} °C, and the map holds there alone")
        whole = whole.having(temperature=np.full(len(whole), ROOM))
    return corrected(whole, others)
