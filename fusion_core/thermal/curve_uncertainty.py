"""The uncertainty of a fitted curve: noise of the soak, misfit, and ranges without a sample.

A kind of map answers to the noise e of the soak's blocks (`soak_noise.py`) with H e, which gives the modes of its
error. What a penalty takes of the curve as well is one mode more, and so is the difference where the curve is further
from a free one than noise explains. In a hole
of the temperatures the curve may bend as it does elsewhere, or as one bends that swings over the whole range as much as
this one. What is expected before anything is recorded is the same sum, with the noise as it is known and the curve
that is to be found (`expected_curve_error`, `expected_misfit`). N samples, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from fusion_core.chunk import Array
from fusion_core.errors import SingularFit
from fusion_core.thermal.curve_error import CurveError, Misfit, modes_of_axes
from fusion_core.thermal.fitted_map import FittedMap
from fusion_core.thermal.ripple import Ripple, ripple_modes, ripples
from fusion_core.thermal.soak_noise import (
    MIN_BLOCKS,
    BlockNoise,
    Blocks,
    Contrasts,
    Smoother,
    blocks_of,
    cells_of,
    straight_pieces,
    summed,
    walk_root,
)

Curve = Callable[[Array], Array]  # of T (N,), with d values (N, d)

GRID = 121
MIN_VARIANCE = 1e-3  # of the largest variance: modes with less are left out
HOLE = 0.05  # of the range, without a sample
HALF = 0.5  # of a shape for which penalty and samples weigh alike a map follows
TAKEN = 0.5  # share of a deviation that a map leaves: with less, it can follow that shape
LITTLE = 1e-9  # of the mean variance of blocks: no combination of them is without noise
NOTHING = 1e-12  # of the largest variance: zero but for rounding, as that of the mean
CHANCE = 1e-3  # probability that noise alone is taken for a misfit
SURE = 2.0  # deviations of the place of a misfit, of which chance is excluded by all places together


@dataclass(frozen=True, eq=False)
class KnownErrors:
    """Errors of the K blocks of d axes: roots (K, r) of their covariance, and the variance of white noise (d,) in it.

    The white noise is that of a mean block.
    """

    blocks: Blocks
    roots: Sequence[Array]
    white: Sequence[float]

    def noise(self, contrasts: Contrasts, blocks: Blocks, axis: int) -> BlockNoise:
        """Return them as the noise of an axis of these blocks, of which a curve leaves `blocks.y` (K, d)."""
        S, white = self.roots[axis] @ self.roots[axis].T, self.white[axis]
        S[np.diag_indices(len(S))] += max(LITTLE * np.trace(S) / len(S), np.finfo(float).tiny)
        return contrasts.known(S, blocks.y[:, axis], 0.0, white)


def curve_error(
    kind: str, T: Array, bias: Array, predict: Curve, smoother: Smoother, known: KnownErrors | None = None
) -> CurveError:
    """Return the error of a curve that was fitted to samples T (N,) and bias (N, d), in the order of time.

    Their noise is that of the blocks where it is `known`, and else follows from what the curve leaves.

    Raises
    ------
    SingularFit
        If the temperatures have a hole over which the curve is less sure than its own swing.
    """
    grid = np.linspace(T.min(), T.max(), GRID)
    d = bias.shape[1]
    left = bias - predict(T)
    blocks = blocks_of(T, left) if known is None else summed(T, left, known.blocks.of_sample)
    holes = find_holes(T)
    swing = np.ptp(predict(np.sort(blocks.T)), axis=0)
    bend = _bend(grid, predict, holes, swing)
    contrasts = Contrasts(blocks)
    smoothed = _smoothed(cells_of(T, bias), grid, predict, smoother)
    narrow = ripples(T, left, float(np.median(np.diff(contrasts.knots))))
    each = [_axis_modes(blocks, contrasts, grid, smoother, k, smoothed[:, k], narrow[k], known) for k in range(d)]
    per_axis, misfits = zip(*each, strict=True)
    found = _joined(grid, list(per_axis), bend, holes, tuple(found for found in misfits if found is not None))
    _check_holes(kind, found, swing)
    return found


def with_errors(fitted: FittedMap, blocks: Blocks, smoother: Smoother, errors: Sequence[Array]) -> FittedMap:
    """Return a map whose curve is off by its answer to errors of the blocks that it was fitted on.

    They are in the place of the noise that the fit has seen; a misfit that it has seen, and what holes may hide, stay.
    `errors` (K, r), one an axis, are roots of their covariance. A map that does not tell how sure it is stays as it is.
    """
    error = fitted.record.error
    if error is None:
        return fitted
    more = _answers(blocks, np.asarray(error.T), smoother, errors)
    if not error.misfits:
        error = error.model_copy(update={"modes": error.modes[len(error.modes) - len(error.holes) :]})
    return fitted.noting(error=error.beside(modes_of_axes(more)))


def answered(T: Array, blocks: Blocks, errors: Sequence[Array], smoother: Smoother) -> CurveError:
    """Return the error of a curve on samples at T (N,) whose blocks have errors of the roots (K, r), one an axis."""
    grid = np.linspace(T.min(), T.max(), GRID)
    return _joined(grid, _answers(blocks, grid, smoother, errors), np.zeros(len(errors)), find_holes(T))


def _answers(blocks: Blocks, grid: Array, smoother: Smoother, errors: Sequence[Array]) -> list[Array]:
    """Return the modes (r, G) of each axis."""
    return [_largest(_answer(blocks, grid, smoother, axis) @ root) for axis, root in enumerate(errors)]


def expected_curve_error(T: Array, dt: float, noise: Array, walk: Array, smoother: Smoother) -> CurveError:
    """Return the error that noise will give the curve that is fitted to samples at T (N,) in degC.

    It has the modes that `curve_error` finds where noise and walk are as they are taken here.

    Parameters
    ----------
    T : (N,) array
        As the soak will go through them.
    dt : float
        From one sample to the next, s.
    noise, walk : (d,) arrays
        Densities of the bias's white noise and random walk, in its unit/sqrt(Hz) and its unit/sqrt(s).
    smoother : function
        How the kind of map answers to noise (`ThermalMap.smoother`).
    """
    blocks = blocks_of(T, np.zeros((len(T), len(noise))))
    wandering, white = walk_root(blocks) * np.sqrt(len(T) * dt), np.diag(np.sqrt(1 / (blocks.n * dt)))
    errors = [np.hstack([wandering * w, white * n]) for n, w in zip(noise, walk, strict=True)]
    return answered(T, blocks, errors, smoother)


def expected_misfit(T: Array, smoother: Smoother, shape: Curve, d: int) -> CurveError:
    """Return the part of a known curve `shape` that a map of d axes will leave, at samples T (N,) in degC: one mode.

    Beyond T and in its holes it bends as the shape does.
    """
    grid = np.linspace(T.min(), T.max(), GRID)
    cells = cells_of(T, np.zeros((len(T), d)))
    true, at_cells = shape(grid), shape(cells.T)
    level = cells.n @ at_cells / len(T)
    left = [_answer(cells, grid, smoother, axis) @ at_cells[:, axis] - true[:, axis] + level[axis] for axis in range(d)]
    bend = _bend(grid, shape, (), np.ptp(at_cells, axis=0))
    return _joined(grid, [mode[None, :] for mode in left], bend, find_holes(T))


def measured_noise(T: Array, left: Array, dt: float, smoother: Smoother) -> tuple[Array, Array]:
    """Return the densities (d,) of white noise and walk in what a map leaves of samples, in its unit, per second.

    The samples T (N,) are in the order of time, one each dt in s, `left` (N, d) is what the map leaves of them, and
    `smoother` how it answers to their noise.
    """
    blocks = blocks_of(T, left)
    contrasts = Contrasts(blocks)
    variances = np.zeros((2, left.shape[1]))
    for axis in range(left.shape[1]):
        free = np.eye(len(blocks.T)) - blocks.over @ smoother(blocks, blocks.fine, axis)
        noise = contrasts.noise(blocks.y[:, axis], free)
        variances[:, axis] = noise.white * np.mean(blocks.n) * dt, noise.walk / (len(T) * dt)
    white, walk = np.sqrt(variances)
    return white, walk


def _joined(
    grid: Array,
    per_axis: list[Array],
    bend: Array,
    holes: tuple[tuple[float, float], ...],
    misfits: tuple[Misfit, ...] = (),
) -> CurveError:
    """Return the error with the modes (r, G) of each axis, and what a hole may hide."""
    hidden = [np.outer(np.maximum((grid - low) * (high - grid), 0.0) / 2, bend) for low, high in holes]
    modes = np.concatenate([modes_of_axes(per_axis), np.reshape(hidden, (-1, len(grid), len(bend)))])
    return CurveError(T=tuple(grid.tolist()), modes=modes, bend=tuple(bend.tolist()), holes=holes, misfits=misfits)


def _check_holes(kind: str, error: CurveError, swing: Array) -> None:
    for low, high in error.holes:
        inside = np.linspace(low, high, 20)[1:-1]
        sigma = np.sqrt(error.variance(inside, low))
        axis = int(np.argmax(np.max(sigma, axis=0) / np.maximum(swing, np.finfo(float).tiny)))
        if np.max(sigma[:, axis]) > swing[axis] > 0:
            names = "xyz" if len(swing) in (2, 3) else ""
            which = f" of axis {names[axis] if names else axis + 1}" if len(swing) > 1 else ""
            raise SingularFit(
                f"{kind}: has no sample between {low:.4g} and {high:.4g} °C, where the curve{which} would be known "
                f"no better than to {np.max(sigma[:, axis]) / swing[axis]:.2g} times what it swings by in all that "
                "was seen; record the temperatures between, or fit each side on its own"
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


def _bend(grid: Array, predict: Curve, holes: tuple[tuple[float, float], ...], swing: Array) -> Array:
    """Return the second derivative (d,) to reckon with: the curve's own, or that of a parabola with its swing."""
    step = grid[1] - grid[0]
    second = np.diff(predict(grid), n=2, axis=0) / step**2
    inside = np.any([(grid > low) & (grid < high) for low, high in holes] or [np.zeros(len(grid), bool)], axis=0)
    known = ~inside[1:-1]
    bend = np.sqrt(np.mean(second[known] ** 2, axis=0)) if np.any(known) else np.zeros(len(swing))
    return np.asarray(np.maximum(bend, 8 * swing / (grid[-1] - grid[0]) ** 2))


