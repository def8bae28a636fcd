"""The contract of thermal maps: a bias as a function of temperature."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Self

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts.fitted_map import FittedMap, Outside
from fusion_core.contracts.plugin import Plugin
from fusion_core.errors import MapError
from fusion_core.settings import ConfigPath
from fusion_core.units import Quantity, Unit


@dataclass(frozen=True)
class Basis:
    """Curves whose combination c is a map: values(T (N,)) -> (N, q), and penalty (q, q) of roughness c' penalty c."""

    values: Callable[[Array], Array]
    penalty: Array


class ThermalMap(Plugin):
    """Settings of a map from temperature to bias: how it is fitted, where it is kept."""

    suffix: ClassVar[str] = ".json"  # of the map's file

    path: ConfigPath | None = None
    """The fitted map's file."""
    outside: Outside = "refuse"
    """Beyond the temperatures of the fit: an error, the value at the end, or straight on."""
    min_swing: Annotated[float, Unit("delta_degC", positive=True, example="2 K")] = Quantity(2.0, "2 K")
    """How far the temperature must move for a fit."""

    def basis(self, domain: tuple[float, float]) -> Basis:
        """Return curves that stand for this kind of map where it is fitted jointly with other effects.

        By default straight lines between knots 1 K apart (at most 150 pieces), as smooth as the samples say; a kind
        that is linear in its coefficients gives its own.
        """
        count = int(np.clip(np.ceil(domain[1] - domain[0]), 4, 150)) + 1
        knots = np.linspace(*domain, count)
        bends = np.diff(np.eye(count), n=2, axis=0)
        return Basis(lambda T: np.stack([np.interp(T, knots, row) for row in np.eye(count)], axis=1), bends.T @ bends)

    def variants(self) -> Iterable[Self]:
        """Return settings like these that are worth a trial where kinds are compared, the simplest first.

        By default these alone.
        """
        return (self,)

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

    def load(self) -> FittedMap:
        """Read the map that the config names."""
        if self.path is None:
            raise MapError(f"{self.kind}: no map file is named; fit one and set path: FILE")
        if not self.path.is_file():
            raise MapError(f"{self.kind}: map file {self.path} does not exist; fit the map first, or name its file")
        return self.read(self.path)
