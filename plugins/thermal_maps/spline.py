"""Map as a penalised cubic spline (P-spline) of temperature, smoothed as much as the samples say.

::

    b(T) = sum_i c_i B_i(T)
    c = argmin  sum_k (b_k - b(T_k))^2 / var_k  +  lambda sum_i (c_{i-1} - 2 c_i + c_{i+1})^2

B_i are cubic B-splines on equal intervals, b_k the means of narrow temperature bins. lambda is found for each
axis by generalised cross-validation, with the trace counted 1.4 times so that chance is not taken for the
curve. Where the soak has a hole the penalty alone acts, and the curve passes over it smoothly; `sigma` grows
there (`fusion_core.thermal.curve_uncertainty`). n coefficients, m bins, d axes.

Sources: Eilers and Marx, Flexible smoothing with B-splines and penalties, Statistical Science 11 (1996); Kim
and Gu, Smoothing spline Gaussian regression, J. R. Stat. Soc. B 66 (2004), for the 1.4.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, Self

import numpy as np
from pydantic import Field, FiniteFloat, model_validator

from fusion_core import contracts
from fusion_core.chunk import Array
from fusion_core.hookspecs import hookimpl
from fusion_core.thermal.penalised import LAMBDAS, penalised
from fusion_core.thermal.soak_noise import Blocks, Smoother
from fusion_core.units import Quantity, Unit
from fusion_plugins.thermal_maps.common import Bins, bin_samples, record_fit

if TYPE_CHECKING:
    from scipy.interpolate import BSpline
    from scipy.sparse import csr_array

_BINS = 8  # to an interval
_INTERVALS = (4, 300)  # fewest and most


class SplineFile(contracts.MapFile):
    """The JSON file of a spline."""

    coefficients: tuple[tuple[FiniteFloat, ...], ...]  # (n, d), of the B-splines on n - 3 equal intervals [rad/s]
    # (n - 2, d), deviation of the curve at the ends of the intervals, as the bins' scatter has it [rad/s]
    spread: tuple[tuple[Annotated[FiniteFloat, Field(ge=0)], ...], ...]

    @model_validator(mode="after")
    def _same_sizes(self) -> Self:
        n, d = max(len(self.coefficients), 4), self.record.d
        contracts.expect_shape("coefficients", self.coefficients, (n, d))
        contracts.expect_shape("spread", self.spread, (n - 2, d))
        return self


@dataclass(frozen=True, eq=False)
class SplineMap(contracts.FittedMap):
    """A fitted spline: coefficients (n, d), and the curve's deviation (n - 2, d) at the intervals' ends."""

    coefficients: Array
    spread: Array

    def save(self, path: Path) -> None:
        """Write the map as JSON."""
        content = SplineFile(record=self.record, coefficients=self.coefficients.tolist(), spread=self.spread.tolist())
        contracts.write_map(path, content)

    @cached_property
    def _curve(self) -> BSpline:
        return _spline(self.domain, self.coefficients)

    @cached_property
    def _derivative(self) -> BSpline:
        return self._curve.derivative()

    def _bias(self, T: Array) -> Array:
        return np.asarray(self._curve(T))

    def _slope(self, T: Array) -> Array:
        return np.asarray(self._derivative(T))


@dataclass(frozen=True, eq=False)
class _Fits:
    """The fit of each axis: coefficients, spread and operator, as `_smooth` has them."""

    domain: tuple[float, float]
    count: int
    bins: Bins
    axes: list[tuple[Array, Array, Array]]

    def smoother(self, blocks: Blocks, grid: Array, axis: int) -> Array:
        shares = blocks.shares(self.bins.of_sample, len(self.bins.T))
        return np.asarray(_sparse(self.domain, self.count, grid) @ (self.axes[axis][2] @ shares))


@hookimpl
class Spline(contracts.ThermalMap):
    """Map as a penalised cubic spline of temperature."""

    kind: Literal["spline"] = "spline"
    interval: Annotated[float, Unit("delta_degC", positive=True, example="1 K")] = Quantity(1.0, "1 K")
    """Distance of the knots."""
    smoothing: Annotated[float, Field(gt=0, le=1e9)] | None = None
    """Relative smoothing; found from the samples where it is left out."""

    def basis(self, domain: tuple[float, float]) -> contracts.Basis:
        """Return the B-splines, with the penalty on their coefficients' second differences."""
        count = self._count(domain)
        D = np.diff(np.eye(count + 3), n=2, axis=0)
        return contracts.Basis(lambda T: _basis(domain, count, T), D.T @ D)

    def _count(self, domain: tuple[float, float]) -> int:
        return int(np.clip(np.ceil((domain[1] - domain[0]) / self.interval), *_INTERVALS))

    @property
    def description(self) -> str:
        """The spline and the distance of its knots."""
        return f"a spline with knots {self.interval:g} K apart"

    @property
    def advice(self) -> str:
        """A shorter interval, or no smoothing that is set."""
        return f"interval: {self.interval / 2:g} K" if self.smoothing is None else "smoothing out of the config"

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> SplineMap:
        """Fit the spline to the means of narrow temperature bins."""
        T, bias = contracts.check_samples(self.kind, T, bias)
        contracts.check_swing(self.kind, T, self.min_swing, 4, "a cubic spline", "use kind: polynomial with order: 1")
        fits = self._fits(T, bias)
        coefficients, spread = (np.stack([fit[k] for fit in fits.axes], axis=1) for k in (0, 1))
        curve = _spline(fits.domain, coefficients)
        record = record_fit(self.kind, T, bias, provenance, lambda T: np.asarray(curve(T)), fits.smoother)
        return SplineMap(record, coefficients, spread, outside=self.outside)

    def smoother(self, T: Array, bias: Array) -> Smoother:
        """Return the answer of the spline with the smoothing that these samples ask for."""
        return self._fits(T, bias).smoother

    def _fits(self, T: Array, bias: Array) -> _Fits:
        domain = (float(T.min()), float(T.max()))
        count = self._count(domain)
        bins = bin_samples(T, bias, count * _BINS)
        B = _basis(domain, count, bins.T)
        breaks = _basis(domain, count, np.linspace(*domain, count + 1))
        lambdas = LAMBDAS if self.smoothing is None else np.array([self.smoothing])
        axes = zip(bins.bias.T, bins.variance.T, strict=True)
        return _Fits(domain, count, bins, [_smooth(B, y, 1 / variance, lambdas, breaks) for y, variance in axes])

    def from_curve(self, T: Array, bias: Array, record: contracts.MapRecord) -> SplineMap:
        """Return the spline that is nearest to the points."""
        count = self._count(record.domain)
        coefficients = np.asarray(np.linalg.lstsq(_basis(record.domain, count, T), bias, rcond=None)[0])
        record = record.model_copy(update={"kind": self.kind})
        return SplineMap(record, coefficients, np.zeros((count + 1, record.d)), outside=self.outside)

    def _over(self, fitted: contracts.FittedMap, record: contracts.MapRecord) -> SplineMap:
        """Return the same curve with more knots as far apart, straight on beyond the old ones."""
        assert isinstance(fitted, SplineMap), "it was fitted with these settings"
        (low, high), c, spread = fitted.domain, fitted.coefficients, fitted.spread
        step = (high - low) / (len(c) - 3)
        below, above = (int(np.ceil(x / step)) for x in (low - record.domain[0], record.domain[1] - high))
        down, up = np.arange(-below, 0)[:, None], np.arange(1, above + 1)[:, None]
        c = np.vstack([c[0] + down * (c[1] - c[0]), c, c[-1] + up * (c[-1] - c[-2])])
        spread = np.pad(spread, ((below, above), (0, 0)), mode="edge")
        record = record.model_copy(update={"domain": (low - below * step, high + above * step)})
        return SplineMap(record, c, spread, outside=fitted.outside)

    def read(self, path: Path) -> SplineMap:
        """Read the JSON file."""
        content = contracts.read_map(self.kind, path, SplineFile)
        return SplineMap(content.record, np.array(content.coefficients), np.array(content.spread), outside=self.outside)


