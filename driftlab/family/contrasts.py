"""What one unit shows of each effect, once a curve of its own is taken off.

Rows of a unit and an axis, whitened by the unit's own noise (`driftlab.noise.local_level`), are

    y = B(T) beta + Z_0 a + z c + noise,      B splines half as far apart as the family's, Z_0 effects already named

With Q an orthonormal basis of B and Z_0, r = y - QQ'y and e = z - QQ'z, generalised least squares gives

    c = e'r / e'e,      var c = 1 / e'e

The curve is free: nothing that a map could be, of the unit or of the family, counts for an effect. An effect of several
coefficients an axis is taken apart one after the other, each beside those before: what they show is then independent.

Neither noise is ever exactly white and walk. So each e has PLACEBOS: itself, times cosines of few half waves over the
soak, without what they share with Q, e and one another. They are as smooth as e, and lie where it lies; what r shows
along them is what noise shows, whatever its colour and wherever it grows.

R rows, d axes, K columns of all effects on one axis, J placebos.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.family.basis import SplineBasis
from driftlab.family.unit_information import SoakRows, UnitInformation
from driftlab.noise.local_level import whitened
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import MissingChannel

PLACEBOS = 16  # waves
OWN = 0.05  # of e's square, that a placebo shares with no other
FINER = 2  # splines of a unit's own curve to one of the family's: a kink that the family's cannot follow is no effect
ROWS = 500  # of a recording: more are averaged
_THIRD = np.array([-1.0, 3.0, -3.0, 1.0])
_SMOOTHING = 10.0 ** np.arange(0, 10)  # of third differences
LEFT = 1e-4  # of a column's square, beside the curve: less is what rounding and the thermometer's noise leave


@dataclass(frozen=True, eq=False)
class EffectContrasts:
    """What units show of effects, a column a coefficient.

    Attributes
    ----------
    c : (..., d, K) array
        Coefficients, SI; 0 where a unit cannot show any.
    information : (..., d, K) array
        1 / variance of each under the unit's own noise.
    placebos : (..., d, K, J) array
        What noise shows along each placebo, in its own deviation; 0 where nothing of it is its own.
    """

    c: Array
    information: Array
    placebos: Array

    def of(self, columns: slice) -> EffectContrasts:
        """Return some of the columns."""
        return EffectContrasts(self.c[..., columns], self.information[..., columns], self.placebos[..., columns, :])


def chunks_of(soaked: UnitInformation) -> list[Chunk]:
    """Return the recordings as effects read them, the thermometer's noise taken off.

    That noise, times the slope that all maps have, is a lag in disguise: fast changes that the bias does not follow.
    """
    return [Chunk(rows.t, {**rows.channels, "temperature": without_noise(rows.T)}) for rows in soaked.recordings]


def shown(effect: Effect, soaked: UnitInformation, chunks: Sequence[Chunk]) -> list[Array]:
    """Return what an effect shows in each recording (R, d, q), a coefficient of 1 each; of a lag, what 1 is.

    A lag has no coefficient: it is the curve at the temperature that the element has, less that at the thermometer's,
    with the unit's own curve. That curve's error is independent of what is left beside it.

    Raises
    ------
    MissingChannel
        If the unit's recordings have not what the effect reads.
    """
    parts = []
    curve = own_curve(soaked) if effect.acts_on_input else None
    for chunk in chunks:
        if curve is not None:
            splines = [soaked.knots.values(T) for T in (effect.input(chunk, None)[0], chunk["temperature"])]
            parts.append(((splines[0] - splines[1]) @ curve.T)[:, :, None])
        else:
            parts.append(of_each_axis(effect.signature(chunk, None)[0]))
    return parts


def seen_temperatures(soaked: UnitInformation, effects: Sequence[Effect]) -> list[Array]:
    """Return the temperatures (R,) of each recording that the curve sees where a unit has the effects."""
    found = []
    for rows in soaked.recordings:
        chunk = Chunk(rows.t, {**rows.channels, "temperature": rows.T})
        for effect in effects:
            if effect.acts_on_input:
                chunk = chunk.having(temperature=effect.input(chunk, None)[0])
        found.append(chunk["temperature"])
    return found


def of_each_axis(signature: Array) -> Array:
    """Return regressors (N, d, d q), of which each axis has q of its own, as (N, d, q)."""
    N, d, p = signature.shape
    own = signature.reshape(N, d, d, p // d)
    return np.ascontiguousarray(own[:, np.arange(d), np.arange(d)])


def own_curve(soaked: UnitInformation) -> Array:
    """Return the coefficients (d, q) that the unit's own rows say, hardly smoothed where they say nothing."""
    D = np.diff(np.eye(soaked.knots.q), n=2, axis=0)
    found = []
    for J, h in zip(soaked.J, soaked.h, strict=True):
        ridge = 1e-4 * np.trace(J) / len(J)
        found.append(np.linalg.solve(J + ridge * (D.T @ D + 1e-4 * np.eye(len(J))), h))
    return np.stack(found)


