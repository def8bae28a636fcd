"""The scale in which a quantity of a line is about normal: its logarithm, its root, or as it is.

What is a size (a density, a rms) varies by a share of itself, so its logarithm is tried first and kept unless another
scale is clearly more normal, by the correlation of the ordered values with normal scores (Filliben). n values.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from fusion_core.chunk import Array

Name = Literal["log", "sqrt", "as it is"]


@dataclass(frozen=True)
class Scale:
    """How values are told apart.

    Attributes
    ----------
    name : str
        `log`, `sqrt` or `as it is`.
    """

    name: Name

    def to(self, values: Array) -> Array:
        """Return values in this scale."""
        if self.name == "as it is":
            return np.asarray(values, dtype=np.float64)
        return np.log(values) if self.name == "log" else np.sqrt(np.maximum(values, 0.0))

    def back(self, x: Array) -> Array:
        """Return what `to` was given."""
        if self.name == "as it is":
            return np.asarray(x)
        return np.exp(x) if self.name == "log" else np.maximum(x, 0.0) ** 2

    def sigma(self, values: Array, sigma: Array) -> Array:
        """Return deviations of values in this scale, 0 where they are not known."""
        known = np.where(np.isfinite(sigma), sigma, 0.0)
        if self.name == "as it is":
            return known
        if self.name == "log":
            return np.asarray(known / values)
        return np.asarray(0.5 * known / np.sqrt(np.maximum(np.maximum(values, known), 1e-300)))  # also of 0


def scale_of(values: Array, *, size: bool) -> Scale:
    """Return the scale of values (n,); `size`: they are positive by their nature, though some may show as 0."""
    if not size or np.any(values < 0):
        return Scale("as it is")
    some = [Scale("log")] if np.all(values > 0) else []
    some += [Scale("sqrt"), Scale("as it is")]
    lack = [1 - _straightness(scale.to(values)) for scale in some]
    best = int(np.argmin(lack))
    return some[best] if lack[best] < 0.5 * lack[0] and lack[0] > 0.005 else some[0]


def normality(x: Array) -> float:
    """Return the probability of values (n,) as little normal, if they were; one in a hundred at either end aside."""
    from scipy.stats import shapiro

    core = _core(x)
    if len(core) < 8 or np.ptp(core) == 0:
        return 1.0
    return float(shapiro(core[:: max(len(core) // 2000, 1)]).pvalue)


def _straightness(x: Array) -> float:
    from scipy.special import ndtri

    n, core = len(x), _core(x)
    if np.ptp(core) == 0:
        return 0.0
    cut = (n - len(core)) // 2
    normal = ndtri((np.arange(cut, cut + len(core)) + 0.625) / (n + 0.25))
    return float(np.corrcoef(core, normal)[0, 1])


def _core(x: Array) -> Array:
    """Return the values in order without those beyond five robust deviations: odd units say nothing of the law."""
    ordered = np.sort(x)
    middle = np.median(ordered)
    reach = 5 * 1.4826 * np.median(np.abs(ordered - middle))
    return ordered[np.abs(ordered - middle) <= reach] if reach > 0 else ordered
