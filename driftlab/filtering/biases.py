"""The bias blocks of a measurement model: what the bias models answer, put together; the host has checked it."""

from __future__ import annotations

from collections.abc import Sequence

from fusion_core.chunk import Chunk
from fusion_core.contracts import Alignment, MeasurementModel, Memory, State, Transition


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
