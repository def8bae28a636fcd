"""The error of a fitted curve as a few modes, so that errors at two inputs are correlated.

The error of a curve of d axes at T is taken as::

    e(T) = sum_i a_i m_i(T),    a_i ~ N(0, 1) independent,    Cov(e(T), e(T')) = sum_i m_i(T) m_i(T')

with the modes m_i given on a grid and straight in between. What is predicted from one input to another is off by
e(T) - e(T'), which vanishes where they meet. Beyond the grid the modes go on straight, and the curve may bend on the
way as it does inside: (bend x^2 / 2)^2 is added at the distance x. G grid points, r modes, N inputs.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from typing import Annotated, Any, Self

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, FiniteFloat, PlainSerializer, PlainValidator, model_validator

from fusion_core.chunk import Array, locked
from fusion_core.settings import Frozen


class Misfit(Frozen):
    """A place at which an axis bends more than its curve can follow, beyond what noise leaves by chance.

    Attributes
    ----------
    axis : int
        Which one, from 0.
    T : float
        Where a free curve is surest to be away from this one.
    left, noise : float
        How far it is there, and the standard deviation that the noise of the soak gives to that; in the unit of the
        curve.
    """

    axis: Annotated[int, Field(ge=0)]
    T: FiniteFloat
    left: FiniteFloat
    noise: Annotated[FiniteFloat, Field(ge=0)]


def numbers(values: Any) -> Array:
    """Return numbers, nested as they may be, as an array that cannot be written to."""
    with suppress(TypeError, ValueError, OverflowError):
        array = np.array(values, dtype=np.float64)
        if array.ndim and np.all(np.isfinite(array)):
            return locked(array)
    raise ValueError("finite numbers were expected, as many in each row")


Numbers = Annotated[Array, PlainValidator(numbers), PlainSerializer(np.ndarray.tolist)]
"""An array in a record: numbers nested in lists as JSON, read-only once they are read."""


def six_digits(modes: Array) -> Array:
    """Return modes (r, G, d) to six digits: a fleet has a map of each unit."""
    return np.array([float(f"{v:.6g}") for v in modes.ravel().tolist()]).reshape(modes.shape)


def modes_of_axes(per_axis: Sequence[Array]) -> Array:
    """Return the modes (r, G) of each axis as those of all (r, G, d)."""
    modes = np.zeros((max(map(len, per_axis)), per_axis[0].shape[1], len(per_axis)))
    for axis, of_axis in enumerate(per_axis):
        modes[: len(of_axis), :, axis] = of_axis
    return modes


class CurveError(Frozen):
    """The error of a fitted curve.

    Attributes
    ----------
    T : (G,) floats
        Inputs of the grid, rising.
    modes : (r, G, d) array
        In the unit of the curve; read-only.
    bend : (d,) floats
        Second derivative to reckon with beyond the grid, in the unit of the curve per squared unit of the input.
    holes : tuple of pairs
        Ranges without a sample.
    misfits : tuple of Misfit
        At most one an axis. Their part of the error is among the modes.
    """

    T: tuple[FiniteFloat, ...]
    modes: Numbers
    bend: tuple[FiniteFloat, ...]
    holes: tuple[tuple[FiniteFloat, FiniteFloat], ...] = ()
    misfits: tuple[Misfit, ...] = ()

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if len(self.T) < 2 or np.any(np.diff(self.T) <= 0):
            raise ValueError("the grid T does not rise")
        shape = self.modes.shape
        if len(self.modes) and shape[1:] != (len(self.T), len(self.bend)):
            raise ValueError(f"modes have the shape {shape}, not (r, {len(self.T)}, {len(self.bend)})")
        if any(misfit.axis >= len(self.bend) for misfit in self.misfits):
            raise ValueError(f"a misfit is of axis {max(misfit.axis for misfit in self.misfits)} of {len(self.bend)}")
        return self

    def beside(self, modes: Array, **fields: Any) -> Self:
        """Return the error with further modes (r, G, d) before its own, independent of them, and with other fields."""
        own = self.modes.reshape(-1, len(self.T), len(self.bend))
        return self.model_copy(update={"modes": locked(np.concatenate([modes, own])), **fields})

    @cached_property
    def _grid(self) -> Array:
        return np.array(self.T)

    def __eq__(self, other: object) -> bool:
        """Return True if all numbers are the same."""
        return isinstance(other, CurveError) and self.model_dump() == other.model_dump()

    def variance(self, T: ArrayLike, T_0: float | None = None) -> Array:
        """Return the variance (N, d) of the error at T (N,), or of its difference from that at T_0."""
        at = np.asarray(T, dtype=np.float64)
        e, ends = self._modes(at), self._beyond(at)
        if T_0 is not None:
            start = np.array([T_0])
            e, ends = e - self._modes(start), ends + self._beyond(start)
        return np.asarray(np.einsum("rNd,rNd->Nd", e, e) + ends)

    def at(self, T: ArrayLike) -> Array:
        """Return the modes (N, r, d) at T (N,)."""
        return np.ascontiguousarray(np.moveaxis(self._modes(np.asarray(T, dtype=np.float64)), 0, 1))

    def _modes(self, T: Array) -> Array:
        """Return the modes (r, N, d) at T (N,)."""
        grid, values = self._grid, self.modes
        if not len(values):
            return np.zeros((0, len(T), len(self.bend)))
        k = np.clip(np.searchsorted(grid, T) - 1, 0, len(grid) - 2)
        share = ((T - grid[k]) / (grid[k + 1] - grid[k]))[:, None]  # beyond the grid: the end pieces go on
        return np.asarray(values[:, k] + (values[:, k + 1] - values[:, k]) * share)

    def _beyond(self, T: Array) -> Array:
        x = np.maximum(np.maximum(self.T[0] - T, T - self.T[-1]), 0.0)
        return np.asarray(np.square(np.outer(x**2 / 2, self.bend)), dtype=np.float64)
