"""Design of a further recording that would tell two explanations apart, from the ranges of the channels so far.

One model predicts the unit's readings on it, and the other is fitted to the old recordings and the new one together,
all whitened by the noise that is left. By how much its misfit grows, in nats, is the expected gain: the log of how much
less likely it would become.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from driftlab.identification.columns import EffectRegressors, NormalEquations
from driftlab.identification.least_squares import Model
from driftlab.identification.records import Evidence, Record, row_starts
from driftlab.identification.state import Search
from driftlab.identification.trials import AS_GOOD
from driftlab.noise.local_level import LocalLevel, one_step
from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts.table import auxiliary
from fusion_core.errors import FusionError

HOURS = 3.0  # of a designed recording
RAMP = 1.0 / 60.0  # K/s of the chamber


@dataclass(frozen=True)
class Experiment:
    """A recording to make, as `loop.json` has it: what it tells apart, and the expected gain."""

    description: str
    separates: tuple[str, str]
    expected_gain_nats: float


@dataclass(frozen=True)
class Question:
    """Two models to tell apart, and their names; the first is what the unit is taken to be."""

    model: Model
    other: Model
    names: tuple[str, str]


def propose(search: Search, questions: Sequence[Question]) -> tuple[Experiment, ...]:
    """Return the recording that tells best the two models of each question apart, where one would tell them at all."""
    if not questions:
        return ()
    evidence, basis = search.evidence, search.columns.basis
    designs = [(text, EffectRegressors(_evidence(evidence, chunk), basis)) for text, chunk in _designs(evidence)]
    proposed = []
    for question in questions:
        gains = [_separation(search, new, question) for _, new in designs]
        k = int(np.argmax(gains))
        if gains[k] > AS_GOOD:
            proposed.append(Experiment(designs[k][0], question.names, gains[k]))
    return tuple(proposed)


def _designs(evidence: Evidence) -> Iterator[tuple[str, Chunk]]:
    """Yield recordings that one can make, as channels over time with what is not moved held at its median."""
    template = evidence.chunks[0]
    step = float(np.median(np.diff(template.t)))
    t = np.arange(1, int(HOURS * 3600 / step) + 1, dtype=np.float64) * step
    still: dict[str, Array] = {}
    for name in template.channels:
        middle = np.median(np.concatenate([chunk[name] for chunk in evidence.chunks]), axis=0)
        still[name] = np.broadcast_to(middle, (len(t), *np.shape(middle))).copy()
    if "temperature" in template.channels:
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        for text, profile in _profiles(t, float(T.min()), float(T.max())):
            along = {name: profile for name in still if name.startswith("temperature_")}  # other thermometers go along
            moved = {"temperature": profile, "temperature_rate": np.asarray(np.gradient(profile, t), dtype=np.float64)}
            yield text, _chunk(t, still | along | {k: v for k, v in moved.items() if k in still})
    else:
        yield f"{HOURS:g} h from switch-on", _chunk(t, still)
    others = set(auxiliary([template])) - {"temperature"}
    for name, values in still.items():
        if name not in others:
            continue
        low_v, high_v = np.quantile(np.concatenate([chunk[name] for chunk in evidence.chunks]), [0.02, 0.98], axis=0)
        up = (t // 900 % 2 == 1).reshape(-1, *[1] * (values.ndim - 1))
        text = f"{HOURS:g} h at constant temperature with {name} alone moved over its range every 15 min"
        moved_alone = np.asarray(np.where(up, high_v, low_v), dtype=np.float64)
        yield text, _chunk(t, still | {name: moved_alone})


def _profiles(t: Array, low: float, high: float) -> Iterator[tuple[str, Array]]:
    """Yield temperatures (N,) over a recording, between the lowest and the highest so far."""
    middle, part = (low + high) / 2, max((high - low) / 4, 1e-3)

    def swing(about: float, reach: float) -> Array:
        return about + reach * (2 * np.abs(2 * (t * RAMP / (4 * reach) % 1) - 1) - 1)

    yield f"{HOURS:g} h from switch-on at a constant {middle:.0f} °C", np.full_like(t, middle)
    yield f"{HOURS:g} h up and down between {low:.0f} and {high:.0f} °C at 1 K/min", swing(middle, 2 * part)
    between = f"{middle - part:.0f} and {middle + part:.0f}"
    yield f"{HOURS:g} h up and down between {between} °C at 1 K/min", swing(middle, part)
    yield f"switch on at {high:.0f} °C and cool to {low:.0f} °C at 1 K/min", np.maximum(high - RAMP * t, low)
    warm = np.clip(low + RAMP * (t - 3600), low, high)
    yield f"switch on at {low:.0f} °C, wait 1 h, then warm up to {high:.0f} °C at 1 K/min", warm


def _chunk(t: Array, channels: dict[str, Array]) -> Chunk:
    return Chunk(t, channels, Chunk(t[:1] - (t[1] - t[0]), {name: values[:1] for name, values in channels.items()}))


def _evidence(evidence: Evidence, chunk: Chunk) -> Evidence:
    """Return a designed recording in rows as long as those of the present ones."""
    return replace(evidence, records=(Record("designed", False, True, chunk, row_starts(chunk.t, evidence.interval)),))


def _separation(search: Search, new: EffectRegressors, question: Question) -> float:
    """Return by how many nats the second model would fall behind on a designed recording.

    0 where an effect cannot predict the readings on such a recording.
    """
    gain = 0.0
    columns = search.columns
    for axis, noise in enumerate(search.noises):
        truth, other = (search.fit(model, axis) for model in (question.model, question.other))
        try:
            reading = _predicted(columns, new, question.model, axis, truth.cols) @ truth.beta
            fitted = _predicted(columns, new, question.other, axis, other.cols)
        except FusionError:
            return 0.0
        old = columns.W[:, np.append(other.cols, columns.y[axis])]
        left = max(float(np.mean(search.squares.residual(axis, other) ** 2)), 1e-300)
        ridge = (other.equations.A - columns.gram(search.everything, other.cols)) / left
        before = _white_equations(search.evidence.split(old), noise).raised(ridge)
        after = before + _white_equations([np.column_stack([fitted, reading])], noise)
        gain += 0.5 * max(after.left - before.left, 0.0)
    return float(gain)


def _predicted(columns: EffectRegressors, new: EffectRegressors, model: Model, axis: int, cols: Integers) -> Array:
    """Return the columns of a fit (n, k) over a designed recording, in the scale of those over the old ones.

    Levels and starts of the old recordings are nothing there, and a memory begins in equilibrium.
    """
    effects = [term.effect for term in model]
    predicted = np.zeros((len(new.evidence), len(cols)))
    at = len(columns.of_map(effects))
    predicted[:, :at] = new.raw(new.of_map(effects))
    at += len(columns.levels)
    for effect in effects:
        old, now = columns.of(effect), new.of(effect)
        for place in old.places[axis]:
            same = np.flatnonzero(now.places[axis] == place)
            if len(same):
                predicted[:, at] = new.raw(now.columns[axis][same])[:, 0]
            at += 1
    return np.asarray(predicted / columns.scale[cols])


def _white_equations(parts: Sequence[Array], noise: LocalLevel) -> NormalEquations:
    """Return the normal equations of columns, one (n, k + 1) a recording, made white."""
    white = np.concatenate(one_step(parts, noise.gain)) / np.sqrt(noise.variance)
    return NormalEquations.of(white.T @ white)
