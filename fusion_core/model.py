"""State, transition, measurement and estimates of the filter, as arrays."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from fusion_core.chunk import Array, Flags, Integers


@dataclass(frozen=True)
class State:
    """Mean x (n,) and covariance P (n, n): after a measurement, or before the first."""

    x: Array
    P: Array


Prior = State  # the word of plugins for the state of their block before the first measurement


@dataclass(frozen=True)
class Transition:
    """The steps that lead to N samples: x_k = F_k x_{k-1} + u_k + w_k, w_k ~ N(0, Q_k).

    Attributes
    ----------
    F, Q : (n, n) or (N, n, n) arrays
        Transition and noise covariance; without the leading N, the same for every step.
    u : (n,) or (N, n) array
        Known drift of the step.
    C : (d, n) or (N, d, n) array, or None
        The bias as a function of the states, where they are not the bias itself. It comes with the
        transition since it may depend on the same memory.
    """

    F: Array
    Q: Array
    u: Array
    C: Array | None = None

    @property
    def invariant(self) -> bool:
        """True if F, Q and C are the same for every step."""
        return self.F.ndim == 2 and self.Q.ndim == 2 and (self.C is None or self.C.ndim == 2)

    def part(self, rows: slice) -> Transition:
        """Return the steps of some samples; what is the same for every step stays so."""
        F, Q = (a if a.ndim == 2 else a[rows] for a in (self.F, self.Q))
        C = self.C if self.C is None or self.C.ndim == 2 else self.C[rows]
        return Transition(F, Q, self.u if self.u.ndim == 1 else self.u[rows], C)


@dataclass(frozen=True)
class Measurement:
    """N measurements: z_k = H_k x_k + r_k, r_k ~ N(0, R_k).

    Attributes
    ----------
    z : (N, m) array
        What a masked array masks is not used.
    H : (m, n) or (N, m, n) array
    R : (m, m) or (N, m, m) array
        Positive definite.
    used : (N,) or (N, m) array of bool
        False where there is no measurement: a component is no part of its sample then, and a sample without any only
        predicts the state. What z, H and R have there is not looked at.
    """

    z: Array
    H: Array
    R: Array
    used: Flags

    @property
    def invariant(self) -> bool:
        """True if H and R are the same at every sample, and every sample is measured."""
        return self.H.ndim == 2 and self.R.ndim == 2 and bool(self.used.all())

    def part(self, rows: slice) -> Measurement:
        """Return the measurements of some samples."""
        H, R = (a if a.ndim == 2 else a[rows] for a in (self.H, self.R))
        return Measurement(self.z[rows], H, R, self.used[rows])


class Estimates(NamedTuple):
    """The results of the filter for N samples.

    Attributes
    ----------
    x, sigma : (N, n) arrays
        State after the measurement and its standard deviation.
    y : (N, m) array
        Innovation z - H x before the measurement; NaN where there was none.
    white : (N, m) array
        Innovation divided by the lower Cholesky factor of S: N(0, I) where the model is right, NaN where it is missing.
    nis : (N,) array
        Normalised innovation squared of the components that were measured: chi-square with `dof` degrees of freedom
        where the model is right, 0 where there were none.
    log_det : (N,) array
        Logarithm of the determinant of their S, 0 where there were none.
    dof : (N,) array of int
        Number of components that were measured.
    used : (N,) array of bool
        False where no component was measured, or the gate refused what was.
    state : State
        After the last sample.
    P : (N, n, n) array or None
        Covariance after each measurement, where it was asked for.
    """

    x: Array
    sigma: Array
    y: Array
    white: Array
    nis: Array
    log_det: Array
    dof: Integers
    used: Flags
    state: State
    P: Array | None = None

    def log_likelihood(self) -> float:
        """Return the log-likelihood of the measurements that were used."""
        terms = self.nis + self.log_det + self.dof * np.log(2 * np.pi)
        return float(-0.5 * np.sum(terms[self.used]))


def join(parts: Iterable[Estimates]) -> Estimates:
    """Join the estimates of consecutive stretches."""
    parts = list(parts)
    if len(parts) == 1:
        return parts[0]

    names = [name for name in Estimates._fields if name not in ("state", "P")]
    names += [] if parts[0].P is None else ["P"]
    arrays = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return Estimates(**arrays, state=parts[-1].state)