def _smooth(B: Array, y: Array, w: Array, lambdas: Array, breaks: Array) -> tuple[Array, Array, Array]:
    """Fit one axis: coefficients (n,), the deviation of the curve at `breaks` (n - 2, n), and operator (n, m)."""
    D = np.diff(np.eye(B.shape[1]), n=2, axis=0)
    fit = penalised(B, y, w, D.T @ D, lambdas)
    return fit.coefficients, np.linalg.norm(breaks @ fit.root, axis=1), fit.operator


def _knots(domain: tuple[float, float], count: int) -> Array:
    low, high = domain
    step = (high - low) / count * np.arange(1, 4)
    return np.concatenate([low - step[::-1], np.linspace(low, high, count + 1), high + step])


def _basis(domain: tuple[float, float], count: int, T: Array) -> Array:
    return np.asarray(_sparse(domain, count, T).toarray())


def _sparse(domain: tuple[float, float], count: int, T: Array) -> csr_array:
    return _design(domain, count, np.ascontiguousarray(T).tobytes())


@lru_cache(maxsize=4)
def _design(domain: tuple[float, float], count: int, T: bytes) -> csr_array:
    """Return the B-splines at T: the axes of a fit ask for those of the same grid."""
    from scipy.interpolate import BSpline

    return BSpline.design_matrix(np.clip(np.frombuffer(T), *domain), _knots(domain, count), 3)


def _spline(domain: tuple[float, float], coefficients: Array) -> BSpline:
    from scipy.interpolate import BSpline

    return BSpline(_knots(domain, len(coefficients) - 3), coefficients, 3)
