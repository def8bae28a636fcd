"""Setup of a run: what stays the same from its first epoch to its last.

Checks of a measurement model's recording and maps before the filter runs, and its bias blocks, put together from the
bias models' own; the host has checked these.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from driftlab.units import BiasUnit, axis_name
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import (
    Alignment,
    BiasModel,
    FittedMap,
    MeasurementModel,
    Memory,
    Sensor,
    Site,
    State,
    ThermalBias,
    ThermalMap,
    Transition,
)
from fusion_core.contracts.table import DERIVED
from fusion_core.errors import ConfigError, MapError, MissingChannel
from fusion_core.settings import nearest

FORCE = "accel"  # the channel of the specific force
TURNED = 0.02  # rad, between two inputs: more is no bias
CHANCE = 1e-3  # probability that noise as it is declared is said to be another
ENOUGH = 3  # updates of an alignment
SEEN = np.log(100.0)  # of the evidence that up and down differ: one soak in 1,000 of all noises drawn has more
OFF = 5.0  # factor between measured and declared noise: more may be a wrong unit or path


def turned(one: Alignment, other: Alignment, channel: str) -> bool:
    """Return True if a unit lies in another way, by the input of a sensor."""
    a, b = one.inputs[channel], other.inputs[channel]
    return float(np.linalg.norm(a - b)) > TURNED * float(np.linalg.norm(a))


def shown_by_soak(fitted: FittedMap, axes: Sequence[str], unit: BiasUnit) -> str:
    """Return the difference between up and down of a map's soak, which no sigma has, as the end of a sentence."""
    memory = fitted.record.memory or {}
    answer, evidence, kinds, why = (memory.get(name) for name in ("answer", "log_evidence", "kinds", "why"))
    likely = answer == "undecided" and isinstance(evidence, int | float) and evidence > SEEN and isinstance(why, str)
    try:
        size = np.abs(np.array(memory.get("size"), dtype=np.float64))
    except (TypeError, ValueError):  # of a file that somebody has changed
        return ""
    if not (likely or answer == "seen") or size.shape != (len(axes),) or np.all(np.isnan(size)):
        return ""
    axis = int(np.nanargmax(size))
    apart = f"up and down differ by up to {size[axis] * unit.factor:.3g} {unit.shown}, {axes[axis]}"
    if not likely:
        named = " or ".join(map(str, kinds)) if isinstance(kinds, list | tuple) else ""
        return f"showed a {named or 'memory'}: {apart}"
    because = str(why).partition(";")[0].partition(": whether")[0].removeprefix("up and down differ ")
    return "" if "uncertainty" in because else f"showed that {apart} ({because})"


def too_few_updates(model: MeasurementModel, updates: int, apart: float) -> str:
    """Return in a sentence that an alignment has so few updates, fewer than ENOUGH and `apart` s, and what to set."""
    lower = ", or filter.update_interval lower" * (model.update_interval > model.align / ENOUGH)
    have = f"{updates} update{'s' * (updates != 1)}"
    return (
        f"an alignment of {model.align:g} s has {have} at most, {ENOUGH} are needed; set filter.align to "
        f"{ENOUGH * apart:.4g} s or more{lower}, or correct the unit of time"
    )


def noise_remarks(sensor: Sensor, ratios: Array, least: float = 2.0, updates: float = np.inf) -> list[str]:
    """Return a sentence on a sensor whose noise is not as declared, by a factor of `least`; nothing where it is.

    `ratios` (d,) are measured over declared noise, of the differences of so many `updates`: fewer show less of it.
    """
    if np.min(ratios) >= 1 / least and np.max(ratios) <= least:
        return []  # nearly always
    low, high = _by_chance(updates)

    def off(ratio: float, factor: float) -> bool:
        return not min(1 / factor, low) <= ratio <= max(factor, high)

    pairs = [pair for pair in zip(sensor.axes, ratios, strict=True) if off(pair[1], least)]
    if not pairs:
        return []
    single = axis_name(sensor.channel, sensor.axes[0]) == sensor.channel
    each = ", ".join(f"{ratio:.2g}" if single else f"{axis} {ratio:.2g}" for axis, ratio in pairs)
    path = f", or correct unit and path of source.channels.{sensor.channel}" if any(off(r, OFF) for r in ratios) else ""
    alike = ", unless neighbouring samples are alike, as those of a filter or of interpolation"
    return [
        f"{sensor.channel}: white noise is not as declared (measured / declared: {each}); "
        f"set {sensor.section}.noise{path}{alike if np.max(ratios) < 1 else ''}"
    ]


