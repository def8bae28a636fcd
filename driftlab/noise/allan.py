"""Allan and Hadamard deviations by cumulative sums, over the stretches of a recording that have no gap.

With the angle (or velocity) x_k = dt sum of the samples of a stretch up to k, mean removed, and tau = m dt::

    allan^2(tau)    = mean of (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 tau^2)                  over all k: overlapping
    hadamard^2(tau) = mean of (x_{k+3m} - 3 x_{k+2m} + 3 x_{k+m} - x_k)^2 / (6 tau^2)     blind to a constant ramp

The mean is over all differences that lie within one stretch, of all stretches that have at least 3 m samples: so each
stretch has the weight of its differences, and the level at which it begins does not matter.

Sources: IEEE Std 952, annex C; W. J. Riley, NIST Special Publication 1065, sections 5.2.4 and 5.2.10.

N samples, S stretches, J averaging times.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from driftlab.noise.allan_gaps import bridged, places, spans
from driftlab.noise.allan_model import AllanCurve
from fusion_core.chunk import Array

Index = NDArray[np.int64]

PER_DECADE = 10  # averaging times; nearer ones are so correlated that they show nothing more
LEAST = 3  # averaging times that all differences cover: a fewer-than-three-fold mean says nothing
ORDER = 3  # of the Hadamard difference: averaging times in the shortest stretch that counts
FINE = 64  # overlaps in one averaging time; more of them are so alike that the mean does not move
LONG = 2**20  # samples up to which every overlap is taken all the same


def factors(lengths: int | Index, per_decade: int = PER_DECADE) -> Index:
    """Return the numbers m of samples to average over, evenly spread on a logarithmic scale.

    They go from 1 to a fifth of a single stretch; of several, `lengths` (S,), to the longest averaging time whose
    differences cover LEAST of it, in stretches of at least ORDER of it.
    """
    N, n = np.unique(lengths, return_counts=True)
    low, high = 1, max(1, int(N[-1]) // ORDER)
    while low < high:
        m = (low + high + 1) // 2
        long = ORDER * m <= N
        enough = int(n[long] @ (N[long] - 2 * m)) >= LEAST * m
        low, high = (m, high) if enough else (low, m - 1)
    count = int(np.ceil(np.log10(low) * per_decade)) + 1
    return np.unique(np.rint(np.geomspace(1, low, count)).astype(np.int64))


def curve(
    rate: Array, dt: float, m: Index | None = None, stretches: Index | None = None, missing: Index | None = None
) -> AllanCurve:
    """Return the overlapping Allan and Hadamard deviations of samples `rate` (N,), dt seconds apart.

    Every overlap is taken, up to LONG samples. Beyond, where an averaging time has more than FINE of them, every
    second, fourth, ... is taken (`stride`), and m is rounded to a multiple of that.

    Parameters
    ----------
    m : (J,) array of int, optional
        Samples to average over; those of `factors` if left out. A stretch of 3 m samples is needed.
    stretches : (S, 2) array of int, optional
        First row of each stretch without a gap, and the row after its last; all rows if left out.
    missing : (S - 1,) array of int, optional
        Samples lost behind each stretch but the last. Short gaps are then bridged; none is if left out. Averaging times
        for which too few windows have their samples are not in the curve.
    """
    if stretches is None:
        stretches = np.array([[0, len(rate)]])
    if missing is not None:
        lengths = np.diff(stretches, axis=1)[:, 0]
        parts = spans(lengths, missing)
        whole = places(lengths, missing, parts)
        parts, whole = parts[whole >= ORDER], whole[whole >= ORDER]
        ends = np.stack([stretches[parts[:, 0], 0], stretches[parts[:, 1] - 1, 1]], axis=1)
        if np.any(np.diff(ends, axis=1)[:, 0] < whole):
            return _bridged(rate, dt, m, (stretches, missing, parts, whole))
        stretches = ends
    lengths = np.diff(stretches, axis=1)[:, 0]
    m, stride = _sizes(factors(lengths) if m is None else m, int(np.sum(lengths)))
    x, begins = _sums(rate, stretches, dt)
    thinned = {int(s): (x, begins) if s == 1 else _thinned(x, begins, s) for s in np.unique(stride)}
    squares = np.array([_mean_squares(*thinned[int(s)], int(k // s)) for k, s in zip(m, stride, strict=True)])
    tau: Array = np.asarray(m * dt, dtype=np.float64)
    deviations = np.sqrt(squares / [2.0, 6.0]) / tau[:, None]
    return AllanCurve(tau, deviations[:, 0], deviations[:, 1], stride, lengths, dt)


def _bridged(rate: Array, dt: float, m: Index | None, grid: tuple[Index, Index, Index, Index]) -> AllanCurve:
    """Return the curve over spans with gaps: `grid` is stretches, missing, spans and their places."""
    stretches, missing, parts, whole = grid
    wanted = m is not None
    m, stride = _sizes(factors(whole) if m is None else m, int(np.sum(whole)))
    squares, bridge = bridged(rate, stretches, missing, parts, m, stride)
    second, third = bridge.differences
    # where m was rounded to the stride it may be a little longer than `factors` has it
    kept = third > 0 if wanted else (second >= 0.8 * LEAST * m) & (third >= m / 2)
    deviations = np.sqrt(squares[kept] / [2.0, 6.0])
    tau: Array = np.asarray(m[kept] * dt, dtype=np.float64)
    return AllanCurve(tau, deviations[:, 0], deviations[:, 1], stride[kept], whole, dt, bridge.of(kept))


def _sizes(m: Index, N: int) -> tuple[Index, Index]:
    """Return m as multiples of the stride over N samples, and the stride."""
    m = np.asarray(m, dtype=np.int64)
    stride = np.array([_stride(int(k), N) for k in m], dtype=np.int64)
    m = np.unique(np.rint(m / stride).astype(np.int64) * stride)
    return m, np.array([_stride(int(k), N) for k in m], dtype=np.int64)


def _stride(m: int, N: int) -> int:
    s = 1
    while m >= 2 * s * FINE and 2 * s * LONG <= N:
        s *= 2
    return s


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _sums(rate: Array, stretches: Index, dt: float) -> tuple[Array, Index]:
    """Return x of one stretch after the other, a zero before each, and where each begins (S + 1,).

    Without their mean the sums do not grow with N, and their rounding stays far below the noise.
    """
    places = np.zeros(len(stretches) + 1, dtype=np.int64)
    for i in range(len(stretches)):
        places[i + 1] = places[i] + stretches[i, 1] - stretches[i, 0] + 1
    x = np.empty(places[-1])
    for i in range(len(stretches)):
        start, stop = stretches[i, 0], stretches[i, 1]
        level, mean = rate[start], 0.0  # equal samples less the first are zero; less their mean they may not be
        for k in range(start, stop):
            mean += (rate[k] - level) / (stop - start)
        total = 0.0
        x[places[i]] = 0.0
        for k in range(start, stop):
            total += rate[k] - level - mean
            x[places[i] + 1 + k - start] = total * dt
    return x, places


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _thinned(x: Array, places: Index, stride: int) -> tuple[Array, Index]:
    """Return every so-manyth x of each stretch, and where each begins."""
    kept = np.zeros_like(places)
    for i in range(len(places) - 1):
        kept[i + 1] = kept[i] + (places[i + 1] - places[i] + stride - 1) // stride
    found = np.empty(kept[-1])
    for i in range(len(places) - 1):
        for k in range(kept[i + 1] - kept[i]):
            found[kept[i] + k] = x[places[i] + k * stride]
    return found, kept


@njit(cache=True, nogil=True, fastmath={"reassoc"})  # type: ignore[untyped-decorator]
def _mean_squares(x: Array, places: Index, m: int) -> tuple[float, float]:
    """Return the mean squares of the second and of the third differences of x over m samples."""
    squares = cubes = 0.0
    seconds = thirds = 0
    for i in range(len(places) - 1):
        start, n = places[i], places[i + 1] - places[i]
        third, second = n - 3 * m, n - 2 * m
        if third < 1:
            continue
        own = x[start : start + n]
        for k in range(third):
            now = own[k + 2 * m] - 2 * own[k + m] + own[k]
            later = own[k + 3 * m] - 2 * own[k + 2 * m] + own[k + m]
            squares += now * now
            cubes += (later - now) * (later - now)
        for k in range(third, second):
            now = own[k + 2 * m] - 2 * own[k + m] + own[k]
            squares += now * now
        seconds += second
        thirds += third
    return squares / seconds, cubes / thirds
