"""The terms of a triad as a stimulus tells them, over temperature, with their joint covariance.

n coefficients, q terms, N temperatures.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from driftlab.triad.model import (
    BIAS,
    GRID,
    NARROW,
    PARABOLA,
    SENSITIVITIES,
    SPAN,
    TERMS,
    TermCurve,
    TriadTerms,
    distinct,
)
from fusion_core.chunk import Array, Flags
from fusion_core.contracts import CurveError, MatrixCurve, TriadInput, TriadMatrix
from fusion_core.thermal.curve_error import six_digits

LEFT = 1e-3  # of the largest mode: smaller ones are left out of a file
# of the error: noise and walk, what was decided, the size of the input, what lies between temperatures
SOURCES = ("equations", "choice", "input", "temperatures")
TINY = 1e-30
UNOBSERVABLE = 0.5  # of the usual size: a term that is not known better is not observable
SURE = 1e-2  # of a usual bias: noise of an equation where a fit has not shown another


@dataclass(frozen=True, eq=False)
class TriadFit:
    """Terms of a triad that were fitted, with their joint covariance.

    Attributes
    ----------
    stimulus : TriadInput
    terms : TriadTerms
    domain : pair of float
        Temperatures of the stimulus.
    usual : (q,) array
        Sizes of the terms of a usual unit, beside which a deviation is large or small.
    free : (q,) array of bool
        Terms that were looked for, and are of the map.
    observable : (q,) array of bool
        Terms that the stimulus shows; the others are zero.
    unobservable_changes : (q,) array of bool
        Observable terms whose change over temperature is not observable.
    design, root : TriadTerms' curves and (n, n) array
        Curves of the error, and the root of the covariance of their coefficients.
    noise : tuple of float
        Deviation of an equation in each group.
    columns : tuple of int
        How many of the columns of the root are of each of SOURCES but the last.
    walk : float
        Density of the random walk of the bias, its unit/sqrt(s).
    level : float
        Deviation of the level of the bias from one recording to another; 0 where the recordings are too few to tell it.
    parabolas : pair of (9, 3) and (9, 3, 3) arrays, or None
        Terms of M as a family takes them, Chebyshev coefficients over the domain with their covariance; None where the
        temperatures or the equations are too few, or a family is their prior.
    distance : (float, int), or None
        Chi-square of the stimulus against the prior, and its degrees of freedom; None without a prior.
    """

    stimulus: TriadInput
    terms: TriadTerms
    domain: tuple[float, float]
    usual: Array
    free: Flags
    observable: Flags
    unobservable_changes: Flags
    design: Sequence[TermCurve]
    root: Array
    noise: tuple[float, ...]
    columns: tuple[int, ...]
    walk: float
    level: float = 0.0
    parabolas: tuple[Array, Array] | None = None
    distance: tuple[float, int] | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the q terms."""
        return (*TERMS, *SENSITIVITIES)[: len(self.free)]

    @property
    def has_bias(self) -> bool:
        """True where the bias of the map is of this fit."""
        return bool(np.any(self.free[list(BIAS)]))

    def without_bias(self) -> Self:
        """Return the fit for a map whose bias is another's: that of these equations is none of its terms."""
        free = self.free.copy()
        free[list(BIAS)] = False
        return replace(self, free=free, level=0.0)

    @cached_property
    def grid(self) -> Array:
        """Temperatures at which the error is kept."""
        low, high = self.domain
        middle, half = (low + high) / 2, max(high - low, NARROW) / 2
        return np.linspace(middle - half, middle + half, GRID if high - low >= NARROW else 2)

    def modes(self, T: Array) -> Array:
        """Return the modes (n, N, q) of the joint error of all terms at T (N,)."""
        parts, at = [], 0
        for curve in self.design:
            parts.append(curve.values(T) @ self.root[at : at + curve.q])
            at += curve.q
        return np.concatenate([np.stack(parts, axis=2).transpose(1, 0, 2), self._untested_modes(T)])

    @cached_property
    def temperatures(self) -> Array:
        """The temperatures (k,) of the stimulus that are apart."""
        return distinct(self.stimulus.T)

    def _untested_modes(self, T: Array) -> Array:
        """Return the modes (q, N, q) of terms between temperatures that any of their curves meets, where none is seen.

        About a single one a term moves by its usual size over SPAN, and in the middle between two it is off a straight
        line by it. Between more it is a Gaussian process of its usual size, alike over SPAN, given what it is there.
        """
        (low, high), seen = self.domain, self.temperatures
        x = T - (low + high) / 2
        shape = x / SPAN if len(seen) == 1 else np.clip(1 - (2 * x / (high - low)) ** 2, 0, 1)
        if len(seen) > PARABOLA:
            given, there = (np.exp(-(((a[:, None] - seen) / SPAN) ** 2) / 2) for a in (T, seen))
            known = np.sum(given * np.linalg.lstsq(there, given.T, rcond=None)[0].T, axis=1)
            shape = np.sign(np.prod(T[:, None] - seen, axis=1)) * np.sqrt(np.clip(1 - known, 0, None))
        lawless = np.array([curve.precision is None for curve in self.design])
        meets = np.array([curve.q >= len(seen) for curve in self.design]) | (len(seen) <= PARABOLA)
        sizes = self.usual * (self.observable & lawless & meets)
        return np.asarray(shape[None, :, None] * np.diag(sizes)[:, None, :])

    def sigma(self, T: Array) -> Array:
        """Return the deviation (N, q) of the terms at T (N,)."""
        return np.asarray(np.sqrt(np.sum(self.modes(np.atleast_1d(T)) ** 2, axis=0)))

    @cached_property
    def drowned(self) -> Flags:
        """True for terms (q,) that what is left of the equations hides, where it would not with a usual noise."""
        e = self.stimulus.equations(self.terms.at(self.stimulus.T))
        J = np.pad(e.J, ((0, 0), (0, len(self.free) - e.J.shape[1])))
        part = UNOBSERVABLE * self.usual * np.sqrt(np.sum(J[e.group == 0] ** 2, axis=0))
        return np.asarray((self.noise[0] > part) & (part > SURE * self.usual[0]) & ~self.observable)

    def parts(self, T: Array) -> dict[str, Array]:
        """Return the deviation (N, q) of the terms at T (N,) by source."""
        parts = np.split(self.modes(T), np.cumsum(self.columns))
        return {name: np.sqrt(np.sum(part**2, axis=0)) for name, part in zip(SOURCES, parts, strict=True)}

    def change(self) -> tuple[Array, Array]:
        """Return the change of each term (q,) from the lowest to the highest temperature, and its deviation."""
        ends = self.grid[[0, -1]]
        values, modes = self.terms.at(ends), self.modes(ends)
        return values[1] - values[0], np.sqrt(np.sum((modes[:, 1] - modes[:, 0]) ** 2, axis=0))

    @cached_property
    def _joint_modes(self) -> Array:
        """Modes (r, G, q) on the grid, those alone that matter beside the deviation of some term."""
        modes = self.modes(self.grid)
        size = np.sqrt(np.sum(modes**2, axis=0)) + TINY
        _, s, V = np.linalg.svd((modes / size).reshape(len(modes), -1), full_matrices=False)
        kept = s > LEFT * s[0]
        return np.asarray((s[kept, None] * V[kept]).reshape(-1, *size.shape) * size)

    def curve_error(self, part: slice) -> CurveError:
        """Return the error of some terms as a map's record holds it; its modes are those of all terms, one by one."""
        T = self.grid
        curve = self.terms.at(T)[:, part]
        bend = 8 * np.ptp(curve, axis=0) / np.ptp(T) ** 2
        modes = six_digits(self._joint_modes[:, :, part])
        return CurveError(T=tuple(T.tolist()), modes=modes, bend=tuple(bend.tolist()))

    def matrix(self) -> TriadMatrix:
        """Return M over temperature as a map's record holds it."""
        frame = "sensor" if self.stimulus.sensor_frame else "given"
        return TriadMatrix.model_validate({**self._curve(slice(3, 12)), "frame": frame})

    def sensitivity(self) -> MatrixCurve | None:
        """Return G over temperature as a map's record holds it; None where none of it was looked for."""
        return MatrixCurve.model_validate(self._curve(slice(12, 21))) if np.any(self.free[12:]) else None

    def _curve(self, part: slice) -> dict[str, object]:
        """Return the fields of the 9 terms of a matrix."""
        from scipy.interpolate import CubicSpline

        (low, high), h = (self.grid[0], self.grid[-1]), 1e-3
        bent = any(curve.q > 4 for curve in self.terms.curves)
        T = np.linspace(low, high, int(np.clip(np.ceil(high - low), 4, 150)) + 1 if bent else 4)
        inside = np.clip(T, low + h, high - h)
        slopes = (self.terms.at(inside + h) - self.terms.at(inside - h))[:, part] / (2 * h)
        if not bent:  # exact for a cubic through four points
            slopes = CubicSpline(T, self.terms.at(T)[:, part])(T, 1)
        return {
            "T": tuple(T.tolist()), "values": tuple(map(tuple, self.terms.at(T)[:, part].tolist())),
            "slopes": tuple(map(tuple, slopes.tolist())), "told": tuple(self.observable[part].tolist()),
            "kinds": tuple(curve.name for curve in self.terms.curves[part]), "error": self.curve_error(part),
        }  # fmt: skip
