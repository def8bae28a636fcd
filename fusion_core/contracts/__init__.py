"""The contracts of the plugin families, one file each."""

from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.calibration import Calibrated, Export, Factor, Inflation, Lag
from fusion_core.contracts.effect import Effect, on_each_axis
from fusion_core.contracts.exporter import (
    Deviation,
    Exporter,
    Loss,
    ReadBack,
    SensorLoss,
    beyond_a_map,
    causes,
    warm_up,
)
from fusion_core.contracts.file_source import FileSource, foreign, kinds_of, recognised
from fusion_core.contracts.framing import Counter, Frames, Framing
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.plugin import Family, Memory, Plugin
from fusion_core.contracts.report_section import ReportSection, Section
from fusion_core.contracts.sensor import Alignment, AlwaysStill, Detector, Patience, Sensor, Site, axis_of
from fusion_core.contracts.source import SimulatedSource, Source, Twin
from fusion_core.contracts.table import USUAL, Block, Channel, Table, Usual, head
from fusion_core.contracts.thermal_bias import ThermalBias
from fusion_core.contracts.thermal_map import Basis, NetworkMap, Target, ThermalMap
from fusion_core.model import Measurement, Prior, State, Transition
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.fitted_map import LARGEST, FittedMap, MapRecord, Outside
from fusion_core.thermal.fitting import SLAB, check_samples, check_swing, record_of
from fusion_core.thermal.map_file import (
    MapFile,
    expect_covariance,
    expect_shape,
    parse_map,
    read_bytes,
    read_map,
    write_bytes,
    write_map,
)

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
