"""How sure a fitted curve is: what noise and a wandering bias do to it, where it misfits, and where it was never seen.

The samples of a fit are in the order of time. In K blocks, of samples that follow one another at about one
temperature, the bias is::

    y = X beta + walk + white,    walk: the means of a random walk over the blocks,    white_k ~ N(0, s^2 / n_k)

X are straight pieces between knots in T, free to follow any curve, up and down alike; both variances are found by
restricted maximum likelihood, so that what a bias wanders over hours counts, and not the noise of one sample. A kind
of map answers to the blocks' noise e with H e, which gives the modes of its error; where its curve is further from
X beta than that noise explains, the difference is one mode more. In a hole of the temperatures the curve may bend as it
does elsewhere, or as one bends that swings over the whole range as much as this one. N samples, d axes.

Source: H. D. Patterson and R. Thompson, Recovery of inter-block information when block sizes are unequal, Biometrika
58 (1971) 545.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.curve_error import CurveError
from fusion_core.errors import SingularFit

Index = NDArray[np.int64]
Curve = Callable[[Array], Array]  # of T (N,), with d values (N, d)
Smoother = Callable[["Blocks", Array, int], Array]
"""How a kind of map answers to the blocks' bias, on a grid (G,), for an axis: H (G, K)."""

SPANS = 240  # of time, at most
BLOCKS = 360  # about, at most
CELLS = 40  # of temperature: a block stays in one
FEWEST = 24  # blocks with which a walk can be told from white noise
KNOTS = 40  # at most, and at least GROUP blocks to each
GROUP = 8
GRID = 121
FINE = 1000
RATIOS = np.logspace(-6, 6, 49)  # of the walk's variance over a soak to the white noise of a block
KEPT = 1e-3  # of the largest variance: modes with less are left out
HOLE = 0.05  # of the range, without a sample
CHANCE = 1e-3  # probability that noise alone is taken for a misfit


@dataclass(frozen=True)
class Blocks:
    """Means of samples: T (K,), what the curve leaves of them y (K, d), how many n (K,).

    `t` and `width` (K,) are the middle of each block and how long it lasts, both in samples, `of_sample` (N,) is the
    block of each sample, and `over` (K, FINE) how its samples are spread over the temperatures `fine` (FINE,).
    """

    T: Array
    y: Array
    n: Array
    t: Array
    width: Array
    of_sample: Index
    fine: Array
    over: Array

    def shares(self, group: Index, count: int) -> Array:
        """Return by what share each block is in each of `count` groups (count, K); group (N,) of each sample."""
        K = len(self.T)
        table = np.bincount(group * K + self.of_sample, minlength=count * K).reshape(count, K)
        return np.asarray(table / np.maximum(table.sum(axis=1, keepdims=True), 1), dtype=np.float64)


def curve_error(kind: str, T: Array, bias: Array, predict: Curve, smoother: Smoother) -> CurveError:
    """Return the error of a curve that was fitted to samples T (N,) and bias (N, d), in the order of time.

    Raises
    ------
    SingularFit
        If the temperatures have a hole over which the curve is less sure than its own swing.
    """
    domain = (float(T.min()), float(T.max()))
    grid = np.linspace(*domain, GRID)
    d = bias.shape[1]
    blocks = _blocks(T, bias - predict(T))
    holes = find_holes(T)
    seen = predict(np.sort(blocks.T))
    swing = np.ptp(seen, axis=0)
    bend = _bend(grid, predict, holes, swing)
    contrasts = Contrasts(blocks)
    per_axis = [_axis_modes(blocks, contrasts, grid, smoother, axis) for axis in range(d)]
    r = max(len(modes) for modes in per_axis)
    modes = np.zeros((r + len(holes), GRID, d))
    for axis, own in enumerate(per_axis):
        modes[: len(own), :, axis] = own
    for k, (low, high) in enumerate(holes):
        modes[r + k] = np.outer(np.maximum((grid - low) * (high - grid), 0.0) / 2, bend)
    found = CurveError(
        T=tuple(grid.tolist()), modes=tuple(tuple(map(tuple, mode)) for mode in modes.tolist()),
        bend=tuple(bend.tolist()), holes=holes,
    )  # fmt: skip
    _check_holes(kind, found, swing)
    return found


def _check_holes(kind: str, found: CurveError, swing: Array) -> None:
    for low, high in found.holes:
        inside = np.linspace(low, high, 20)[1:-1]
        sigma = np.sqrt(found.variance(inside, low))
        axis = int(np.argmax(np.max(sigma, axis=0) / np.maximum(swing, np.finfo(float).tiny)))
        if np.max(sigma[:, axis]) > swing[axis] > 0:
            raise SingularFit(
                f"{kind}: has no sample between {low:.4g} and {high:.4g} degC, where the curve of axis {'xyz'[axis]} "
                f"would be known to {np.max(sigma[:, axis]):.2g} rad/s and swings by {swing[axis]:.2g} rad/s in all "
                "that was seen; record the temperatures between, or fit each side on its own"
            )


