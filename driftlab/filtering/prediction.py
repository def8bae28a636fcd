"""The tracked bias as it is told after each epoch, and as it is predicted from the end of the alignment on."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from driftlab.filtering.coasting import Coast, Uncertainty
from driftlab.filtering.extrapolation import Extrapolated, Extrapolation
from driftlab.filtering.plan import Plan
from driftlab.filtering.thermometer import Thermometer
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Alignment, State, ThermalBias, Transition
from fusion_core.contracts.thermometer import NO_STEPS
from fusion_core.model import Estimates


class Told(NamedTuple):
    """Bias and deviation, by the filter and by coasting, (N, d) each; of the latter NaN before the departure."""

    bias: Array
    sigma: Array
    coast: Array
    coast_sigma: Array


class Prediction:
    """The bias of the tracked sensor with all that its deviation holds.

    Parameters
    ----------
    plan : Plan
    first : Alignment
        From which on it coasts.
    """

    def __init__(self, plan: Plan, first: Alignment) -> None:
        tracked, fitted = plan.model.tracked, plan.fitted
        self.block = plan.model.places[tracked.channel]
        self.effects = isinstance(tracked.bias, ThermalBias) and bool(tracked.bias.effects)
        self.initial_error = plan.initial_error
        self.first = first
        self.coast: Coast | None = None  # from the end of the first alignment on
        known = NO_STEPS if fitted is None else fitted.record.steps
        self.thermometer = Thermometer(known, plan.model.temperature_rate.memory_s)
        self.uncertainty = Uncertainty(fitted, tracked.noise)
        self.extrapolation = Extrapolation(tracked.bias)
        self.departed = np.zeros(len(tracked.axes))  # what was extrapolated then

    def snapshot(self) -> dict[str, Any]:
        """Return what was learned so far."""
        return {
            "coast": self.coast,
            "thermometer": self.thermometer.snapshot(),
            "uncertainty": self.uncertainty.snapshot(),
            "extrapolated": (self.extrapolation.memory, self.departed),
        }

    def restore(self, snapshot: dict[str, Any]) -> None:
        """Go on from a snapshot."""
        self.coast = snapshot["coast"]
        self.thermometer.restore(snapshot["thermometer"])
        self.uncertainty.restore(snapshot["uncertainty"])
        memory, self.departed = snapshot["extrapolated"]
        self.extrapolation.memory = Extrapolated(*memory)
        if self.coast is not None:
            self.uncertainty.resumed(self.coast)

    def depart(self, state: State, after: Chunk) -> State:
        """End the alignment with the epochs that come after it; return the state that the filter goes on from."""
        at = after if after.previous is None else after.previous
        T_0 = float(at["temperature"][-1]) if "temperature" in at.channels else np.nan
        block = self.block
        self.coast = Coast(state.x[block], state.P[block, block], self.first.t, T_0)
        self.uncertainty.departed(self.coast)
        self.departed = self.extrapolation.memory.last
        error = np.zeros(len(state.x))
        error[block.start : block.start + len(self.uncertainty.noise)] = self.initial_error
        return State(state.x + error, state.P)

    def look(self, done: Chunk, found: Estimates, step: Transition, alignment: Alignment) -> Told:
        """Return what is told of the bias over the next epochs, whose block went by `step`."""
        T = done.channels.get("temperature")
        error = None if T is None else self.thermometer.look(done)
        bias, variance = _output(found, self.block, step.C)
        sigma = self.uncertainty.of_estimate(variance, done["tau"] * found.used, T, error, alignment.unsure)
        x = self.extrapolation.look(done)
        left = self.extrapolation.of_estimate(x, variance, done.dt, self.uncertainty.noise)
        sigma = sigma if left is None else np.hypot(sigma, left)
        coast = coast_sigma = np.full_like(bias, np.nan)
        if self.coast is not None:
            coast, variance = self.coast.advance(len(done), step)
            coast_sigma = self.uncertainty.of_coast(variance, T, error, self.first.unsure)
            if x is not None or np.any(self.departed):
                coast_sigma = np.hypot(coast_sigma, (0.0 if x is None else x) - self.departed)
        late = self._to_the_end(done, step)
        return Told(bias + late, sigma, coast + late, coast_sigma)

    def _to_the_end(self, done: Chunk, step: Transition) -> Array:
        """Return what the known drift adds (N, d) from the middle of an epoch, of which its channels are, to its end.

        None where there are effects: their channels are not smoothed, and half a step more of them is more noise.
        """
        if self.effects:
            return np.zeros((len(done), 1))
        drift = step.u if step.C is None else np.einsum("...ij,...j->...i", step.C, step.u)
        share = done["tau"] / np.where(done.dt > 0, done.dt, np.inf) / 2
        return np.asarray(share[:, None] * drift)


def _output(found: Estimates, block: slice, C: Array | None) -> tuple[Array, Array]:
    """Return the bias (N, d) and its variance from the states of its block."""
    if C is None:
        return found.x[:, block], found.sigma[:, block] ** 2
    assert found.P is not None, "the deviation of an output needs P"
    variance = np.einsum("...ij,...jl,...il->...i", C, found.P[:, block, block], C)
    return np.einsum("...ij,...j->...i", C, found.x[:, block]), variance