def _by_chance(updates: float) -> tuple[float, float]:
    """Return the least and the largest ratio that chance makes of the noise of so many updates.

    Mean squares of differences of neighbours about their mean, which share an update, vary as those of two thirds as
    many numbers, less one third.
    """
    if not np.isfinite(updates):
        return 1.0, 1.0
    from scipy.special import chdtri

    freedom = max(2 / 3 * (updates - 1) - 1 / 3, 1.0)
    low, high = (float(np.sqrt(chdtri(freedom, p) / freedom)) for p in (1 - CHANCE / 2, CHANCE / 2))
    return low, high


def noise_doubts(sensor: Sensor, ratios: Array, updates: float = np.inf) -> list[str]:
    """Return that sentence where the noise is far less than declared.

    So it is of an axis in another unit, of one that is not there, at its range, or filtered, and so is its bias.
    """
    return noise_remarks(sensor, ratios, OFF, updates) if np.min(ratios) < 1 / OFF else []


@dataclass(frozen=True)
class RunSetup:
    """Settings and maps of a run.

    Attributes
    ----------
    model : MeasurementModel
        The filter section of the config.
    site : Site
        Where the sensors are.
    calibrations : dict of str to FittedMap
        The maps that are subtracted first, by channel.
    followed : dict of str to FittedMap
        The maps that bias models follow, by channel.
    gate : float
        The nis beyond which an epoch is not used.
    initial_error : float
        Added to every axis of the tracked bias at the end of the alignment, in SI; unknown to the filter.
    keep_model : bool
        Whether the stretches keep the arrays that the filter was run on.
    """

    model: MeasurementModel
    site: Site
    calibrations: dict[str, FittedMap]
    followed: dict[str, FittedMap]
    gate: float
    initial_error: float
    keep_model: bool

    @property
    def fitted(self) -> FittedMap | None:
        """The map of the tracked sensor, whichever way it is used."""
        channel = self.model.tracked.channel
        return self.calibrations.get(channel) or self.followed.get(channel)

    def aligned_again(self, window: Chunk, before: Alignment) -> Alignment:
        """Return another alignment; a unit that lies as it did keeps an input of which only the length is known.

        What such a sensor shows there is its bias that has moved, and no tilt.
        """
        alignment, channel = self.aligned(window), self.model.tracked.channel
        if self.model.length_of_input(self.site) is None or turned(before, alignment, channel):
            return alignment
        return replace(alignment, inputs={**alignment.inputs, channel: before.inputs[channel]})

    def aligned(self, window: Chunk) -> Alignment:
        """Freeze the reference from a stretch at rest, as the filter sees it: calibrations subtracted."""
        return self.model.aligned(corrected(window, self.calibrations, self.followed), self.site)


def calibrations_of(model: MeasurementModel) -> dict[str, FittedMap]:
    """Return the maps that are subtracted from the sensors before the filter, by channel.

    Raises MapError where one cannot be read, or is of another channel, unit or number of axes than its sensor.
    """
    return {s.channel: loaded_map(s.calibration, s) for s in model.sensors if s.calibration is not None}


def other_calibrations(model: MeasurementModel) -> dict[str, FittedMap]:
    """Return those of the sensors that are not tracked, as far as they have been fitted already; raises as above."""
    others = ((s, s.calibration) for s in model.sensors if s.channel != model.tracked.channel)
    return {s.channel: loaded_map(c, s) for s, c in others if c is not None and c.path is not None and c.path.is_file()}


def loaded_map(settings: ThermalMap, sensor: Sensor) -> FittedMap:
    """Read the map that a config has for a sensor; raises MapError where it cannot be read, or is of another one."""
    fitted = settings.load()
    check_map(fitted, sensor)
    return fitted


def check_map(fitted: FittedMap, sensor: Sensor) -> None:
    """Raise MapError where a map is of another channel, another unit or other axes than its sensor."""
    record, d = fitted.record, len(sensor.axes)
    actual = (record.channel, record.unit, record.d)
    expected = (sensor.channel, sensor.unit, d)
    if actual != expected:
        raise MapError(
            f"{sensor.section}: the map ({record.kind}) is of the channel {actual[0]} in {actual[1]} with "
            f"{actual[2]} axes, {expected[0]} in {expected[1]} with {expected[2]} was expected; "
            "name a map that was fitted on this channel"
        )
    if record.axes and record.axes != sensor.axes:
        raise MapError(
            f"{sensor.section}: the map ({record.kind}) is of the axes {', '.join(record.axes)}, "
            f"{', '.join(sensor.axes)} were expected; name a map that was fitted on these axes"
        )


