"""Contrasts of one unit for each effect, a curve of its own taken off.

Rows of a unit and an axis, whitened by the unit's own noise (`driftlab.noise.local_level`), are

    y = B(T) beta + Z_0 a + z c + noise,      B splines half as far apart as the family's, Z_0 effects already named

With Q an orthonormal basis of B and Z_0, r = y - QQ'y and e = z - QQ'z, generalised least squares gives

    c = e'r / e'e,      var c = 1 / e'e

The curve is free: nothing that a map could be, of the unit or of the family, counts for an effect. An effect of several
coefficients an axis is taken apart one after the other, each beside those before: their contrasts are independent.

Neither noise is ever exactly white and walk. So each e has PLACEBOS: itself, times cosines of few half waves over the
soak, orthogonal to Q, e and one another. They are as smooth as e, and lie where it lies; r along them is noise,
whatever its colour and wherever it grows.

R rows, d axes, K columns of all effects on one axis, J placebos.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from driftlab.family.basis import SplineBasis
from driftlab.family.unit_information import UnitInformation
from driftlab.identification.records import map_inputs
from driftlab.soak.blocks import SoakRows, runs
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import MissingChannel
from fusion_core.fast import compiled

PLACEBOS = 16  # waves
OWN = 0.05  # of e's square, that a placebo shares with no other
FINER = 2  # splines of a unit's own curve to one of the family's: a kink that the family's cannot follow is no effect
ROWS = 500  # of a recording: more are averaged
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
_SMOOTHING = tuple(10.0 ** np.arange(0, 10))  # of third differences
LEFT = 1e-4  # of a column's square, beside the curve: less is what rounding and the thermometer's noise leave


@dataclass(frozen=True, eq=False)
class EffectContrasts:
    """Contrasts of units for effects, a column a coefficient."""

    c: Array  # (..., d, K) coefficients, SI; 0 where a unit cannot show any
    information: Array  # (..., d, K) 1 / variance of each under the unit's own noise
    placebos: Array  # (..., d, K, J) noise along each placebo, in its own deviation; 0 where nothing of it is its own
    lots: tuple[str, ...] = field(default=(), kw_only=True)  # of units

    def of(self, columns: slice) -> EffectContrasts:
        """Return some of the columns."""
        some = self.c[..., columns], self.information[..., columns], self.placebos[..., columns, :]
        return EffectContrasts(*some, lots=self.lots)

    def flat(self, units: NDArray[np.intp] | slice = slice(None)) -> tuple[Array, Array, Array]:
        """Return coefficients, information (n, d K) and placebos (n, d K, J) of some units, axis by axis."""
        c, placebos = self.c[units], self.placebos[units]
        shape = len(c), c.shape[1] * c.shape[2]
        return c.reshape(shape), self.information[units].reshape(shape), placebos.reshape(*shape, placebos.shape[-1])


@lru_cache(maxsize=1)  # of the unit that is worked on
def chunks_of(soaked: UnitInformation) -> list[Chunk]:
    """Return the recordings as effects read them, the thermometer's noise taken off.

    That noise, times the slope that all maps have, is a lag in disguise: fast changes that the bias does not follow.
    """
    return [Chunk(rows.t, {**rows.channels, "temperature": without_noise(rows.T)}) for rows in soaked.recordings]


def signatures(effect: Effect, soaked: UnitInformation) -> list[Array]:
    """Return the signature of an effect in each recording (R, d, q), a coefficient of 1 each; of a lag, its own.

    A lag has no coefficient: it is the curve at the temperature of the element, less that at the thermometer's, with
    the unit's own curve. That curve's error is independent of the residual beside it. Raises MissingChannel if the
    unit's recordings lack a channel of the effect.
    """
    if not effect.acts_on_input:
        return [of_each_axis(effect.signature(chunk, None)[0]) for chunk in chunks_of(soaked)]
    curve, here = _own_curve(soaked)
    lagged = [soaked.knots.values(effect.input(chunk, None)[0]) @ curve for chunk in chunks_of(soaked)]
    return [(there - bias)[:, :, None] for there, bias in zip(lagged, here, strict=True)]


@lru_cache(maxsize=1)
def _own_curve(soaked: UnitInformation) -> tuple[Array, list[Array]]:
    """Return the coefficients (q, d) of the unit's own curve, and the curve (R, d) in each recording."""
    curve = own_curve(soaked).T
    return curve, [soaked.knots.values(chunk["temperature"]) @ curve for chunk in chunks_of(soaked)]


