"""The law of an axis though some units are wild: restricted maximum likelihood with weights.

As in the deterministic MCD (Hubert, Rousseeuw & Verdonck 2012), the first law is that of the four fifths of the units
that lie nearest under a smooth prior, so that wild units cannot hide behind a spread of their own making. Then each
step of EM weighs the units by their squared distance from their lot's mean, in the law of all others: 1 up to what the
bulk of the units has, (cut / distance)^2 beyond, so what a unit adds to Sigma is bounded and falls to nothing. The cut
is set by the units themselves - median and median deviation of the cube roots, which Wilson & Hilferty (1931) make
about normal -, since no family's law is Gaussian. Without wild units all weights are 1, and it is plain REML.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from driftlab.family.restricted import Expected, Index, Law, change, expected, stepped
from driftlab.family.smooth_prior import WEIGHT, first_guess, fitted
from fusion_core.chunk import Array

TOLERANCE = 2e-3  # of Sigma's deviations in a step: far below their sampling error
MOST = 60  # steps
CUT = 4.0  # deviations of the bulk: of Gaussian units one in 30,000 is weighted down
KEPT = 0.8  # of the units, for the first law
LEAST = 1e-4  # of a weight
SMOOTH = 4  # steps in which Sigma is a smooth prior's: with nothing yet to say how, no curve goes on beyond its range
FROZEN = 24  # steps, after which weights stay
HYPER = 4  # steps of EM between two fits of the prior


@dataclass(frozen=True, eq=False)
class Fitted:
    """What the fit of an axis ends with.

    `w` (n,) are the weights, `limit` the share of the expected distance beyond which they fall, `steps` how many EM
    took and `moved` by how much Sigma changed in the last.
    """

    law: Law
    found: Expected
    w: Array
    limit: float
    steps: int
    moved: float


def fit_axis(J: Array, h: Array, lot: Index, peaks: Array) -> Fitted:
    """Return the law of units with J (n, q, q) and h (n, q), of the lots numbered `lot` (n,), at `peaks` (q,) degC."""
    q, lots = J.shape[1], int(lot.max()) > 0
    prior = first_guess(peaks, rough_spread(J, h))
    law = Law(prior.mean, 0.1 * prior.mean if lots else np.zeros((q, q)))
    for _ in range(SMOOTH):
        w = _nearest(expected(law, J, h, lot, np.ones(len(J))))
        found = expected(law, J, h, lot, w)
        prior = fitted(peaks, found.scatter, float(w.sum()), prior)
        law = Law(prior.mean, found.between if lots else law.Lambda)
    moved, steps, settled, limit = np.inf, 0, False, np.inf
    for steps in range(1, MOST + 1):
        found, older_w = expected(law, J, h, lot, w), w
        if not settled and steps % HYPER == 1:
            older, prior = prior, fitted(peaks, found.scatter, float(w.sum()), prior)
            settled = steps > 1 and bool(np.max(np.abs(older.numbers - prior.numbers)) < 0.1)
        later = stepped(found, w, prior, lots=lots)
        law, moved = later, change(law, later)
        if HYPER <= steps <= FROZEN:
            w, limit = weights(found, w, float(w.sum()) + WEIGHT)
        if steps >= HYPER and moved < TOLERANCE and np.max(np.abs(w - older_w)) < 0.05:
            break
    return Fitted(law, expected(law, J, h, lot, w), w, limit, steps, moved)


def weights(found: Expected, w: Array, total: float) -> tuple[Array, float]:
    """Return weights (n,) and their limit, by distances in the law without the unit itself, of `total` weight."""
    share, dof = found.distance
    own = np.minimum(w * share * found.spread[:, 0] / total, 0.9)
    share = share * (1 - w / total) / (1 - own)
    roots = np.cbrt(share)
    middle = np.median(roots)
    width = max(1.4826 * float(np.median(np.abs(roots - middle))), float(np.median(np.sqrt(2 / (9 * dof)))))
    limit = float((middle + CUT * width) ** 3)
    return falling(share, limit), limit


def falling(share: Array, limit: float) -> Array:
    """Return weights (n,) of distances `share` (n,) under a limit."""
    return np.asarray(np.clip((limit / np.maximum(share, 1e-12)) ** 2, LEAST, 1.0))


def rough_spread(J: Array, h: Array) -> float:
    """Return about how far units are apart: median over coefficients of the units' median deviation."""
    q = J.shape[1]
    bend = np.diff(np.eye(q), 2, axis=0) if q > 2 else np.zeros((1, q))
    size = np.trace(J, axis1=1, axis2=2)[:, None, None] / q
    own = np.linalg.solve(J + 1e-6 * size * (bend.T @ bend + 1e-4 * np.eye(q)), h[..., None])[..., 0]
    seen = np.diagonal(J, axis1=1, axis2=2)
    own = np.where(seen > 0.01 * np.median(seen), own, np.nan)
    enough = np.sum(np.isfinite(own), axis=0) >= 2
    middle = np.nanmedian(own[:, enough], axis=0)
    spread = 1.4826 * float(np.median(np.nanmedian(np.abs(own[:, enough] - middle), axis=0)))
    return max(spread, float(np.sqrt(1 / np.median(seen[seen > 0]))), float(np.finfo(float).tiny))


def _nearest(found: Expected) -> Array:
    """Return 1 for the units nearest to their lot's mean, LEAST for the others; small families keep all."""
    share = found.distance[0]
    return np.where((share <= np.quantile(share, KEPT)) | (len(share) < 8), 1.0, LEAST)
