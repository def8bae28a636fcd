"""Evidence that coefficients of many units are about more than noise: c_i ~ N(m, s^2) against (0, 0).

Two tests, of which neither stands on the variances alone that the units' noise models give:

- of the mean m, by the scatter of the c_i between units, whatever makes it (Student's t of a weighted mean with the
  sandwich variance). What the same rows show along placebos, mean over units, must be as noise is, or it counts less.
- of the size of the c_i, whatever their signs: c_i^2 against the placebos of the same unit, an F ratio each, as
  normal scores whose sum is normal: a unit whose noise is not what its model says is measured by its own noise.

n units, K coefficients (columns), J placebos. Sources: R. C. Paule and J. Mandel, J. Res. NBS 87 (1982) 377 (s^2);
P. J. Huber, Proc. 5th Berkeley Symp. 1 (1967) 221 (sandwich); S. A. Stouffer et al., The American Soldier (1949) 45.
"""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array

HALVINGS = 36  # of the interval that holds s^2
FEWEST = 5  # units that say anything of a mean and its scatter
PLACEBOS = 3  # that say anything of a unit's noise


def noise_of(placebos: Array) -> tuple[Array, Array]:
    """Return the mean squares (..., K) of placebos, 1 where there are hardly any, and degrees of freedom of each."""
    count = np.count_nonzero(placebos, axis=-1)
    enough = count >= PLACEBOS
    square = np.sum(placebos**2, axis=-1) / np.maximum(count, 1)
    return np.where(enough, square, 1.0), np.where(enough, count, 0.0)


def variances(information: Array, placebos: Array) -> Array:
    """Return variances (n, K) of coefficients, by the noise that placebos show; infinite where nothing is seen.

    A unit's own mean square counts as much as that of all units.
    """
    seen = information > 0
    own = noise_of(placebos)[0]
    count = np.maximum(seen.sum(axis=0), 1)
    pooled = np.where(seen, own, 0.0).sum(axis=0) / count
    return np.where(seen, (own + pooled) / 2, np.inf) / np.where(seen, information, 1.0)


def between(c: Array, v: Array) -> Array:
    """Return the variance s^2 (K,) between units of c (n, K) with variances v, by Paule and Mandel; at least 0."""
    seen = np.isfinite(v)
    n = seen.sum(axis=0)
    lowest = np.min(v, axis=0, initial=np.inf)
    scale = np.where(np.isfinite(lowest), lowest, 1.0)

    def excess(s2: Array) -> Array:
        w = np.where(seen, 1 / (np.where(seen, v, 1.0) + s2), 0.0)
        m = (w * c).sum(axis=0) / np.maximum(w.sum(axis=0), 1e-300)
        return np.asarray((w * (c - m) ** 2).sum(axis=0) - (n - 1))

    low = np.zeros_like(scale)
    high = np.where(seen, c**2, 0.0).sum(axis=0) + scale
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        more = excess(middle) > 0
        low, high = np.where(more, middle, low), np.where(more, high, middle)
    return np.where(excess(np.zeros_like(scale)) > 0, (low + high) / 2, 0.0)


def mean_of(c: Array, v: Array, s2: Array) -> tuple[Array, Array, Array]:
    """Return means m (K,) of c (n, K), their deviations by the scatter between units, and degrees of freedom."""
    seen = np.isfinite(v)
    w = np.where(seen, 1 / (np.where(seen, v, 1.0) + s2), 0.0)
    w = w / np.maximum(w.sum(axis=0), 1e-300)
    m = (w * c).sum(axis=0)
    count = 1 / np.maximum((w**2).sum(axis=0), 1e-300)
    spread = (w**2 * (c - m) ** 2).sum(axis=0)
    sigma = np.sqrt(spread * count / np.maximum(count - 1, 1e-3))
    return m, sigma, np.maximum(count - 1, 1e-3)


def scores(m: Array, sigma: Array, freedom: Array) -> Array:
    """Return means over their deviations as normal scores (K,): what is as unlikely as Student's t."""
    from scipy.stats import norm, t

    ratio = np.where(sigma > 0, np.abs(m) / np.where(sigma > 0, sigma, 1.0), 0.0)
    p = np.maximum(t.logsf(ratio, freedom), -700.0)
    return np.asarray(np.sign(m) * np.maximum(norm.isf(np.exp(p)), 0.0))


def of_mean(c: Array, v: Array, placebos: Array) -> tuple[Array, Array]:
    """Return normal scores (K,) of the means, and mean squares (K,) of those of the placebos."""
    n, K = c.shape
    seen = np.isfinite(v)
    if n < FEWEST:
        return np.zeros(K), np.ones(K)
    z = np.where(seen.sum(axis=0) >= FEWEST, scores(*mean_of(c, v, between(c, v))), 0.0)
    own = np.sqrt(noise_of(placebos)[0])[:, :, None]
    b = np.where(seen[:, :, None], placebos / own, 0.0)
    total = np.sqrt(np.maximum((b**2).sum(axis=0), 1e-300))
    return z, noise_of(np.where(total > 1e-100, b.sum(axis=0) / total, 0.0))[0]


def of_size(c: Array, information: Array, placebos: Array) -> Array:
    """Return normal scores (K,) of the squares of coefficients against those of the placebos of the same unit."""
    from scipy.stats import f, norm

    noise, freedom = noise_of(placebos)
    seen = (information > 0) & (freedom > 0)
    ratio = np.where(seen, c**2 * information / noise, 0.0)
    p = np.clip(f.cdf(ratio, 1, np.maximum(freedom, 1.0)), 1e-9, 1 - 1e-9)
    z = np.where(seen, norm.ppf(p), 0.0)
    n = seen.sum(axis=0)
    return np.where(n >= FEWEST, z.sum(axis=0) / np.sqrt(np.maximum(n, 1)), 0.0)


def chance_of_means(z: Array, noise: Array) -> float:
    """Return - log of the probability that scores of means (K,) are no more than chance, placebos' squares known."""
    from scipy.stats import chi2

    held = z != 0
    if not np.any(held):
        return 0.0
    return -float(chi2.logsf(np.sum(z[held] ** 2) / max(float(np.mean(noise[held])), 1.0), int(held.sum())))


def chance_of_sizes(z: Array) -> float:
    """Return - log of the probability that scores of sizes (K,) are no more than chance."""
    from scipy.stats import norm

    held = z != 0
    return -float(norm.logsf(np.sum(z[held]) / np.sqrt(held.sum()))) if np.any(held) else 0.0


def gains(c: Array, v: Array, m: Array, s2: Array) -> Array:
    """Return how much likelier each coefficient (n, K) is as a draw from N(m, s^2) than as noise, nats."""
    seen = np.isfinite(v)
    own = np.where(seen, v, 1.0)
    wide = own + s2
    return np.where(seen, 0.5 * (c**2 / own - (c - m) ** 2 / wide - np.log(wide / own)), 0.0)
