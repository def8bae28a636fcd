"""The short road: a time-invariant model by its steady gain, with the exact correction for the prior.

P and K of a time-invariant model do not depend on the data. With the steady gain from the first sample on, and the
closed-loop transition A = (I - K H) F, the true estimates follow from the steady ones (partitioned form,
D. G. Lainiotis, IEEE Trans. Automatic Control 16 (1971) 160)::

    x_k = xs_k + A^k M_k theta_k,         P_k = Ps + A^k M_k A^k',      M_k = (I + Pr O_k)^-1 Pr,  Pr = P_0 - Ps
    O_k = sum_j<k A^j' G A^j,             theta_k = sum_j<k A^j' F' H' S^-1 ys_{j+1},     G = F' H' S^-1 H F

where xs and ys are the state and the innovation of the steady filter started from x_0. The correction dies out
with A^k; from there on a step costs a few products.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fusion_core.chunk import Array
from fusion_core.model import Estimates, State

BLOCK = 64  # steps whose corrections are computed together
LIFT = 8  # steps that become one matrix product


@dataclass(frozen=True)
class Steady:
    """The steady state of one time-invariant model: posterior P, predicted P_, gain K, and what follows from them."""

    F: Array
    H: Array
    P: Array
    P_: Array
    K: Array
    S: Array
    A: Array


def steady_state(F: Array, Q: Array, H: Array, R: Array) -> Steady | None:
    """Return the steady filter of a model, or None where there is none (an undriven or unobserved state)."""
    return _steady_state(*((a.tobytes(), a.shape) for a in (F, Q, H, R)))


@lru_cache(maxsize=32)
def _steady_state(*matrices: tuple[bytes, tuple[int, ...]]) -> Steady | None:
    F, Q, H, R = (np.frombuffer(data).reshape(shape) for data, shape in matrices)
    P_ = _riccati(F, Q, H, R)
    if P_ is None:
        return None
    S = H @ P_ @ H.T + R
    K = np.asarray(np.linalg.solve(S, H @ P_).T, dtype=np.float64)
    B = np.eye(len(F)) - K @ H
    P = B @ P_ @ B.T + K @ R @ K.T
    return Steady(F, H, (P + P.T) / 2, P_, K, S, B @ F)


def _riccati(F: Array, Q: Array, H: Array, R: Array) -> Array | None:
    """Return the predicted covariance of the steady state by structured doubling, or None if it does not settle.

    Chu, Fan, Lin, Wang, Int. J. Control 77 (2004) 767: after i iterations, 2^i steps of the filter from P = 0.
    """
    n = len(F)
    A, G, P_ = F.T, H.T @ np.linalg.solve(R, H), Q
    for _ in range(60):
        W = np.linalg.inv(np.eye(n) + G @ P_)
        step = A.T @ P_ @ W @ A
        G = G + A @ W @ G @ A.T
        A = A @ W @ A
        P_ = P_ + (step + step.T) / 2
        G = (G + G.T) / 2
        scale = np.sqrt(np.diag(P_))
        if not np.all(np.isfinite(P_)):
            return None
        if np.all(np.abs(step) <= 1e-15 * np.outer(scale, scale)):
            return P_ if np.max(np.abs(A)) < 1 else None
    return None


def scan(A: Array, c: Array, x: Array) -> Array:
    """Return x_k = A x_{k-1} + c_k for N steps from x (n,): c is (N, n).

    `LIFT` steps at a time become one matrix product, and the ends of the blocks are a scan in turn, so that the
    depth is logarithmic in N and all the work is in matrix-matrix products.
    """
    N, n = c.shape
    if N <= LIFT:
        out = np.empty_like(c)
        for k in range(N):
            x = A @ x + c[k]
            out[k] = x
        return out
    powers = [np.eye(n)]
    for _ in range(LIFT):
        powers.append(A @ powers[-1])
    impulse = np.zeros((LIFT, n, LIFT, n))  # of input j on state i
    for i in range(LIFT):
        for j in range(i + 1):
            impulse[i, :, j, :] = powers[i - j]
    blocks = -(-N // LIFT)
    padded = np.zeros((blocks, LIFT * n))
    padded.reshape(-1)[: N * n] = c.reshape(-1)
    forced = padded @ impulse.reshape(LIFT * n, LIFT * n).T
    ends = scan(powers[LIFT], forced[:, -n:], x)
    starts = np.vstack([x, ends[:-1]])
    free = np.concatenate(powers[1:], axis=0)
    return (forced + starts @ free.T).reshape(-1, n)[:N]


def short_road(steady: Steady, state: State, u: Array, z: Array, *, keep_P: bool = False) -> Estimates:
    """Run the filter over N samples of a time-invariant model: u (N, n), z (N, m)."""
    N = len(z)
    F, H, K = steady.F, steady.H, steady.K
    x = scan(steady.A, u - (u @ H.T - z) @ K.T, state.x)
    y = z - (np.vstack([state.x, x[:-1]]) @ F.T + u) @ H.T
    sigma = np.broadcast_to(np.sqrt(np.diag(steady.P)), x.shape)
    root = np.linalg.cholesky(steady.S)
    white = np.linalg.solve(root, y.T).T
    log_det = np.full(N, 2 * np.sum(np.log(np.diag(root))))
    P = np.broadcast_to(steady.P, (N, *steady.P.shape)) if keep_P else None
    end = State(x[-1], steady.P)

    correction = _corrections(steady, state.P - steady.P, y)
    if len(correction[0]):
        dx, dP = correction
        k = len(dx)
        x[:k] += dx
        P_all = steady.P + dP
        sigma = np.concatenate([np.sqrt(np.diagonal(P_all, axis1=1, axis2=2)), sigma[k:]])
        before = np.concatenate([(state.P - steady.P)[None], dP[:-1]])
        y[:k] -= np.concatenate([np.zeros((1, len(state.x))), dx[:-1]]) @ (H @ F).T
        roots = np.linalg.cholesky(steady.S + (H @ F) @ before @ (H @ F).T)
        white[:k] = np.linalg.solve(roots, y[:k, :, None])[..., 0]
        log_det[:k] = 2 * np.sum(np.log(np.diagonal(roots, axis1=1, axis2=2)), axis=1)
        P = None if P is None else np.concatenate([P_all, P[k:]])
        end = State(x[-1], P_all[-1] if k == N else steady.P)
    nis = np.einsum("ki,ki->k", white, white)
    return Estimates(x, sigma, y, white, nis, log_det, np.ones(N, dtype=bool), end, P)


def _corrections(steady: Steady, Pr: Array, y: Array) -> tuple[Array, Array]:
    """Return what the prior adds to x (k, n) and P (k, n, n), for as many steps as it matters."""
    scale = np.sqrt(np.diag(steady.P))
    scale = np.where(scale > 0, scale, 1.0)
    n, N = len(scale), len(y)
    B = np.linalg.solve(steady.S, steady.H @ steady.F).T
    values, vectors = np.linalg.eigh(Pr / np.outer(scale, scale))
    L = scale[:, None] * vectors * np.sqrt(np.abs(values))  # Pr = L J L', J = diag(signs)
    J = np.diag(np.sign(values))

    powers = np.empty((BLOCK + 1, n, n))
    powers[0] = np.eye(n)
    for k in range(BLOCK):
        powers[k + 1] = steady.A @ powers[k]
    seen = powers[:-1].transpose(0, 2, 1) @ B  # A^j' F' H' S^-1
    O_block = np.cumsum(seen @ steady.S @ seen.transpose(0, 2, 1), axis=0)
    A_k, O_k, theta = np.eye(n), np.zeros((n, n)), np.zeros(n)
    xs, Ps = [np.empty((0, n))], [np.empty((0, n, n))]
    for k in range(0, N, BLOCK):
        rows = min(BLOCK, N - k)
        O_ks = O_k + A_k.T @ O_block[:rows] @ A_k
        thetas = theta + np.cumsum(np.einsum("kij,kj->ki", seen[:rows], y[k : k + rows]), axis=0) @ A_k
        A_ks = powers[1 : rows + 1] @ A_k
        M = L @ np.linalg.solve(np.eye(n) + J @ (L.T @ O_ks @ L), J @ L.T)
        xs.append(np.einsum("kij,kj->ki", A_ks @ M, thetas))
        Ps.append(A_ks @ M @ A_ks.transpose(0, 2, 1))
        if np.all(np.abs(Ps[-1][-1]) < 1e-20 * np.outer(scale, scale)):
            break
        A_k, O_k, theta = A_ks[-1], O_ks[-1], thetas[-1]
    return np.concatenate(xs), np.concatenate(Ps)
