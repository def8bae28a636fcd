"""A fitted map, and its record in a file."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import AfterValidator, Field, model_validator

from fusion_core.checks import FLOAT, all_finite
from fusion_core.chunk import Array, extremes
from fusion_core.errors import BadValue, OutsideDomain
from fusion_core.faults import RANGES
from fusion_core.settings import Frozen
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.record_texts import AxisNames, Name, Plain, SiUnit, check_tree
from fusion_core.thermal.thermometer import Steps
from fusion_core.thermal.triad_matrix import MatrixCurve, TriadMatrix

Outside = Literal["refuse", "clamp", "tangent"]

LARGEST = 1e30  # number of a map file; what is beyond it becomes infinite in a curve
COLDEST, HOTTEST, _ = RANGES["temperature"]  # degC

Rms = Annotated[float, Field(ge=0, le=LARGEST)]


class MapRecord(Frozen):
    """The record of a fitted map, which every map file holds."""

    kind: Name
    domain: tuple[float, float]
    """Smallest and largest input of the fit [degC]."""
    channel: Name = "gyro"
    """Channel whose bias it is."""
    unit: SiUnit = "rad/s"
    """Of the bias."""
    axes: AxisNames = ()
    """Their names, where they are known."""
    residual: tuple[Rms, ...] | None
    """Rms of the fit's residual, one value an axis, in `unit`; None: not known."""
    averaged_residual: tuple[Rms, ...] | None = None
    """The same of averages over `averaged_over`, in which white noise hardly counts; None: not known."""
    averaged_over: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Length of those averages [s]."""
    averaged_bounds: tuple[tuple[Rms, Rms], ...] | None = None
    """Between which the rms that another such soak has in the mean must lie, one pair an axis; None: not known.

    Each of the two is kept with 95 %."""
    lasted: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Duration of the samples of the fit [s]; 0: not known."""
    memory: Annotated[Mapping[str, Any], AfterValidator(check_tree)] | None = None
    """Hysteresis and lags in the soak, as `judged.memory` of `fit-map --json`; None: not known."""
    samples: Annotated[int, Field(ge=0)] = 0
    """Rows of the fit; 0: not known, as of a map that was imported."""
    resolution: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Steps of the input while fitting [K]; 0: fine."""
    dither: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    """Noise of the input before it was rounded to them [K]."""
    error: CurveError | None = None
    """Of the curve; None where the kind does not tell."""
    matrix: TriadMatrix | None = None
    """Scale factor and misalignment of a triad over temperature; None where only the bias was fitted."""
    sensitivity: MatrixCurve | None = None
    """g-sensitivity of a triad of gyros over temperature; None where it was not fitted."""
    provenance: Annotated[Mapping[Plain, Plain], Field(max_length=100)] = {}
    """Recording, date, version, settings."""

    @model_validator(mode="after")
    def _axes_are_known(self) -> Self:
        if not self.axes and self.residual is None:
            raise ValueError("neither axes nor residual are given; name the axes of a map whose residual is not known")
        if self.axes and self.residual is not None and len(self.axes) != len(self.residual):
            raise ValueError(f"{len(self.axes)} axes and {len(self.residual)} residuals; give one an axis")
        each = {"averaged_residual": self.averaged_residual, "averaged_bounds": self.averaged_bounds}
        if self.error is not None:
            each["error"] = self.error.bend
        for name, values in each.items():
            if values is not None and len(values) != self.d:
                raise ValueError(f"{name} is of {len(values)} axes, the map of {self.d}; give one value an axis")
        return self

    @model_validator(mode="after")
    def _matrix_is_of_a_triad(self) -> Self:
        if (self.matrix is not None or self.sensitivity is not None) and self.d != 3:
            raise ValueError(f"has scale and misalignment of a triad, and {self.d} axes; a triad has three")
        return self

    @model_validator(mode="after")
    def _domain_is_a_range(self) -> Self:
        low, high = self.domain
        if not (COLDEST <= low < high <= HOTTEST and self.d):
            raise ValueError(
                f"has the domain ({low}, {high}) and {self.d} axes, expected a range within {COLDEST:g} to "
                f"{HOTTEST:g} °C and at least one axis"
            )
        return self

    def model_copy(self, *, update: Mapping[str, Any] | None = None, deep: bool = False) -> Self:
        """Return a copy with other fields, which are checked as those of a file are."""
        copy = super().model_copy(deep=deep)
        return type(self).model_validate({**dict(copy), **update}) if update else copy

    @property
    def steps(self) -> Steps:
        """The steps of the input while fitting, and its noise before them."""
        return Steps(self.resolution, self.dither)

    @property
    def d(self) -> int:
        """Number of axes."""
        return len(self.axes) if self.residual is None else len(self.residual)


@dataclass(frozen=True)
class FittedMap(ABC):
    """A map that has been fitted: a bias of d axes as a function of temperature T (N,) in degC.

    A family overrides the three underscored methods; the checks of the domain are here, once.
    """

    record: MapRecord
    outside: Outside = field(default="refuse", kw_only=True)

    @property
    def domain(self) -> tuple[float, float]:
        """Smallest and largest temperature of the fit, degC."""
        return self.record.domain

    def noting(self, **fields: Any) -> Self:
        """Return the map with other fields in its record."""
        return replace(self, record=self.record.model_copy(update=fields))

    def bias(self, T: Array, t: Array | None = None) -> Array:
        """Bias (N, d) at T (N,) degC, or (1, d) at one T.

        Raises
        ------
        OutsideDomain
            If the map refuses a temperature; it names the time t in s.
        BadValue
            If T is not finite numbers (N,).
        """
        T = self._temperatures(T)
        inside = self._inside(T, t)
        bias = self._bias(inside)
        if self.outside == "tangent" and inside is not T:
            bias = bias + (T - inside)[:, None] * self._slope(inside)
        return bias

    def distortion(self, reading: Array, T: Array, t: Array | None = None, force: Array | None = None) -> Array:
        """Return the part M u + G f (N, d) of readings y = (I + M) u + b + G f (N, d) at T (N,), f the force (N, 3).

        Zero for a map of the bias alone, and without its part of G where the force is not known. Beyond the domain M
        and G are those of its end. Raises as `bias`.
        """
        inside, strain = np.clip(self._temperatures(T), *self.domain), np.zeros_like(reading)
        if self.record.sensitivity is not None and force is not None:
            strain = np.einsum("nij,nj->ni", self.record.sensitivity.at(inside), force)
        if self.record.matrix is None:
            return strain
        return strain + self.record.matrix.distortion(reading - strain - self.bias(T, t), inside)

    def corrected(self, reading: Array, T: Array, t: Array | None = None, force: Array | None = None) -> Array:
        """Return the input u = (I + M)^-1 (y - b - G f) (N, d) that readings y at T (N,) show; as `distortion`."""
        return np.asarray(reading - self.bias(T, t) - self.distortion(reading, T, t, force))

    def slope(self, T: Array, t: Array | None = None) -> Array:
        """Return the analytic derivative of the bias with temperature (N, d); zero where T is clamped."""
        T = self._temperatures(T)
        inside = self._inside(T, t)
        slope = self._slope(inside)
        return np.where((inside == T)[:, None], slope, 0.0) if self.outside == "clamp" else slope

    def sigma(self, T: Array, T_0: float | None = None) -> Array:
        """Return the standard deviation (N, d) of the curve's error at T (N,), or of its change from T_0 to T.

        It is the curve's, not that of one more sample; its mean over the fit is not part of it. It grows beyond the
        domain. A map that does not tell has the rms of its residual, and zero where that is not known either: then its
        error is part of no deviation, and `driftlab check` says so.
        """
        T = self._temperatures(T)
        if self.record.error is None:
            known = np.zeros(self.record.d) if self.record.residual is None else np.asarray(self.record.residual)
            return np.broadcast_to(known, (len(T), self.record.d))
        variance = self.record.error.variance(T, T_0) + self._clamped(T)
        return np.asarray(np.sqrt(variance if T_0 is None else variance + self._clamped(np.array([T_0]))))

    def _clamped(self, T: Array) -> Array:
        """Return the square (N, d) of what clamping leaves out."""
        inside = np.clip(T, *self.domain)
        if self.outside != "clamp" or np.all(inside == T):
            return np.zeros((len(T), self.record.d))
        return np.square((T - inside)[:, None] * self._slope(inside))

    @abstractmethod
    def save(self, path: Path) -> None:
        """Write the map with its record to `path`."""

    @abstractmethod
    def _bias(self, T: Array) -> Array: ...

    @abstractmethod
    def _slope(self, T: Array) -> Array: ...

    def _temperatures(self, T: Array) -> Array:
        """Return T as (N,); raises BadValue where it is not one number or (N,) numbers."""
        if type(T) is np.ndarray and T.dtype == FLOAT and T.ndim == 1 and all_finite(T):
            return T  # nearly always, and quickly
        T = np.atleast_1d(np.ma.filled(T.astype(np.float64), np.nan) if np.ma.is_masked(T) else T)
        if T.ndim != 1 or T.dtype.kind not in "fiu":
            raise BadValue(
                f"{self.record.kind}: is asked at T of {T.dtype} and shape {T.shape}; give numbers (N,) in degC"
            )
        if np.isnan(T.sum(dtype=np.float64)) and np.isnan(T).any():
            k = int(np.argmax(np.isnan(T)))
            raise BadValue(f"{self.record.kind}: is asked at T[{k}], which is NaN or masked; leave it out")
        return T

    def _inside(self, T: Array, t: Array | None = None) -> Array:
        low, high = self.domain
        coldest, hottest = extremes(T) if len(T) else self.domain
        if low <= coldest and hottest <= high:
            return T
        rounding = 1e-9 * max(abs(low), abs(high), 1.0)  # of a mean
        if self.outside == "refuse" and not (low - rounding <= coldest and hottest <= high + rounding):
            k = int(np.argmax((low - rounding > T) | (high + rounding < T)))
            raise OutsideDomain(
                f"{self.record.kind}: T = {T[k]:.6g} °C",
                f" is outside the map's domain ({low:.6g}, {high:.6g}); refit on a wider soak, or set outside: clamp "
                "or tangent",
                None if t is None else float(t[k]),
            )
        return np.clip(T, low, high)