def subtracted(
    chunk: Chunk, calibrations: Mapping[str, FittedMap], followed: Mapping[str, FittedMap] | None = None
) -> dict[str, Array]:
    """Return the part (N, d) of each channel that is taken off before the filter.

    Of a calibration all that its map says, of a map that a bias model follows all but the bias. The force that strains
    a gyro is that of the accelerometers, less their own part; where there are none, g-sensitivity stays in.
    """
    parts: dict[str, Array] = {}
    for name, fitted in calibrations.items():
        parts[name] = fitted.bias(chunk["temperature"], chunk.t)
    maps = {**calibrations, **(followed or {})}
    for name in sorted(maps, key=lambda name: name != FORCE):
        record = maps[name].record
        if record.matrix is not None or record.sensitivity is not None:
            force = chunk[FORCE] - parts.get(FORCE, 0.0) if FORCE in chunk.channels and name != FORCE else None
            part = maps[name].distortion(chunk[name], chunk["temperature"], chunk.t, force)
            parts[name] = parts.get(name, 0.0) + part
    return parts


def corrected(
    chunk: Chunk, calibrations: Mapping[str, FittedMap], followed: Mapping[str, FittedMap] | None = None
) -> Chunk:
    """Return the chunk less what `subtracted` says."""
    parts = subtracted(chunk, calibrations, followed)
    return chunk.having(**{name: chunk[name] - part for name, part in parts.items()}) if parts else chunk


def followed_map(model: BiasModel) -> FittedMap | None:
    """Return the map that a bias model follows, if it follows one."""
    return model.fitted if isinstance(model, ThermalBias) else None


def needed_channels(model: MeasurementModel) -> set[str]:
    """Return the names of the channels that a recording must have."""
    needs = {name for sensor in model.sensors for name in (sensor.channel, *sensor.bias.requires)}
    calibrated = any(sensor.calibration is not None for sensor in model.sensors)
    return (needs | set(model.requires) | ({"temperature"} if calibrated else set())) - {"temperature_rate"}


def check_channels(model: MeasurementModel, chunk: Chunk) -> None:
    """Raise MissingChannel or ConfigError where the samples are not what the filter needs."""
    needed = needed_channels(model)
    optional = {sensor.channel for sensor in model.sensors if sensor.optional}
    for name in sorted(needed - set(chunk.channels)):
        others = sorted(set(chunk.channels) - DERIVED)
        like = nearest(name, set(others) - needed)
        without = f", or write `{name}: null` under filter"
        advice = without if name in optional else f", as '{like}' is" if like else ""
        raise MissingChannel(
            f"channel '{name}' is needed by the filter and the recording has {', '.join(others) or 'none'}; "
            f"name it under source.channels{advice}"
        )
    for sensor in reversed(model.sensors):
        channel, d = sensor.channel, len(sensor.axes)
        if chunk[channel].ndim != 2 or chunk[channel].shape[1] != d:
            axes = 1 if chunk[channel].ndim == 1 else chunk[channel].shape[1]
            raise ConfigError(
                f"{channel}: the recording has {axes} axes and the bias model {d}; name as many under bias.axes"
            )


def prior(model: MeasurementModel) -> State:
    """Return the state before anything is measured; raises PluginError or ConfigError where it cannot be used."""
    return model.prior([sensor.bias.prior() for sensor in model.sensors])


def prior_at(model: MeasurementModel, chunk: Chunk, alignment: Alignment) -> State:
    """Return the state before the step that leads to the chunk's first epoch, which is the first of all."""
    return model.prior([sensor.bias.prior_at(chunk) for sensor in model.sensors], alignment)


def prior_again(model: MeasurementModel, memories: Sequence[Memory], alignment: Alignment) -> State:
    """Return the state after the epoch that the bias models' memories are of, where the unit is aligned anew."""
    pairs = zip(model.sensors, memories, strict=True)
    return model.prior([sensor.bias.prior_again(memory) for sensor, memory in pairs], alignment)


def bias_steps(
    model: MeasurementModel, chunk: Chunk, memories: Sequence[Memory]
) -> tuple[list[Transition], list[Memory]]:
    """Return the steps of each bias block over N epochs, and the memories after them."""
    steps, after = [], []
    for sensor, memory in zip(model.sensors, memories, strict=True):
        step, memory = sensor.bias.transition(chunk, memory)
        steps.append(step)
        after.append(memory)
    return steps, after
