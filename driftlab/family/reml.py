"""Law of the coefficients of one axis over the units of a family: robust restricted maximum likelihood.

Unit i of n has the information J_i, h_i on its coefficients::

    c_i = mu + b_lot + e_i,   b ~ N(0, Lambda),  e_i ~ N(0, Sigma / w_i)

mu has no prior, so the uncertainty of the mean is part of every expectation, which makes EM's fixed point the
*restricted* likelihood's (Patterson & Thompson 1971; Laird & Ware 1982). In the coordinates z = L^-1 c with Sigma = LL'
no matrix that is inverted has an eigenvalue below w, whatever the condition of J: A = L'JL, M = w + A. Lambda is
diagonal in z: lots differ by so much of each of the family's own shapes. w_i of a wild unit is small, of all others 1.

Weights: as in the deterministic MCD (Hubert, Rousseeuw & Verdonck 2012), the first law is that of the four fifths of
the units that lie nearest under a smooth prior, so that wild units cannot hide behind a spread of their own making.
Then each step of EM weighs the units by their squared distance from their lot's mean, in the law of all others: 1 up to
the limit of the bulk of the units, (cut / distance)^2 beyond, so the contribution of a unit to Sigma is bounded and
falls to nothing. The cut is set by the units themselves - median and median deviation of the cube roots, which Wilson &
Hilferty (1931) make about normal -, since no family's law is Gaussian. Without wild units all weights are 1, and it is
plain REML.

Prior: Sigma ~ inverse Wishart with `weight` degrees of freedom about a smooth covariance Psi of a level, a slope, a
smooth curve and a rougher remainder::

    Psi(T, T') = a0^2 + a1^2 u u' + s^2 exp(-(T-T')^2 / 2 l^2) + r^2 (1 + k) exp(-k),   k = sqrt(3) |T-T'| / (3 step)

Its five numbers are those under which the scatter of the units is likeliest: with n units of scatter S that likelihood
is the matrix-variate t (Gupta & Nagar 2000, section 4.2), up to a constant::

    log p = nu/2 log det(nu Psi) - (nu+n)/2 log det(nu Psi + S),    nu = q + 6

whose maximum over all Psi is S/n. In Sigma it counts as WEIGHT units. The same likelihood, taken over nu too, chooses a
prior that is all but certain for families of up to some 100 units, and maps of left-out units are then up to twice as
far off. q coefficients at the temperatures `peaks`, G lots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from driftlab.family.partitions import tree
from fusion_core.chunk import Array, Integers
from fusion_core.fast import compiled

TOLERANCE = 2e-3  # of the units' deviations in a step: far below their sampling error
MAX_STEPS = 60
CUT = 4.0  # deviations of the bulk: of Gaussian units one in 30,000 is weighted down
NEAREST = 0.8  # of the units, for the first law
MIN_WEIGHT = 1e-4
SMOOTH = 4  # steps in which Sigma is a smooth prior's: with nothing yet to say how, no curve goes on beyond its range
FROZEN = 24  # steps, after which weights stay
HYPER = 4  # steps of EM between two fits of the prior
WEIGHT = 5.0  # of the prior, units


@dataclass(frozen=True, eq=False)
class Means:
    """Mean of the family and of its lots: `mu` (q,) with covariance (q, q), the lots' shifts (G, q) and (G, q, q).

    `of_lot` (G, q, q) is the covariance of mu and the shift together.
    """

    mu: Array
    covariance: Array
    shifts: Array
    shifts_covariance: Array
    of_lot: Array

    def turned(self, L: Array) -> Means:
        """Return the means in the coordinates L z."""
        return Means(
            L @ self.mu, L @ self.covariance @ L.T, self.shifts @ L.T, L @ self.shifts_covariance @ L.T,
            L @ self.of_lot @ L.T,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class VarianceComponents:
    """Sigma (q, q) and Lambda (q, q)."""

    Sigma: Array
    Lambda: Array

    def root(self) -> tuple[Array, Array, Array]:
        """Return L (q, q), its inverse, and the variances (q,) of the lots' shifts in L's coordinates."""
        L, inverse = root_of(self.Sigma)
        return L, inverse, np.maximum(np.diag(inverse @ self.Lambda @ inverse.T), 0.0)


def root_of(Sigma: Array) -> tuple[Array, Array]:
    """Return L (..., q, q) with Sigma = L L', and its inverse."""
    values, vectors = np.linalg.eigh(Sigma)
    size = np.sqrt(np.maximum(values, 1e-14 * values[..., -1:]))[..., None, :]
    return vectors * size, (vectors / size).swapaxes(-1, -2)


