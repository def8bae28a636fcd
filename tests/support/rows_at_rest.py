"""Recordings of a known bias in rows, as the loop has them, with the textbook's dense matrices beside them."""

import numpy as np

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import parts
from driftlab.identification.least_squares import LeastSquares
from driftlab.identification.records import Evidence, Record
from driftlab.identification.state import Search
from driftlab.units import BiasUnit
from fusion_core.chunk import Chunk
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.thermal_maps.polynomial import Polynomial

AXES = ("x", "y", "z")
STEP = 10.0  # s, of a mean; a row is of two
WHITE = 2e-6  # rad/s, of a mean
PLAY, VOLTAGE, SLIP = Hysteresis(width="6 K"), Channel(channel="voltage"), Relaxation(tau="20 min")
C_PLAY, C_VOLTAGE = np.array([4e-6, -3e-6, 5e-6]), np.array([1e-5, 2e-5, -1e-5])


def chunk_of(rng, count):
    t = 50.0 + STEP * np.arange(1, count + 1)
    T = 20 + 14 * np.sin(t / rng.uniform(700, 1500) + rng.uniform(0, 6)) + 3 * np.sin(t / 300)
    accel = np.stack([rng.normal(size=count), rng.normal(size=count), 9.8 + 0.1 * rng.normal(size=count)], axis=1)
    return Chunk(t, {"temperature": T, "voltage": 5 + rng.normal(size=count), "accel": accel})


def evidence(bias, counts=(400, 300, 350), seed=0, white=WHITE):
    """Return recordings of a curve of temperature, a level each, what `bias(k, chunk)` adds (N, 3), and white noise."""
    rng = np.random.default_rng(seed)
    records = []
    for k, count in enumerate(counts):
        chunk = chunk_of(rng, count)
        x = (chunk["temperature"] - 20) / 17
        curve = np.stack([1e-5 * x**2, -2e-5 * x, 1e-5 * x**3], axis=1)
        rate = curve + bias(k, chunk) + rng.normal(0, 3e-5, 3) + white * rng.normal(size=(count, 3))
        record = Chunk(chunk.t, {**chunk.channels, "gyro": rate}, sensors=frozenset({"gyro", "accel"}))
        records.append(Record(f"{k}", k == 0, k > 0, record, np.arange(0, count, 2)))
    return Evidence(tuple(records), "gyro", AXES, BiasUnit("rad/s", "deg/h"), 2 * STEP, 300.0)


def signature(effect, chunk):
    return effect.signature(chunk, None)[0]


def known(k, chunk):
    return signature(PLAY, chunk) @ C_PLAY + signature(VOLTAGE, chunk) @ C_VOLTAGE


def squares_of(evidence):
    T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
    basis = Polynomial(order=3).basis((float(T.min()), float(T.max())))
    return LeastSquares(EffectRegressors(evidence, basis), np.zeros(3), np.ones(3))


def search_of(evidence, model):
    squares = squares_of(evidence)
    found = Search(squares, lambda text: None, (), model, parts(squares.columns))
    found.noises = found.noises_of(model)
    return found


def dense(evidence, effects, axis, rows=slice(None)):
    """Return curve (n, 3), levels (n, R) and the effects' own columns (n, p) as a textbook writes them."""
    curves, levels, own = [], [], []
    for k, record in enumerate(evidence.records):
        T = record.chunk["temperature"]
        for effect in effects:
            T = effect.input(record.chunk.having(temperature=T), None)[0] if effect.acts_on_input else T
        one = np.zeros((len(record), len(evidence.records)))
        one[:, k] = 1
        curves.append(record.rows(np.stack([T, T**2, T**3], axis=1)))
        levels.append(one)
        shown = [signature(effect, record.chunk)[:, axis] for effect in effects]
        own.append(record.rows(np.concatenate([np.zeros((len(T), 0)), *shown], axis=1)))
    return tuple(np.concatenate(part)[rows] for part in (curves, levels, own))
