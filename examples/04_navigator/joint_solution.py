"""The errors of a whole drive from one least-squares problem: what the filter's last estimate must be.

With e_j the error at the end of segment j, before the feedback x_j moves into the nominal state::

    e_1 ~ N(0, Phi_1 P_0 Phi_1' + Q_1),   e_j = Phi_j (e_{j-1} - x_{j-1}) + w_j,   z_j = H e_j + r_j

all rows divided by their deviations, and solved at once by an orthogonal factorisation.
"""

from __future__ import annotations

import numpy as np
from navigator import Navigator, Nominal
from scipy.linalg import solve_triangular

from fusion_core import Array, Measurement, Transition, feed_back


def joint_solution(navigator: Navigator, start: Nominal) -> tuple[Array, Array, Array, Array]:
    """Return the filter's x and P of the error at the last measurement, and those of the joint solution."""
    recorded: list[tuple[Transition, Measurement]] = []

    def propagate(nominal: Nominal, rows: slice) -> tuple[Nominal, Transition, Measurement]:
        path, *model = navigator.propagate(nominal, rows)
        recorded.append((model[0], model[1]))
        return path, model[0], model[1]

    prior = navigator.space.prior()
    until = int(np.flatnonzero(navigator.used)[-1]) + 1
    parts = list(feed_back(prior, start, navigator.used[:until], propagate, navigator.correct))
    fed = [part.estimates.state.x for part in parts]
    n, J = navigator.space.n, len(parts)
    rows, right = [], []

    def add(root: Array, values: Array, *blocks: tuple[int, Array]) -> None:
        row = np.zeros((len(values), J * n))
        for j, block in blocks:
            row[:, j * n : (j + 1) * n] = solve_triangular(root, block, lower=True)
        rows.append(row)
        right.append(solve_triangular(root, values, lower=True))

    for j, (step, measured) in enumerate(recorded):
        Phi, Q = np.eye(n), np.zeros((n, n))
        for F, Q_k in zip(*np.broadcast_arrays(step.F, step.Q), strict=True):
            Phi, Q = F @ Phi, F @ Q @ F.T + Q_k
        if j == 0:
            add(np.linalg.cholesky(Phi @ prior.P @ Phi.T + Q), np.zeros(n), (0, np.eye(n)))
        else:
            add(np.linalg.cholesky(Q), -Phi @ fed[j - 1], (j, np.eye(n)), (j - 1, -Phi))
        if measured.used[-1]:
            add(np.linalg.cholesky(measured.R), measured.z[-1], (j, measured.H))
    scale = np.tile(np.sqrt(np.diag(prior.P)), J)
    orthogonal, triangle = np.linalg.qr(np.vstack(rows) * scale)
    x = scale * solve_triangular(triangle, orthogonal.T @ np.concatenate(right))
    root = scale[-n:, None] * np.linalg.inv(triangle[-n:, -n:])  # the last states' own corner of the triangle
    last = parts[-1].estimates.state
    return last.x, last.P, x[-n:], root @ root.T