def inverse(matrices: Array) -> Array:
    """Inverses of symmetric matrices (..., q, q) without an eigenvalue of zero or less; the lower triangle is read."""
    shape = int(np.prod(matrices.shape[:-2])), *matrices.shape[-2:]
    swept: Array = _swept(np.ascontiguousarray(matrices.reshape(shape)))[0]
    return swept.reshape(matrices.shape)


@compiled
def _swept(matrices: Array) -> tuple[Array, Array]:
    """Return the inverses of matrices (n, q, q), and the pivots (n, q), whose products are the determinants.

    Of small ones LAPACK's take four times as long. Source: J. H. Goodnight, A tutorial on the SWEEP operator, Am. Stat.
    33 (1979) 149.
    """
    inverses, (n, q, _) = matrices.copy(), matrices.shape
    pivots, row = np.empty((n, q)), np.empty(q)
    for i in range(n):
        S = inverses[i]
        for k in range(q):
            pivots[i, k], pivot = S[k, k], 1.0 / S[k, k]
            for m in range(q):
                row[m] = S[k, m] if m < k else S[m, k]
            row[k] = 0.0
            for j in range(q):
                factor = row[j] * pivot
                for m in range(j + 1):
                    S[j, m] -= factor * row[m]
            for m in range(q):
                S[max(k, m), min(k, m)] = row[m] * pivot
            S[k, k] = -pivot
        for j in range(q):
            for m in range(j + 1):
                S[j, m] = S[m, j] = -S[j, m]
    return inverses, pivots


class OfAxes(NamedTuple):
    """Information of the units of a partition, J (n, d, q, q) and h (n, d, q), on the knots of their family."""

    J: Array
    h: Array


@dataclass(frozen=True, eq=False)
class ByLot:
    """Values (G, ...) of lots, of which a partition of units, of the lots `lot` (n,), is sent its own."""

    values: Array
    lot: Integers

    def __getitem__(self, units: slice) -> dict[int, Array]:
        """Return the values of the lots of some units, by lot."""
        return {int(g): self.values[g] for g in np.unique(self.lot[units])}


@dataclass(frozen=True, eq=False)
class EStep:
    """Expectations of the units under a law.

    Attributes
    ----------
    share : (n,) array
        Squared distance of each unit from its lot's mean, had it the weight 1, as a share of what is expected.
    spread : (n, 2) array
        Sum of the variances that the deviation has over units, in the coordinates of L, and of their squares.
    scatter : (q, q) array
        Weighted sum of the expected outer products of the deviations.
    between : (q, q) array
        Mean over lots of those of their shifts.
    """

    share: Array
    spread: Array
    scatter: Array
    between: Array

    @property
    def dof(self) -> Array:
        """Degrees of freedom of the distance of each unit (n,)."""
        total = np.maximum(self.spread[:, 0], 1e-12)
        return np.asarray(total**2 / np.maximum(self.spread[:, 1], 1e-24))


