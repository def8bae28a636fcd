"""Whether a bias differs between warming and cooling at the same temperature: hysteresis, or a lag.

What a map leaves of K blocks of the soak, each of one way, is taken as::

    y = X(T) beta + Z gamma_0 + s D(T) gamma + walk + white,      s = +1/2 warming, -1/2 cooling

X are straight pieces in T, free to follow any curve, up and down alike; Z is a steady drift with time and a level for
each further recording; D(T) gamma is the difference, of straight pieces between q knots where both ways were. Walk and
white noise are those of `fusion_core.contracts.soak_noise`: a bias that wanders over hours differs between up and down
too, so their variances are found anew with and without the difference, in what X and Z leave (m contrasts u)::

    l_0 = max over k, s of log N(u; 0, k^2 W + s^2 I),     l_1 = the same about D gamma,     L = 2 (l_1 - l_0)

L is chi-square with q degrees of freedom where there are many contrasts; here its mean under chance is found by
drawing DRAWS soaks without a difference, and L is scaled by it (Bartlett's correction): the largest mean of all ratios
k/s that are within REACH of the likeliest, since a walk that hardly shows is the easiest to take for a difference.
A difference is said to be seen where chance gives as much less than once in 1 / CHANCE soaks, all axes together. Its
size is found without the drift: on an even way up and down, one part of it is that of a drift.

Sources: H. D. Patterson and R. Thompson, Biometrika 58 (1971) 545; M. S. Bartlett, Properties of sufficiency and
statistical tests, Proc. R. Soc. A 160 (1937) 268.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from driftlab.maps.soak import WAYS, Soak
from fusion_core.chunk import Array
from fusion_core.contracts.soak_noise import FEWEST, RATIOS, Blocks, Contrasts, blocks_of, straight_pieces
from fusion_core.scaled_sum import ScaledSum

CHANCE = 1e-3  # probability, over all axes, that a soak without a difference shows one
KNOTS = 4  # of the difference
DRAWS = 100
REACH = 6.0  # of - 2 log likelihood: 98.6 %
WORTH = 0.05  # chance as chi-square has it, above which no closer look is worth it
UNSEEN = 1e-3  # of the largest: what is left of a shape beside the free curve and a drift, that says nothing
SPLINE = 40  # knots of a curve that is taken off first
SHARED = 0.2  # of the range of temperature, that both ways must have seen
_PER_WAY = 6  # blocks, at least
SHAPES = np.concatenate([[0.0], RATIOS])  # of the walk's variance to that of the white noise


@dataclass(frozen=True, eq=False)
class Difference:
    """Bias of an axis while warming less that while cooling.

    Attributes
    ----------
    T : (G,) array
        Temperatures that both ways have seen, degC.
    value, sigma : (G,) arrays
        The difference and its standard deviation.
    chance : float
        Probability that noise shows as much, all axes together.
    """

    T: Array
    value: Array
    sigma: Array
    chance: float

    @property
    def seen(self) -> bool:
        """Whether it is more than chance."""
        return self.chance < CHANCE

    @property
    def peak(self) -> int:
        """Where on T it is largest, two standard deviations taken off."""
        return int(np.argmax(np.abs(self.value) - 2 * self.sigma))

    @property
    def rms(self) -> float:
        """Its rms over T, less what its own uncertainty adds to that."""
        return float(np.sqrt(np.maximum(np.mean(self.value**2 - self.sigma**2), 0.0)))


def differences(soak: Soak, residual: Array) -> tuple[Difference, ...] | str:
    """Return the difference of each axis, or why none could be seen.

    Parameters
    ----------
    soak : Soak
        The samples.
    residual : (S, d) array
        What the map leaves of its slots.
    """
    warms, cools = (bool(np.any(soak.way == way)) for way in WAYS.values())
    if not (warms and cools):
        if not (warms or cools):
            return "no way"
        return "warms" if warms else "cools"
    shared = _shared(soak)
    if shared is None:
        return "apart"
    ways = _ways(soak, residual - _common(soak, residual))
    if min(np.sum(ways.way == w) for w in WAYS.values()) < _PER_WAY or len(ways.way) < FEWEST + KNOTS:
        return "short"
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    with threadpool_limits(1):
        free = Contrasts(ways.blocks)
        chances = _Contrasts(ways, free, shared, drift=True).chances()
        contrasts = _Contrasts(ways, free, shared, drift=False)
        sizes, divided = contrasts.sizes(), contrasts.divided
    together = 1 - (1 - np.array(chances)) ** len(chances)
    if divided and not np.any(together < CHANCE):
        return "levels"
    return tuple(Difference(*size, float(chance)) for size, chance in zip(sizes, together, strict=True))


def _shared(soak: Soak) -> tuple[float, float] | None:
    """Return the range of temperature that both ways have seen; None where it is too little."""
    both = (soak.cells(1)[0] > 0) & (soak.cells(-1)[0] > 0)
    if np.mean(both) < SHARED:
        return None
    k, edges = np.flatnonzero(both), soak.edges
    return float(edges[k[0]]), float(edges[k[-1] + 1])


def _common(soak: Soak, residual: Array) -> Array:
    """Return a cubic spline (S, d) through what the map leaves, up and down alike.

    What bends is not straight between the knots of X, and would be taken for noise. Of a difference it has nothing.
    """
    from scipy.interpolate import BSpline

    inner = np.unique(np.quantile(soak.T, np.linspace(0, 1, SPLINE)))
    if len(inner) < 2:
        return np.zeros_like(residual)
    knots = np.concatenate([[inner[0]] * 3, inner, [inner[-1]] * 3])
    basis = BSpline.design_matrix(soak.T, knots, 3).tocsr()
    inverse = np.linalg.pinv((basis.T @ basis).toarray(), hermitian=True, rcond=1e-10)
    return np.asarray(basis @ (inverse @ (basis.T @ residual)))


@dataclass(frozen=True, eq=False)
class _Ways:
    """Blocks of slots of one way, one recording and about one temperature: way, recording and middle (K,) of each."""

    blocks: Blocks
    way: Array
    recording: Array
    t: Array


def _ways(soak: Soak, residual: Array) -> _Ways:
    # slots have as many samples as one another, and stand for samples here
    keep = soak.way != 0
    way, recording = soak.way[keep], soak.recording[keep]
    blocks = blocks_of(soak.T[keep], residual[keep], recording * 2 + (way > 0))
    first = np.unique(blocks.of_sample, return_index=True)[1]
    t = np.bincount(blocks.of_sample, soak.t[keep]) / blocks.n
    return _Ways(blocks, way[first].astype(np.float64), recording[first], t)


class _Contrasts:
    """The contrasts u (m, d) of K blocks, turned so that walk and white noise are independent in each.

    With `drift`, of what no steady drift can make either.
    """

    def __init__(self, ways: _Ways, contrasts: Contrasts, shared: tuple[float, float], *, drift: bool) -> None:
        from scipy.linalg import solve_triangular

        blocks = ways.blocks
        levels = ways.recording[:, None] == np.unique(ways.recording)[1:]
        X = np.column_stack([contrasts.X, levels, *([ways.t / ways.t.max()] if drift else [])])
        Z = np.linalg.qr(X, mode="complete")[0][:, np.linalg.matrix_rank(X) :]
        root = np.linalg.cholesky((Z.T * contrasts.white) @ Z)
        L = solve_triangular(root, Z.T, lower=True, check_finite=False)
        self.walk = L @ contrasts.covariance @ L.T  # (m, m), beside white noise of variance 1
        self.knots = np.linspace(*shared, KNOTS)
        pieces = straight_pieces(self.knots, blocks.T)
        self.D = L @ (pieces * (ways.way[:, None] / 2))
        self.scale = np.sqrt(np.mean(blocks.y**2, axis=0))
        self.u = L @ (blocks.y / np.where(self.scale > 0, self.scale, 1.0))

    @cached_property
    def divided(self) -> bool:
        """Whether some difference is what levels of recordings are: where each recording or placement goes one way."""
        sizes = np.linalg.svd(self.D, compute_uv=False)
        return bool(sizes[-1] < UNSEEN * sizes[0])

    def chances(self) -> list[float]:
        """Return how probable so much is by chance, of each axis."""
        from scipy.special import chdtrc

        U, size, _ = np.linalg.svd(self.D, full_matrices=False)
        D = U[:, size > UNSEEN * size[0]]  # on an even way up and down a drift and a difference may look alike
        q = D.shape[1]
        without, with_it = self._costs(D, self.u)
        chances = []
        for axis, L in enumerate((without.min(axis=0) - with_it.min(axis=0)).tolist()):
            plain = float(chdtrc(q, L))
            if plain < WORTH:
                likely = np.flatnonzero(without[:, axis] < without[:, axis].min() + REACH)
                normal = np.random.default_rng(axis).normal(size=(2, len(self.u), DRAWS))
                walks = self._walk_root @ normal[0]
                means = [
                    self._mean(D, np.sqrt(SHAPES[k]) * walks + normal[1]) for k in likely[:: max(1, len(likely) // 6)]
                ]
                plain = float(chdtrc(q, L * q / max(*means, q)))
            chances.append(plain)
        return chances

    @cached_property
    def _walk_root(self) -> Array:
        tiny = 1e-12 * np.trace(self.walk) / len(self.walk)
        return np.asarray(np.linalg.cholesky(self.walk + tiny * np.eye(len(self.walk))))

    def _mean(self, D: Array, u: Array) -> float:
        """Return the mean of L over the columns of u (m, B)."""
        without, with_it = self._costs(D, u)
        return float(np.mean(without.min(axis=0) - with_it.min(axis=0)))

    def _costs(self, D: Array, u: Array) -> tuple[Array, Array]:
        """Return - 2 log likelihood of each shape of the noise without and with a difference (R, B), for u (m, B)."""
        without, with_it = [], []
        q, tiny = D.shape[1], np.finfo(float).tiny
        sums = ScaledSum(self.walk, np.column_stack([D, u]))
        for ratio in SHAPES:
            solved, logs = sums.solved(ratio)
            cross = sums.B[:, :q].T @ solved
            squares = np.sum(sums.B[:, q:] * solved[:, q:], axis=0)
            taken = np.sum(cross[:, q:] * np.linalg.solve(cross[:, :q], cross[:, q:]), axis=0)
            without.append(len(u) * np.log(np.maximum(squares, tiny)) + logs)
            with_it.append(len(u) * np.log(np.maximum(squares - taken, tiny)) + logs)
        return np.array(without), np.array(with_it)

    def sizes(self) -> list[tuple[Array, Array, Array]]:
        """Return where, the difference and its deviation (G,), of each axis: by generalised least squares.

        Over all shapes of the noise, each as much as it is likely: where a walk is hardly seen, the likeliest alone
        would be too sure.
        """
        m, d = self.u.shape
        cost, gammas, roots = np.empty((len(SHAPES), d)), [], []
        sums = ScaledSum(self.walk, np.column_stack([self.D, self.u]))
        for k, ratio in enumerate(SHAPES):
            solved, logs = sums.solved(ratio)
            cross = sums.B[:, :KNOTS].T @ solved
            own, V = np.linalg.eigh(cross[:, :KNOTS])
            seen = own > UNSEEN**2 * own[-1]  # what is one with the levels of recordings is left at zero
            root = np.where(seen, V / np.sqrt(np.where(seen, own, 1.0)), 0.0)  # root root' = (D' S^-1 D)^-1
            taken = root.T @ cross[:, KNOTS:]
            squares = np.sum(sums.B[:, KNOTS:] * solved[:, KNOTS:], axis=0) - np.sum(taken**2, axis=0)
            squares = np.maximum(squares, np.finfo(float).tiny)
            cost[k] = (m - KNOTS) * np.log(squares) + logs + np.sum(np.log(own[seen]))
            gammas.append(root @ taken)
            roots.append(root[:, :, None] * np.sqrt(squares / (m - KNOTS)))
        T = np.linspace(self.knots[0], self.knots[-1], 61)
        pieces = straight_pieces(self.knots, T)
        values = np.einsum("Gp,Rpd->RGd", pieces, np.array(gammas))
        spread = np.sum(np.einsum("Gp,Rpqd->RGqd", pieces, np.array(roots)) ** 2, axis=2)
        share = np.exp(-(cost - cost.min(axis=0)) / 2) * np.concatenate([RATIOS[:1], RATIOS])[:, None] ** 0.5
        share /= np.sum(share, axis=0)  # even in the walk's deviation
        value = np.einsum("Rd,RGd->Gd", share, values)
        sigma = np.sqrt(np.einsum("Rd,RGd->Gd", share, spread + (values - value) ** 2))
        return [(T, v * scale, s * scale) for v, s, scale in zip(value.T, sigma.T, self.scale, strict=True)]