def _axis_modes(
    blocks: Blocks, contrasts: Contrasts, grid: Array, smoother: Smoother, axis: int, smoothed: Array,
    ripple: Ripple | None, known: KnownErrors | None,
) -> tuple[Array, Misfit | None]:  # fmt: skip
    """Return the modes (r, G) of the curve's error, and where a misfit is seen.

    They are of the noise's part, of what is `smoothed` (G,), of the misfit, and of a ripple that is narrower. As few as
    needed are those of the noise alone: beside a deep dip none of them would count, and sigma be nothing elsewhere.
    """
    G, K = len(grid), len(blocks.T)
    both = smoother(blocks, np.concatenate([grid, blocks.fine]), axis)
    taken = np.asarray(blocks.over @ both[G:])
    H, left = both[:G] - (blocks.n / np.sum(blocks.n)) @ taken, np.eye(K) - taken
    noise = contrasts.noise(blocks.y[:, axis], left) if known is None else known.noise(contrasts, blocks, axis)
    shapes = [smoothed] if np.any(smoothed) else []
    misfit, shape = _misfit(blocks, contrasts, noise, left, axis)
    if np.any(shape):
        shapes.append(np.interp(grid, contrasts.knots, shape))
    if ripple is not None:
        shapes += [*ripple_modes(ripple, grid).T]
        misfit = misfit or Misfit(axis=axis, T=ripple.T, left=ripple.rms, noise=ripple.chance)
    return np.vstack([_largest(H @ noise.root), *shapes]), misfit