def means_of(information: Array, weighted: Array, lots: Array) -> Means:
    """Return the means in the coordinates z.

    Parameters
    ----------
    information, weighted : (G, q, q) and (G, q) arrays
        Sums over each lot's units of what they say of their mean, and of that times its value.
    lots : (q,) array
        Variances of the shifts.
    """
    q = weighted.shape[1]
    root, one = np.sqrt(lots), np.eye(q)
    cov = root[:, None] * inverse(one + root[:, None] * information * root) * root  # of a shift, mu known
    taken = cov @ information
    own = information - information @ taken
    total = own.sum(axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-12))
    P = scale[:, None] * np.linalg.pinv(scale[:, None] * total * scale, rcond=1e-13, hermitian=True) * scale
    mu = P @ (weighted - np.einsum("gij,gj->gi", information @ cov, weighted)).sum(axis=0)
    shifts = np.einsum("gij,gj->gi", cov, weighted - information @ mu)
    rest = one - taken
    return Means(mu, P, shifts, cov + taken @ P @ taken.transpose(0, 2, 1), cov + rest @ P @ rest.transpose(0, 2, 1))


class UnitsUnderLaw:
    """Units of an axis under a law: in parts of J (n, q, q), h (n, q) and their lots by number (n,).

    Sums are those of a tree over the parts (`driftlab.family.partitions`).
    """

    def __init__(self, law: VarianceComponents, parts: Sequence[tuple[Array, Array, Integers]]) -> None:
        self.law, (self.L, _, self.lots) = law, law.root()
        self.parts = [_PartUnderLaw(self.L, *part) for part in parts]

    def means(self, w: Array) -> Means:
        """Return the means of the units with weights w (n,), at most 1, in the coordinates of L."""
        cuts = np.cumsum([len(part.lot) for part in self.parts])[:-1]
        sums = tree(part.of_lots(own) for part, own in zip(self.parts, np.split(w, cuts), strict=True))
        information, weighted = (np.stack(column) for column in zip(*(sums[g] for g in range(len(sums))), strict=True))
        return means_of(information, weighted, self.lots)


class _PartUnderLaw:
    """Units of a part under a law: A = L'JL (n, q, q) and a = L'h (n, q), and what follows of these and of weights.

    V (n, q, q) is the covariance of z, and K (n, q, q) what z follows of an error of its mean.
    """

    def __init__(self, L: Array, J: Array, h: Array, lot: Integers) -> None:
        self.L, self.J, self.h, self.lot, self.one = L, J, h, lot, np.eye(len(L))
        self.A, self.a = L.T @ (J @ L), h @ L
        V = inverse(self.A + self.one)
        self.alike = V, np.einsum("nij,nj->ni", V, self.a), self.one - V  # V, V a and K of the weight 1

    def of_lots(self, w: Array) -> dict[int, tuple[Array, Array]]:
        """Take weights w (n,); return the information (q, q) on the lots' means, and that times these, by lot."""
        self.w, self.low, (V, Va, K) = w, np.flatnonzero(w < 1), self.alike
        if len(low := self.low):
            V, Va, K = V.copy(), Va.copy(), K.copy()
            V[low] = inverse(self.A[low] + w[low, None, None] * self.one)
            Va[low] = np.einsum("nij,nj->ni", V[low], self.a[low])
            K[low] = self.one - w[low, None, None] * V[low]
        self.V, self.Va, self.K, (n, q) = V, Va, K, Va.shape
        present = np.unique(self.lot)
        of_lot = w * (self.lot == present[:, None])
        sums = zip(present.tolist(), (of_lot @ K.reshape(n, q * q)).reshape(-1, q, q), of_lot @ Va, strict=True)
        return {g: (information, weighted) for g, information, weighted in sums}

    def deviations(self, means: Means, shares: bool) -> tuple[Array, list[tuple[Array, Array]]]:
        """Return the scatter (q, q) of units about the means of their lots.

        And with `shares` the square of each deviation (n,), with the sums of its variances and of their squares (n, 2).
        """
        w, low, K = self.w, self.low, self.K
        centre = means.mu + means.shifts[self.lot]
        z = self.Va - np.einsum("nij,nj->ni", K, centre)
        scatter = (z * w[:, None]).T @ z + np.einsum("n,nij->ij", w, self.V)
        for g in np.unique(self.lot):
            own, q = K[self.lot == g], len(scatter)
            half = (means.of_lot[g] @ own) * w[self.lot == g, None, None]  # K is symmetric
            scatter += half.reshape(-1, q).T @ own.reshape(-1, q)
        if not shares:
            return scatter, []
        if len(low):  # their distance is that of a unit like any other, or none would ever be weighted up again
            _, own, K_own = _PartUnderLaw(self.L, self.J[low], self.h[low], self.lot[low]).alike
            K = K.copy()
            K[low], z[low] = K_own, own - np.einsum("nij,nj->ni", K_own, centre[low])
        spread = np.stack([np.trace(K, axis1=1, axis2=2), np.einsum("nij,nij->n", K, K)], axis=1)
        return scatter, [(np.sum(z**2, axis=1), spread)]


