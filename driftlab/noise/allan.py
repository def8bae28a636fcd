"""Allan and Hadamard deviations by cumulative sums, over stretches without a gap, short gaps bridged.

With the angle (or velocity) x_k = dt sum of the samples of a stretch up to k, mean removed, and tau = m dt::

    allan^2(tau)    = mean of (x_{k+2m} - 2 x_{k+m} + x_k)^2 / (2 tau^2)                  over all k: overlapping
    hadamard^2(tau) = mean of (x_{k+3m} - 3 x_{k+2m} + 3 x_{k+m} - x_k)^2 / (6 tau^2)     blind to a constant ramp

The mean is over all differences that lie within one stretch, of all stretches that have at least 3 m samples: so each
stretch has the weight of its differences, and the level at which it begins does not matter.

An average over m places of the time grid counts where at least PRESENT of its samples are there, and is their mean; so
short gaps are bridged. With the means a_i of neighbouring windows that all count::

    allan^2(tau)    = mean of (a_2 - a_1)^2 / 2                hadamard^2(tau) = mean of (a_3 - 2 a_2 + a_1)^2 / 6

No window reaches over a long gap, and windows of fewer than 1 / (1 - PRESENT) places are whole. White noise of n
samples has the variance m / n of a whole window, and an integrating sensor's quantisation enters at both sides of a
gap: how much larger the two terms become is counted.

Sources: IEEE Std 952, annex C; W. J. Riley, NIST Special Publication 1065, sections 5.2.4 and 5.2.10.

N samples, S stretches without a gap, P spans of such stretches, G groups of spans of like length, J averaging times;
the order of a difference is 0 for the second, 1 for the third.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from driftlab.noise.allan_model import PRESENT, AllanCurve, Bridge, octaves
from driftlab.noise.allan_unsteady import PARTS, tail
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.fast import compiled

PER_DECADE = 10  # averaging times; nearer ones are so correlated that they show nothing more
COVERED = 3  # averaging times that all differences cover: a fewer-than-three-fold mean says nothing
ORDER = 3  # of the Hadamard difference: averaging times in the shortest stretch that counts
FINE = 64  # overlaps in one averaging time; more of them are so alike that the mean does not move
LONG = 2**20  # samples up to which every overlap is taken all the same
REACH = 0.45  # of an averaging time: differences nearer than that tell the same, at white noise and at walks
Sums = tuple[Array, Integers, Integers, Integers]
Sizes = tuple[int, int, int, int]  # of an average in rows and in samples, the least of these, and the reach of pairs
Grid = tuple[Integers, Integers, Integers, Integers]  # stretches, missing, spans, and the places of these


def factors(lengths: int | Integers) -> Integers:
    """Return the numbers m of samples to average over, evenly spread on a logarithmic scale.

    They go from 1 to a fifth of a single stretch; of several, `lengths` (S,), to the longest averaging time whose
    differences cover COVERED of it, in stretches of at least ORDER of it.
    """
    N, n = np.unique(lengths, return_counts=True)
    low, high = 1, max(1, int(N[-1]) // ORDER)
    while low < high:
        m = (low + high + 1) // 2
        long = ORDER * m <= N
        enough = int(n[long] @ (N[long] - 2 * m)) >= COVERED * m
        low, high = (m, high) if enough else (low, m - 1)
    count = int(np.ceil(np.log10(low) * PER_DECADE)) + 1
    return np.unique(np.rint(np.geomspace(1, low, count)).astype(np.int64))


def curve(
    rate: Array,
    dt: float,
    m: Integers | None = None,
    stretches: Integers | None = None,
    missing: Integers | None = None,
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
        parts, whole = bridgeable(np.diff(stretches, axis=1)[:, 0], missing)
        ends = np.stack([stretches[parts[:, 0], 0], stretches[parts[:, 1] - 1, 1]], axis=1)
        if np.any(np.diff(ends, axis=1)[:, 0] < whole):
            return _bridged(rate, dt, m, (stretches, missing, parts, whole))
        stretches = ends
    lengths = np.diff(stretches, axis=1)[:, 0]
    m, stride = _sizes(factors(lengths) if m is None else m, int(np.sum(lengths)))
    x, begins = _sums(rate, stretches, dt)
    thinned = {1: (x, begins)}
    for s in set(stride.tolist()) - {1}:
        rows, few = _thinned_rows(begins, s)
        thinned[s] = x[rows], few
    squares_of = np.zeros((len(m), PARTS, 2))
    each = zip(m, stride, squares_of, strict=True)
    squares = np.array([_mean_squares(*thinned[int(s)], int(k // s), own) for k, s, own in each])
    tau: Array = np.asarray(m * dt, dtype=np.float64)
    deviations = np.sqrt(squares / [2.0, 6.0]) / tau[:, None]
    return AllanCurve(tau, deviations[:, 0], deviations[:, 1], stride, lengths, dt, squares_of, tail(rate, stretches))


def _bridged(rate: Array, dt: float, m: Integers | None, grid: Grid) -> AllanCurve:
    """Return the curve over spans with gaps."""
    wanted, whole = m is not None, grid[-1]
    m, stride = _sizes(factors(whole) if m is None else m, int(np.sum(whole)))
    squares, parts, bridge = bridged(rate, grid, m, stride)
    second, third = bridge.differences
    # where m was rounded to the stride it may be a little longer than `factors` has it
    enough = third > 0 if wanted else (second >= 0.8 * COVERED * m) & (third >= m / 2)
    deviations = np.sqrt(squares[enough] / [2.0, 6.0])
    tau: Array = np.asarray(m[enough] * dt, dtype=np.float64)
    deviation, third = deviations.T
    stride, parts, index = stride[enough], parts[enough], tail(rate, grid[0])
    return AllanCurve(tau, deviation, third, stride, whole, dt, parts, index, bridge.of(enough))


def _sizes(m: Integers, N: int) -> tuple[Integers, Integers]:
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


@compiled
def _sums(rate: Array, stretches: Integers, dt: float) -> tuple[Array, Integers]:
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


def _thinned_rows(edges: Integers, stride: int) -> tuple[Integers, Integers]:
    """Return every so-manyth row between edges (S + 1,), from each on, and the edges of these rows."""
    sizes = -(-np.diff(edges) // stride)
    few = np.concatenate([[0], np.cumsum(sizes)])
    return np.arange(few[-1]) * stride + np.repeat(edges[:-1] - few[:-1] * stride, sizes), few


@partial(compiled, fastmath={"reassoc"})
def _mean_squares(x: Array, places: Integers, m: int, parts: Array) -> tuple[float, float]:
    """Return the mean squares of the second and of the third differences of x over m samples.

    To `parts` (PARTS, 2) go the squares of the second ones in equal parts of x, and their number.
    """
    cubes, thirds = 0.0, 0
    for i in range(len(places) - 1):
        start, n = places[i], places[i + 1] - places[i]
        third, second = n - 3 * m, n - 2 * m
        if third < 1:
            continue
        own = x[start : start + n]
        at = 0
        while at < second:
            part = (start + at) * len(parts) // len(x)
            end = min(second, -(-(part + 1) * len(x) // len(parts)) - start)
            squares = 0.0
            for k in range(at, min(end, third)):
                now = own[k + 2 * m] - 2 * own[k + m] + own[k]
                later = own[k + 3 * m] - 2 * own[k + 2 * m] + own[k + m]
                squares += now * now
                cubes += (later - now) * (later - now)
            for k in range(max(at, third), end):
                now = own[k + 2 * m] - 2 * own[k + m] + own[k]
                squares += now * now
            parts[part, 0] += squares
            parts[part, 1] += end - at
            at = end
        thirds += third
    return np.sum(parts[:, 0]) / np.sum(parts[:, 1]), cubes / thirds


def spans(lengths: Integers, missing: Integers) -> Integers:
    """Return first stretch and end (P, 2) of the spans between gaps that no window can bridge.

    A gap is within a span where some interval around it has PRESENT of its samples. Such intervals cover a span at
    most twice, so it has at least 80 % of its samples: the time grid never is much longer than the recording.
    `lengths` (S,) are samples of each stretch, `missing` (S - 1,) those lost behind each but the last.
    """
    lost = np.minimum(missing, np.sum(lengths)) * PRESENT / (1 - PRESENT)
    after = np.cumsum(lengths - np.concatenate([[0.0], lost]))
    least = np.minimum.accumulate(after - lengths)[:-1]
    most = np.maximum.accumulate(after[::-1])[::-1][1:]
    edges = np.concatenate([[0], np.flatnonzero(most < least - 1e-6) + 1, [len(lengths)]])
    return np.stack([edges[:-1], edges[1:]], axis=1).astype(np.int64)


def places(lengths: Integers, missing: Integers, parts: Integers) -> Integers:
    """Return the places of the time grid in each span (P,), lost samples included."""
    if not len(parts):
        return np.empty(0, dtype=np.int64)
    behind = np.append(missing, 0)
    behind[parts[:, 1] - 1] = 0
    return np.asarray(np.add.reduceat(lengths + behind, parts[:, 0]), dtype=np.int64)


def bridgeable(lengths: Integers, missing: Integers) -> tuple[Integers, Integers]:
    """Return the spans (P, 2) that are long enough for a difference, and their places (P,)."""
    parts = spans(lengths, missing)
    whole = places(lengths, missing, parts)
    return parts[whole >= ORDER], whole[whole >= ORDER]


def bridged(rate: Array, grid: Grid, m: Integers, stride: Integers) -> tuple[Array, Array, Bridge]:
    """Return mean squares (J, 2) of the differences of means over m places, second and third, and their basis.

    Between them are the squares of second ones in parts of the grid, and their number (J, PARTS, 2).

    Rates (N,), stretches (S, 2) and `missing` (S - 1,) are those of `curve`, spans (P, 2) those of `spans`; m (J,) is a
    multiple of the `stride` (J,), which says which overlaps are taken.
    """
    stretches, missing, parts, whole = grid
    lengths, group = np.diff(stretches, axis=1)[:, 0], octaves(whole)
    full = _bridged_sums(rate, stretches, np.append(missing, 0), parts, whole)
    thinned = {1: full}
    for s in set(stride.tolist()) - {1}:
        rows, few = _thinned_rows(full[3], s)
        thinned[s] = full[0][rows], full[1][rows], full[2][rows], few
    sums, stands, parts_of = np.zeros((len(m), 2, 3)), np.zeros((len(m), 2)), np.zeros((len(m), PARTS, 2))
    taken = np.zeros((len(m), 2, 4, int(group.max()) + 1))
    for j, (size, s) in enumerate(zip(m.tolist(), stride.tolist(), strict=True)):
        least = int(np.ceil(PRESENT * size - 1e-9))
        sizes = size // s, size, least, int(REACH * size / s)
        stands[j] = _window(thinned[s], sizes, group, sums[j], taken[j], parts_of[j])
    sums[:, 0, 0] = np.sum(parts_of[:, :, 0], axis=1)
    count = np.sum(taken[:, :, 0], axis=2)
    mean = sums / np.maximum(count, 1)[:, :, None]
    ratio = taken[:, :, ::2] / np.maximum(taken[:, :, 1::2], 1)
    inner = np.concatenate([missing[a : b - 1] for a, b in parts])
    bridge = Bridge(
        stretches=np.concatenate([lengths[a:b] for a, b in parts]),
        gaps=inner[inner > 0],
        differences=(count * stride[:, None]).T,
        white=(mean[:, :, 1] * m[:, None] / [2, 6]).T,
        angle=(mean[:, :, 2] * m[:, None].astype(np.float64) ** 2 / [6, 20]).T,
        part=ratio[:, :, 0].transpose(1, 2, 0),
        square=ratio[:, :, 1].transpose(1, 2, 0),
        pieces=stands[:, 0].astype(np.int64),
        samples=stands[:, 1].astype(np.int64),
    )
    return mean[:, :, 0], parts_of, bridge


@compiled
def _bridged_sums(rate: Array, stretches: Integers, behind: Integers, parts: Integers, whole: Integers) -> Sums:
    """Return sums over one span after the other, a zero before each, and where each begins (P + 1,).

    They are of the samples less their mean, of samples that are there, and of runs of such: twice their number, and
    one more where the sample before and the one behind belong to the same run.
    """
    edges = np.zeros(len(whole) + 1, dtype=np.int64)
    for i in range(len(whole)):
        edges[i + 1] = edges[i] + whole[i] + 1
    x, count, runs = np.zeros(edges[-1]), np.zeros(edges[-1], dtype=np.int32), np.zeros(edges[-1], dtype=np.int32)
    for i in range(len(parts)):
        level, mean, n = rate[stretches[parts[i, 0], 0]], 0.0, 0
        for s in range(parts[i, 0], parts[i, 1]):
            for k in range(stretches[s, 0], stretches[s, 1]):
                mean += rate[k] - level
                n += 1
        mean /= n
        at, begun, joined = edges[i], 0, False
        for s in range(parts[i, 0], parts[i, 1]):
            for k in range(stretches[s, 0], stretches[s, 1]):
                runs[at] = 2 * begun + joined
                begun += not joined
                joined = True
                x[at + 1] = x[at] + (rate[k] - level - mean)
                count[at + 1] = count[at] + 1
                at += 1
            lost = behind[s] if s + 1 < parts[i, 1] else 0
            for _ in range(lost):
                runs[at] = 2 * begun
                joined = False
                x[at + 1] = x[at]
                count[at + 1] = count[at]
                at += 1
        runs[at] = 2 * begun
    return x, count, runs, edges


@compiled
def _number(runs: Integers, a: int, b: int) -> int:
    """Return the number of runs of samples in the window from a to b; one that began before it, too."""
    return int((runs[b] >> 1) - (runs[a] >> 1) + (runs[a] & 1))


@compiled
def _window(grid: Sums, sizes: Sizes, group: Integers, sums: Array, taken: Array, parts: Array) -> tuple[int, int]:
    """Add up the differences over m places; return the pieces that they cover without a break, and their samples.

    To `sums` (2, 3) go squares of third ones, and the variances of white noise and of the angle's; to `taken` (2, 4, G)
    how many differences count, how many there would be without a gap, and of both the pairs of them within `reach`; to
    `parts` (PARTS, 2) the squares of second ones in equal parts of the grid, and their number.
    """
    x, count, runs, edges = grid
    m, size, least, reach = sizes
    pieces = samples = 0
    inverse = 1 / np.arange(least, size + 1)
    for i in range(len(edges) - 1):
        start, n = edges[i], edges[i + 1] - edges[i]
        if n <= 3 * m:
            continue
        covered = start - 1
        seconds, thirds = np.zeros(n - 2 * m, dtype=np.bool_), np.zeros(n - 3 * m, dtype=np.bool_)
        for k in range(start, start + n - 2 * m):
            a, b, c = k, k + m, k + 2 * m
            n_1, n_2 = count[b] - count[a], count[c] - count[b]
            if n_1 < least or n_2 < least:
                continue
            seconds[k - start] = True
            first, second = inverse[n_1 - least], inverse[n_2 - least]
            now = (x[c] - x[b]) * second - (x[b] - x[a]) * first
            one, two = 2 * _number(runs, a, b) * first * first, 2 * _number(runs, b, c) * second * second
            shared = 2 * (runs[b] & 1) * first * second
            _add_square(parts[k * len(parts) // len(x)], now)
            sums[0, 1] += first + second
            sums[0, 2] += one + two + shared
            pieces += a > covered
            samples += count[c] - count[max(a, covered)]
            covered = c
            d = c + m
            if d >= start + n or count[d] - count[c] < least:
                continue
            thirds[k - start] = True
            third = inverse[count[d] - count[c] - least]
            later = (x[d] - x[c]) * third - (x[c] - x[b]) * second
            sums[1, 0] += (later - now) * (later - now)
            sums[1, 1] += first + 4 * second + third
            sums[1, 2] += one + 4 * two + 2 * _number(runs, c, d) * third * third
            sums[1, 2] += 2 * shared + 4 * (runs[c] & 1) * second * third
        _add_pairs(seconds, reach, taken[0, :, group[i]])
        _add_pairs(thirds, reach, taken[1, :, group[i]])
    return pieces, samples


@compiled
def _add_square(part: Array, value: float) -> None:
    part[0] += value * value
    part[1] += 1


@compiled
def _add_pairs(counts: Flags, reach: int, taken: Array) -> None:
    """Add to `taken` (4,) as in `_window`, of differences of which some count."""
    n = len(counts)
    near = min(reach, n - 1)
    every = n + 2.0 * near * n - near * (near + 1.0)
    valid = np.sum(counts)
    taken[0] += valid
    taken[1] += n
    taken[2] += every if valid == n else _pairs(counts, near)
    taken[3] += every


@compiled
def _pairs(counts: Flags, reach: int) -> int:
    """Return the number of pairs of differences that count at most `reach` apart, each in both orders."""
    n, pairs = len(counts), 0
    before = np.zeros(n + 1, dtype=np.int64)  # how many count before each
    for k in range(n):
        before[k + 1] = before[k] + counts[k]
    for k in range(n):
        if counts[k]:
            pairs += before[min(k + reach + 1, n)] - before[max(k - reach, 0)]
    return pairs
