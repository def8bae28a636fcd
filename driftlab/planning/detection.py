"""From which size on the loop would find an effect on a planned recording: its own gates, on twins of the noise.

All that the gates look at is linear or square in what was measured, so a few twins of the noise, and what the effect
adds to them, say for any size what share of the twins passes. m twins, n rows, d axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from driftlab.loop.gates import Evidence, judged, matched, nats_of
from driftlab.loop.least_squares import Model, Term
from driftlab.loop.left_out import Part
from driftlab.loop.noise import Noise, effective, one_step
from driftlab.loop.state import Search
from driftlab.planning.recording import Unit, noises
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

TWINS = 7
LEAST, MOST = -2, 6  # powers of 2 about the size that has ten nats, where the answer is looked for
HALVINGS = 3  # of the last factor 2

Pairs = list[list[tuple[Array, Array]]]  # of each part, of each axis: the errors with the effect and without
Errors = list[list[Array]]  # of each part, of each axis: (n', m + 1), the last what the effect adds


@dataclass(frozen=True)
class Bench:
    """Twins of one planned recording.

    Attributes
    ----------
    found : Search
        The recording, nothing found on it yet.
    unit : Unit
    noise : (d, n, m) array
        Noise of each twin, SI.
    curve : (d, n) array
        The map's curve, SI.
    noises : list of Noise
        Of the rows of each axis.
    price : float
        Log of how many candidates the loop tries there.
    """

    found: Search
    unit: Unit
    noise: Array
    curve: Array
    noises: list[Noise]
    price: float

    def smallest(self, effect: Effect, shape: Array, start: float) -> float:
        """Return the size in SI from which on half of the twins pass; infinite where none helps.

        `shape` (n, d) is the effect at one SI unit, `start` a size near which the answer may be. Of an effect on the
        map's input it is the whole curve as it shows then, the map's own part with it: with its slope it grows.
        """
        case = _Case(self, effect, shape)
        power = next((k for k in range(LEAST, MOST + 1) if case.passes(start * 2.0**k)), None)
        if power is None:
            return float("inf")
        low, high = power - 1.0, float(power)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if case.passes(start * 2.0**middle) else (middle, high)
        return float(start * 2.0 ** ((low + high) / 2))


def bench(found: Search, unit: Unit, price: float, seed: int = 0) -> Bench:
    """Return twins of a planned recording."""
    n, interval, d = len(found.columns.evidence), found.columns.evidence.interval, len(unit.axes)
    rng = np.random.default_rng(seed)
    T = found.columns.evidence.rows([chunk["temperature"] for chunk in found.columns.evidence.chunks])
    noise = rng.normal(size=(d, n, TWINS)) * (unit.white / np.sqrt(interval))[:, None, None]
    walk = np.cumsum(rng.normal(size=(d, n, TWINS)), axis=1) * (unit.walk * np.sqrt(interval))[:, None, None]
    return Bench(found, unit, noise + walk, unit.curve(T).T, noises(unit, interval), price)


class _Case:
    """One effect at the bench: what the loop would look at, with and without it in the model."""

    def __init__(self, bench: Bench, effect: Effect, shape: Array) -> None:
        self.bench, self.effect = bench, effect
        noise = bench.noise + (0.0 if effect.acts_on_input else bench.curve[:, :, None])
        self.signals = [np.column_stack([noise[axis], shape[:, axis]]) for axis in range(shape.shape[1])]
        self.without, self.errors = self._left_out(()), self._left_out((Term(effect),))
        self.white = [self._white(axis, noise) for axis, noise in enumerate(bench.noises)]

    def passes(self, size: float) -> bool:
        """Return whether most of the twins pass where the effect has this size."""
        passed = 0
        for k in range(TWINS):
            passed += self._passes(k, size)
            if passed > TWINS // 2 or passed + TWINS - 1 - k <= TWINS // 2:
                break
        return passed > TWINS // 2

    def _passes(self, k: int, size: float) -> bool:
        pairs = [
            [(new[:, k] + size * new[:, -1], old[:, k] + size * old[:, -1]) for new, old in zip(*both, strict=True)]
            for both in zip(self.errors, self.without, strict=True)
        ]
        evidence = self._evidence(pairs, k, size)
        if not judged(self.effect, evidence, ())[0]:
            return False
        gained = 0.0  # what is left is slow to work out
        for axis, log in enumerate(self._logs(pairs)):
            parts = [part[axis] for part in pairs]
            gained -= sum(effective(e, old - e, walking=self.effect.walks) for e, old in parts) / 4 * log
        return judged(self.effect, replace(evidence, left_out=gained - self.bench.price), ())[0]

    def _evidence(self, pairs: Pairs, k: int, size: float) -> Evidence:
        """Return the figures of twin k, as `driftlab.loop.trials` works them out, the left-out gain apart."""
        price = self.bench.price
        squares = np.maximum([[[float(e @ e) for e in pair] for pair in part] for part in pairs], 1e-300)
        steps = np.mean(np.log(squares[:, :, 0] / squares[:, :, 1]), axis=1)
        spread = max(float(np.std(steps, ddof=1)) / np.sqrt(len(steps)), 1e-12)
        ratio, steady = float(np.exp(np.mean(self._logs(pairs)))), float(np.mean(steps)) / spread
        chance, gain = self._fast(k, size)
        return Evidence(
            ratio, steady, len(steps), 0.0, beside=False, left_out=np.inf, chance=chance, gain=gain - price, price=price
        )

    def _logs(self, pairs: Pairs) -> Array:
        """Return the log (d,) of the ratio of what is left of all parts, with the effect over without."""
        squares = np.sum([[[float(e @ e) for e in pair] for pair in part] for part in pairs], axis=0)
        return np.asarray(np.log(np.maximum(squares[:, 0], 1e-300) / np.maximum(squares[:, 1], 1e-300)))

    def _fast(self, k: int, size: float) -> tuple[float, float]:
        wald, gain, dof = 0.0, 0.0, 0
        for left, Z in self.white:
            one = matched(left[:, k] + size * left[:, -1], Z)
            wald, gain, dof = wald + one[0], gain + one[1], dof + one[2]
        if dof == 0:
            return 0.0, -np.inf
        return nats_of(wald, dof), gain - 0.5 * (dof + len(self.effect.continuous)) * float(np.log(len(left)))

    def _left_out(self, model: Model) -> Errors:
        return [
            [self._error(model, part, axis) for axis in range(len(self.signals))] for part in self.bench.found.left_out
        ]

    def _error(self, model: Model, part: Part, axis: int) -> Array:
        """Return the errors (n', m + 1) of predicting a part from the rest, less their means."""
        squares, W, y = self.bench.found.squares, self.bench.found.columns.W, self.signals[axis]
        fit = squares.fit(model, axis, part.rest)
        segments = self.bench.found.columns.segments
        rest = np.concatenate([np.arange(len(W))[segments[k].rows] for k in part.rest])
        beta = fit.equations.solve(W[np.ix_(rest, fit.cols)].T @ y[rest])
        e = (y[part.rows] - W[part.rows][:, fit.cols] @ beta)[part.window.stop - part.rows.start :]
        return np.asarray(e - e.mean(axis=0))

    def _white(self, axis: int, noise: Noise) -> tuple[Array, Array]:
        """Return the twins' residuals (n - 1, m + 1) and the effect's columns (n - 1, p), the map out of both."""
        found, y = self.bench.found, self.signals[axis]
        fit = found.squares.fit((), axis, found.everything)
        base = found.columns.W[:, fit.cols]
        cols = found.columns.of(self.effect).columns[axis]
        Z = y[:, -1:] if self.effect.acts_on_input else found.columns.W[:, cols]  # the map takes its own part of it
        both = np.column_stack([y, Z])
        left = both - base @ fit.equations.solve(base.T @ both)
        white = one_step([left], noise.gain)[0]
        return white[:, : y.shape[1]], white[:, y.shape[1] :]
