"""r M + I for many ratios r of one symmetric, non-negative M: one reduction to three diagonals, then O(m) a ratio.

::

    M = Q T Q',  T tridiagonal;    r M + I = Q (r T + I) Q'

so inner products of columns under noise of the covariance r M + I are those of Q' B and (r T + I)^-1 Q' B.
m rows, p columns.

Source: G. H. Golub and C. F. Van Loan, Matrix Computations, 4th ed., sec. 4.3.6 and 8.3.1.
"""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array


class ScaledSum:
    """r M + I, M (m, m), for columns; `B` (m, p) are these as Q' B."""

    def __init__(self, M: Array, B: Array) -> None:
        from scipy.linalg import lapack

        if len(M) == 1:  # a further row that adds nothing: LAPACK takes no empty second diagonal
            M, B = np.pad(M, (0, 1)), np.pad(B, ((0, 1), (0, 0)))
        m = len(M)
        reduced, self.d, self.e, tau, _ = lapack.dsytrd(np.asfortranarray(M), lower=1, lwork=64 * m)
        # Q is 1 in the first row and column; its reflectors are those of a QR of what is below the diagonal
        turned = np.array(B, dtype=np.float64, order="F")
        rest = np.asfortranarray(turned[1:])
        reflectors = np.asfortranarray(reduced[1:, :-1])
        turned[1:] = lapack.dormqr("L", "T", reflectors, tau, rest, 64 * rest.shape[1])[0]
        self.B = turned

    def solved(self, ratio: float) -> tuple[Array, float]:
        """Return (r T + I)^-1 Q' B (m, p), and log det (r M + I)."""
        from scipy.linalg import lapack

        d, e, failed = lapack.dpttrf(ratio * self.d + 1.0, ratio * self.e)
        if failed:
            raise np.linalg.LinAlgError("the matrix is not non-negative")
        return lapack.dpttrs(d, e, self.B)[0], float(np.sum(np.log(d)))