class EffectColumns:
    """Rows of a unit under its own noise, and what effects show in them.

    Parameters
    ----------
    soaked : Soaked
    beside : effects
        Already named: a free coefficient each in every unit; the curve is one of the temperatures that they make.
    """

    def __init__(self, soaked: UnitInformation, beside: Sequence[Effect] = ()) -> None:
        self.soaked, self.chunks, d = soaked, chunks_of(soaked), len(soaked.axes)
        low, high = soaked.knots.domain
        knots = SplineBasis.covering(low, high, soaked.knots.step / FINER)
        curves = [knots.values(T) for T in seen_temperatures(soaked, beside)]
        have = set(soaked.recordings[0].channels) | {"temperature"}
        named = [
            shown(effect, soaked, self.chunks)
            for effect in beside
            if set(effect.requires) <= have and not effect.acts_on_input
        ]
        none = [np.zeros((len(rows.t), d, 0)) for rows in soaked.recordings]
        fixed = [np.concatenate(parts, axis=2) for parts in zip(none, *named, strict=True)]
        self.Q = [_orthonormal(X) for X in self._white(fixed, curves)]
        self.r = [
            y[:, 0] - Q @ (Q.T @ y[:, 0])
            for Q, y in zip(self.Q, self._white([rows.bias[:, :, None] for rows in soaked.recordings]), strict=True)
        ]

    def contrasts(self, effects: Sequence[Effect], sizes: Sequence[int]) -> EffectContrasts:
        """Return what effects show, `sizes` coefficients an axis each; nothing of those whose channels are missing."""
        recordings, d, K = self.soaked.recordings, len(self.soaked.axes), sum(sizes)
        parts = [np.zeros((len(rows.t), d, K)) for rows in recordings]
        at = 0
        for effect, size in zip(effects, sizes, strict=True):
            try:
                for part, values in zip(parts, shown(effect, self.soaked, self.chunks), strict=True):
                    part[:, :, at : at + size] = values
            except MissingChannel:
                pass
            at += size
        found = [self._of_axis(Q, r, Z, sizes) for Q, r, Z in zip(self.Q, self.r, self._white(parts), strict=True)]
        return EffectContrasts(*(np.stack(values) for values in zip(*found, strict=True)))

    def estimates(self, effect: Effect) -> tuple[Array, Array]:
        """Return the coefficients (d, q) of an effect, all at once, and covariances (d, q, q); infinite where unseen.

        Raises
        ------
        MissingChannel
            If the unit's recordings have not what the effect reads.
        """
        found, covariances = [], []
        for Q, r, Z in zip(self.Q, self.r, self._white(shown(effect, self.soaked, self.chunks)), strict=True):
            e = Z - Q @ (Q.T @ Z)
            N, scale = e.T @ e, np.linalg.norm(Z, axis=0)
            scaled = N / np.outer(scale, scale) if np.all(scale > 0) else np.zeros_like(N)
            if np.linalg.eigvalsh(scaled)[0] > LEFT:
                covariances.append(np.linalg.inv(N))
                found.append(covariances[-1] @ (e.T @ r))
            else:
                covariances.append(np.diag(np.full(len(N), np.inf)))
                found.append(np.zeros(len(N)))
        return np.stack(found), np.stack(covariances)

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
        short = [
            averaged(rows, *both)
            for rows, both in zip(
                self.soaked.recordings, zip(parts, *([alike] if alike else []), strict=True), strict=True
            )
        ]
        found = []
        for axis in range(len(self.soaked.axes)):
            blocks = []
            for k, (rows, (own, *same)) in enumerate(short):
                noise = rows.variances(self.soaked.white[axis], self.soaked.walk[axis], free=k > 0)
                blocks.append(whitened(np.column_stack([*same, own[:, axis]]), *noise))
            found.append(np.concatenate(blocks))
        return found


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
    smooth = T
    for weight in _SMOOTHING:
        matrix = weight * bands
        matrix[-1] += 1.0
        tried = np.asarray(solveh_banded(matrix, T))
        if np.mean((T - tried) ** 2) > noise:
            break
        smooth = tried
    return smooth


