"""Rows of a soak with their walk and white noise taken apart: least squares on what is left is generalised.

A bias that walks under white noise is a local level; its filter's normalised innovations are white, and the filter is
linear. So the same filter run on a column of a model gives what that column shows in the innovations, and ordinary
least squares on these is generalised least squares on the rows. R rows, m columns.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from fusion_core.chunk import Array


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def whitened(columns: Array, white: Array, walk: Array) -> Array:
    """Return columns (R, m) as normalised innovations (R, m) of a local level that begins at 0.

    Parameters
    ----------
    columns : (R, m) array
    white : (R,) array
        Variance of the white noise of each row.
    walk : (R,) array
        Variance by which the level walks from the row before to each; of the first, from what is known.
    """
    R, m = columns.shape
    out = np.empty_like(columns)
    x = np.zeros(m)
    P = 0.0
    for k in range(R):
        P += walk[k]
        S = P + white[k]
        gain, root = P / S, 1.0 / np.sqrt(S)
        for j in range(m):
            y = columns[k, j] - x[j]
            out[k, j] = y * root
            x[j] += gain * y
        P *= 1.0 - gain
    return out


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def log_determinant(white: Array, walk: Array) -> float:
    """Return the logarithm of the determinant of the covariance of the rows that `whitened` takes apart."""
    P, total = 0.0, 0.0
    for k in range(len(white)):
        P += walk[k]
        S = P + white[k]
        total += np.log(S)
        P -= P * P / S
    return total