def e_step(under: UnitsUnderLaw, w: Array, *, shares: bool = True) -> EStep:
    """Return the expectations of units with the weights w (n,), at most 1; without `shares` none of each unit.

    The units' sums first make the means of their lots, from which they then deviate.
    """
    L, means = under.L, under.means(w)
    scatter, rows = tree(part.deviations(means, shares) for part in under.parts)
    squares, spread = (np.concatenate(part) for part in zip((w[:0], np.zeros((0, 2))), *rows, strict=True))
    share = squares / np.maximum(spread[:, 0], 1e-12)
    between = np.diag(np.mean(means.shifts**2, axis=0) + np.mean(np.diagonal(means.shifts_covariance, 0, 1, 2), axis=0))
    return EStep(share, spread, L @ scatter @ L.T, L @ between @ L.T)


def m_step(expected: EStep, w: Array, Psi: Array | None, *, lots: bool) -> VarianceComponents:
    """Return the law that maximises the expected likelihood, with the prior of Sigma about Psi where there is one."""
    scatter, count = expected.scatter, float(w.sum())
    if Psi is not None:
        scatter, count = scatter + WEIGHT * Psi, count + WEIGHT
    Sigma = scatter / count
    return VarianceComponents((Sigma + Sigma.T) / 2, expected.between if lots else np.zeros_like(Sigma))


def change(before: VarianceComponents, after: VarianceComponents) -> float:
    """Return the largest change of an entry of Sigma or Lambda, as a share of the deviations of units."""
    size = np.sqrt(np.diag(before.Sigma))
    moved = np.maximum(np.abs(after.Sigma - before.Sigma), np.abs(after.Lambda - before.Lambda))
    return float(np.max(moved / np.outer(size, size)))


@dataclass(frozen=True, eq=False)
class RemlFit:
    """Result of the fit of an axis.

    `w` (n,) are the weights, `limit` the share of the expected distance beyond which they fall, `steps` how many EM
    took and `moved` by how much the law changed in the last.
    """

    law: VarianceComponents
    means: Means
    w: Array
    limit: float
    steps: int
    moved: float


