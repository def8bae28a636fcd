"""The contracts of the plugin families, one file each."""

from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect, on_each_axis
from fusion_core.contracts.fitted_map import FittedMap, MapRecord, Outside
from fusion_core.contracts.framing import Counter, Frames, Framing
from fusion_core.contracts.measurement_model import (
    Alignment,
    AlwaysStill,
    Detector,
    MeasurementModel,
    Patience,
    Sensor,
    Site,
    block_of,
)
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.contracts.source import Source
from fusion_core.contracts.thermal_bias import ThermalBias
from fusion_core.contracts.thermal_map import Basis, ThermalMap
from fusion_core.model import Measurement, Prior, State, Transition

__all__ = [
    "Alignment",
    "AlwaysStill",
    "Basis",
    "BiasModel",
    "Counter",
    "Detector",
    "Effect",
    "FittedMap",
    "Frames",
    "Framing",
    "MapRecord",
    "Measurement",
    "MeasurementModel",
    "Memory",
    "Outside",
    "Patience",
    "Plugin",
    "Prior",
    "Sensor",
    "Site",
    "Source",
    "State",
    "ThermalBias",
    "ThermalMap",
    "Transition",
    "block_of",
    "on_each_axis",
]
