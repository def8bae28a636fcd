"""The families of plugins whose contracts are here, with the check of each answer that a plugin of it gives."""

from __future__ import annotations

from collections.abc import Mapping

from fusion_core.chunk import Chunk
from fusion_core.contracts import output_checks as checks
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.exporter import Exporter, ReadBack
from fusion_core.contracts.framing import Counter, Framing
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.output_checks import array, instance, several, with_memory
from fusion_core.contracts.plugin import Check, Family
from fusion_core.contracts.report_section import ReportSection, Section
from fusion_core.contracts.sensor import Detector, Patience, Sensor
from fusion_core.contracts.source import Source
from fusion_core.contracts.stimulus import Equations, Stimulus, TriadInput
from fusion_core.contracts.thermal_map import ThermalMap
from fusion_core.statespace import Block
from fusion_core.thermal.fitted_map import FittedMap, MapRecord

Answers = Mapping[str, Check]

_FITTED = instance("the fitted map", FittedMap, record=instance("the record of the fitted map", MapRecord))

BIAS_MODELS: Answers = {
    "labels": checks.labels,
    **dict.fromkeys(("units", "requires"), checks.names),
    **dict.fromkeys(("prior", "prior_at", "prior_again"), checks.check_prior),
    "transition": with_memory("transition", checks.check_transition),
}
THERMAL_MAPS: Answers = {
    **dict.fromkeys(("fit", "from_curve", "read", "load"), _FITTED),
    "basis": checks.basis,
    "smoother": checks.smoother,
    "variants": several("variants", least=1),
    **dict.fromkeys(("description", "advice"), checks.text),
}
SOURCES: Answers = {
    "chunks": checks.chunks,
    "name": checks.text,
    "about": instance("about", Mapping),
    "of_file": instance("of_file", Source, optional=True),
}
FRAMINGS: Answers = {
    "decode": with_memory("decode", checks.frames),
    "encode": instance("encode", bytes),
    "device_counter": instance("device_counter", Counter, optional=True),
}
EFFECTS: Answers = {
    "labels": checks.labels,
    **dict.fromkeys(("requires", "terms", "units"), checks.names),
    **dict.fromkeys(("explanation", "subject", "variant"), checks.text),
    **dict.fromkeys(("candidates", "proposals"), checks.effects),
    "signature": with_memory("signature", array("signature", "N d p", why="its {p} labels ask for ")),
    "input": with_memory("input", array("the map's input", "N")),
    "fading": with_memory("fading", array("fading", "N", optional=True)),
}
MEASUREMENT_MODELS: Answers = {
    "sensors": checks.sensors,
    "tracked": instance("tracked", Sensor),
    "_tracking": instance("tracking"),
    **{name: instance(name) for name in ("with_tracked", "only")},
    "requires": checks.names,
    "patience": instance("patience", Patience),
    "own": several("own", Block),
    "components": checks.components,
    "prior": checks.check_prior,
    "equations": checks.equations,
    "white": array("white", "n n", "N n n", why="its {n} states ask for ", covariance=True),
    "known": array("known", "d", "N d", why="the {d} axes of its tracked sensor ask for "),
    "length_of_input": checks.length_of_input,
    "still": checks.still,
    "aligned": checks.aligned,
    "detector": instance("detector", Detector),
    "simulated": checks.simulated,
}
EXPORTERS: Answers = {"export": checks.loss, "read": several("what it reads back", ReadBack)}
_TEXTS = dict.fromkeys(("title", "text", "html", "svg"), checks.text)
REPORT_SECTIONS: Answers = {"section": instance("section", Section, optional=True, **_TEXTS)}
STIMULI: Answers = {"inputs": instance("inputs", TriadInput), "simulated": several("simulated", Chunk)}
PARTS: Mapping[type, Answers] = {  # what a plugin makes, which answers for it
    FittedMap: dict.fromkeys(("_bias", "_slope", "sigma"), checks.curve),
    Detector: {"look": checks.look},
    TriadInput: {"equations": instance("equations", Equations), "lacking": checks.text},
}

FAMILIES = (
    Family("bias_models", BiasModel, "how a sensor's bias moves from sample to sample", BIAS_MODELS),
    Family("thermal_maps", ThermalMap, "a bias as a function of temperature", THERMAL_MAPS),
    Family("sources", Source, "where recordings come from", SOURCES),
    Family("framings", Framing, "how samples are cut out of a stream of bytes", FRAMINGS),
    Family("effects", Effect, "what a residual can be traced to", EFFECTS),
    Family(
        "measurement_models",
        MeasurementModel,
        "which sensors the filter is given, and what is measured of them",
        MEASUREMENT_MODELS,
    ),
    Family("exporters", Exporter, "forms in which a fitted map leaves for other programs", EXPORTERS),
    Family("stimuli", Stimulus, "how the input of a triad is known", STIMULI),
    Family("report_sections", ReportSection, "sections of the report of a run", REPORT_SECTIONS),
)
