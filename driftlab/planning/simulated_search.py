"""A planned recording, as the loop would have it: its rows, its simulated noise, and its information on effects.

On each axis the bias is curve(T) + level + walk + white noise. Made white by the noise of the rows
(`driftlab.noise.local_level.whitened`), with the map's curves B and the unknown level of each recording taken out, the
log-likelihood ratios are

::

    nats of a shape s:                  1/2 |M s|^2,    M = I - B (B'B + ridge)^-1 B'
    left where Z may take its part:     1/2 |M s|^2 - 1/2 s'M Z (Z'M Z)^-1 Z'M s

in expectation. The rest beside another effect is taken at the hyper-parameters with which that imitates best. n rows,
d axes, K columns of shapes, each one SI unit from its lowest to its highest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from driftlab.config import Config
from driftlab.identification.columns import NormalEquations
from driftlab.identification.records import Evidence, Record, lengths, row_starts
from driftlab.identification.state import Search
from driftlab.noise.local_level import LocalLevel, whitened
from driftlab.planning.unit_model import UnitModel
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, FileSource
from fusion_core.thermal.penalised import smooth_lines

SEED = 20  # of the simulated noise, by which the map is smoothed
MOST = 20_000  # means: those of a longer recording are longer than the loop's
MAX_CURVES = 153  # of a map, about one a kelvin: with more of its own it stands as straight lines

Body = Callable[[Array], Array]  # temperature (N,) in degC at t (N,) in s


def still_channels(config: Config) -> tuple[str, ...]:
    """Return the channels of the config's source that a chamber does not move: neither sensors' nor temperature."""
    if not isinstance(config.source, FileSource):
        return ()
    own = {"time", "temperature"} | {sensor.channel for sensor in (config.filter.sensors if config.filter else ())}
    return tuple(name for name in config.source.channels if name not in own)


def planned(unit: UnitModel, body: Body, duration: float, rows: int | None = None) -> Search:
    """Return a search without effects on a simulated recording; `rows` are as many as the loop's by default."""
    fine, interval = _lengths(duration, max(1.0, unit.interval))
    if rows is not None:
        fine = interval = duration / rows
    t = np.arange(1, int(duration / fine) + 1, dtype=np.float64) * fine
    T = body(t - fine / 2)
    rng, size = np.random.default_rng(SEED), (len(t), len(unit.axes))
    noise = unit.noise / np.sqrt(fine) * rng.normal(size=size)
    noise += unit.walk * np.sqrt(fine) * np.cumsum(rng.normal(size=size), axis=0)
    return _search(unit, [(t, T, unit.curve(T) + noise)], interval)


def measured(unit: UnitModel, recordings: Sequence[tuple[Array, Array]], dt: float) -> Search:
    """Return a search without effects on recordings: of each T (N,) in degC and bias (N, d), one each dt in s."""
    fine, interval = _lengths(max(len(T) for T, _ in recordings) * dt, dt)
    many, means_of_each = round(fine / dt), []
    for T, bias in recordings:
        n = len(T) // many
        means = [x[: n * many].reshape(n, many, *x.shape[1:]).mean(axis=1) for x in (T, bias)]
        means_of_each.append((np.arange(1, n + 1, dtype=np.float64) * fine, *means))
    return _search(unit, means_of_each, interval)


def _lengths(longest: float, least: float) -> tuple[float, float]:
    """Return the lengths of means and rows in s, as the loop has them; of no more than MOST means."""
    fine, interval = lengths(longest, least)
    return (fine, interval) if longest <= MOST * fine else lengths(longest, least * np.ceil(longest / MOST / least))


def _search(unit: UnitModel, recordings: Sequence[tuple[Array, Array, Array]], interval: float) -> Search:
    """Return a search on recordings, each with times (N,), temperatures (N,) and bias (N, d)."""
    records = []
    for k, (t, T, bias) in enumerate(recordings):
        chunk = Chunk(t, {"temperature": T, unit.channel: bias}, sensors=frozenset({unit.channel}))
        records.append(Record(str(k), True, True, chunk, row_starts(t, interval)))
    evidence = Evidence(tuple(records), unit.channel, unit.axes, unit.unit, interval, unit.align)
    T = np.concatenate([T for _, T, _ in recordings])
    domain = float(T.min()), float(T.max())
    basis = unit.map.basis(domain)
    if basis is not None and len(basis.penalty) > MAX_CURVES:
        basis = smooth_lines(domain)
    return Search.begun(evidence, basis, lambda text: None, ())


def noises(unit: UnitModel, interval: float) -> list[LocalLevel]:
    """Return the noise of rows of `interval` s on each axis, SI."""
    return [
        LocalLevel.of(float(white**2 / interval), float(walk**2 * interval))
        for white, walk in zip(unit.noise, unit.walk, strict=True)
    ]


