"""A soak in brief: its samples in a few thousand means, with where the temperature turned and what white noise is.

The samples of a fit, N of d axes in the order of time, are read once, a slab at a time:

- *slots*, S means of equally many samples that follow one another, of which the way of the temperature is read
  (`driftlab.samples.turning`);
- *cells*, CELLS equal ranges of temperature, with the samples of each way in them;
- white noise, from the differences between neighbouring samples: var = mean((b_k+1 - b_k)^2) / 2, to which neither a
  curve nor a walk adds much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.samples.turning import Index, directions
from fusion_core.chunk import Array
from fusion_core.contracts import SLAB

SLOTS = 4096  # at most
CELLS = 120
TURN = 0.05  # of the range of temperature: less is no turn
WAYS = {"warming": 1, "cooling": -1}
CLEAR = 10  # times the scatter of the slots' temperatures: what is in no order, turns nowhere
_ROW = {0: 0, 1: 1, -1: 2}  # of a way among the cells


@dataclass(frozen=True, eq=False)
class Soak:
    """What a verdict on a map needs to know of the samples it was fitted on.

    Attributes
    ----------
    domain : tuple of float
        Lowest and highest temperature, degC.
    interval : float
        Between samples, s.
    n, T, t, way, recording : (S,) arrays
        Of each slot: samples, mean temperature, its middle in samples from the first, +1 warming, -1 cooling or 0, and
        from which recording it is.
    bias : (S, d) array
        Mean bias of each slot.
    count : (3, CELLS) array
        Samples in each cell on no way, warming, and cooling.
    cell_T, cell_bias : (3, CELLS) and (3, CELLS, d) arrays
        Their means; NaN where there are none.
    white : (d,) array
        Standard deviation of the white noise of a sample.
    """

    domain: tuple[float, float]
    interval: float
    n: Array
    T: Array
    t: Array
    way: Index
    recording: Index
    bias: Array
    count: Array
    cell_T: Array
    cell_bias: Array
    white: Array

    @property
    def edges(self) -> Array:
        """Edges of the cells (CELLS + 1,), degC."""
        return np.linspace(*self.domain, CELLS + 1)

    def hours(self, way: int) -> float:
        """Return how long the soak went one way."""
        return float(np.sum(self.n[self.way == way])) * self.interval / 3600

    def cells(self, way: int) -> tuple[Array, Array, Array]:
        """Return samples (CELLS,), mean temperature (CELLS,) and mean bias (CELLS, d) of one way."""
        row = _ROW[way]
        return self.count[row], self.cell_T[row], self.cell_bias[row]


def brief(T: Array, bias: Array, starts: Sequence[int], interval: float) -> Soak:
    """Return the soak of samples T (N,) and bias (N, d); each recording begins at one of `starts`, the first at 0."""
    N, domain = len(T), (float(T.min()), float(T.max()))
    size, stops = -(-N // SLOTS), [*starts[1:], N]
    cuts = np.concatenate([np.arange(start, stop, size) for start, stop in zip(starts, stops, strict=True)])
    n = np.diff(np.append(cuts, N)).astype(np.float64)
    slot_T = np.add.reduceat(T, cuts) / n
    recording = np.searchsorted(np.asarray(starts), cuts, side="right") - 1
    threshold = max(TURN * (domain[1] - domain[0]), CLEAR * _scatter(slot_T))
    way = np.concatenate([directions(slot_T[recording == k], threshold) for k in range(len(starts))])
    rows = np.array([_ROW[int(w)] for w in way])
    count, cell_T, cell_bias = _cells(T, bias, np.repeat(rows.astype(np.int8), n.astype(np.int64)), domain)
    return Soak(
        domain, interval, n, slot_T, cuts + (n - 1) / 2, way, recording,
        np.add.reduceat(bias, cuts, axis=0) / n[:, None], count, cell_T, cell_bias, _white(bias),
    )  # fmt: skip


def _scatter(T: Array) -> float:
    """Return the deviation of temperatures (S,) about straight lines between their neighbours."""
    if len(T) < 3:
        return 0.0
    return float(np.median(np.abs(np.diff(T, n=2))) / (0.6745 * np.sqrt(6)))


def _cells(T: Array, bias: Array, row: NDArray[np.int8], domain: tuple[float, float]) -> tuple[Array, Array, Array]:
    """Return samples (3, CELLS), mean temperature and mean bias (3, CELLS, d) of the cells, `row` (N,) in 0, 1, 2."""
    size, d = 3 * CELLS, bias.shape[1]
    sums = np.zeros((2 + d, size))
    scale = CELLS / ((domain[1] - domain[0]) or 1.0)
    for start in range(0, len(T), SLAB):
        part = slice(start, start + SLAB)
        cell = np.minimum(((T[part] - domain[0]) * scale).astype(np.intp), CELLS - 1) + CELLS * row[part].astype(
            np.intp
        )
        sums[0] += np.bincount(cell, minlength=size)
        for k, column in enumerate((T[part], *bias[part].T), start=1):
            sums[k] += np.bincount(cell, column, minlength=size)
    with np.errstate(invalid="ignore"):
        means = sums[1:] / sums[0]
    return sums[0].reshape(3, CELLS), means[0].reshape(3, CELLS), means[1:].T.reshape(3, CELLS, d)


def _white(bias: Array) -> Array:
    total = np.zeros(bias.shape[1])
    for start in range(0, len(bias) - 1, SLAB):
        step = np.diff(bias[start : start + SLAB + 1], axis=0)
        total += np.einsum("Nd,Nd->d", step, step)
    return np.asarray(np.sqrt(total / (2 * max(len(bias) - 1, 1))))
