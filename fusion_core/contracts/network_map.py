"""The contract of thermal maps that are a network, of which somebody has to say how large it is."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from fusion_core.contracts.thermal_map import ThermalMap

Target = Literal["bias", "slope"]


class NetworkMap(ThermalMap):
    """Settings of a map that is a network of a size that can be chosen by trial."""

    target: Target = "bias"
    """What the network gives: the bias, or its derivative with temperature."""
    neurons: Annotated[int, Field(ge=1, le=20)] = 2
    """Neurons in each of the two hidden layers, an axis."""
