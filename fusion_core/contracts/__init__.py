"""The contracts of the plugin families, one file each."""

from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.calibrated import Calibrated, Export
from fusion_core.contracts.channel import USUAL, Channel, Usual
from fusion_core.contracts.curve_error import CurveError
from fusion_core.contracts.effect import Effect, on_each_axis
from fusion_core.contracts.exporter import Exporter, ReadBack
from fusion_core.contracts.family import Family
from fusion_core.contracts.file_source import FileSource
from fusion_core.contracts.fitted_map import LARGEST, FittedMap, MapRecord, Outside
from fusion_core.contracts.foreign import foreign, kinds_of, recognised
from fusion_core.contracts.framing import Counter, Frames, Framing
from fusion_core.contracts.inflation import Factor, Inflation, Lag
from fusion_core.contracts.loss import Deviation, Loss, SensorLoss, beyond_a_map, causes, warm_up
from fusion_core.contracts.map_file import (
    MapFile,
    expect_covariance,
    expect_shape,
    parse_map,
    read_bytes,
    read_map,
    write_bytes,
    write_map,
)
from fusion_core.contracts.map_fit import SLAB, check_samples, check_swing, record_of
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.network_map import NetworkMap, Target
from fusion_core.contracts.plugin import Memory, Plugin
from fusion_core.contracts.report_section import ReportSection, Section
from fusion_core.contracts.rest import Alignment, AlwaysStill, Detector, Patience
from fusion_core.contracts.sensor import Sensor, Site, axis_of
from fusion_core.contracts.simulated_source import SimulatedSource, Twin
from fusion_core.contracts.source import Source
from fusion_core.contracts.table import Block, Table, head
from fusion_core.contracts.thermal_bias import ThermalBias
from fusion_core.contracts.thermal_map import Basis, ThermalMap
from fusion_core.model import Measurement, Prior, State, Transition

__all__ = [
    "LARGEST",
    "SLAB",
    "USUAL",
    "Alignment",
    "AlwaysStill",
    "Basis",
    "BiasModel",
    "Block",
    "Calibrated",
    "Channel",
    "Counter",
    "CurveError",
    "Detector",
    "Deviation",
    "Effect",
    "Export",
    "Exporter",
    "Factor",
    "Family",
    "FileSource",
    "FittedMap",
    "Frames",
    "Framing",
    "Inflation",
    "Lag",
    "Loss",
    "MapFile",
    "MapRecord",
    "Measurement",
    "MeasurementModel",
    "Memory",
    "NetworkMap",
    "Outside",
    "Patience",
    "Plugin",
    "Prior",
    "ReadBack",
    "ReportSection",
    "Section",
    "Sensor",
    "SensorLoss",
    "SimulatedSource",
    "Site",
    "Source",
    "State",
    "Table",
    "Target",
    "ThermalBias",
    "ThermalMap",
    "Transition",
    "Twin",
    "Usual",
    "axis_of",
    "beyond_a_map",
    "causes",
    "check_samples",
    "check_swing",
    "expect_covariance",
    "expect_shape",
    "foreign",
    "head",
    "kinds_of",
    "on_each_axis",
    "parse_map",
    "read_bytes",
    "read_map",
    "recognised",
    "record_of",
    "warm_up",
    "write_bytes",
    "write_map",
]