def fit_axis(
    units: Sequence[tuple[Array, Array, Integers]], peaks: Array, start: VarianceComponents | None = None
) -> RemlFit:
    """Return the law of the units of an axis, as `UnitsUnderLaw` has them, at `peaks` (q,) degC.

    EM begins with the law `start`, the last of them, or where that is None with a smooth prior's.
    """
    n, lots = sum(len(lot) for *_, lot in units), max(int(lot.max()) for *_, lot in units) > 0
    w = np.ones(n)
    spread = initial_scale(units)
    prior = np.log([spread, spread, spread, np.ptp(peaks) / 4, 0.3 * spread])  # rough: no curve goes on anywhere
    Psi = smooth(peaks, prior)[0]
    law = start or VarianceComponents(Psi, 0.1 * Psi if lots else np.zeros_like(Psi))
    under = UnitsUnderLaw(law, units)
    if start is not None:
        w, _ = weights(e_step(under, w), w, n + WEIGHT)
    for _ in range(SMOOTH if start is None else 0):
        w = _nearest(e_step(under, np.ones(n)))
        expected = e_step(under, w, shares=False)
        prior = likeliest_prior(peaks, expected.scatter, float(w.sum()), prior)
        law = VarianceComponents(smooth(peaks, prior)[0], expected.between if lots else law.Lambda)
        under = UnitsUnderLaw(law, units)
    moved, steps, settled, limit = np.inf, 0, False, np.inf
    for steps in range(1, MAX_STEPS + 1):
        weighed = HYPER <= steps <= FROZEN
        expected, older_w = e_step(under, w, shares=weighed), w
        if not settled and steps % HYPER == 1:
            older, prior = prior, likeliest_prior(peaks, expected.scatter, float(w.sum()), prior)
            settled = steps > 1 and bool(np.max(np.abs(older - prior)) < 0.1)
        later = m_step(expected, w, smooth(peaks, prior)[0], lots=lots)
        law, moved = later, change(law, later)
        under = UnitsUnderLaw(law, units)
        if weighed:
            w, limit = weights(expected, w, float(w.sum()) + WEIGHT)
        if steps >= HYPER and moved < TOLERANCE and np.max(np.abs(w - older_w)) < 0.05:
            break
    return RemlFit(law, under.means(w).turned(under.L), w, limit, steps, moved)


def weights(expected: EStep, w: Array, total: float) -> tuple[Array, float]:
    """Return weights (n,) and their limit, by distances in the law without the unit itself, of `total` weight."""
    share, dof = expected.share, expected.dof
    own = np.minimum(w * share * expected.spread[:, 0] / total, 0.9)
    share = share * (1 - w / total) / (1 - own)
    roots = np.cbrt(share)
    middle = np.median(roots)
    width = max(1.4826 * float(np.median(np.abs(roots - middle))), float(np.median(np.sqrt(2 / (9 * dof)))))
    limit = float((middle + CUT * width) ** 3)
    return outlier_weights(share, limit), limit


def outlier_weights(share: Array, limit: float | Array) -> Array:
    """Return weights (n,) of distances `share` (n,) under a limit, or one each (n,)."""
    return np.asarray(np.clip((limit / np.maximum(share, 1e-12)) ** 2, MIN_WEIGHT, 1.0))


def initial_scale(units: Sequence[tuple[Array, Array, Integers]]) -> float:
    """Return the scale of the units' spread: median over coefficients of the units' median deviation."""
    own, seen = (np.concatenate(part) for part in zip(*(_alone(J, h) for J, h, _ in units), strict=True))
    own = np.where(seen > 0.01 * np.median(seen), own, np.nan)
    enough = np.sum(np.isfinite(own), axis=0) >= 2
    middle = np.nanmedian(own[:, enough], axis=0)
    spread = 1.4826 * float(np.median(np.nanmedian(np.abs(own[:, enough] - middle), axis=0)))
    return max(spread, float(np.sqrt(1 / np.median(seen[seen > 0]))), float(np.finfo(float).tiny))


def _alone(J: Array, h: Array) -> tuple[Array, Array]:
    """Return the coefficients of units by their own soaks alone, and the information on each (n, q)."""
    q = J.shape[1]
    bend = np.diff(np.eye(q), 2, axis=0) if q > 2 else np.zeros((1, q))
    size = np.trace(J, axis1=1, axis2=2)[:, None, None] / q
    size = np.where(size > 0, size, 1.0)  # a unit that saw nothing of the family's temperatures says nothing
    own = np.linalg.solve(J + 1e-6 * size * (bend.T @ bend + 1e-4 * np.eye(q)), h[..., None])[..., 0]
    return np.asarray(own), np.diagonal(J, axis1=1, axis2=2)


