"""What the map and the effects show: as signals in the data, and as the filter of each axis leaves them.

Most of it is kept for a while, since a search asks for the same again and again; axes whose filters are alike share it.
Symbols are those of `driftlab.loop.regression`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from threading import Lock
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from driftlab.loop.evidence import Evidence
from fusion_core.chunk import Array
from fusion_core.contracts import Basis, Effect
from fusion_core.whitening import Whitening

Model = tuple[Effect, ...]
Indices = NDArray[np.intp]
K = TypeVar("K")
T = TypeVar("T")


class Kept(Generic[K, T]):
    """What was worked out, the oldest gone where there is too much of it; any thread may ask."""

    def __init__(self, most: int) -> None:
        self._most, self._lock = most, Lock()
        self._found: dict[K, T] = {}

    def __len__(self) -> int:
        return len(self._found)

    def get(self, key: K, make: Callable[[], T]) -> T:
        """Return what is kept under the key, made now where there is nothing."""
        if (known := self._found.get(key)) is not None:
            return known
        value = make()
        with self._lock:
            while len(self._found) >= self._most and key not in self._found:
                del self._found[next(iter(self._found))]
            self._found[key] = value
        return value

    def clear(self) -> None:
        """Let go of it."""
        self._found.clear()


@dataclass(frozen=True)
class Columns:
    """What an effect with p coefficients shows on each axis: columns (N, p') other than zero, and which they are."""

    p: int
    of_axis: list[tuple[Array, Indices]]


@dataclass(frozen=True)
class WhiteMap:
    """The map's curves as a filter leaves them, and what makes their fit diagonal for every lambda.

    Attributes
    ----------
    X : (N, q) array
        The curves.
    XX : (q, q) array
        X'X.
    B : (q, q) array
        With B'(X'X + epsilon I)B = I and B'PB = diag(e).
    e : (q,) array
    log_det, log_det_S : float
        Of X'X + epsilon I, and of S over all steps.
    """

    X: Array
    XX: Array
    B: Array
    e: Array
    log_det: float
    log_det_S: float


class Signals:
    """Map and effects of any model on one evidence."""

    def __init__(self, evidence: Evidence, basis: Basis) -> None:
        self.evidence, self.basis = evidence, basis
        filters = evidence.filters
        self._alike = [
            next(k for k, other in enumerate(filters) if other is one or other.same_as(one)) for one in filters
        ]
        P = basis.penalty
        self.rough = bool(np.any(P))
        scale = np.trace(P) if self.rough else 1.0
        self.penalty = P / scale
        values = np.linalg.eigvalsh(self.penalty)
        # what is not penalised stays so at any lambda: rounding, times the largest, would outweigh epsilon
        self.eigenvalues = np.where(values > 1e-12 * values[-1], values, 0.0)
        self._curves: Kept[str, Array] = Kept(64)
        self._shown: Kept[str, Columns] = Kept(256)
        self._gains: Kept[tuple[int, float], Whitening] = Kept(256)
        self._white: Kept[tuple[str, int, float], WhiteMap] = Kept(48)

    def curves(self, effects: Model) -> Array:
        """Return the map's curves (N, q) at the temperatures that the map sees."""

        def make() -> Array:
            parts = []
            for chunk in self.evidence.chunks:
                for effect in _acting(effects):
                    chunk = chunk.having(temperature=effect.input(chunk, None)[0])
                parts.append(self.basis.values(chunk["temperature"]))
            return np.concatenate(parts)

        return self._curves.get(repr(_acting(effects)), make)

    def signature(self, effect: Effect) -> Array:
        """Return the effect's regressors (N, d, p) over all recordings, centred: a constant is the turn-on's."""
        parts = [effect.signature(chunk, None)[0] for chunk in self.evidence.chunks]
        return np.concatenate([part - part.mean(axis=0) for part in parts])

    def columns(self, effects: Model, axis: int) -> tuple[Array, Indices]:
        """Return what the effects show on one axis (N, p'), and to which of all p coefficients each column belongs."""
        parts = [self._columns(effect) for effect in effects]
        if len(parts) == 1:
            return parts[0].of_axis[axis]
        first = np.cumsum([0, *(part.p for part in parts)])
        shown = [part.of_axis[axis] for part in parts]
        own = [start + place for start, (_, place) in zip(first, shown, strict=False)]
        nothing = np.zeros((len(self.evidence), 0)), np.zeros(0, dtype=np.intp)
        return np.hstack([nothing[0], *(Z for Z, _ in shown)]), np.concatenate([nothing[1], *own])

    def number(self, effect: Effect) -> int:
        """Return how many coefficients an effect has."""
        return self._columns(effect).p

    def _columns(self, effect: Effect) -> Columns:
        """Return what an effect shows on each axis."""

        def make() -> Columns:
            whole = self.signature(effect)
            places = [np.flatnonzero(np.any(whole[:, axis] != 0, axis=0)) for axis in range(whole.shape[1])]
            return Columns(whole.shape[2], [(whole[:, axis][:, place], place) for axis, place in enumerate(places)])

        return self._shown.get(repr(effect), make)

    def white_map(self, effects: Model, axis: int, log_ratio: float) -> WhiteMap:
        """Return the map's curves as the filter of an axis leaves them."""

        def make() -> WhiteMap:
            whitening = self.whitening(axis, log_ratio)
            X = whitening(self.curves(effects))
            XX = X.T @ X
            own, vectors = np.linalg.eigh(XX)
            own = np.clip(own, 0.0, None) + self.epsilon
            B = vectors / np.sqrt(own)
            e, U = np.linalg.eigh(B.T @ (self.weight * self.penalty) @ B)
            e = np.where(self.eigenvalues > 0, np.clip(e, 0.0, None), 0.0)  # of one rank, both ascending
            return WhiteMap(X, XX, B @ U, e, float(np.sum(np.log(own))), float(np.sum(whitening.log_S)))

        return self._white.get((repr(_acting(effects)), self._alike[axis], log_ratio), make)

    def whitening(self, axis: int, log_ratio: float) -> Whitening:
        """Return the filter of an axis with its gains."""
        own = self.evidence.filters[axis]
        return self._gains.get((self._alike[axis], log_ratio), lambda: own.at(float(np.exp(log_ratio))))

    def prior(self, smoothing: float) -> Array:
        """Return K (q, q)."""
        return smoothing * self.weight * self.penalty + self.epsilon * np.eye(len(self.penalty))

    @cached_property
    def weight(self) -> float:
        """Weight of the curves in the innovations as declared: what lambda is relative to."""
        return float(np.sum(self.whitening(0, 0.0)(self.curves(())) ** 2))

    @cached_property
    def epsilon(self) -> float:
        """What keeps directions that neither the data nor P determine from being free."""
        return 1e-8 * self.weight / len(self.penalty)

    def forget(self) -> None:
        """Let go of what is kept to be fast."""
        for kept in (self._curves, self._shown, self._gains, self._white):
            kept.clear()


def _acting(effects: Model) -> Model:
    """Return those that change the temperature that the map sees."""
    return tuple(effect for effect in effects if effect.acts_on_input)
