"""The families of plugins whose contracts are here."""

from __future__ import annotations

from fusion_core.contracts import output_checks
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.exporter import Exporter
from fusion_core.contracts.framing import Framing
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.plugin import Family
from fusion_core.contracts.report_section import ReportSection
from fusion_core.contracts.source import Source
from fusion_core.contracts.thermal_map import ThermalMap

FAMILIES = (
    Family("bias_models", BiasModel, "how a sensor's bias moves from sample to sample", output_checks.OF_BIAS_MODELS),
    Family("thermal_maps", ThermalMap, "a bias as a function of temperature", output_checks.OF_THERMAL_MAPS),
    Family("sources", Source, "where recordings come from", output_checks.OF_SOURCES),
    Family("framings", Framing, "how samples are cut out of a stream of bytes", output_checks.OF_FRAMINGS),
    Family("effects", Effect, "what a residual can be traced to", output_checks.OF_EFFECTS),
    Family(
        "measurement_models",
        MeasurementModel,
        "which sensors the filter is given, and what is measured of them",
        output_checks.OF_MEASUREMENT_MODELS,
    ),
    Family("exporters", Exporter, "forms in which a fitted map leaves for other programs", output_checks.OF_EXPORTERS),
    Family("report_sections", ReportSection, "sections of the report of a run", output_checks.OF_REPORT_SECTIONS),
)
