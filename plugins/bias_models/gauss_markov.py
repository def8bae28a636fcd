"""Bias as a first-order Gauss-Markov process around an unknown constant.

::

    b_k = c + m_k,    m_k = exp(-dt / tau) m_{k-1} + w_k,    w_k ~ N(0, sigma^2 (1 - exp(-2 dt / tau)))

Two states an axis: the constant c (turn-on bias) and the correlated part m, with stationary standard deviation
`sigma`. Source: Brown and Hwang, Introduction to Random Signals and Applied Kalman Filtering, 4th ed., sec. 4.2.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Literal, Self

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import BiasModel, Memory, Prior, Transition
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Unit, along_axes


@hookimpl
class GaussMarkov(BiasModel):
    """Bias as an exponentially correlated process around an unknown constant."""

    kind: Literal["gauss_markov"] = "gauss_markov"
    sigma: Annotated[float | tuple[float, ...], Unit("bias", least=0, example="10 deg/h")]
    """Stationary deviation of the correlated part."""
    tau: Annotated[float, Unit("s", positive=True, example="300 s")]
    """Correlation time of the correlated part."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return a slow and a fast one."""
        return (cls(sigma=5e-5, tau=300.0), cls(sigma=(5e-5, 0.0), tau=2.0, axes=("x", "y")))

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the states: the constants, then the correlated parts."""
        return (*self.axes, *(f"{axis}_markov" for axis in self.axes))

    def prior(self) -> Prior:
        """Return zero, with the stationary variance for the correlated part."""
        d = len(self.axes)
        variance = np.concatenate([self.initial_sigma**2, along_axes(self.sigma, d) ** 2])
        return Prior(np.zeros(2 * d), np.diag(variance))

    def transition(self, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
        """Return the exact discretisation, whatever the step's duration."""
        d = len(self.axes)
        decay = np.exp(-chunk.dt / self.tau)[..., None, None]
        variance = along_axes(self.sigma, d) ** 2
        F = _diagonal(np.ones(d), 0) + decay * _diagonal(np.ones(d), 1)
        Q = (1 - decay**2) * _diagonal(variance, 1)
        return Transition(F, Q, np.zeros(2 * d), C=np.hstack([np.eye(d), np.eye(d)])), memory


def _diagonal(values: Array, half: int) -> Array:
    """Return a diagonal (2d, 2d) with `values` in its first (0) or second (1) half."""
    which = np.diag(np.eye(2)[half])
    return np.asarray(np.kron(which, np.diag(values)), dtype=np.float64)
