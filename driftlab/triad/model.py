"""The readings of a triad as a function of its input and of temperature, and the curves that its terms may follow.

::

    y = (I + M(T)) u + b(T) + G(T) f + noise,    M_ii: error of the scale factor,    M_ij: i reads the input along j

The 12 terms are the bias, 3, and M row by row, 9; 9 more are a gyro's g-sensitivity G, where that is asked for. A term
is a curve c' B(T): a constant, a polynomial of an order, or the curves that stand for an installed kind of map, as
smooth as their penalty has them. m equations, q coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial import chebyshev

from fusion_core.chunk import Array, Integers
from fusion_core.contracts import Equations, NetworkMap, ThermalMap
from fusion_core.contracts.stimulus import AXES as AXES
from fusion_core.contracts.stimulus import PAIRS as PAIRS
from fusion_core.contracts.stimulus import SENSITIVITIES as SENSITIVITIES
from fusion_core.contracts.stimulus import TERMS as TERMS
from fusion_core.contracts.stimulus import inverted as inverted
from fusion_core.errors import ConfigError

GRAVITY = 9.80665  # m/s^2, in a g
BIAS, SCALE = range(3), (3, 7, 11)
GROUPS = {"bias": [*BIAS], "scale": [*SCALE], "misalignment": [j for j in range(3, len(TERMS)) if j not in SCALE]}
NARROW = 2.0  # K: temperatures that move less have one value of each term
SPAN = 60.0  # K, over which a term of a usual unit moves by its usual size
ORDERS = 3  # highest order that is tried, where the map's kind names none
SMOOTHINGS = tuple(10.0**k for k in range(-3, 5))  # of a kind with a penalty, relative to its information
GRID = 25  # temperatures at which the error is kept


@dataclass(frozen=True, eq=False)
class TermCurve:
    """One form that a term may have over temperature, and the law N(mean, precision^-1) of its coefficients, if any."""

    name: str
    values: Callable[[Array], Array]  # of T (m,): (m, q)
    penalty: Array  # (q, q)
    mean: Array = field(default_factory=lambda: np.zeros(1))  # (q,), or zero
    precision: Array | None = None  # (q, q)

    @property
    def q(self) -> int:
        """Number of coefficients."""
        return len(self.penalty)


def polynomial(order: int, domain: tuple[float, float]) -> TermCurve:
    """Return the Chebyshev polynomials up to an order, on the domain."""
    low, high = domain

    def values(T: Array) -> Array:
        return np.asarray(chebyshev.chebvander(np.clip((2 * T - low - high) / max(high - low, 1e-9), -1, 1), order))

    return TermCurve("constant" if order == 0 else f"order {order}", values, np.zeros((order + 1, order + 1)))


PARABOLA = 2


@dataclass(frozen=True, eq=False)
class TermPrior:
    """Law of the 9 terms of M before a stimulus: Chebyshev coefficients of parabolas over a domain.

    Attributes
    ----------
    domain : pair of float
        In degC.
    mean, covariance : (9, 3) and (9, 3, 3) arrays
    """

    domain: tuple[float, float]
    mean: Array
    covariance: Array

    def curves(self) -> list[TermCurve]:
        """Return the curve of each term with its law."""
        values, flat = polynomial(PARABOLA, self.domain).values, np.zeros((PARABOLA + 1, PARABOLA + 1))
        laws = zip(self.mean, np.linalg.inv(self.covariance), strict=True)
        return [TermCurve("family", values, flat, mean, precision) for mean, precision in laws]


def distinct(T: Array) -> Array:
    """Return the temperatures (k,) among T (m,) that are apart: by NARROW, and by a tenth of the range."""
    found, apart = list[float](), max(NARROW, float(np.ptp(T)) / 10)
    for value in np.sort(T):
        if not found or value - found[-1] > apart:
            found.append(float(value))
    return np.array(found)


def curves_of(settings: ThermalMap, domain: tuple[float, float], temperatures: int) -> list[TermCurve]:
    """Return the forms that are tried for each term, the simplest first, none with more freedom than temperatures.

    Raises
    ------
    ConfigError
        If the kind is a network, whose coefficients no information matrix holds.
    """
    if isinstance(settings, NetworkMap):
        raise ConfigError(
            f"--kind {settings.kind}: is not linear in its coefficients, by which terms have their joint covariance; "
            "give --kind spline; a network may hold the bias alone, with --terms scale,misalignment --kind spline"
        )
    if domain[1] - domain[0] < NARROW:
        return [polynomial(0, domain)]
    most = min(getattr(settings, "order", ORDERS), temperatures - 1)
    curves = [polynomial(order, domain) for order in range(most + 1)]
    basis = settings.basis(domain)
    if np.any(basis.penalty) and temperatures > ORDERS:
        unit = basis.penalty / np.trace(basis.penalty) * len(basis.penalty)
        curves += [TermCurve(settings.kind, basis.values, smoothing * unit) for smoothing in SMOOTHINGS[::-1]]
    return curves


@dataclass(frozen=True, eq=False)
class TriadTerms:
    """The 12 or 21 terms over temperature: curves with their coefficients."""

    curves: Sequence[TermCurve]
    coefficients: Sequence[Array]  # (q_j,) of each

    def at(self, T: Array) -> Array:
        """Return the terms (N, 12), or (N, 21), at T (N,)."""
        T = np.atleast_1d(np.asarray(T, dtype=np.float64))
        return np.stack([c.values(T) @ x for c, x in zip(self.curves, self.coefficients, strict=True)], axis=1)

    def matrix(self, T: Array) -> Array:
        """Return M (N, 3, 3)."""
        return self.at(T)[:, 3:12].reshape(-1, 3, 3)

    def sensitivity(self, T: Array) -> Array:
        """Return G (N, 3, 3); zero where it was not asked for."""
        values = self.at(T)[:, 12:]
        return values.reshape(-1, 3, 3) if values.shape[1] else np.zeros((len(values), 3, 3))


def laws_of(curves: Sequence[TermCurve]) -> Array:
    """Return the precision (n, n) of the coefficients of curves by their own laws, zero of those that have none."""
    sizes = [curve.q for curve in curves]
    known, starts = np.zeros((sum(sizes), sum(sizes))), np.cumsum([0, *sizes])
    for curve, at in zip(curves, starts, strict=False):
        if curve.precision is not None:
            known[at : at + curve.q, at : at + curve.q] = curve.precision
    return known


def recordings_of(e: Equations) -> Integers:
    """Return the recording of each equation (m,)."""
    return np.zeros(len(e.t), dtype=np.int64) if e.recording is None else e.recording


def clocks_of(e: Equations) -> Integers:
    """Return the number of the clock of each equation: it goes on in a recording after the end of the one before."""
    names, own = np.unique(recordings_of(e), return_inverse=True)
    first, last = (np.array([end(e.t[own == k]) for k in range(len(names))]) for end in (np.min, np.max))
    return np.asarray(np.cumsum(np.concatenate([[0], first[1:] <= last[:-1]])))[own]
