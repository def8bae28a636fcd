"""Bias that settles after switch-on: b = c + a exp(-t / tau), c and a unknown, plus a random walk of c."""

from collections.abc import Iterable
from typing import Annotated, Literal, Self

import numpy as np

from fusion_core.chunk import Chunk
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit


class WarmUp(BiasModel):
    """A constant and a decaying exponential, two states an axis."""

    kind: Literal["warm_up"] = "warm_up"
    tau: Annotated[float, Unit("s", positive=True, example="600 s")]
    """Time constant of the transient."""
    walk: Annotated[float, Unit("bias/sqrt(s)", least=0, example="1e-4 deg/s/sqrt(s)")]
    """Density of the constant's random walk."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        return (cls(tau=600.0, walk=1e-6), cls(tau=5.0, walk=0.0, axes=("x",)))

    @property
    def labels(self) -> tuple[str, ...]:
        return (*self.axes, *(f"{axis}_transient" for axis in self.axes))

    def prior(self) -> Prior:
        return Prior(np.zeros(2 * len(self.axes)), np.diag(np.tile(self.initial_sigma, 2) ** 2))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        one = np.eye(len(self.axes))
        dt = chunk.dt[..., None, None]
        F = np.kron(np.diag([1.0, 0.0]), one) + np.exp(-dt / self.tau) * np.kron(np.diag([0.0, 1.0]), one)
        Q = self.walk**2 * dt * np.kron(np.diag([1.0, 0.0]), one)
        return Transition(F, Q, np.zeros(2 * len(one)), C=np.hstack([one, one])), memory


@hookimpl
def bias_models() -> list[type[BiasModel]]:
    return [WarmUp]
