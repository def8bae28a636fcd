"""Scale factor, misalignment and g-sensitivity of a triad as functions of temperature.

The readings y of a triad whose input is u, under a specific force f, are::

    y = (I + M(T)) u + b(T) + G(T) f,    M_ij: change of what axis i reads with the input along axis j

The diagonal of M holds the errors of the scale factors, the rest the misalignments; G is a gyro's g-sensitivity. Each
of the 9 terms of a matrix is a piecewise cubic through values and slopes at K temperatures, which holds constants,
lines, parabolas, cubics and the cubic spline exactly. N samples.
"""

from __future__ import annotations

from functools import cached_property
from typing import Literal, Self

import numpy as np
from pydantic import FiniteFloat, model_validator

from fusion_core.chunk import Array, Flags
from fusion_core.settings import Frozen
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.record_texts import Plain

Rows = tuple[tuple[FiniteFloat, ...], ...]
Frame = Literal["given", "sensor"]

TERMS = 9
SINGULAR = 0.5  # largest sum of |M_ij| along a row: beyond, an axis reads another one


class MatrixCurve(Frozen):
    """A matrix over temperature, as a map's record holds it: of a gyro's g-sensitivity, in its unit per m/s^2.

    Attributes
    ----------
    T : (K,) floats
        Temperatures, rising, degC.
    values, slopes : (K, 9) floats
        The matrix there, row by row, and its derivative with temperature.
    kinds : (9,) texts
        The curve of each term.
    told : (9,) bools
        Whether the stimulus shows a term; one that it does not is zero.
    error : CurveError, optional
        Of the 9 terms, with how their errors go together. Its modes are those of the error of the bias, one by one.
        None of a matrix that was imported: not known.
    """

    T: tuple[FiniteFloat, ...]
    values: Rows
    slopes: Rows
    kinds: tuple[Plain, ...]
    told: tuple[bool, ...]
    error: CurveError | None = None

    @model_validator(mode="after")
    def _whole(self) -> Self:
        shape = (len(self.T), TERMS)
        if len(self.T) < 2 or np.any(np.diff(self.T) <= 0):
            raise ValueError("the temperatures of the matrix do not rise")
        if np.shape(self.values) != shape or np.shape(self.slopes) != shape:
            raise ValueError(f"values and slopes of the matrix are not of the shape {shape}")
        if {len(self.kinds), len(self.told), len(self.error.bend) if self.error else TERMS} != {TERMS}:
            raise ValueError(f"kinds, told and error of the matrix are not of its {TERMS} terms")
        return self

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        return np.asarray(self.T), np.asarray(self.values), np.asarray(self.slopes)

    def terms(self, T: Array) -> Array:
        """Return the terms (N, 9) at T (N,) degC within the temperatures of the matrix, row by row."""
        grid, values, slopes = self._arrays
        k = np.clip(np.searchsorted(grid, T, side="right") - 1, 0, len(grid) - 2)
        h = (grid[k + 1] - grid[k])[:, None]
        x = np.clip((T - grid[k])[:, None] / h, 0.0, 1.0)
        left, right = (1 + 2 * x) * (1 - x) ** 2, x**2 * (3 - 2 * x)
        bent = h * x * (1 - x) * ((1 - x) * slopes[k] - x * slopes[k + 1])
        return np.asarray(left * values[k] + right * values[k + 1] + bent)

    def at(self, T: Array) -> Array:
        """Return the matrix (N, 3, 3) at T (N,) degC."""
        return self.terms(T).reshape(-1, 3, 3)

    def sigma(self, T: Array) -> Array:
        """Return the standard deviation (N, 9) of the terms at T (N,) degC; NaN where it is not known."""
        return np.full((len(T), TERMS), np.nan) if self.error is None else np.asarray(np.sqrt(self.error.variance(T)))


class TriadMatrix(MatrixCurve):
    """The matrix M(T) of scale factor and misalignment, a number.

    Attributes
    ----------
    frame : str
        `given`: all 9 terms are from the frame of the stimulus. `sensor`: that the triad defines itself, z along its
        z axis and y in the plane of y and z; the terms below the diagonal are zero.
    """

    frame: Frame

    @model_validator(mode="after")
    def _can_be_inverted(self) -> Self:
        rows = np.abs(np.asarray(self.values)).reshape(-1, 3, 3).sum(axis=2)
        if np.max(rows) >= SINGULAR:
            raise ValueError(f"a row of the matrix adds up to {np.max(rows):.3g}, below {SINGULAR:g} was expected")
        return self

    @property
    def free(self) -> Flags:
        """True for the terms (9,) that the frame leaves free, row by row."""
        whole = np.ones((3, 3), dtype=bool)
        return (whole if self.frame == "given" else np.triu(whole)).ravel()

    def distortion(self, less: Array, T: Array) -> Array:
        """Return M u (N, 3), the part of readings less their bias (I + M) u (N, 3) that is no input."""
        u = np.linalg.solve(np.eye(3) + self.at(T), less[:, :, None])[:, :, 0]
        return np.asarray(less - u)
