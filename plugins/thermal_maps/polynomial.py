"""Map as a polynomial of temperature, fitted by least squares.

::

    b(T) = sum_i c_i P_i(x),    x = 2 (T - T_min) / (T_max - T_min) - 1,    i = 0 .. order

P_i is the Chebyshev polynomial, and x runs from -1 to 1 over the fit's domain: so an order of 15 is as well
conditioned as one of 3. The covariance of the coefficients takes the residuals as white; what `sigma` says of the
curve does not (`fusion_core.thermal.curve_uncertainty`). N samples, n = order + 1 coefficients, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from numpy.polynomial import chebyshev
from pydantic import Field, FiniteFloat, model_validator

from fusion_core import contracts
from fusion_core.chunk import Array
from fusion_core.errors import SingularFit
from fusion_core.hookspecs import hookimpl
from fusion_core.thermal.soak_noise import Blocks, Smoother
from fusion_plugins.thermal_maps.common import record_fit

_TRIED = range(1, 8)  # orders that are compared, and that of the settings
_SMALLEST_SINGULAR_VALUE = 1e-8  # relative; below it a coefficient is not determined


class PolynomialFile(contracts.MapFile):
    """The JSON file of a polynomial."""

    coefficients: tuple[tuple[FiniteFloat, ...], ...]  # (n, d), of the Chebyshev polynomials [rad/s]
    covariance: tuple[tuple[tuple[FiniteFloat, ...], ...], ...]  # (d, n, n) [(rad/s)^2]

    @model_validator(mode="after")
    def _same_sizes(self) -> Self:
        n, d = max(len(self.coefficients), 1), self.record.d
        contracts.expect_shape("coefficients", self.coefficients, (n, d))
        contracts.expect_shape("covariance", self.covariance, (d, n, n))
        contracts.expect_covariance("covariance", np.array(self.covariance))
        return self


@dataclass(frozen=True, eq=False)
class PolynomialMap(contracts.FittedMap):
    """A fitted polynomial: Chebyshev coefficients (n, d) and their covariance (d, n, n)."""

    coefficients: Array
    covariance: Array

    def save(self, path: Path) -> None:
        """Write the map as JSON."""
        content = PolynomialFile(
            record=self.record, coefficients=self.coefficients.tolist(), covariance=self.covariance.tolist()
        )
        contracts.write_map(path, content)

    def _bias(self, T: Array) -> Array:
        return _polynomial(T, self.domain, self.coefficients)

    def _slope(self, T: Array) -> Array:
        low, high = self.domain
        derivative = chebyshev.chebder(self.coefficients) * (2 / (high - low))
        return _polynomial(T, self.domain, derivative)


@hookimpl
class Polynomial(contracts.ThermalMap):
    """Map as a polynomial of temperature."""

    kind: Literal["polynomial"] = "polynomial"
    order: Annotated[int, Field(ge=1, le=15)] = 3
    """Order of the polynomial."""

    def basis(self, domain: tuple[float, float]) -> contracts.Basis:
        """Return the Chebyshev polynomials; none is penalised."""
        n = self.order + 1

        def values(T: Array) -> Array:
            return np.asarray(chebyshev.chebvander(_scaled(np.clip(T, *domain), domain), n - 1), dtype=np.float64)

        return contracts.Basis(values, np.zeros((n, n)))

    def variants(self) -> Iterable[Self]:
        """Return those of all orders to 7, and of its own."""
        return tuple(self.model_copy(update={"order": order}) for order in sorted({*_TRIED, self.order}))

    @property
    def description(self) -> str:
        """Return the name of a polynomial of its order."""
        names = {1: "a straight line", 2: "a parabola", 3: "a cubic"}
        return names.get(self.order, f"a polynomial of order {self.order}")

    @property
    def advice(self) -> str:
        """A polynomial of high order bends everywhere where one place asks for it; a spline does not."""
        return "kind: spline"

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> PolynomialMap:
        """Fit the coefficients by least squares, every sample with the same weight."""
        T, bias = contracts.check_samples(self.kind, T, bias)
        contracts.check_swing(self.kind, T, self.min_swing, self.order + 1, self.description, "lower order")
        domain = (float(T.min()), float(T.max()))
        R, z, squares = _triangle(_scaled(T, domain), bias, self.order)
        values = np.linalg.svd(R, compute_uv=False)
        rank = int(np.sum(values > _SMALLEST_SINGULAR_VALUE * values[0]))
        if rank <= self.order:
            raise SingularFit(
                f"{self.kind}: the temperatures determine only {rank} of {self.order + 1} coefficients, "
                f"{self.description} needs all of them; fit it on a soak with more temperatures or lower order"
            )
        inverse = np.linalg.inv(R)
        variance = squares / max(len(T) - self.order - 1, 1)
        coefficients = inverse @ z
        covariance = variance[:, None, None] * (inverse @ inverse.T)

        smoother = self.smoother(T, bias)
        record = record_fit(self.kind, T, bias, provenance, lambda T: _polynomial(T, domain, coefficients), smoother)
        return PolynomialMap(record, coefficients, covariance, outside=self.outside)

    def smoother(self, T: Array, bias: Array) -> Smoother:
        """Return the answer of least squares: it depends on the temperatures alone."""
        domain, order = (float(T.min()), float(T.max())), self.order

        def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
            V, V_grid = (chebyshev.chebvander(_scaled(x, domain), order) for x in (blocks.T, grid))
            root = np.sqrt(blocks.n)
            rounding = len(root) * np.finfo(float).eps
            return np.asarray(V_grid @ (np.linalg.pinv(root[:, None] * V, rcond=rounding) * root))

        return smoother

    def _over(self, fitted: contracts.FittedMap, record: contracts.MapRecord) -> PolynomialMap:
        """Return the same polynomial, scaled to the wider domain."""
        assert isinstance(fitted, PolynomialMap), "it was fitted with these settings"
        x = chebyshev.chebpts1(self.order + 1)
        low, high = record.domain
        there = chebyshev.chebvander(_scaled(low + (x + 1) / 2 * (high - low), fitted.domain), self.order)
        A = np.linalg.solve(chebyshev.chebvander(x, self.order), there)
        return PolynomialMap(record, A @ fitted.coefficients, A @ fitted.covariance @ A.T, outside=fitted.outside)

    def read(self, path: Path) -> PolynomialMap:
        """Read the JSON file."""
        content = contracts.read_map(self.kind, path, PolynomialFile)
        coefficients, covariance = np.array(content.coefficients), np.array(content.covariance)
        return PolynomialMap(content.record, coefficients, covariance, outside=self.outside)


def _scaled(T: Array, domain: tuple[float, float]) -> Array:
    low, high = domain
    return (2 * T - (low + high)) / (high - low)


def _polynomial(T: Array, domain: tuple[float, float], coefficients: Any) -> Array:
    return np.asarray(chebyshev.chebval(_scaled(T, domain), coefficients).T, dtype=np.float64)


def _triangle(x: Array, bias: Array, order: int) -> tuple[Array, Array, Array]:
    """Reduce the least-squares problem V c = bias to a triangular one, a slab of samples at a time.

    Returns
    -------
    R, z : (n, n) and (n, d) arrays
        R c = z has the same solution.
    squares : (d,) array
        Sum of the squared residuals.
    """
    n = order + 1
    triangle: Array = np.empty((0, n + bias.shape[1]))
    for start in range(0, len(x), contracts.SLAB):
        part = slice(start, start + contracts.SLAB)
        rows = np.hstack([chebyshev.chebvander(x[part], order), bias[part]])
        triangle = np.asarray(np.linalg.qr(np.vstack([triangle, rows]), mode="r"))
    return triangle[:n, :n], triangle[:n, n:], np.sum(triangle[n:, n:] ** 2, axis=0)
