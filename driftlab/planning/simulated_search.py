"""A recording that is planned, as the loop would have it: its rows, what effects would show, and a twin of its noise.

On each axis the bias is curve(T) + level + walk + white noise. n rows, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.config import Config
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import parts
from driftlab.identification.least_squares import LeastSquares
from driftlab.identification.records import Evidence, Record, lengths
from driftlab.identification.state import Search
from driftlab.noise.local_level import LocalLevel
from driftlab.planning.unit_model import UnitModel
from driftlab.units import BiasUnit
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, FileSource, MeasurementModel, ThermalMap

LOUD = 100.0  # times the noise of a minute: swing of a curve that nobody knows
SEED = 20  # of the twin whose noise says how smooth the map will be

Curve = Callable[[Array], Array]  # of T (N,), with a bias on each axis (N, d), SI
Body = Callable[[Array], Array]  # temperature (N,) in degC at t (N,) in s


@dataclass(frozen=True, eq=False)
class UnrecordedUnit:
    """What is known of a unit before it is recorded.

    Attributes
    ----------
    map : ThermalMap
        The kind of map that it gets.
    channel, axes, shown : str, tuple of str, BiasUnit
        Of the tracked sensor.
    white, walk : (d,) arrays
        Densities of its white noise, SI/sqrt(Hz), and of the walk of its bias, SI/sqrt(s).
    curve : callable
        The bias over temperature that is reckoned with.
    interval, align : float
        Duration of an epoch, and how long a unit is aligned, s.
    curve_known : bool
        Whether the curve is the unit's own, or one that is taken for want of it.
    """

    map: ThermalMap
    channel: str
    axes: tuple[str, ...]
    shown: BiasUnit
    white: Array
    walk: Array
    curve: Curve
    interval: float
    align: float
    curve_known: bool = True

    @classmethod
    def of(cls, subject: UnitModel, low: float, high: float, model: MeasurementModel | None) -> UnrecordedUnit:
        """Return what a plan knows of its unit, whose map is to reach from `low` to `high` degC.

        Where the curve is not known it is taken to bend: to swing by LOUD times the noise of a minute, with a slope
        that grows to three times what it was.
        """
        interval, align = (model.update_interval, model.align) if model else (1.0, 60.0)
        curve = subject.shape

        def bent(T: Array) -> Array:
            x = (T - (low + high) / 2) / ((high - low) / 2)
            return np.outer(x + x**2 / 4, LOUD / 2 * subject.noise / np.sqrt(60.0))

        return cls(
            subject.map, subject.channel, subject.axes, subject.unit, subject.noise, subject.walk,
            bent if curve is None else curve, float(interval), float(align), curve is not None,
        )  # fmt: skip


def still_channels(config: Config) -> tuple[str, ...]:
    """Return the channels of the config's source that a chamber does not move: neither sensors' nor temperature."""
    if not isinstance(config.source, FileSource):
        return ()
    own = {"time", "temperature"} | {sensor.channel for sensor in (config.filter.sensors if config.filter else ())}
    return tuple(name for name in config.source.channels if name not in own)


def planned(unit: UnrecordedUnit, body: Body, duration: float, rows: int | None = None) -> Search:
    """Return a search that has nothing yet, on a twin of a recording; `rows` are as many as the loop's by default."""
    fine, interval = lengths(duration, max(1.0, unit.interval))
    if rows is not None:
        fine = interval = duration / rows
    t = np.arange(1, int(duration / fine) + 1, dtype=np.float64) * fine
    T = body(t - fine / 2)
    rng, size = np.random.default_rng(SEED), (len(t), len(unit.axes))
    noise = unit.white / np.sqrt(fine) * rng.normal(size=size)
    noise += unit.walk * np.sqrt(fine) * np.cumsum(rng.normal(size=size), axis=0)
    return _search(unit, [(t, T, unit.curve(T) + noise)], interval)


def measured(unit: UnrecordedUnit, recordings: Sequence[tuple[Array, Array]], dt: float) -> Search:
    """Return a search that has nothing yet on recordings: of each T (N,) in degC and bias (N, d), one each dt in s."""
    fine, interval = lengths(max(len(T) for T, _ in recordings) * dt, dt)
    many, found = round(fine / dt), []
    for T, bias in recordings:
        n = len(T) // many
        means = [x[: n * many].reshape(n, many, *x.shape[1:]).mean(axis=1) for x in (T, bias)]
        found.append((np.arange(1, n + 1, dtype=np.float64) * fine, *means))
    return _search(unit, found, interval)


def _search(unit: UnrecordedUnit, recordings: Sequence[tuple[Array, Array, Array]], interval: float) -> Search:
    """Return a search on recordings, each with times (N,), temperatures (N,) and bias (N, d)."""
    records = []
    for k, (t, T, bias) in enumerate(recordings):
        chunk = Chunk(t, {"temperature": T, unit.channel: bias}, sensors=frozenset({unit.channel}))
        number = np.floor((t - t[0] + 1e-6) / interval)
        records.append(Record(str(k), True, True, chunk, np.flatnonzero(np.diff(number, prepend=-1.0))))
    evidence = Evidence(tuple(records), unit.channel, unit.axes, unit.shown, interval, unit.align)
    T = np.concatenate([T for _, T, _ in recordings])
    columns = EffectRegressors(evidence, unit.map.basis((float(T.min()), float(T.max()))))
    d = len(unit.axes)
    found = Search(LeastSquares(columns, np.full(d, 1e-4), np.ones(d)), lambda text: None, (), (), parts(columns))
    found.fresh()
    return found


def noises(unit: UnrecordedUnit, interval: float) -> list[LocalLevel]:
    """Return the noise of rows of `interval` s on each axis, SI."""
    return [
        LocalLevel.of(float(white**2 / interval), float(walk**2 * interval))
        for white, walk in zip(unit.white, unit.walk, strict=True)
    ]


def shapes(found: Search, unit: UnrecordedUnit, effect: Effect, axis: int, *, whole: bool = False) -> Array:
    """Return what an effect may show on an axis (n, p), each column one unit (SI) from its lowest to its highest.

    One that acts on the map's input shows by how much the curve that is reckoned with differs there; `whole` is that
    curve with it.
    """
    values = _values(found, unit, effect, axis)
    swing = np.ptp(values, axis=0)
    if whole and effect.acts_on_input:
        own = [unit.curve(chunk["temperature"])[:, axis : axis + 1] for chunk in found.columns.evidence.chunks]
        values = values + found.columns.evidence.rows(own)
    return np.asarray(values / np.where(swing > 0, swing, 1.0))


def swing_of(found: Search, unit: UnrecordedUnit, effect: Effect) -> float:
    """Return how far an effect with coefficients of one goes from its lowest to its highest, its first column."""
    values = _values(found, unit, effect, 0)
    scale = 1.0 if effect.acts_on_input else float(found.columns.scale[found.columns.of(effect).columns[0][0]])
    return float(np.ptp(values[:, 0])) * scale


def _values(found: Search, unit: UnrecordedUnit, effect: Effect, axis: int) -> Array:
    """Return what an effect shows on an axis (n, p), in the columns' scale; by how much the curve differs, in SI."""
    columns = found.columns
    if not effect.acts_on_input:
        own = columns.of(effect).columns[axis]  # before W, which it may add to
        return np.asarray(columns.W[:, own])
    chunks = columns.evidence.chunks
    late = [unit.curve(effect.input(c, None)[0]) - unit.curve(c["temperature"]) for c in chunks]
    return np.asarray(columns.evidence.rows(late)[:, axis : axis + 1])