def find_holes(T: Array) -> tuple[tuple[float, float], ...]:
    """Return the ranges of T (N,) without a sample that are wider than HOLE of all."""
    values = np.unique(T)
    step = np.diff(values)
    if len(step) < 4:
        return ()
    coarse = 3 * np.max(np.sort(step)[: max(1, int(0.9 * len(step)))])  # of a thermometer with large steps
    wide = np.flatnonzero((step > HOLE * (values[-1] - values[0])) & (step > coarse))
    return tuple((float(values[k]), float(values[k + 1])) for k in wide)


def resolution(T: Array) -> float:
    """Return the steps of a thermometer in K that shows T (N,) one after the other; 0 where none are seen.

    Between values that stay for two samples or more, the smallest difference; where many small changes lead from one
    to the other, the largest of them.
    """
    change = np.abs(np.diff(T))
    stays = np.flatnonzero(change < 1e-6)
    if len(stays) < 2 or len(stays) <= 0.2 * len(change):
        return 0.0
    size, largest = np.abs(np.diff(T[stays])), np.maximum.reduceat(change, stays)[:-1]
    steps = np.where(2 * largest >= size, size, largest)[size > 1e-6]
    return float(steps.min()) if len(steps) else 0.0


def _blocks(T: Array, left: Array) -> Blocks:
    """Return the blocks of samples T (N,) and what a curve leaves of them (N, d): spans of time, cut by temperature."""
    N = len(T)
    cell = np.minimum(((T - T.min()) * (CELLS / np.ptp(T))).astype(np.int64), CELLS - 1)
    spans = min(SPANS, N)
    while True:
        span = np.arange(N) * spans // N
        found, of_sample = np.unique(span * CELLS + cell, return_inverse=True)
        if len(found) <= BLOCKS or spans <= 2:
            break
        spans //= 2
    n = np.bincount(of_sample).astype(np.float64)
    y = np.stack([np.bincount(of_sample, column) / n for column in left.T], axis=1)
    at = np.arange(N, dtype=np.float64)
    t = np.bincount(of_sample, at) / n
    # as long as an even stretch with the same scatter, also where a span comes back to a temperature
    width = np.sqrt(12 * np.maximum(np.bincount(of_sample, (at - t[of_sample]) ** 2) / n, 1 / 12))
    low, step = float(T.min()), float(np.ptp(T)) / (FINE - 1)
    near = np.rint((T - low) / step).astype(np.int64)
    over = np.bincount(of_sample * FINE + near, minlength=len(n) * FINE).reshape(len(n), FINE) / n[:, None]
    fine = low + step * np.arange(FINE, dtype=np.float64)
    return Blocks(np.bincount(of_sample, T) / n, y, n, t, width, of_sample, fine, over)


def _bend(grid: Array, predict: Curve, holes: tuple[tuple[float, float], ...], swing: Array) -> Array:
    """Return the second derivative (d,) to reckon with: the curve's own, or that of a parabola with its swing."""
    step = grid[1] - grid[0]
    second = np.diff(predict(grid), n=2, axis=0) / step**2
    inside = np.any([(grid > low) & (grid < high) for low, high in holes] or [np.zeros(len(grid), bool)], axis=0)
    known = ~inside[1:-1]
    own = np.sqrt(np.mean(second[known] ** 2, axis=0)) if np.any(known) else np.zeros(len(swing))
    return np.asarray(np.maximum(own, 8 * swing / (grid[-1] - grid[0]) ** 2))


def _axis_modes(blocks: Blocks, contrasts: Contrasts, grid: Array, smoother: Smoother, axis: int) -> Array:
    """Return the modes (r, G) of the noise's part in the curve's error, and of its misfit."""
    H = smoother(blocks, grid, axis)
    taken = blocks.over @ smoother(blocks, blocks.fine, axis)
    H = H - (blocks.n / np.sum(blocks.n)) @ taken  # its mean over the fit is not its error
    left = np.eye(len(blocks.T)) - taken
    noise = contrasts.noise(blocks.y[:, axis], left)
    modes = H @ noise.root
    misfit = _misfit(blocks, contrasts, noise, left)
    if misfit is not None:
        modes = np.column_stack([modes, np.interp(grid, contrasts.knots, misfit)])
    U, s, _ = np.linalg.svd(modes, full_matrices=False)
    keep = s**2 > KEPT * s[0] ** 2 if s[0] > 0 else np.zeros(len(s), dtype=bool)
    return np.asarray((U[:, keep] * s[keep]).T)


@dataclass(frozen=True)
class Noise:
    """Noise of the K blocks of one axis.

    `root` (K, r) is one of its covariance, `curve` (p,) the free curve at the knots, `operator` (p, K) what took the
    blocks there.
    """

    root: Array
    curve: Array
    operator: Array


