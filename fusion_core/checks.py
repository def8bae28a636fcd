"""Checks of the arrays of a stretch of samples, made once: shapes, kinds of numbers, covariances.

Behind this file arrays are float64, contiguous, and of the shapes that the core's conventions name: N samples, n
states, m components.

`check_shape` and `common_lead` are for arrays whose leading axis, time, may be left out.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import isfinite
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Flags
from fusion_core.model import Measurement, State, Transition

Shape = tuple[int, ...]
ROUNDING = 1e-9  # of a covariance, relative to its deviations: less asymmetry is rounding
FEW = 4096  # numbers, of which BLAS takes sums in one thread
FLOAT = np.dtype(np.float64)
KINDS = {"f": ("fiu", "numbers"), "b": ("b", "true or false")}


class NotFinite(ValueError):
    """An estimate is not a finite number; `sample` is the first such one of the stretch."""

    def __init__(self, sample: int) -> None:
        super().__init__(
            f"estimate: the state is not a finite number after sample {sample} of the stretch; "
            "look for NaN and for values too large in P, F, Q, u, H, R and z there"
        )
        self.sample = sample


class TooWide(ValueError):
    """P is so much wider than R that double precision cannot hold both; `sample` is the first such one."""

    def __init__(self, sample: int) -> None:
        super().__init__(
            f"estimate: P at sample {sample} of the stretch is too wide beside R for double precision (1e26 times and "
            "more; 1e12 times where it is nearly singular); begin with a smaller P, or run more samples in one call"
        )
        self.sample = sample


def checked_state(state: State) -> State:
    """Return a state x (n,), P (n, n) with P symmetric and no variance below zero, or raise ValueError."""
    n = np.size(state.x)
    if n == 0:
        raise ValueError("estimate: x has no state, at least one was expected")
    x = numbers("x", state.x, (n,), "of the states")
    return State(finite("x", x), covariance("P", numbers("P", state.P, (n, n), f"for the {n} states of x")))


def checked_transition(transition: Transition, n: int, N: int) -> Transition:
    """Return F, Q (n, n) or (N, n, n) and u (n,) or (N, n), or raise ValueError; C is looked at by its shape alone."""
    why = f"for n = {n} states and N = {N} samples"
    F, Q = (numbers(name, getattr(transition, name), (n, n), (N, n, n), why) for name in ("F", "Q"))
    u = numbers("u", transition.u, (n,), (N, n), why)
    C = transition.C
    if C is not None:
        d = np.shape(C)[-2] if np.ndim(C) >= 2 else 0
        C = numbers("C", C, (d, n), (N, d, n), why)
    return Transition(F if F.ndim == 3 else finite("F", F), Q if Q.ndim == 3 else covariance("Q", Q), u, C)


def checked_measurement(measurement: Measurement, n: int) -> Measurement:
    """Return z (N, m), H (m, n) or (N, m, n), R (m, m) or (N, m, m) and used (N, m), or raise ValueError.

    What is masked in z is not used.
    """
    if np.ndim(measurement.z) != 2:
        raise ValueError(
            f"estimate: z has shape {np.shape(measurement.z)}, (N, m) was expected; time is the first axis"
        )
    N, m = np.shape(measurement.z)
    why = f"for n = {n} states and z of N = {N} samples and m = {m} components"
    missing = np.ma.getmaskarray(measurement.z) if np.ma.isMaskedArray(measurement.z) else None
    z = numbers("z", measurement.z if missing is None else np.ma.filled(measurement.z, 0), (N, m), why)
    H = numbers("H", measurement.H, (m, n), (N, m, n), why)
    R = numbers("R", measurement.R, (m, m), (N, m, m), why)
    used = flags("used", measurement.used, (N,), (N, m), why)
    if used.ndim == 1:
        used = np.ones((N, m), dtype=np.bool_) if used.all() else np.repeat(used[:, None], m, axis=1)
    used = used if missing is None else used & ~missing
    if R.ndim == 2:
        covariance("R", R)
    elif not np.allclose(R, np.swapaxes(R, 1, 2), rtol=ROUNDING, atol=0.0):
        raise ValueError("estimate: R is not symmetric or not finite at every sample, covariances were expected")
    if not R.diagonal(axis1=-2, axis2=-1).min(initial=np.inf) > 0:
        raise ValueError("estimate: R has a variance of zero, more was expected; leave a component out by used")
    return Measurement(z, H if H.ndim == 3 else finite("H", H), R, used)


def checked_reset(reset: Flags | None, n: int) -> Flags:
    """Return the flags (n,) of states that start again."""
    return np.zeros(n, dtype=np.bool_) if reset is None else flags("reset", reset, (n,), f"for n = {n} states")


def numbers(name: str, value: object, *expected: Shape | str) -> Array:
    """Return an array of float64 of one of the expected shapes; the last of them says in words what asks for it."""
    # what is read-only would have compiled loops of its own
    if type(value) is np.ndarray and value.dtype == FLOAT and value.shape in expected and value.flags.carray:
        return value  # nearly always, and quickly
    return np.require(_array(name, value, "f", *expected), np.float64, ["C", "W"])


def flags(name: str, value: object, *expected: Shape | str) -> Flags:
    """Return an array of bool of one of the expected shapes."""
    if type(value) is np.ndarray and value.dtype == np.bool_ and value.shape in expected and value.flags.carray:
        return value
    return np.require(_array(name, value, "b", *expected), np.bool_, ["C", "W"])


def _array(name: str, value: object, kind: str, *expected: Shape | str) -> NDArray[Any]:
    allowed, words = KINDS[kind]
    if np.ma.is_masked(value):
        raise ValueError(f"estimate: {name} has masked values; only those of z are taken as missing, fill the others")
    try:
        array = np.asarray(value)
    except ValueError:
        raise ValueError(f"estimate: {name} is a list of unequal rows, an array was expected") from None
    *shapes, why = expected
    if array.shape not in shapes:
        some = " or ".join(map(str, dict.fromkeys(shapes)))
        raise ValueError(f"estimate: {name} has shape {array.shape}, {some} was expected {why}; time is the first axis")
    if not array.size and kind == "b":  # an empty list is one of numbers
        return array.astype(np.bool_)
    if array.dtype.kind not in allowed:
        raise ValueError(f"estimate: {name} is of type {array.dtype}, {words} were expected; convert it with astype")
    return array


def all_finite(array: Array) -> bool:
    """Return True if all numbers are finite; of few the sum of squares says so soonest, of many it takes threads."""
    return (array.size < FEW and isfinite(np.vdot(array, array))) or bool(np.isfinite(array).all())


def finite(name: str, array: Array) -> Array:
    """Return the array, or raise ValueError where it is not finite."""
    if not all_finite(array):
        raise ValueError(f"estimate: {name} has NaN or infinity, numbers were expected; leave a sample out by used")
    return array


def covariance(name: str, matrix: Array, *, sample: int | None = None) -> Array:
    """Return a matrix (n, n) as it is, or raise where it is no covariance by its looks.

    NotFinite where that is of a `sample`, else ValueError.
    """
    sound = min(matrix.diagonal().tolist(), default=0.0) >= 0 and isfinite(np.vdot(matrix, matrix))
    if sound and matrix.tobytes() == matrix.T.tobytes():
        return matrix  # nearly always, and quickly
    if sample is not None and not np.isfinite(matrix).all():
        raise NotFinite(sample)
    variances = np.diagonal(finite(name, matrix))
    if np.any(variances < 0):
        raise ValueError(f"estimate: {name} has a variance below zero, a covariance was expected")
    sigma = np.sqrt(variances)
    if np.any(np.abs(matrix - matrix.T) > ROUNDING * sigma[:, None] * sigma):
        raise ValueError(f"estimate: {name} is not symmetric, a covariance was expected; take ({name} + {name}.T) / 2")
    return matrix


def common_lead(who: str, arrays: Mapping[str, Array], ndim: int) -> tuple[int, ...]:
    """Return the leading (N,) of the arrays, or () where none has one; raises ValueError where they differ."""
    leads = {name: array.shape[0] for name, array in arrays.items() if array.ndim > ndim}
    if len(set(leads.values())) > 1:
        counts = ", ".join(f"{name} {N}" for name, N in leads.items())
        raise ValueError(f"{who}: steps differ in number ({counts}); give each N of them, or one without leading N")
    return tuple(leads.values())[:1]


def check_shape(who: str, what: str, array: Array, shape: tuple[int, ...], *, lead: bool = False) -> None:
    """Raise ValueError where an array is not of that shape; with `lead`, (N, *shape) will do too."""
    have = np.shape(array)
    if have == shape or (lead and have[1:] == shape and len(have) == len(shape) + 1):
        return
    last = ", ".join(map(str, shape))
    alone = f"({last},)" if len(shape) == 1 else f"({last})"
    expected = f"{alone} or (N, {last})".replace("(N, )", "(N,)") if lead else alone
    raise ValueError(f"{who}: {what} has the shape {have}, {expected} was expected; time comes first, then states")