def columns_of(effects: Sequence[Effect], soaked: UnitInformation) -> list[Array]:
    """Return the signatures of effects side by side (R, d, K), of each recording."""
    none = [np.zeros((len(rows.t), len(soaked.axes), 0)) for rows in soaked.recordings]
    parts = zip(none, *(signatures(effect, soaked) for effect in effects), strict=True)
    return [np.concatenate(part, axis=2) for part in parts]


def seen_temperatures(soaked: UnitInformation, effects: Sequence[Effect]) -> list[Array]:
    """Return the temperatures (R,) of each recording that the curve sees where a unit has the effects."""
    chunks = (Chunk(rows.t, {**rows.channels, "temperature": rows.T}) for rows in soaked.recordings)
    return map_inputs(chunks, effects)


def of_each_axis(signature: Array) -> Array:
    """Return regressors (N, d, d q), of which each axis has q of its own, as (N, d, q)."""
    N, d, p = signature.shape
    return np.moveaxis(np.diagonal(signature.reshape(N, d, d, p // d), axis1=1, axis2=2), 2, 1)


def own_curve(soaked: UnitInformation) -> Array:
    """Return the coefficients (d, q) by the unit's own rows, hardly smoothed where there are none."""
    D = np.diff(np.eye(soaked.knots.q), n=2, axis=0)
    ridge = D.T @ D + 1e-4 * np.eye(soaked.knots.q)
    scales = 1e-4 * np.trace(soaked.J, axis1=1, axis2=2) / soaked.knots.q
    return np.stack([np.linalg.solve(J + s * ridge, h) for J, s, h in zip(soaked.J, scales, soaked.h, strict=True)])


class UnitRows:
    """Rows of a unit under its own noise, and effects in them.

    Effects `beside` are named already: a free coefficient each; the curve is one of the temperatures that they make.
    """

    def __init__(self, soaked: UnitInformation, beside: Sequence[Effect] = ()) -> None:
        self.soaked = soaked
        knots = SplineBasis.covering(*soaked.knots.domain, soaked.knots.step / FINER)
        curves = [knots.values(T) for T in seen_temperatures(soaked, beside)]
        have = set(soaked.recordings[0].channels) | {"temperature"}
        linear = [one for one in beside if set(one.requires) <= have and not one.acts_on_input]
        own = zip(columns_of(linear, soaked), soaked.recordings, strict=True)
        white = self._white([np.concatenate([X, rows.bias[:, :, None]], axis=2) for X, rows in own], curves)
        self.Q = [_orthonormal(X[:, :-1]) for X in white]
        self.r = [X[:, -1] - Q @ (Q.T @ X[:, -1]) for Q, X in zip(self.Q, white, strict=True)]

    def contrasts(self, effects: Sequence[Effect], sizes: Sequence[int]) -> EffectContrasts:
        """Return the contrasts for effects, `sizes` coefficients an axis each; 0 where their channels are missing."""
        recordings, d, K = self.soaked.recordings, len(self.soaked.axes), sum(sizes)
        parts = [np.zeros((len(rows.t), d, K)) for rows in recordings]
        at = 0
        for effect, size in zip(effects, sizes, strict=True):
            try:
                for part, values in zip(parts, signatures(effect, self.soaked), strict=True):
                    part[:, :, at : at + size] = values
            except MissingChannel:
                pass
            at += size
        axes = [self._of_axis(Q, r, Z, sizes) for Q, r, Z in zip(self.Q, self.r, self._white(parts), strict=True)]
        return EffectContrasts(*(np.stack(values) for values in zip(*axes, strict=True)))

    def estimates(self, effect: Effect) -> tuple[Array, Array]:
        """Return the coefficients (d, q) of an effect, all at once, and covariances (d, q, q); infinite where unseen.

        Raises MissingChannel if the unit's recordings lack a channel of the effect.
        """
        signature = self._white(signatures(effect, self.soaked))
        estimates = [_least_squares(Q, r, Z) for Q, r, Z in zip(self.Q, self.r, signature, strict=True)]
        c, covariances = (np.stack(values) for values in zip(*estimates, strict=True))
        return c, covariances

    def _of_axis(self, Q: Array, r: Array, Z: Array, sizes: Sequence[int]) -> tuple[Array, Array, Array]:
        e = Z - Q @ (Q.T @ Z)
        at = 0
        for count in sizes:  # Gram-Schmidt within an effect
            for k in range(at + 1, at + count):
                before = e[:, at:k]
                e[:, k] -= before @ np.linalg.lstsq(before, e[:, k], rcond=1e-10)[0]
            at += count
        square = np.sum(e * e, axis=0)
        seen = square > LEFT * np.sum(Z * Z, axis=0)
        square = np.where(seen, square, 0.0)
        size = np.where(seen, square, 1.0)
        along = e.T @ r / size
        drawn = _placebos(Q, r, e, size, along)
        return np.where(seen, along, 0.0), square, np.where(seen[:, None], drawn, 0.0)

    def _white(self, parts: Sequence[Array], alike: Sequence[Array] = ()) -> list[Array]:
        """Return columns (R, d, m) of each recording as one (R, m) an axis, under its noise; first those of any axis.

        `alike` (R, q) of each recording are the same on every axis.
        """
        columns = zip(parts, *([alike] if alike else []), strict=True)
        short = [averaged(rows, *of_rows) for rows, of_rows in zip(self.soaked.recordings, columns, strict=True)]
        white = []
        for axis, noise in enumerate(zip(self.soaked.white, self.soaked.walk, strict=True)):
            blocks = [
                rows.whitened(np.column_stack([*same, own[:, axis]]), *noise, free=k > 0)
                for k, (rows, (own, *same)) in enumerate(short)
            ]
            white.append(np.concatenate(blocks))
        return white


def _least_squares(Q: Array, r: Array, Z: Array) -> tuple[Array, Array]:
    """Return the coefficients (q,) of columns Z (R, q), and their covariance (q, q); infinite where unseen."""
    e = Z - Q @ (Q.T @ Z)
    N, scale = e.T @ e, np.linalg.norm(Z, axis=0)
    if np.any(scale == 0) or np.linalg.eigvalsh(N / np.outer(scale, scale))[0] <= LEFT:
        return np.zeros(len(N)), np.diag(np.full(len(N), np.inf))
    covariance = np.asarray(np.linalg.inv(N), dtype=np.float64)
    return covariance @ (e.T @ r), covariance


def without_noise(T: Array) -> Array:
    """Return temperatures (R,) as smooth as they can be with what is left no more than their noise.

    Third differences of noise have 20 times its variance, those of a temperature that the rows follow hardly any.
    Source: E. T. Whittaker, Proc. Edinburgh Math. Soc. 41 (1923) 63.
    """
    from scipy.linalg import solveh_banded

    R = len(T)
    if 2 * len(_THIRD) > R:
        return T
    third = np.convolve(T, _THIRD, mode="valid")
    square = float(np.median(third**2)) / 0.455  # of chi-square with one degree of freedom
    noise = (square or float(np.mean(third**2))) / float(_THIRD @ _THIRD)
    bands = np.zeros((len(_THIRD), R))
    for k in range(len(_THIRD)):
        both = _THIRD[: len(_THIRD) - k] * _THIRD[k:]
        for place, value in enumerate(both):
            bands[-1 - k, place + k : R - len(_THIRD) + 1 + place + k] += value

    def smooth(weight: float) -> Array:
        """Return the temperatures of the least weighted sum of squares; what is left of T grows with the weight."""
        matrix = weight * bands
        matrix[-1] += 1.0
        return np.asarray(solveh_banded(matrix, T, overwrite_ab=True, check_finite=False))

    k = bisect_right(_SMOOTHING, noise, key=lambda weight: float(np.mean((T - smooth(weight)) ** 2)))
    return smooth(_SMOOTHING[k - 1]) if k else T


def averaged(rows: SoakRows, *columns: Array) -> tuple[SoakRows, list[Array]]:
    """Return rows and columns (R, ...) over them as means of runs of them, ROWS at most."""
    n = -(-len(rows.t) // ROWS)
    short = replace(rows, channels={}).coarsened(runs([0], len(rows.t), n))
    return short, [
        _weighted_sums(values, rows.span, n) / short.span.reshape(-1, *[1] * (values.ndim - 1)) for values in columns
    ]


def _weighted_sums(values: Array, weight: Array, n: int) -> Array:
    """Return sums (K, ...) of n rows (R, ...) with a weight (R,) each, of the last also what is over.

    `soak.blocks.means` takes ten times as long where rows are wide and n is small.
    """
    K = len(values) // n
    sums: Array = np.einsum(
        "Kn,Kn...->K...", weight[: K * n].reshape(K, n), values[: K * n].reshape(K, n, *values.shape[1:])
    )
    sums[-1] += np.einsum("n,n...->...", weight[K * n :], values[K * n :])
    return sums


@lru_cache(maxsize=8)
def _cosines(R: int) -> Array:
    """Return cosines (R, 2 J + 1) of 0 to 2 J half waves over R rows: what products of two waves are made of."""
    waves: Array = np.cos(np.pi * np.outer((np.arange(R) + 0.5) / R, np.arange(2 * PLACEBOS + 1)))
    return waves


_WAVES = np.arange(1, PLACEBOS + 1)
_PAIRS = _WAVES[:, None] + _WAVES, np.abs(_WAVES[:, None] - _WAVES)  # cos a cos b = (cos(a + b) + cos(a - b)) / 2


def _placebos(Q: Array, r: Array, e: Array, size: Array, along: Array) -> Array:
    """Return r (R,) along the placebos (K, J) of e (R, K), each in its own deviation."""
    R, K = e.shape
    waves, sums = _cosines(R)[:, _WAVES], (e * e).T @ _cosines(R)
    with_e, G = sums[:, _WAVES], (sums[:, _PAIRS[0]] + sums[:, _PAIRS[1]]) / 2
    placebos = (np.ascontiguousarray(e.T)[:, None] * np.ascontiguousarray(waves.T)).reshape(-1, R)
    with_Q = (Q.T @ placebos.T).reshape(-1, K, PLACEBOS).transpose(1, 2, 0)
    G -= with_Q @ with_Q.transpose(0, 2, 1) + with_e[:, :, None] * with_e[:, None] / size[:, None, None]
    drawn: Array = _apart(G, (e * r[:, None]).T @ waves - with_e * along[:, None], OWN * size)
    return drawn


@compiled
def _apart(G: Array, b: Array, least: Array) -> Array:
    """Return b (K, J), of products G (K, J, J), each apart from those before (Cholesky); both are overwritten.

    0 where no more than `least` (K,) is left.
    """
    K, J = b.shape
    for k in range(K):
        for j in range(J):
            root = np.sqrt(G[k, j, j]) if G[k, j, j] > least[k] else np.inf
            b[k, j] /= root
            for i in range(j + 1, J):
                column = G[k, i, j] / root
                b[k, i] -= column * b[k, j]
                for m in range(j + 1, i + 1):
                    G[k, i, m] -= column * G[k, m, j] / root
    return b


def _orthonormal(X: Array) -> Array:
    from scipy.linalg import qr

    Q, upper, _ = qr(X / np.maximum(np.linalg.norm(X, axis=0), 1e-300), mode="economic", pivoting=True)
    independent = np.abs(np.diag(upper)) > 1e-7
    return np.ascontiguousarray(Q[:, : len(independent)][:, independent])