def shapes(search: Search, unit: UnitModel, effect: Effect, axis: int, *, whole: bool = False) -> Array:
    """Return the shapes of an effect on an axis (n, p), each column one unit (SI) from its lowest to its highest.

    Of one that acts on the map's input it is the change of the unit's curve; `whole` is that curve with it.
    """
    values = _values(search, unit, effect, axis)
    swing = np.ptp(values, axis=0)
    if whole and effect.acts_on_input:
        own = [unit.curve(chunk["temperature"])[:, axis : axis + 1] for chunk in search.columns.evidence.chunks]
        values = values + search.columns.evidence.rows(own)
    return np.asarray(values / np.where(swing > 0, swing, 1.0))


def swing_of(search: Search, unit: UnitModel, effect: Effect) -> float:
    """Return the swing of an effect with coefficients of one from its lowest to its highest, its first column."""
    values = _values(search, unit, effect, 0)
    scale = 1.0 if effect.acts_on_input else float(search.columns.scale[search.columns.of(effect).columns[0][0]])
    return float(np.ptp(values[:, 0])) * scale


def _values(search: Search, unit: UnitModel, effect: Effect, axis: int) -> Array:
    """Return an effect on an axis (n, p), in the columns' scale; on the map's input, the change of the curve in SI."""
    columns = search.columns
    if not effect.acts_on_input:
        own = columns.of(effect).columns[axis]  # before W, which it may add to
        return np.asarray(columns.W[:, own])
    chunks = columns.evidence.chunks
    late = [unit.curve(effect.input(c, None)[0]) - unit.curve(c["temperature"]) for c in chunks]
    return np.asarray(columns.evidence.rows(late)[:, axis : axis + 1])


def _white(columns: Array, noise: LocalLevel) -> Array:
    """Return columns (n, m) of one recording as innovations of unit variance, its first level unknown."""
    walk = np.r_[np.inf, np.full(len(columns) - 1, noise.walk)]
    return np.asarray(whitened(np.ascontiguousarray(columns), np.full(len(columns), noise.white), walk)[0])


class Information:
    """Information of a planned recording on the shapes of effects.

    G (d, K, K) are inner products of the columns, white, with map and level taken out, b (d, K) theirs with what was
    measured.
    """

    def __init__(self, search: Search, unit: UnitModel, effects: Sequence[Effect]) -> None:
        self.effects = tuple(effects)
        own = [[shapes(search, unit, effect, axis) for effect in effects] for axis in range(len(unit.axes))]
        ends = np.cumsum([0, *(part.shape[1] for part in own[0])])
        self._places = [np.arange(a, b) for a, b in pairwise(ends)]
        columns = search.columns
        B = columns.of_map([])
        self.G, self.b = np.zeros((len(unit.axes), ends[-1], ends[-1])), np.zeros((len(unit.axes), ends[-1]))
        for axis, noise in enumerate(noises(unit, columns.evidence.interval)):
            q, y = len(B), columns.y[axis]
            whole = np.column_stack([columns.W[:, B], *own[axis], columns.W[:, y] * columns.scale[y]])
            white = np.concatenate([_white(whole[rows], noise) for rows in columns.evidence.slices])
            squares = white.T @ white
            ridge = search.squares.ridge(axis, B, columns.gram(search.everything, B)) / noise.variance
            equations = NormalEquations(squares[:q, :q], np.zeros(q), 0.0).raised(ridge)
            left = squares[q:, q:] - squares[q:, :q] @ equations.solve(squares[:q, q:])
            self.G[axis], self.b[axis] = left[:-1, :-1], left[:-1, -1]

    def size(self, k: int) -> tuple[Array, Array]:
        """Return the sizes (d,) of the k-th effect, of one column, in what was measured, and their deviations, SI."""
        (place,) = self._places[k]
        squares = np.maximum(self.G[:, place, place], 1e-300)
        return self.b[:, place] / squares, 1 / np.sqrt(squares)

    def columns_of(self, k: int) -> int:
        """Return the number of columns of the k-th effect."""
        return len(self._places[k])

    def direction(self, k: int) -> Array:
        """Return coefficients (p,) of the k-th effect's columns: of its directions, that of median information."""
        own = self._places[k]
        values, vectors = np.linalg.eigh(self.G[:, own][:, :, own].sum(axis=0))
        return np.asarray(vectors[:, len(values) // 2])

    def nats(self, k: int, theta: Array) -> float:
        """Return the nats of the k-th effect with coefficients theta (p,) on every axis alike."""
        own = self._places[k]
        return 0.5 * max(float(np.sum(theta @ self.G[:, own][:, :, own] @ theta)), 0.0)

    def left(self, k: int, theta: Array, others: Sequence[int]) -> float:
        """Return the nats that are left where one of the other effects takes its part, the one that takes most."""
        own = self._places[k]
        least = self.nats(k, theta)
        for j in others:
            Z = self._places[j]
            taken = 0.0
            for G in self.G:
                b = G[np.ix_(Z, own)] @ theta
                taken += float(b @ np.linalg.pinv(G[np.ix_(Z, Z)], rcond=1e-9, hermitian=True) @ b)
            least = min(least, self.nats(k, theta) - 0.5 * taken)
        return max(least, 0.0)
