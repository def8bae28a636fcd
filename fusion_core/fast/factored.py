"""The recursion where P is far wider than R: on factors of P, so that what is measured is not lost in rounding.

Where a state is known 1e6 times worse than it is measured, the fourth digit of its variance after the measurement is
lost in the rounding of P, whatever the form of the update. On P = U D U', U unit upper triangular and D diagonal, both
steps do without differences of large numbers::

    [F U, U_Q] with weights [D, D_Q], made orthogonal row by row from the last                     (predict)
    f = U' h,   alpha_j = r + sum_{i <= j} D_i f_i^2,   D_j <- D_j alpha_{j-1} / alpha_j           (correct, one scalar)

The recursion of `fusion_core.fast.loop` gives such a sample up, and it is done here, in NumPy, until P is narrow again:
a few samples at the start.

Source: G. J. Bierman, Factorization Methods for Discrete Sequential Estimation, Academic Press (1977) ch. V, VI.
"""

from __future__ import annotations

import numpy as np

from fusion_core.checks import NotFinite, TooWide
from fusion_core.chunk import Array
from fusion_core.fast.groups import IndependentGroups
from fusion_core.fast.loop import WIDE, Data, Model, SampleArrays
from fusion_core.model import State

NARROW = WIDE / 100  # of variances over R: below it the plain recursion goes on
WIDEST = 1e26  # beyond it the factors lose digits too
WIDEST_ALONE = 1e200  # of one state
LOST = 1e-12  # of a variance: what the states after it leave of it, where P cannot say it any more
LONGEST = 10_000  # samples


def factors(P: Array) -> tuple[Array, Array, bool]:
    """Return U (n, n) and D (n,) of a covariance, and whether no difference in it was lost in rounding."""
    P, n, sound = P.copy(), len(P), True
    U, D = np.eye(n), np.zeros(n)
    for j in range(n - 1, -1, -1):
        D[j] = max(P[j, j], 0.0)
        if D[j] > 0:
            U[:j, j] = P[:j, j] / D[j]
        before = np.diagonal(P)[:j].copy()
        P[:j, :j] -= np.outer(U[:j, j], U[:j, j]) * D[j]
        left = np.diagonal(P)[:j]
        sound &= not np.any((left != 0) & (left < LOST * before))
    return U, D, sound


def orthogonal(W: Array, weights: Array) -> tuple[Array, Array]:
    """Return U (n, n) and D (n,) of W diag(weights) W', W (n, k), by the modified Gram-Schmidt of Thornton."""
    W, n = W.copy(), len(W)
    U, D = np.eye(n), np.zeros(n)
    for j in range(n - 1, -1, -1):
        weighted = weights * W[j]
        D[j] = weighted @ W[j]
        if D[j] > 0:
            U[:j, j] = W[:j] @ weighted / D[j]
            W[:j] -= U[:j, j, None] * W[j]
    return U, D


def correct(U: Array, D: Array, h: Array, r: float) -> tuple[Array, float]:
    """Update U and D in place with one scalar h x + r; return its gain (n,) and the variance of its innovation."""
    f = U.T @ h
    v, alpha, K = D * f, r, np.zeros(len(D))
    for j in range(len(D)):
        before, alpha = alpha, alpha + f[j] * v[j]
        D[j] *= before / alpha
        old = U[:j, j].copy()
        U[:j, j] -= K[:j] * f[j] / before
        K[:j] += old * v[j]
        K[j] = v[j]
    return K / alpha, alpha


@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def wide(
    state: State, groups: IndependentGroups, model: Model, data: Data, out: SampleArrays, first: int
) -> tuple[State, int]:
    """Run the filter as `recursive` does, until P is narrow; return the state then, and after how many samples.

    Raises
    ------
    NotFinite, TooWide
        With the sample, counted from `first` on.
    """
    x, (U, D, sound) = state.x, factors(state.P)
    if not sound:
        raise TooWide(first)
    for k in range(len(data.z)):
        F, Q, u, H, r = (a[min(k, len(a) - 1)] for a in model)
        U_Q, D_Q, _ = factors(Q)
        x, (U, D) = F @ x + u, orthogonal(np.hstack([F @ U, U_Q]), np.append(D, D_Q))
        widths = H**2 @ (U**2 @ D) / r
        if np.any(widths > (WIDEST if len(x) > 1 else WIDEST_ALONE)):
            raise TooWide(first + k)
        before = x, U.copy(), D.copy()
        x, squares, logs = _measured(x, U, D, H, r, data, out, k, groups)
        dof = int(np.sum(data.used[k]))
        used = dof > 0 and squares <= data.gates[dof]
        if not used:
            x, U, D = before
            if np.any(data.reset):
                x = np.where(data.reset, 0.0, x)
                U, D = orthogonal(np.where(data.reset[:, None], 0.0, U), D)
        P = (U * D) @ U.T
        sigma = np.sqrt(np.diagonal(P))
        if not np.isfinite(np.sum(x) + np.sum(sigma) + squares + logs):
            raise NotFinite(first + k)
        out.x[k], out.sigma[k] = x, sigma
        out.nis[k], out.log_det[k], out.used[k] = squares, logs, used
        if len(out.P):
            out.P[k] = groups.blocks(P, groups.states, groups.states)
        if np.all(widths <= NARROW):
            return State(x, P), k + 1
        if k == LONGEST:
            raise TooWide(first + k)
    return State(x, P), len(data.z)


def _measured(
    x: Array, U: Array, D: Array, H: Array, r: Array, data: Data, out: SampleArrays, k: int, groups: IndependentGroups
) -> tuple[Array, float, float]:  # fmt: skip
    """Correct U and D in place with sample k; return x, the sum of squares of innovations and their log determinant."""
    predicted, squares, logs = x, 0.0, 0.0
    for row in np.flatnonzero(data.used[k]):
        y = data.z[k, row] - H[row] @ x
        K, S = correct(U, D, H[row], r[row])
        x = x + K * y
        out.y[k, row], out.white[k, row] = data.z[k, row] - H[row] @ predicted, y / np.sqrt(S)
        squares, logs = squares + y**2 / S, logs + np.log(S)
        if len(out.K):
            at = groups.rows == row
            out.K[k, at] = np.append(K, 0.0)[groups.states[np.any(at, axis=1)]]
            out.root[k, at] = 1 / np.sqrt(S)
    return x, squares, logs
