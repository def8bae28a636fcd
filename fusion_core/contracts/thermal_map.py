"""The contract of thermal maps: a bias as a function of temperature; of a network the size is chosen by trial, too."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from pydantic import Field, PrivateAttr

from fusion_core.chunk import Array
from fusion_core.contracts.plugin import Plugin
from fusion_core.errors import MapError
from fusion_core.settings import ConfigPath
from fusion_core.thermal.curve_uncertainty import HOLE
from fusion_core.thermal.fitted_map import FittedMap, MapRecord, Outside
from fusion_core.thermal.penalised import Basis, penalised_smoother, smooth_lines
from fusion_core.thermal.soak_noise import Smoother
from fusion_core.units import Quantity, Unit

POINTS = 4000  # of a curve that another map follows


class ThermalMap(Plugin):
    """Settings of a map from temperature to bias: how it is fitted, where it is kept."""

    suffix: ClassVar[str] = ".json"  # of the map's file

    path: ConfigPath | None = None
    """The fitted map's file."""
    outside: Outside = "refuse"
    """Beyond the temperatures of the fit: an error, the value at the end, or straight on."""
    min_swing: Annotated[float, Unit("delta_degC", positive=True, example="2 K")] = Quantity(2.0, "2 K")
    """Least swing of the temperature for a fit."""

    _held: FittedMap | None = PrivateAttr(None)

    # must: what every kind writes

    @abstractmethod
    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> FittedMap:
        """Fit the map to samples T (N,) in degC and bias (N, d) in rad/s.

        Raises
        ------
        SwingTooSmall
            If T does not move enough to determine the map.
        SingularFit
            If the samples cannot determine the coefficients.
        """

    @abstractmethod
    def read(self, path: Path) -> FittedMap:
        """Read a map of this kind from its file; raises MapError."""

    # may: what a kind can do better than the default

    def basis(self, domain: tuple[float, float]) -> Basis:
        """Return curves that stand for this kind of map where it is fitted jointly with other effects.

        By default straight lines between knots 1 K apart (at most 150 pieces), as smooth as the samples say; a kind
        that is linear in its coefficients gives its own.
        """
        return smooth_lines(domain)

    def smoother(self, T: Array, bias: Array) -> Smoother:
        """Return the response of a fit to the noise of samples T (N,) in degC and bias (N, d) in rad/s, to first order.

        By default that of `basis`, as smooth as the samples say. Nothing is fitted by it: with samples that are made up
        it says how sure a map will be (`expected_curve_error`).
        """
        return penalised_smoother(self.basis((float(T.min()), float(T.max()))), T, bias)

    def variants(self) -> Iterable[Self]:
        """Return settings like these that are worth a trial where kinds are compared, the simplest first.

        By default these alone.
        """
        return (self,)

    def from_curve(self, T: Array, bias: Array, record: MapRecord) -> FittedMap:
        """Return a map of this kind along a curve that is known, of which the record is written already.

        By default it is fitted to the curve's points; a kind that goes through points has a shorter way.

        Parameters
        ----------
        T, bias : (N,) and (N, d) arrays
            Points of the curve over the record's domain, rising, some to each bend.
        record : MapRecord
            Of that curve: its domain, its error, where it is from.
        """
        fitted = self.fit(T, bias, {})
        return replace(fitted, record=record.model_copy(update={"kind": self.kind}))

    def _over(self, fitted: FittedMap, record: MapRecord) -> FittedMap:
        """Return a map with another record, whose domain is wider."""
        T = np.linspace(*record.domain, POINTS)
        return self.from_curve(T, replace(fitted, outside="tangent").bias(T), record)

    # text: what reports and advice say of it

    @property
    def description(self) -> str:
        """Its name in a sentence: `a cubic`, `a spline with knots 1 K apart`."""
        return f"kind {self.kind}"

    @property
    def advice(self) -> str:
        """The setting with which its curve bends more, as advice in a sentence; empty where nothing is known."""
        return ""

    # given: the same for every kind

    def with_fitted(self, fitted: FittedMap) -> Self:
        """Return these settings with a map that is in memory: `load` returns it, and no file is read."""
        copy = self.model_copy()
        copy._held = fitted
        return copy

    @property
    def has_map(self) -> bool:
        """True if there is a map to load: in memory, or in a file that is named."""
        return self._held is not None or self.path is not None

    def load(self) -> FittedMap:
        """Return the map that these settings hold, or else read the one that the config names."""
        if self._held is not None:
            return replace(self._held, outside=self.outside)
        if self.path is None:
            raise MapError(f"{self.kind}: no map file is named; fit one and set path: FILE")
        if not self.path.is_file():
            raise MapError(f"{self.kind}: map file {self.path} does not exist; fit the map first, or name its file")
        return self.read(self.path)

    def over(self, fitted: FittedMap, domain: tuple[float, float]) -> FittedMap:
        """Return a map that was fitted with these settings over a wider domain: as it is inside, and on beyond.

        Its error grows there, and what is wide is a range without a sample. By default a map that follows the curve,
        straight on at its ends.

        Parameters
        ----------
        fitted : FittedMap
        domain : pair of float
            Temperatures that were seen, degC: of all of a soak, also where it could not be used.
        """
        low, high = min(domain[0], fitted.domain[0]), max(domain[1], fitted.domain[1])
        if (low, high) == fitted.domain:
            return fitted
        record, error = fitted.record, fitted.record.error
        if error is not None:
            ends = ((low, fitted.domain[0]), (fitted.domain[1], high))
            holes = tuple(end for end in ends if end[1] - end[0] > HOLE * (high - low))
            error = error.model_copy(update={"holes": tuple(sorted((*error.holes, *holes)))})
        return self._over(fitted, record.model_copy(update={"domain": (low, high), "error": error}))


Target = Literal["bias", "slope"]


class NetworkMap(ThermalMap):
    """Settings of a map that is a network of a size that can be chosen by trial."""

    target: Target = "bias"
    """Output of the network: the bias, or its derivative with temperature."""
    neurons: Annotated[int, Field(ge=1, le=20)] = 2
    """Neurons in each of the two hidden layers, an axis."""
