"""Which further recording would tell two explanations apart, and by how much.

A recording is designed from what the channels did so far, the better model says what the unit would show on it, and the
rival is fitted to the old recordings and the new one together. By how much its misfit grows, in nats, is the expected
gain: the log of how much less likely the rival would become.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from driftlab.loop.evidence import Evidence, Record
from driftlab.loop.regression import Fit, Regression, solution
from driftlab.loop.signals import Indices, Signals
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect

HOURS = 3.0  # of a designed recording
RAMP = 1.0 / 60.0  # K/s of the chamber


@dataclass(frozen=True)
class Experiment:
    """A recording to make: what it tells apart, and the expected gain in nats."""

    description: str
    separates: tuple[str, ...]
    gain: float


def propose(
    regression: Regression, fit: Fit, rivalry: Sequence[tuple[Effect, Fit]], unseen: Sequence[Effect]
) -> tuple[Experiment, ...]:
    """Return the best experiment for each pair of rivals, and for each effect that the map hides."""
    designs = [(text, _evidence(regression.evidence, chunk)) for text, chunk in _designs(regression.evidence)]
    found = []
    for effect, rival in rivalry:
        gains = [_separation(regression, fit, rival, evidence) for _, evidence in designs]
        names = (effect.kind, rival.effects[-1].kind)
        found.append(_best(designs, gains, _named(names, (effect, rival.effects[-1]))))
    for effect in unseen:
        gains = [_information(regression, fit, effect, evidence) for _, evidence in designs]
        found.append(_best(designs, gains, (effect.kind, "the map")))
    return tuple(found)


def _named(kinds: tuple[str, str], effects: tuple[Effect, Effect]) -> tuple[str, ...]:
    same = kinds[0] == kinds[1]
    return tuple(f"{e.kind} of {e.subject}" if same or e.kind == "channel" else e.kind for e in effects)


def _best(designs: list[tuple[str, Evidence]], gains: list[float], separates: tuple[str, ...]) -> Experiment:
    k = int(np.argmax(gains))
    return Experiment(designs[k][0], separates, gains[k])


def _designs(evidence: Evidence) -> Iterator[tuple[str, Chunk]]:
    """Yield recordings that one can make, as channels over time with what is not moved held at its median."""
    template = evidence.chunks[0]
    t = np.arange(1, int(HOURS * 3600 / evidence.interval) + 1, dtype=np.float64) * evidence.interval
    still: dict[str, Array] = {}
    for name in template.channels:
        middle = np.median(np.concatenate([chunk[name] for chunk in evidence.chunks]), axis=0)
        still[name] = np.broadcast_to(middle, (len(t), *np.shape(middle))).copy()
    still["tau"] = np.full(len(t), evidence.interval)
    if "temperature" in template.channels:
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        for text, profile in _profiles(t, float(T.min()), float(T.max())):
            others = {name: profile for name in still if name.startswith("temperature_")}  # other thermometers go along
            moved = {"temperature": profile, "temperature_rate": np.asarray(np.gradient(profile, t), dtype=np.float64)}
            yield text, _chunk(t, still | others | moved)
    for name, values in still.items():
        if name in ("gyro", "accel", "tau", "temperature", "temperature_rate"):
            continue
        seen = np.concatenate([chunk[name] for chunk in evidence.chunks])
        low_v, high_v = np.quantile(seen, [0.02, 0.98], axis=0)
        up = (t // 900 % 2 == 1).reshape(-1, *[1] * (values.ndim - 1))
        text = f"{HOURS:g} h at constant temperature with {name} alone moved over its range every 15 min"
        moved_alone = np.asarray(np.where(up, high_v, low_v), dtype=np.float64)
        yield text, _chunk(t, still | {name: moved_alone})


def _profiles(t: Array, low: float, high: float) -> Iterator[tuple[str, Array]]:
    """Yield temperatures (N,) over a recording, between the lowest and the highest so far."""
    middle, part = (low + high) / 2, (high - low) / 4

    def swing(about: float, reach: float) -> Array:
        return about + reach * (2 * np.abs(2 * (t * RAMP / (4 * reach) % 1) - 1) - 1)

    yield f"{HOURS:g} h from switch-on at a constant {middle:.0f} degC", np.full_like(t, middle)
    yield f"{HOURS:g} h up and down between {low:.0f} and {high:.0f} degC at 1 K/min", swing(middle, 2 * part)
    between = f"{middle - part:.0f} and {middle + part:.0f}"
    yield f"{HOURS:g} h up and down between {between} degC at 1 K/min", swing(middle, part)
    yield f"switch on at {high:.0f} degC and cool to {low:.0f} degC at 1 K/min", np.maximum(high - RAMP * t, low)
    warm = np.clip(low + RAMP * (t - 3600), low, high)
    yield f"switch on at {low:.0f} degC, wait 1 h, then warm up to {high:.0f} degC at 1 K/min", warm


def _chunk(t: Array, channels: dict[str, Array]) -> Chunk:
    return Chunk(t, channels, Chunk(t[:1] - (t[1] - t[0]), {name: values[:1] for name, values in channels.items()}))


def _evidence(evidence: Evidence, chunk: Chunk) -> Evidence:
    """Return a designed recording with the filters of the present ones at their usual step."""
    usual = int(np.argmin(np.abs(np.concatenate([c["tau"] for c in evidence.chunks]) - evidence.interval)[1:])) + 1
    N = len(chunk)
    fresh = np.arange(N) == 0

    def rows(array: Array) -> Array:
        return np.ascontiguousarray(np.broadcast_to(array[usual], (N, *array.shape[1:])))

    filters = tuple(
        replace(f, F=rows(f.F), Q=rows(f.Q), walk=rows(f.walk), b=rows(f.b), fresh=fresh) for f in evidence.filters
    )
    record = Record("designed", True, chunk, fresh, evidence.records[0].alignment)
    return Evidence((record,), filters, evidence.axes, evidence.interval)


def _separation(regression: Regression, fit: Fit, rival: Fit, designed: Evidence) -> float:
    """Return by how many nats the rival would fall behind."""
    new = Signals(designed, regression.basis)
    gain = 0.0
    for axis, own in enumerate(fit.axes):
        _, place = regression.columns(fit.effects, axis)
        shown = new.curves(fit.effects) @ own.c + _shown(new, fit.effects, axis, place) @ own.theta
        noise, (_, rivals) = rival.axes[axis], regression.columns(rival.effects, axis)
        grams = []
        for part, y in ((regression, regression.evidence.rate[:, axis]), (new, shown)):
            X, Zr = part.curves(rival.effects), _shown(part, rival.effects, axis, rivals)
            white = part.whitening(axis, noise.log_ratio)(np.hstack([X, Zr, y[:, None]]))
            grams.append(white.T @ white)
        K = np.zeros_like(grams[0])
        q = regression.curves(rival.effects).shape[1]
        K[:q, :q] = regression.prior(noise.smoothing)
        both = _misfit(grams[0] + grams[1] + K) - _misfit(grams[0] + K)
        gain += 0.5 * max(both, 0.0) / noise.scale**2
    return float(gain)


def _shown(signals: Signals, effects: Sequence[Effect], axis: int, place: Indices) -> Array:
    """Return the columns of the effects on one axis, those at `place` of all p coefficients."""
    parts = [signals.signature(effect)[:, axis] for effect in effects]
    return np.concatenate([*parts, np.zeros((len(signals.evidence), 0))], axis=1)[:, place]


def _misfit(G: Array) -> float:
    return float(G[-1, -1] - G[:-1, -1] @ solution(G[:-1, :-1], G[:-1, -1]))


def _information(regression: Regression, fit: Fit, effect: Effect, designed: Evidence) -> float:
    """Return by how many nats the coefficients' information grows, the map taken out: half the log of the ratio."""
    new = Signals(designed, regression.basis)
    gain = 0.0
    for axis, own in enumerate(fit.axes):
        grams, q = [], len(regression.prior(1.0))
        for part in (regression, new):
            Z = _shown(part, (effect,), axis, regression.columns((effect,), axis)[1])
            if effect.acts_on_input:
                Z = np.hstack([Z, ((part.curves((effect,)) - part.curves(())) @ own.c)[:, None]])
            white = part.whitening(axis, own.log_ratio)(np.hstack([part.curves(()), Z]))
            grams.append(white.T @ white)
        K = regression.prior(1e-6)
        before, after = (_left(G, K, q) for G in (grams[0], grams[0] + grams[1]))
        gain += 0.5 * float(np.sum(np.log(np.maximum(after, 1e-300) / np.maximum(before, 1e-300))))
    return gain


def _left(G: Array, K: Array, q: int) -> Array:
    R = G[q:, q:] - G[q:, :q] @ np.linalg.solve(G[:q, :q] + K, G[:q, q:])
    return np.asarray(np.clip(np.diag(R), 1e-12 * np.diag(G)[q:], None))
