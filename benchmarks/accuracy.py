"""Both methods against the textbook recursion in 80-bit arithmetic after a million steps."""

from __future__ import annotations

import numpy as np
from common import Row, limit, show, triads

from fusion_core.contracts import Transition
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State


def rows(N: int = 1_000_000) -> list[Row]:
    F, Q, H, R = triads(2, 0.01, d=1)
    P0 = np.diag([0.0, 1e-6])
    rng = np.random.default_rng(0)
    u = rng.normal(size=(N, 2)) * np.sqrt(np.diag(Q))
    z = rng.normal(size=(N, 1)) * 1e-6
    exact = np.longdouble
    f, q, r = exact(F[0, 1]), Q.astype(exact), exact(R[0, 0])
    x, b, (p, c, v) = exact(0), exact(0), (exact(P0[0, 0]), exact(0), exact(P0[1, 1]))
    every, kept = 1000, []
    for k in range(N):
        x, b = x + f * b + exact(u[k, 0]), b + exact(u[k, 1])
        p, c, v = p + 2 * f * c + f * f * v + q[0, 0], c + f * v + q[0, 1], v + q[1, 1]
        s = p + r
        K, L, y = p / s, c / s, exact(z[k, 0]) - x
        x, b = x + K * y, b + L * y
        p, c, v = p - K * p, c - K * c, v - L * c
        if (k + 1) % every == 0:
            kept.append((x, b, p, c, v))
    x, b, p, c, v = (np.array(column) for column in zip(*kept, strict=True))
    sigma = np.sqrt(np.stack([p, v], axis=1))
    found = []
    for method in ("recursive", "steady"):
        ours = estimate(
            State(np.zeros(2), P0),
            Transition(F, Q, u),
            Measurement(z, H, R, np.ones(N, bool)),
            method=method,
            keep_P=True,
        )
        assert ours.P is not None
        dx = np.abs(ours.x[every - 1 :: every] - np.stack([x, b], axis=1)) / sigma
        P = ours.P[every - 1 :: every]
        scale = sigma[:, :, None] * sigma[:, None, :]
        dP = np.abs(P - np.stack([p, c, c, v], axis=1).reshape(-1, 2, 2)) / scale
        found.append(limit(f"{method} method after 1e6 steps, error of x", float(dx.max()), "σ", 1e-7))
        found.append(limit(f"{method} method after 1e6 steps, error of P", float(dP.max()), "of σσ'", 1e-10))
    return found


def main() -> None:
    show("Accuracy", rows())


if __name__ == "__main__":
    main()
