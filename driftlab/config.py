"""The configuration of the application, as a user writes it.

The limits that a customer sets for a unit, and its serial number, as a config writes them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial, reduce
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from pydantic import (
    BeforeValidator,
    PrivateAttr,
    SerializeAsAny,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    model_validator,
)

from driftlab.storage.in_memory import CopyName, InMemoryName, MemorySource
from fusion_core.contracts import FileSource, MeasurementModel, Sensor, Site, Source, Stimulus, ThermalBias, ThermalMap
from fusion_core.errors import ConfigError, UnitError, quote
from fusion_core.escaping import is_plain
from fusion_core.host.config import Document, override, read_document, validate
from fusion_core.host.registry import Installed, registry
from fusion_core.settings import Settings
from fusion_core.units import LIMITS, Quantity, Unit, bias_unit, problem
from fusion_core.units.grammar import NUMBER


def _default_kind(value: Any) -> Any:
    """Return a filter section with the kind that it has where it does not say one."""
    return {"kind": "zupt", **value} if isinstance(value, dict) else value


def _of_the_tracked_sensor(value: Any, handler: ValidatorFunctionWrapHandler, info: ValidationInfo) -> Any:
    """Read the limits in the unit of the sensor whose bias is tracked; of a gyro where there is no filter."""
    if "filter" not in info.data:  # it is wrong, and that has been reported
        return handler(value)
    model: MeasurementModel | None = info.data["filter"]
    unit, shown = ("rad/s", "deg/h") if model is None else (model.tracked.unit, model.tracked.shown)
    with bias_unit(unit, shown):
        return handler(value)


class Config(Settings):
    """A whole configuration."""

    written_too: ClassVar[frozenset[str]] = frozenset({"extends"})

    _name: str = PrivateAttr("")
    _file: Path | None = PrivateAttr(None)

    serial: Serial | None = None
    """Serial number of the unit, for the pages; a text or a whole number."""
    latitude: Annotated[float, Unit("rad", example="40.9 deg")] | None = None
    """Latitude of the site, for gravity and the Earth rate."""
    heading: Annotated[float, Unit("rad", example="0 deg")] | None = None
    """Heading of the x axis, from north, clockwise."""
    # one made in memory is none of the union
    source: Annotated[Source, Installed(), SerializeAsAny()] | None = None
    """Source that reads the recording."""
    filter: Annotated[Annotated[MeasurementModel, Installed()] | None, BeforeValidator(_default_kind)] = None
    """The filter: its sensors, and how their biases move."""
    stimulus: Annotated[Stimulus, Installed()] | None = None
    """The input of a triad while its scale factor and misalignment are fitted (`fit-map --terms`)."""
    limits: Annotated[Limits | None, WrapValidator(_of_the_tracked_sensor)] = None
    """Upper limits of acceptance; the pages say whether the unit passes."""
    certificate: CertificateTexts | None = None
    """Texts for a certificate that the laboratory knows; what is left out is a line to fill in by hand."""

    @property
    def name(self) -> str:
        """Name of its file; empty where it was made otherwise."""
        return self._name

    @property
    def file(self) -> Path | None:
        """The file that it was read from, if it was."""
        return self._file

    @property
    def recording(self) -> str:
        """Name of its recording; empty where it has none."""
        return "" if self.source is None else self.source.name

    def as_yaml(self) -> str:
        """Return the whole config as it is understood, defaults and packaged product included."""
        import yaml

        return yaml.safe_dump(self.model_dump(mode="json", exclude_none=True), sort_keys=False)

    @model_validator(mode="after")
    def _on_earth(self) -> Self:
        if self.latitude is not None and abs(self.latitude) > np.pi / 2:
            raise problem(f"latitude is {np.rad2deg(self.latitude):.6g} deg; write one from -90 deg to 90 deg")
        if self.heading is not None and self.latitude is None:
            raise problem("heading is given and latitude is not: no Earth rate can be removed; add latitude")
        return self

    @model_validator(mode="after")
    def _in_one_dimension(self) -> Self:
        """Let the filter refuse channels whose units are not those of its sensors."""
        if self.filter is not None and isinstance(self.source, FileSource):
            try:
                self.filter.check_units({name: channel.unit for name, channel in self.source.channels.items()})
            except UnitError as error:
                raise problem(str(error)) from None
        return self

    @property
    def site(self) -> Site:
        """Site of the sensors."""
        return Site(self.latitude, self.heading)

    def maps(self) -> list[ThermalMap]:
        """Return the thermal maps that the config names: those of the tracked sensor, then those of the others."""
        return [*self.tracked_maps(), *self._other_maps()]

    def tracked_maps(self) -> list[ThermalMap]:
        """Return the thermal maps of the tracked sensor: the calibration's, then the bias model's."""
        return [] if self.filter is None else maps_of(self.filter.tracked)

    def _other_maps(self) -> list[ThermalMap]:
        others = () if self.filter is None else (s for s in self.filter.sensors if s is not self.filter.tracked)
        return [item for sensor in others for item in maps_of(sensor)]

    def tracking(self, channel: str | None) -> Self:
        """Return the config that is about another sensor of its filter; its limits, which were not of that, go.

        None: as it is. Raises ConfigError where the filter has no such sensor.
        """
        if channel is None or (self.filter is not None and self.filter.tracked.channel == channel):
            return self
        if self.filter is None:
            raise ConfigError(f"--channel {channel}: the config describes no sensor; add a filter section")
        return self.model_copy(update={"filter": self.filter.tracking(channel), "limits": None})

    def files(self) -> list[Path]:
        """Return the files that the config is read from, and reads: its own, its recording and its maps."""
        return self._files(self.maps())

    def files_to_fit(self) -> list[Path]:
        """Return the files that a fit of the tracked sensor's map reads, a stimulus's tables among them."""
        given: Iterable[Any] = () if self.stimulus is None else vars(self.stimulus).values()
        tables = (path for value in given for path in (value if isinstance(value, tuple) else (value,)))
        return [*self._files(self._other_maps()), *(path for path in tables if isinstance(path, Path))]

    def _files(self, maps: Iterable[ThermalMap]) -> list[Path]:
        recording = self.source.path if isinstance(self.source, FileSource) else None
        items = [self._file, recording, *(settings.path for settings in maps)]
        return [Path(path) for path in items if path is not None]


def maps_of(sensor: Sensor) -> list[ThermalMap]:
    """Return the thermal maps of a sensor: the calibration's, then the bias model's."""
    items = [sensor.calibration, sensor.bias.map if isinstance(sensor.bias, ThermalBias) else None]
    return [item for item in items if item is not None]


def products() -> dict[str, Path]:
    """Return the configs that others extend by name, packaged here or brought by plugins."""
    return registry().products()


def load_config(
    path: Path, recording: str | None = None, settings: Sequence[str] = (), *, measuring: bool = False
) -> Config:
    """Read a config, with the recording of the command line (`PATH` or `PATH::START:STOP`) in place of its own.

    `settings` are keys that are set beside the file, each as `KEY=VALUE` (`fusion_core.host.config`). Where noise is
    what is measured (`measuring`), it need not be there.

    Raises
    ------
    ConfigError
        With one line for each thing that is wrong.
    """
    if str(path) in products() and not path.exists():
        raise ConfigError(f"{path}: is a packaged product, which a config names; write one with extends: {path}")
    config = understood(reduce(override, settings, read_document(path, products())), measuring=measuring)
    config._file = path
    return config if recording is None else with_recording(config, recording)


def understood(document: Document, *, measuring: bool = False) -> Config:
    """Return the config that a document holds; raises ConfigError as `load_config`."""
    if measuring:
        document = reduce(override, _undeclared(document.data), document)
    config = validate(Config, document, registry().broken)
    config._name = document.path.name
    return config


def _at(data: Any, *keys: object) -> Any:
    """Return the value at keys within one another; None where there is none, or no mapping."""
    for key in keys:
        data = data.get(key) if isinstance(data, dict) and isinstance(key, str) else None
    return data


def _undeclared(data: Mapping[str, Any]) -> Iterator[str]:
    """Yield settings of the noise and walk that a config lacks: so large that nothing is taken for motion."""
    model = data.get("filter")
    if not isinstance(model, dict):
        return
    held = model.get("kind", "zupt") != "zupt"
    unit = _at(data, "source", "channels", model.get("channel"), "unit")
    sections = {"": unit if isinstance(unit, str) else "1"} if held else {".gyro": "deg/s", ".accel": "g"}
    for place, unit in sections.items():
        section = model if held else model.get(place[1:])
        if isinstance(section, dict):
            bias = section.get("bias", {"kind": "random_walk"})
            if "noise" not in section:
                yield f"filter{place}.noise=1e6 {unit}/sqrt(Hz)"
            if isinstance(bias, dict) and bias.get("kind") == "random_walk" and "walk" not in bias:
                yield f"filter{place}.bias.kind=random_walk"
                yield f"filter{place}.bias.walk=1 {unit}/sqrt(s)"


def with_recording(config: Config, recording: str) -> Config:
    """Return the config with `PATH` or `PATH::START:STOP` (seconds from the first row), or what is held, as source."""
    if isinstance(recording, InMemoryName):
        if config.filter is not None and isinstance(recording.source, MemorySource):
            recording.source.check_units(config.filter)
        return config.model_copy(update={"source": recording.source})
    source = config.source
    if source is None:
        raise ConfigError("source: is missing; say how the recording is read: its kind and its channels")
    path, span = part_of(recording)
    if source.live:
        from driftlab.storage.recorder import recorded_source

        source = recorded_source(path, source)
    if not isinstance(source, FileSource):
        raise ConfigError(f"source: kind {source.kind} reads no file; name no recording, or use a file source")
    source = source.model_copy(update={"path": path, **span})
    source._title = recording.url if isinstance(recording, CopyName) else ""
    return config.model_copy(update={"source": source})


def paths_of(recordings: Iterable[str]) -> list[Path]:
    """Return the files of recordings, but for those in memory."""
    return [part_of(name)[0] for name in recordings if not isinstance(name, InMemoryName)]


def part_of(recording: str) -> tuple[Path, dict[str, float | None]]:
    """Return the path of `PATH` or `PATH::START:STOP`, and `start` and `stop` (s; None: left out) if they are there."""
    path, _, span = (recording.copy if isinstance(recording, CopyName) else recording).partition("::")
    if not path:
        raise ConfigError(f"recording '{recording}': names no file; write PATH or PATH::START:STOP")
    if not span:
        return Path(path), {}
    start, colon, stop = span.partition(":")
    if not colon:
        raise ConfigError(f"'{recording}': write PATH::START:STOP in seconds; either side may be left out")
    return Path(path), {"start": _seconds(start, recording), "stop": _seconds(stop, recording)}


def _seconds(text: str, recording: str) -> float | None:
    if not text:
        return None
    if not NUMBER.fullmatch(text) or not abs(float(text)) <= LIMITS["s"][1]:
        given = quote(recording, 200)
        raise ConfigError(f"'{given}': '{quote(text)}' is not a number of seconds; write PATH::START:STOP")
    return Quantity(float(text), f"{text} s", "s")


LONGEST = 64  # characters of a serial number
LONGEST_TEXT = 120  # characters of a text on a certificate, which has one sheet


def _line(longest: int, wrong: str, value: Any) -> Any:
    """Return a text in one line; a whole number is one."""
    text = str(value) if isinstance(value, int) and not isinstance(value, bool) else value
    if isinstance(text, str) and not (0 < len(text) <= longest and is_plain(text) and text == text.strip()):
        raise problem(f"'{quote(text)}' {wrong}; write 1 to {longest} characters in one line")
    return text


def _serial(value: Any) -> Any:
    """Return a serial number as text; a number with a point has lost its spelling."""
    if isinstance(value, float):
        raise problem(f"{value!r} is a number, and its digits may not be those on the label; write it in quotes")
    return _line(LONGEST, "is no serial number", value)


Serial = Annotated[str, BeforeValidator(_serial, json_schema_input_type=str | int)]
"""The serial number of a unit, as it is on its label."""

Bias = Annotated[float, Unit("bias", positive=True, example="5 deg/h")]


class Limits(Settings):
    """Upper limits of acceptance for the worst axis of the tracked sensor."""

    bias_instability: Bias | None = None
    """Floor of the Allan deviation, the coefficient B of IEEE Std 952."""
    residual: Bias | None = None
    """Rms of 30 s averages about the thermal map, in the samples of its fit."""
    coast: Bias | None = None
    """Rms error of the bias that is predicted without a measurement, over 10 minutes after an alignment."""
    swing: Bias | None = None
    """Largest less smallest bias of the thermal map over its domain."""
    hysteresis: Bias | None = None
    """Largest difference between warming and cooling at one temperature: a hysteresis, a lag, a relaxation."""
    noise: Annotated[float, Unit("bias/sqrt(Hz)", positive=True, example="4 deg/h/sqrt(Hz)")] | None = None
    """Density of the white noise."""
    scale: Annotated[float, Unit("1", positive=True, example="500 ppm")] | None = None
    """Largest error of the scale factors of a triad over temperature, as found."""
    misalignment: Annotated[float, Unit("rad", positive=True, example="2 mrad")] | None = None
    """Largest misalignment of a triad over temperature, as found."""

    @property
    def declared(self) -> dict[str, float]:
        """Those that are set, by name, in SI."""
        return {name: float(value) for name, value in self if value is not None}


Text = Annotated[
    str, BeforeValidator(partial(_line, LONGEST_TEXT, "does not fit the sheet"), json_schema_input_type=str | int)
]


class CertificateTexts(Settings):
    """Texts that stand on a certificate as they are; of ISO/IEC 17025, 7.8, what a program cannot know."""

    number: Text | None = None
    """Number of the certificate; in a fleet the unit's name follows it."""
    laboratory: Text | None = None
    """Name and address of the laboratory."""
    location: Text | None = None
    """Place of the calibration, where it is another."""
    customer: Text | None = None
    """Name and contact of the customer."""
    item: Text | None = None
    """Manufacturer and type of the unit."""
    condition: Text | None = None
    """Condition of the unit as it was received."""
    received: Text | None = None
    """Date on which it was received."""
    performed: Text | None = None
    """Date of the calibration."""
    procedure: Text | None = None
    """Procedure of the laboratory, and deviations from it."""
    equipment: Text | None = None
    """Chamber, mount and reference thermometer."""
    traceability: Text | None = None
    """Traceability of time base and thermometer to the SI."""
    environment: Text | None = None
    """Humidity, pressure and supply."""
    operator: Text | None = None
    """Name of who calibrated."""
    authorised_by: Text | None = None
    """Name of who answers for the results."""
    temperature_uncertainty: Annotated[float, Unit("K", positive=True, example="0.3 K")] | None = None
    """Expanded uncertainty (k = 2) of the thermometer; without it T is its reading."""