def _smoothed(cells: Blocks, grid: Array, predict: Curve, smoother: Smoother) -> Array:
    """Return the part (G, d) of a curve that a penalty takes, without its mean, from that of the fitted one.

    The map follows a part h of each shape that a curve f is made of: H f = h f, and takes (1 - h) f. Of the fitted
    curve it would take h (1 - h) f once more, which is seen. Most of that is of shapes for which penalty and samples
    weigh alike, h = 1/2, as at the ends, where a penalty on bends lets the curve go straight on: so it takes twice what
    is seen. Least squares without a penalty follow their own curve and take nothing.

    Source: W. Stuetzle and Y. Mittal, Some comments on the asymptotic behavior of robust smoothers, Lecture Notes in
    Mathematics 757 (1979) 191: twicing.
    """
    at_cells, on_grid = predict(cells.T), predict(grid)
    left = np.stack([on_grid[:, k] - smoother(cells, grid, k) @ values for k, values in enumerate(at_cells.T)], axis=1)
    weight = straight_pieces(grid, cells.T).T @ cells.n
    return np.asarray((left - weight @ left / np.sum(weight)) / HALF)


def _answer(blocks: Blocks, grid: Array, smoother: Smoother, axis: int) -> Array:
    """Return the map's response to the blocks' noise on the grid (G, K); its mean over the fit is not its error."""
    level = (blocks.n / np.sum(blocks.n)) @ blocks.over
    return np.asarray(smoother(blocks, grid, axis) - level @ smoother(blocks, blocks.fine, axis))


def _largest(modes: Array) -> Array:
    """Return the modes (G, m) as few that are orthogonal (r, G)."""
    U, s = _left_vectors(modes)
    keep = s**2 > MIN_VARIANCE * s[0] ** 2 if s[0] > 0 else np.zeros(len(s), dtype=bool)
    return np.asarray((U[:, keep] * s[keep]).T)


