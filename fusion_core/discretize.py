"""From continuous to discrete time: F and Q of a step from the dynamics A and the density Q_c of the noise.

N is the number of steps, n that of states; any array may leave its leading N out.
"""

from __future__ import annotations

import numpy as np

from fusion_core.checks import check_shape, common_lead
from fusion_core.chunk import Array


def van_loan(A: Array, Q_c: Array, dt: Array | float) -> tuple[Array, Array]:
    """Return F and Q of one step of x' = A x + w, where w is white noise of the density Q_c.

    ::

        F = exp(A dt),     Q = int_0^dt exp(A s) Q_c exp(A' s) ds

    Both from one matrix exponential (C. F. Van Loan, IEEE Trans. Automatic Control 23 (1978) 395, eq. 1.2 and 2.2),
    taken of a part of the step that A changes little over, then doubled: F_2h = F_h F_h, Q_2h = F_h Q_h F_h' + Q_h. So
    a step far longer than the time constants of A neither overflows nor cancels.

    Parameters
    ----------
    A : (n, n) or (N, n, n) array
        Continuous dynamics in 1/s.
    Q_c : (n, n) or (N, n, n) array
        Density of the noise; for w = G v with v of the density q it is G q G'.
    dt : float or (N,) array
        Durations in s, not negative.

    Returns
    -------
    F, Q : (n, n) or (N, n, n) arrays
        Without the leading N where A, Q_c and dt have none.

    Raises
    ------
    ValueError
        If a shape is not as above, or a duration is negative or not finite.
    """
    A, Q_c, dt = np.asarray(A, dtype=float), np.asarray(Q_c, dtype=float), np.asarray(dt, dtype=float)
    if A.ndim not in (2, 3):
        raise ValueError(f"van_loan: A has the shape {A.shape}, (n, n) or (N, n, n) was expected; time comes first")
    n = A.shape[-1]
    for name, array in (("A", A), ("Q_c", Q_c)):
        check_shape("van_loan", name, array, (n, n), lead=True)
    check_shape("van_loan", "dt", dt, (), lead=True)
    lead = common_lead("van_loan", {"A": A[..., 0], "Q_c": Q_c[..., 0], "dt": dt[..., None]}, 1)
    if not np.all(np.isfinite(dt)) or np.any(dt < 0):
        raise ValueError("van_loan: dt has a value that is negative or not finite; time stamps must not decrease")
    if A.ndim == Q_c.ndim == 2 and dt.ndim == 1:  # few durations differ, usually
        steps, which = np.unique(dt, return_inverse=True)
        F, Q = _exponential(A, Q_c, steps[:, None, None])
        return F[which], Q[which]
    F, Q = _exponential(A, Q_c, dt[..., None, None])
    return np.broadcast_to(F, (*lead, n, n)), Q


def _exponential(A: Array, Q_c: Array, dt: Array) -> tuple[Array, Array]:
    from scipy.linalg import expm

    n = A.shape[-1]
    size = float(np.max(np.linalg.norm(A, 1, axis=(-2, -1), keepdims=True) * dt, initial=0.0))
    doublings = max(0, int(np.ceil(np.log2(size)))) if size > 1 else 0
    h = dt / 2.0**doublings
    density = float(np.max(np.abs(Q_c), initial=0.0)) or 1.0
    lead = np.broadcast_shapes(A.shape[:-2], Q_c.shape[:-2], h.shape[:-2])
    whole = np.zeros((*lead, 2 * n, 2 * n))
    whole[..., :n, :n], whole[..., n:, n:] = -A * h, np.swapaxes(A, -1, -2) * h
    whole[..., :n, n:] = Q_c / density * h
    found = np.asarray(expm(whole), dtype=np.float64)
    F = np.ascontiguousarray(np.swapaxes(found[..., n:, n:], -1, -2))
    Q = F @ found[..., :n, n:]
    for _ in range(doublings):
        Q = F @ Q @ np.swapaxes(F, -1, -2) + Q
        F = F @ F
    return F, density / 2 * (Q + np.swapaxes(Q, -1, -2))
