"""Law of the coefficients of one axis over the units of a family, by restricted maximum likelihood.

Of n units, unit i says J_i, h_i of its coefficients::

    c_i = mu + b_lot + e_i,   b ~ N(0, Lambda),  e_i ~ N(0, Sigma / w_i)

mu has no prior, so the uncertainty of the mean is part of every expectation, which makes EM's fixed point the
*restricted* likelihood's (Patterson & Thompson 1971; Laird & Ware 1982). In the coordinates z = L^-1 c with Sigma = LL'
no matrix that is inverted has an eigenvalue below w, whatever the condition of J: A = L'JL, M = w + A. Lambda is
diagonal in z: lots differ by so much of each of the family's own shapes. w_i of a wild unit is small, of all others 1.
q coefficients, G lots.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from driftlab.family.smooth_prior import WEIGHT, SmoothPrior
from fusion_core.chunk import Array

Index = npt.NDArray[np.intp]


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
        """Return it in the coordinates L z."""
        return Means(
            L @ self.mu, L @ self.covariance @ L.T, self.shifts @ L.T, L @ self.shifts_covariance @ L.T,
            L @ self.of_lot @ L.T,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Law:
    """Sigma (q, q) and Lambda (q, q)."""

    Sigma: Array
    Lambda: Array

    def root(self) -> tuple[Array, Array, Array]:
        """Return L (q, q), its inverse, and the variances (q,) of the lots' shifts in L's coordinates."""
        values, vectors = np.linalg.eigh(self.Sigma)
        size = np.sqrt(np.maximum(values, 1e-14 * values[-1]))
        L, inverse = vectors * size, (vectors / size).T
        return L, inverse, np.maximum(np.diag(inverse @ self.Lambda @ inverse.T), 0.0)


@dataclass(frozen=True, eq=False)
class Expected:
    """What units say under a law.

    Attributes
    ----------
    z : (n, q) array
        Expected deviation of each unit from its lot's mean, in the coordinates of L, had it the weight 1.
    spread : (n, 2) array
        Sum of the variances that z has over units, and of their squares.
    scatter : (q, q) array
        Weighted sum of the expected outer products of the deviations.
    between : (q, q) array
        Mean over lots of those of their shifts.
    means : Means
    L : (q, q) array
    """

    z: Array
    spread: Array
    scatter: Array
    between: Array
    means: Means
    L: Array

    @property
    def distance(self) -> tuple[Array, Array]:
        """Squared distance of each unit from its lot's mean (n,), as a share of what is expected, and its dof (n,)."""
        total = np.maximum(self.spread[:, 0], 1e-12)
        return np.sum(self.z**2, axis=1) / total, total**2 / np.maximum(self.spread[:, 1], 1e-24)


def inside(J: Array, L: Array) -> Array:
    """Return L'JL (n, q, q) of J (n, q, q)."""
    n, q, r = *J.shape[:2], L.shape[1]
    half = (J.reshape(n * q, q) @ L).reshape(n, q, r).transpose(0, 2, 1)
    return np.asarray((np.ascontiguousarray(half).reshape(n * r, q) @ L).reshape(n, r, r))


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
    cov = root[:, None] * np.linalg.inv(one + root[:, None] * information * root) * root  # of a shift, mu known
    taken = cov @ information
    own = information - information @ taken
    total = own.sum(axis=0)
    scale = 1 / np.sqrt(np.maximum(np.diag(total), 1e-12))
    P = scale[:, None] * np.linalg.pinv(scale[:, None] * total * scale, rcond=1e-13, hermitian=True) * scale
    mu = P @ (weighted - np.einsum("gij,gj->gi", information @ cov, weighted)).sum(axis=0)
    shifts = np.einsum("gij,gj->gi", cov, weighted - information @ mu)
    rest = one - taken
    return Means(mu, P, shifts, cov + taken @ P @ taken.transpose(0, 2, 1), cov + rest @ P @ rest.transpose(0, 2, 1))


def expected(law: Law, J: Array, h: Array, lot: Index, w: Array) -> Expected:
    """Return what units with J (n, q, q), h (n, q), of the lots numbered `lot` (n,), say with the weights w (n,)."""
    L, _, lots = law.root()
    G, q, one, weigh = int(lot.max()) + 1, len(L), np.eye(len(L)), w[:, None, None]
    A, a = inside(J, L), h @ L
    V = np.linalg.inv(A + weigh * one)  # covariance of z
    K = one - weigh * V  # V A: what a unit follows of an error of its mean
    own = np.einsum("nij,nj->ni", V, a)
    information, weighted = np.zeros((G, q, q)), np.zeros((G, q))
    np.add.at(information, lot, weigh * K)
    np.add.at(weighted, lot, w[:, None] * own)
    means = means_of(information, weighted, lots)
    centre = means.mu + means.shifts[lot]
    z = own - np.einsum("nij,nj->ni", K, centre)
    scatter = (z * w[:, None]).T @ z + np.einsum("n,nij->ij", w, V)
    for g in range(G):
        half = (K[lot == g] @ means.of_lot[g]) * weigh[lot == g]
        scatter += np.tensordot(half, K[lot == g], axes=((0, 2), (0, 2)))
    low = w < 1  # their distance is that of a unit like any other, or none would ever be weighted up again
    K[low] = one - np.linalg.inv(A[low] + one)
    z[low] = np.einsum("nij,nj->ni", one - K[low], a[low]) - np.einsum("nij,nj->ni", K[low], centre[low])
    spread = np.stack([np.trace(K, axis1=1, axis2=2), np.sum(K * K.transpose(0, 2, 1), axis=(1, 2))], axis=1)
    between = np.diag(np.mean(means.shifts**2, axis=0) + np.mean(np.diagonal(means.shifts_covariance, 0, 1, 2), axis=0))
    return Expected(z, spread, L @ scatter @ L.T, L @ between @ L.T, means.turned(L), L)


def stepped(found: Expected, w: Array, prior: SmoothPrior | None, *, lots: bool) -> Law:
    """Return the law that an EM step leads to."""
    scatter, count = found.scatter, float(w.sum())
    if prior is not None:
        scatter, count = scatter + prior.scatter, count + WEIGHT
    Sigma = scatter / count
    return Law((Sigma + Sigma.T) / 2, found.between if lots else np.zeros_like(Sigma))


def restricted(
    J: Array, h: Array, lot: Index, start: Law, *, prior: SmoothPrior | None = None, tolerance: float = 1e-6,
    most: int = 2000,
) -> tuple[Law, Expected]:  # fmt: skip
    """Return the law of highest restricted likelihood, every unit's weight 1, and what the units say under it.

    Until no entry of Sigma changes in a step by more than `tolerance` of its deviations, or `most` steps.
    """
    law, w, lots = start, np.ones(len(J)), int(lot.max()) > 0
    law = law if lots else replace(law, Lambda=np.zeros_like(law.Sigma))
    for _ in range(most):
        found = expected(law, J, h, lot, w)
        later = stepped(found, w, prior, lots=lots)
        law, moved = later, change(law, later)
        if moved < tolerance:
            break
    return law, expected(law, J, h, lot, w)


def change(before: Law, after: Law) -> float:
    """Return the largest change of an entry of Sigma, as a share of its deviations."""
    size = np.sqrt(np.diag(before.Sigma))
    return float(np.max(np.abs(after.Sigma - before.Sigma) / np.outer(size, size)))