def _left_vectors(modes: Array) -> tuple[Array, Array]:
    """Return the left singular vectors (G, r) of modes (G, m) and their singular values, the largest first."""
    if modes.shape[1] <= len(modes):
        U, s, _ = np.linalg.svd(modes, full_matrices=False)
        return U, s
    squares, U = np.linalg.eigh(modes @ modes.T)  # the small ones are left out: squares lose nothing of the others
    return U[:, ::-1], np.sqrt(np.clip(squares[::-1], 0.0, None))


def _misfit(
    blocks: Blocks, contrasts: Contrasts, noise: BlockNoise, left: Array, axis: int
) -> tuple[Misfit | None, Array]:
    """Return the part (p,) of the free curve that the map leaves, where noise alone would hardly leave as much.

    And the place at which the samples are off by it, where they are.

    `left` (K, K) is what the map leaves of the blocks' noise. Only shapes of which it leaves most are looked at: what
    it can follow says nothing of its misfit. Of each shape the share is returned that is no noise: where knots stand
    near one another the free curve is hardly known, and what it shows there is none.
    """
    from scipy.special import chdtri

    knots = contrasts.knots
    nothing = None, np.zeros(len(knots))
    if len(blocks.T) < MIN_BLOCKS or len(knots) < 3:
        return nothing
    weight = contrasts.X.mean(axis=0)
    mean = weight / np.sum(weight)
    curve, operator = noise.curve - mean @ noise.curve, noise.operator - mean @ noise.operator
    expected = _expected_to_be_left(contrasts, noise, operator, left)
    variances, U = np.linalg.eigh(expected)
    whole = np.sum((U.T @ operator @ noise.root) ** 2, axis=1)
    unfollowed = (variances > TAKEN**2 * whole) & (variances > NOTHING * variances[-1])
    shape, variances = (U.T @ curve)[unfollowed], variances[unfollowed]
    chi_square, freedom = float(np.sum(shape**2 / variances)), int(np.sum(unfollowed))
    if freedom == 0 or chi_square < chdtri(freedom, CHANCE):
        return nothing
    return _place(blocks, contrasts.X, curve, expected, axis), np.asarray(
        U[:, unfollowed] @ (shape * _share_of_misfit(shape, variances))
    )


def _place(blocks: Blocks, X: Array, curve: Array, expected: Array, axis: int) -> Misfit | None:
    """Return the block in which the free curve (p,) is surest to be away, by no more than its samples are off.

    None where no samples are: a walk, a lag or a hysteresis move the free curve, too, which follows what goes with the
    temperature within minutes, and the means of all samples at one temperature stay where the map is.
    """
    weight = np.sqrt(blocks.n)
    means = X @ np.linalg.lstsq(X * weight[:, None], blocks.y[:, axis] * weight)[0]
    off = np.maximum(np.minimum(X @ curve * np.sign(means), np.abs(means)), 0.0)
    sigma = np.sqrt(np.clip(np.sum((X @ expected) * X, axis=1), 0.0, None))
    k = int(np.argmax(off - SURE * sigma))
    if off[k] <= SURE * sigma[k]:
        return None
    return Misfit(axis=axis, T=float(blocks.T[k]), left=float(off[k]), noise=float(sigma[k]))


def _share_of_misfit(shape: Array, variances: Array) -> Array:
    """Return the share of each shape (m,) that a misfit has, beside noise and smoothing of the variances (m,).

    A misfit is as large in one shape as in another, of the likeliest variance: v in a finding that is misfit and noise
    has the mean v / (v + variance) of it (C. N. Morris, Parametric empirical Bayes inference, J. Am. Stat. Assoc. 78
    (1983) 47).
    """
    v = np.max(shape**2) * np.logspace(-6, 0, 121)[:, None]
    cost = np.sum(np.log(v + variances) + shape**2 / (v + variances), axis=1)
    likeliest = v[int(np.argmin(cost))]
    return np.asarray(likeliest / (likeliest + variances))


def _expected_to_be_left(contrasts: Contrasts, noise: BlockNoise, operator: Array, left: Array) -> Array:
    """Return the covariance (p, p) of what a map that can follow its curve leaves for the free one, `operator` (p, K).

    A penalty smooths the curve as well as the noise. One that is as strong as the samples ask for says how much a
    curve bends: a map H = K (K + V)^-1 stands for a curve of covariance K beside white noise V, of which it leaves
    (I - H) K (I - H)' = H V (I - H)'. Least squares without a penalty leave nothing of it.

    Source: G. Wahba, Bayesian "confidence intervals" for the cross-validated smoothing spline, J. R. Stat. Soc. B 45
    (1983) 133.
    """
    of_left = operator @ left
    of_noise = of_left @ noise.root
    smoothed = (operator - of_left) * (noise.white * contrasts.white) @ of_left.T
    return np.asarray(of_noise @ of_noise.T + (smoothed + smoothed.T) / 2)