class Contrasts:
    """What no free curve of T can make of K blocks.

    Attributes
    ----------
    knots : (p,) array
        Of the free curve, X (K, p) its straight pieces.
    Z : (K, m) array
        Contrasts: Z' X = 0.
    walk : (K, K) array
        Root of the covariance of a walk.
    white : (K,) array
        Variance of white noise, 1 in the mean block.
    """

    def __init__(self, blocks: Blocks) -> None:
        self.knots, pieces = _pieces(blocks)
        self.X = blocks.over @ pieces
        self.walk, self.white = _walk(blocks), np.mean(blocks.n) / blocks.n
        Q, _ = np.linalg.qr(self.X, mode="complete")
        self.Z = Q[:, np.linalg.matrix_rank(self.X) :]

    def noise(self, y: Array, left: Array) -> Noise:
        """Tell walk from white noise in what a map leaves of the blocks, y (K,) = left (K, K) times their noise."""
        scale, K = float(np.sqrt(np.mean(y**2))) or 1.0, len(y)
        A = self.Z.T @ left  # the map has taken its part of the noise already
        k2, s2 = 0.0, float(np.mean((y / scale) ** 2 / self.white))
        if len(A) >= FEWEST:
            # turned so that the white noise is alike in all contrasts, and the walk independent
            R, V = np.linalg.eigh((A * self.white) @ A.T)
            seen = 1e-6 * R[-1] < R
            L = (V[:, seen] / np.sqrt(R[seen])).T
            own, V = np.linalg.eigh(L @ (A @ self.walk) @ (A @ self.walk).T @ L.T)
            k2, s2 = _likeliest(np.clip(own, 0.0, None), V.T @ (L @ (self.Z.T @ (y / scale))))
        root = np.hstack([np.sqrt(k2) * self.walk, np.diag(np.sqrt(s2 * self.white))])
        S = root @ root.T + np.eye(K) * max(1e-9 * (k2 + s2), 1e-12)
        weighted = np.linalg.solve(S, self.X)
        operator = np.asarray(np.linalg.pinv(self.X.T @ weighted, hermitian=True) @ weighted.T, dtype=np.float64)
        return Noise(scale * root, operator @ y, operator)


def _walk(blocks: Blocks) -> Array:
    """Return a root (K, K) of the covariance of a walk's means over the blocks; its variance in all is 1.

    Of one that starts at zero: min(t, t'), and t - width / 6 for one block with itself.
    """
    covariance = np.minimum(blocks.t[:, None], blocks.t) + 0.5
    covariance[np.diag_indices_from(covariance)] -= blocks.width / 6
    own, V = np.linalg.eigh(covariance / np.sum(blocks.n))
    return np.asarray(V * np.sqrt(np.clip(own, 0.0, None)))


def _likeliest(own: Array, u: Array) -> tuple[float, float]:
    """Return the variances of walk and white noise for which u (m,) ~ N(0, k^2 own + s^2) is likeliest."""
    from scipy.optimize import minimize_scalar

    if not np.any(u):
        return 0.0, 0.0

    def at(ratio: float) -> tuple[float, float]:
        shape = ratio * own + 1.0
        scale = float(np.mean(u**2 / shape))
        return len(u) * np.log(scale) + float(np.sum(np.log(shape))), scale

    k = int(np.argmin([at(ratio)[0] for ratio in RATIOS]))
    bounds = np.log(RATIOS[max(k - 1, 0)]), np.log(RATIOS[min(k + 1, len(RATIOS) - 1)])
    best = float(np.exp(minimize_scalar(lambda log: at(float(np.exp(log)))[0], bounds=bounds, method="bounded").x))
    best = best if at(best)[0] < at(0.0)[0] else 0.0
    scale = at(best)[1]
    return best * scale, scale


def _pieces(blocks: Blocks) -> tuple[Array, Array]:
    """Return knots (p,) and the straight pieces between them (FINE, p), each with blocks of its own."""
    p = int(np.clip(len(blocks.T) // GROUP, 2, KNOTS))
    knots = np.unique(np.quantile(blocks.T, np.linspace(0, 1, p)))
    if len(knots) < 2:
        return knots, np.ones((FINE, 1))
    return knots, np.stack([np.interp(blocks.fine, knots, row) for row in np.eye(len(knots))], axis=1)


def _misfit(blocks: Blocks, contrasts: Contrasts, noise: Noise, left: Array) -> Array | None:
    """Return what the free curve has (p,) that the map leaves, where noise alone would hardly leave as much.

    `left` (K, K) is what the map leaves of the blocks' noise.
    """
    knots = contrasts.knots
    if len(blocks.T) < FEWEST or len(knots) < 3:
        return None
    weight = contrasts.X.mean(axis=0)
    mean = weight / np.sum(weight)

    def centred(values: Array) -> Array:
        return np.asarray(values - mean @ values)

    curve = centred(noise.curve)
    spread = np.sqrt(weight)[:, None] * centred(noise.operator) @ left @ noise.root
    variance = np.linalg.svd(spread, compute_uv=False) ** 2
    found, expected = float(weight @ curve**2), float(np.sum(variance))
    if expected <= 0 or found <= expected:
        return None
    from scipy.special import chdtri

    freedom = expected**2 / float(np.sum(variance**2))  # Satterthwaite's: a sum of squares of unequal weight
    return curve if found / expected * freedom > chdtri(freedom, CHANCE) else None
