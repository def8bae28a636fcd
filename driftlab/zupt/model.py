"""The zero-velocity (ZUPT) model: what an inertial unit at rest tells about its biases.

Attitude and velocity are frozen at the alignment. What the unit's own integration then shows as motion is error
(Fontanella et al. 2018, sec. 2.1)::

    attitude error  psi_k = psi_{k-1} + tau (omega_k - omega_ie) - int b_g        (rad)
    velocity error  v_k   = v_{k-1}   + tau (f_k - f_ref)        - int b_a        (m/s)
    measured        0 = psi_k + r_psi,     0 = v_k + r_v

in the axes of the unit as they were frozen: since the reference attitude is known, specific force is resolved through
it and not through the drifting one, so that no small-angle limit holds and the triads do not mix. The integrals of
the biases over the tau seconds that were integrated, with rho = tau / dt and the block's x_k = F x_{k-1} + u + w::

    int b = tau C (rho/2 x_{k-1} + (1 - rho/2) x_k),     left out: tau^2 (rho/3 - rho^2/4) C Q C'

which is exact for a random walk, gaps included. States: velocity error, attitude error (3 each), then the blocks of
the accelerometer and gyro bias models: 12 for two random walks.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.config import Filter, PerAxis
from driftlab.zupt.alignment import Alignment
from fusion_core.chunk import Array, Chunk, constant
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.errors import ConfigError, PluginError
from fusion_core.host.answers import check_prior, check_transition
from fusion_core.model import Measurement, State
from fusion_core.statespace import Block, StateSpace
from fusion_core.units import along_axes

MOST_DIGITS = 3e7  # prior deviation over that of one update; its square times the rounding of a double is 0.2


@dataclass(frozen=True)
class Triad:
    """One triad of sensors: the integral of its error, and the model of its bias."""

    channel: str  # of the rate that is integrated
    integral: str  # what the integral is called
    noise: Array  # (d,) white-noise density
    shake: Array  # (d,) deviation of the frozen reference
    model: BiasModel


class Zupt:
    """The model of one config, as blocks: integrals first, then the bias blocks."""

    def __init__(self, settings: Filter) -> None:
        gyro, accel, rest = settings.gyro, settings.accel, settings.rest

        def triad(channel: str, integral: str, noise: PerAxis, rest: float | None, model: BiasModel) -> Triad:
            density = along_axes(noise, len(model.axes))
            shake = 0.03 * density * np.sqrt(settings.update_interval) if rest is None else np.full_like(density, rest)
            return Triad(channel, integral, density, shake, model)

        self.tau = float(settings.update_interval)  # usual duration of an epoch [s]
        self.triads = [triad("gyro", "attitude_error", gyro.noise, rest.attitude, gyro.bias)]
        if accel is not None:
            self.triads.insert(0, triad("accel", "velocity_error", accel.noise, rest.velocity, accel.bias))
        unit = {"gyro": ("rad", "rad/s"), "accel": ("m/s", "m/s^2")}
        blocks = [_block(t.integral, t.model.axes, unit[t.channel][0]) for t in self.triads]
        self.m = sum(block.n for block in blocks)
        blocks += [_bias_block(t, unit[t.channel][1]) for t in self.triads]
        self.space = StateSpace(blocks)
        self.n, self.labels, self.units = self.space.n, self.space.labels, self.space.units
        self.integrals = {t.channel: self.space.places[t.integral] for t in self.triads}
        self.blocks = {t.channel: self.space.places[f"{t.channel}_bias"] for t in self.triads}
        self.reset = self.space.flags(*(t.integral for t in self.triads))  # anew at a refused measurement
        self._H, self._R = np.eye(self.m, self.n), np.diag(np.concatenate([t.shake**2 for t in self.triads]))
        self._kept: tuple[tuple[bytes, ...], tuple[Array, Array]] | None = None  # the last F and Q that did not vary

    @property
    def components(self) -> list[str]:
        """Sensor and axis of the m measured components."""
        return [f"{t.channel} {axis}" for t in self.triads for axis in t.model.axes]

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the gyro's d axes."""
        return self.triads[-1].model.axes

    def prior(self) -> State:
        """State before any epoch: integrals at zero, exactly; biases as their models say."""
        return self._composed([triad.model.prior() for triad in self.triads])

    def prior_at(self, chunk: Chunk) -> State:
        """State before the step that leads to the chunk's first epoch, which is the first of all."""
        return self._composed([triad.model.prior_at(chunk) for triad in self.triads])

    def prior_again(self, memories: list[Memory]) -> State:
        """State after the epoch that the bias models' memories are of, where the unit is aligned anew."""
        pairs = zip(self.triads, memories, strict=True)
        return self._composed([triad.model.prior_again(memory) for triad, memory in pairs])

    def _composed(self, priors: list[Prior]) -> State:
        for triad, prior in zip(self.triads, priors, strict=True):
            check_prior(triad.model, prior)
            self._check_digits(triad, np.sqrt(np.max(np.diag(prior.P))))
        return self.space.prior({f"{t.channel}_bias": prior for t, prior in zip(self.triads, priors, strict=True)})

    def _check_digits(self, triad: Triad, sigma_0: float) -> None:
        """Raise ConfigError where the prior is so wide that what one update tells of the bias is lost in rounding."""
        most = MOST_DIGITS * float(np.sqrt(np.min(triad.noise**2 / self.tau + (triad.shake / self.tau) ** 2)))
        if sigma_0 > most:
            raise ConfigError(
                f"filter.{triad.channel}.bias: the deviation before the first sample is {sigma_0:.3g} in SI, beyond "
                f"{most:.3g} the digits of a computer do not suffice beside filter.{triad.channel}.noise; "
                "set sigma_0 (or sigma of an estimated effect) lower"
            )

    def measurement(self, N: int) -> Measurement:
        """Zero motion, N times."""
        return Measurement(np.zeros((N, self.m)), self._H, self._R, np.ones(N, dtype=bool))

    def bias_steps(self, chunk: Chunk, memories: list[Memory]) -> tuple[list[Transition], list[Memory]]:
        """Ask each bias model for its steps, and check what it answers."""
        steps, after = [], []
        for triad, memory in zip(self.triads, memories, strict=True):
            step, memory = triad.model.transition(chunk, memory)
            check_transition(triad.model, step, len(chunk))
            steps.append(step)
            after.append(memory)
        return steps, after

    def transition(self, chunk: Chunk, steps: list[Transition], alignment: Alignment) -> Transition:
        """Put the bias models' steps and the integrals of the epochs together."""
        dt, tau = chunk.dt, constant(chunk["tau"])
        arrays = [dt, tau, *(a for step in steps for a in (step.F, step.Q, step.C) if a is not None)]
        if max(a.ndim for a in arrays) <= 2 and dt.ndim == tau.ndim == 0:  # nearly always, and then always the same
            key = tuple(a.tobytes() for a in arrays)
            if self._kept is None or self._kept[0] != key:
                self._kept = key, self._matrices(dt, tau, steps)
            F, Q = self._kept[1]
        else:
            F, Q = self._matrices(dt, tau, steps)
        drifts = {}
        late = (tau * (1 - tau / dt / 2))[..., None]
        for triad, step in zip(self.triads, steps, strict=True):
            drift = step.u if step.C is None else np.einsum("...ij,...j->...i", step.C, step.u)
            turned = chunk["tau"][:, None] * (chunk[triad.channel] - alignment.rest_of(triad.channel))
            drifts[triad.integral], drifts[f"{triad.channel}_bias"] = turned - late * drift, step.u
        return Transition(F, Q, self.space.vector(drifts))

    def _matrices(self, dt: Array, tau: Array, steps: list[Transition]) -> tuple[Array, Array]:
        """Return F and Q: (n, n), or (N, n, n) where anything in them differs from step to step."""
        rho, parts, coupling, noise = tau / dt, {}, {}, {}
        early, late = (tau * rho / 2)[..., None, None], (tau * (1 - rho / 2))[..., None, None]
        left_out = (tau**2 * (rho / 3 - rho**2 / 4))[..., None, None]
        for triad, step in zip(self.triads, steps, strict=True):
            integral, bias = triad.integral, f"{triad.channel}_bias"
            C = np.eye(len(triad.model.axes)) if step.C is None else step.C
            CQ = C @ step.Q
            parts[bias] = step
            coupling[integral, bias] = -(early * C + late * (C @ step.F))
            noise[integral, bias] = -late * CQ
            white = tau[..., None, None] * np.diag(triad.noise**2)
            noise[integral, integral] = (late**2 + left_out) * (CQ @ np.swapaxes(C, -1, -2)) + white
        whole = self.space.transition(parts, coupling, noise)
        return whole.F, whole.Q

    def white(self, chunk: Chunk) -> Array:
        """Return the part of Q that is the triads' white noise: (n, n), or (N, n, n) where tau is not constant."""
        return self._white(constant(chunk["tau"]))

    def _white(self, tau: Array) -> Array:
        density = np.zeros(self.n)
        for triad in self.triads:
            density[self.integrals[triad.channel]] = triad.noise**2
        white: Array = tau[..., None, None] * np.diag(density)
        return white


def _block(name: str, labels: tuple[str, ...], units: tuple[str, ...] | str) -> Block:
    return Block(name, tuple(f"{name}_{label}" for label in labels), units)


def _bias_block(triad: Triad, unit: str) -> Block:
    try:
        return _block(f"{triad.channel}_bias", triad.model.labels, tuple(triad.model.units(unit)))
    except ValueError as error:
        raise PluginError(f"{triad.model.kind}: {error}") from None