def _nearest(expected: EStep) -> Array:
    """Return 1 for the units nearest to their lot's mean, MIN_WEIGHT for the others; small families keep all."""
    share = expected.share
    return np.where((share <= np.quantile(share, NEAREST)) | (len(share) < 8), 1.0, MIN_WEIGHT)


def smooth(peaks: Array, numbers: Array) -> tuple[Array, Array]:
    """Return Psi (q, q) of the logarithms of a0, a1, s, l [K], r, and its derivatives (5, q, q) by these."""
    parts: Array = _parts_of_prior(peaks, *np.exp(numbers))
    return parts[0], parts[1:]


@compiled
def _parts_of_prior(peaks: Array, a0: float, a1: float, s: float, length: float, r: float) -> Array:
    """Return Psi and its derivatives (6, q, q)."""
    parts = np.empty((6, len(peaks), len(peaks)))
    u = (peaks - peaks.mean()) / max((peaks.max() - peaks.min()) / 2, 1e-9)
    shorter = np.sqrt(3.0) / (3 * max(peaks[1] - peaks[0], 1e-9))
    for i in range(len(peaks)):
        for j in range(i + 1):
            distance, tiny = abs(peaks[i] - peaks[j]), 1e-9 if i == j else 0.0
            k, square = shorter * distance, (distance / length) ** 2
            curve = s**2 * np.exp(-0.5 * square)
            four = a0**2 * (1 + tiny), a1**2 * (u[i] * u[j] + tiny), curve + s**2 * tiny, r**2 * (1 + k) * np.exp(-k)
            psi = four[0] + four[1] + four[2] + four[3]
            for m, part in enumerate((psi, 2 * four[0], 2 * four[1], 2 * four[2], curve * square, 2 * four[3])):
                parts[m, i, j] = parts[m, j, i] = part
    return parts


def likeliest_prior(peaks: Array, scatter: Array, count: float, start: Array) -> Array:
    """Return the numbers of Psi under which a scatter (q, q) of `count` draws is likeliest, sought from `start`."""
    from scipy.optimize import Bounds, minimize

    scale = np.log(np.sqrt(np.trace(scatter) / (len(peaks) * count)))
    low = np.array([scale - 9] * 3 + [np.log(2 * (peaks[1] - peaks[0])), scale - 9])
    high = np.array([scale + 4] * 3 + [np.log(3 * np.ptp(peaks)), scale + 1])

    def cost(numbers: Array) -> tuple[float, Array]:
        """Return - log p of the module's text, a draw, and its derivatives."""
        nu, (Psi, by_numbers) = len(peaks) + 6.0, smooth(peaks, numbers)
        (own, with_units), (inverse, inverse_with) = _log_det(np.stack([nu * Psi, nu * Psi + scatter]))
        slope = nu / 2 * ((nu + count) * inverse_with - nu * inverse)
        value = ((nu + count) * with_units - nu * own) / 2
        return value / count, by_numbers.reshape(5, -1) @ slope.ravel() / count

    begin, bounds = np.clip(start, low + 1e-6, high - 1e-6), Bounds(low, high)
    best: Array = minimize(cost, begin, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 25}).x
    return best


def _log_det(matrices: Array) -> tuple[Array, Array]:
    """Return the logarithms of the determinants (n,) of covariances (n, q, q), and their inverses.

    Raises
    ------
    numpy.linalg.LinAlgError
        If it is none.
    """
    scale = np.sqrt(np.diagonal(matrices, axis1=1, axis2=2))
    both = scale[:, :, None] * scale[:, None]
    inverses, pivots = _swept(matrices / both)
    if not np.all(pivots > 0):
        raise np.linalg.LinAlgError("a covariance has an eigenvalue of zero or less")
    return np.sum(np.log(pivots), axis=1) + 2 * np.sum(np.log(scale), axis=1), inverses / both
