"""The error-state (indirect) filter: what is estimated is the error of a nominal state, and is fed back into it.

A nominal state follows its own equations, which need not be linear; x is its error, small, with a linear model. A
stretch of samples is propagated at once, the filter runs over its measurements, and at its end the error moves into the
nominal state (P. S. Maybeck, Stochastic Models, Estimation, and Control, vol. 1 (1979), sec. 6.4-6.5)::

    nominal <- correct(nominal, x),     x <- 0,     P <- G P G'

G (n, n) is the Jacobian of the error that is left with respect to x: the identity, but where the correction turns the
axes that the error is written in. N is the number of samples, n that of error states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np

from fusion_core.checks import check_shape
from fusion_core.chunk import Array, Flags
from fusion_core.kalman import estimate
from fusion_core.model import Estimates, Measurement, State, Transition

Nominal = TypeVar("Nominal")
Path = TypeVar("Path")


@dataclass(frozen=True)
class Segment(Generic[Path, Nominal]):
    """A stretch of samples from one feedback to the next.

    Attributes
    ----------
    rows : slice
        Which of all samples.
    path : object
        The nominal state on its way, as `propagate` returned it.
    estimates : Estimates
        Of the error at each sample, before it was fed back.
    nominal : object
        At the end, corrected.
    state : State
        Of the error after the feedback: x = 0.
    """

    rows: slice
    path: Path
    estimates: Estimates
    nominal: Nominal
    state: State


def feed_back(
    state: State,
    nominal: Nominal,
    ends: Flags,
    propagate: Callable[[Nominal, slice], tuple[Path, Transition, Measurement]],
    correct: Callable[[Path, Array], Nominal],
    *,
    gate: float = np.inf,
    jacobian: Callable[[Array], Array] | None = None,
    keep_P: bool = False,
) -> Iterator[Segment[Path, Nominal]]:
    """Run the filter over N samples, and yield each segment as it is done.

    Parameters
    ----------
    state : State
        Of the error before the first step. What x it has is moved into the first nominal state at the first feedback.
    nominal : object
        The nominal state before the first step, of any type.
    ends : (N,) array of bool
        Samples after which the error is fed back, usually those that end a stretch of measurements. The last sample
        always does.
    propagate : callable
        Given the nominal state before a segment and the slice of its samples, returns the nominal state on its way
        (any object), and the error's Transition and Measurement of these samples.
    correct : callable
        Given what `propagate` returned first and the error x (n,) at the end, returns the nominal state there without
        the error.
    gate : float
        As in `fusion_core.kalman.estimate`.
    jacobian : callable, optional
        Given the error x (n,) that is fed back, returns G (n, n).
    keep_P : bool
        Whether the estimates have P (N, n, n).

    Raises
    ------
    ValueError
        If `ends` is not (N,) bool, or a shape does not fit the state.
    """
    marks, n = np.asarray(ends), len(state.x)
    if marks.ndim != 1 or marks.dtype != np.bool_:
        raise ValueError(
            f"feed_back: ends is {marks.dtype} {marks.shape}, bool (N,) was expected; give one flag a sample"
        )
    stops = np.flatnonzero(marks) + 1
    if len(marks) and not marks[-1]:
        stops = np.append(stops, len(marks))
    start = 0
    for stop in stops.tolist():
        rows = slice(start, stop)
        path, transition, measurement = propagate(nominal, rows)
        check_shape("feed_back", "z of propagate", measurement.z, (stop - start, measurement.z.shape[-1]))
        estimates = estimate(state, transition, measurement, gate=gate, keep_P=keep_P)
        x, P = estimates.state.x, estimates.state.P
        nominal = correct(path, x)
        if jacobian is not None:
            G = jacobian(x)
            check_shape("feed_back", "the jacobian", G, (n, n))
            P = G @ P @ G.T
        state = State(np.zeros(n), P)
        yield Segment(rows, path, estimates, nominal, state)
        start = stop