def averaged(rows: SoakRows, *columns: Array) -> tuple[SoakRows, list[Array]]:
    """Return rows and columns (R, ...) over them as means of runs of them, ROWS at most; what is over is left out."""
    run = -(-len(rows.t) // ROWS)
    if run == 1:
        return rows, list(columns)
    count = len(rows.t) // run

    def mean(values: Array) -> Array:
        return np.asarray(values[: count * run].reshape(count, run, *values.shape[1:]).mean(axis=1))

    span = mean(rows.span) * run
    return SoakRows(mean(rows.t), mean(rows.T), mean(rows.bias), span, {}), [mean(values) for values in columns]


def _placebos(Q: Array, r: Array, e: Array, size: Array, along: Array) -> Array:
    """Return what r (R,) shows along the placebos (K, J) of e (R, K), each in its own deviation."""
    R, K = e.shape
    waves = np.cos(np.pi * np.outer((np.arange(R) + 0.5) / R, np.arange(1, PLACEBOS + 1)))
    square = e * e
    with_e = square.T @ waves
    G = (square.T @ (waves[:, :, None] * waves[:, None]).reshape(R, -1)).reshape(K, PLACEBOS, PLACEBOS)
    with_Q = (Q.T @ (e[:, :, None] * waves[:, None]).reshape(R, -1)).reshape(-1, K, PLACEBOS).transpose(1, 2, 0)
    G -= with_Q @ with_Q.transpose(0, 2, 1) + with_e[:, :, None] * with_e[:, None] / size[:, None, None]
    b = (e * r[:, None]).T @ waves - with_e * along[:, None]
    for j in range(PLACEBOS):  # Cholesky, without what is left of none
        own = G[:, j, j] > OWN * size
        root = np.sqrt(np.where(own, G[:, j, j], 1.0))
        column = np.where(own[:, None], G[:, :, j] / root[:, None], 0.0)
        b[:, j] = np.where(own, b[:, j] / root, 0.0)
        b[:, j + 1 :] -= column[:, j + 1 :] * b[:, j, None]
        G -= column[:, :, None] * column[:, None]
    return np.asarray(b)


def _orthonormal(X: Array) -> Array:
    from scipy.linalg import qr

    Q, upper, _ = qr(X / np.maximum(np.linalg.norm(X, axis=0), 1e-300), mode="economic", pivoting=True)
    kept = np.abs(np.diag(upper)) > 1e-7
    return np.ascontiguousarray(Q[:, : len(kept)][:, kept])
