"""All sensors of a vehicle in one command: `driftlab vehicle`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.commands.console import say, say_lines
from driftlab.commands.export import calibrated, exporter_of
from driftlab.commands.fit_map import FitMapResult, fit_map
from driftlab.commands.inputs import Place, Progress
from driftlab.commands.vehicle_log import PLATFORMS, LogSensor, config_and_data, product_of, sensors_of
from driftlab.config import paths_of
from driftlab.reports import vehicle as report
from driftlab.reports.provenance import map_facts, sheet_of
from driftlab.storage.folders import output_folder
from driftlab.storage.json import plain, write_json
from driftlab.storage.map_file import save
from fusion_core.contracts import Calibrated, Export, Exporter, Loss
from fusion_core.errors import ConfigError, DataError, MapError, MissingChannel

COMMAND = "vehicle"  # by which its files are known
PAGE = "report.html"
OF_A_SENSOR = (
    "device_id", "accel_device_id", "mag_device_id", "baro_device_id", "instance", "calibration", "imu",
)  # fmt: skip
"""Settings of exporters that the logs say."""
SHARE = 0.5  # of the swing of a barometer or magnetometer that may be between up and down


@dataclass(frozen=True)
class VehicleSensor(LogSensor):
    """A sensor of a vehicle with its map.

    Attributes
    ----------
    result : FitMapResult or None
        Its map; None where none could be fitted.
    problem : str
        The reason for that.
    left_out : str
        The reason why its map is not among the parameters; empty where it is.
    """

    result: FitMapResult | None = None
    problem: str = ""
    left_out: str = ""

    @property
    def file(self) -> str:
        """Name of its map's file."""
        return f"{self.channel}{self.number}.map.json"

    @property
    def title(self) -> str:
        """Its name with its device."""
        return f"{self.name}, device id {self.device}" if self.device else self.name

    @property
    def sentences(self) -> list[str]:
        """The verdict on its map, a sentence each, or the reason why it has none."""
        sentences = self.result.verdict.sentences(self.result.unit) if self.result else [f"no map: {self.problem}"]
        return [*sentences, *([f"not among the parameters: {self.left_out}"] if self.left_out else [])]

    def lines(self) -> list[str]:
        """Return its sentences, each with its name."""
        return [f"{self.title}: {sentence}" for sentence in self.sentences]

    def drifts(self) -> str:
        """Return in words that its input may have drifted, and not its bias; empty where the soak excludes that.

        The air pressure and the field about a vehicle drift. What drifts differs between up and down; what follows
        the temperature does not.
        """
        if not self.held or self.result is None:
            return ""
        memory = self.result.verdict.memory
        between = memory.size if memory.answer == "seen" else memory.none_larger_than
        swing = np.ptp(self.result.map.bias(self.result.verdict.T), axis=0)
        if np.linalg.norm(between) <= SHARE * np.linalg.norm(swing):
            return ""
        return (
            "air pressure and field drift by themselves, and this soak does not tell that from temperature; warm and "
            "cool the vehicle several times"
        )


@dataclass(frozen=True)
class VehicleResult:
    """The maps of all sensors of a vehicle, and what its firmware loses of them.

    Attributes
    ----------
    product : str
        The packaged config by which its logs are read.
    sensors : tuple of VehicleSensor
    loss : Loss or None
        Of the parameter file; None where it could not be written.
    problem : str
        The reason for that.
    written : tuple of Path
    """

    product: str
    sensors: tuple[VehicleSensor, ...]
    loss: Loss | None
    problem: str = ""
    written: tuple[Path, ...] = ()

    @property
    def status(self) -> int:
        """Exit status: 1 where there is no parameter file, or a gyro or an accelerometer is not in it."""
        inertial = [sensor for sensor in self.sensors if not sensor.held]
        return int(self.loss is None or any(sensor.result is None or sensor.left_out for sensor in inertial))

    @property
    def summary(self) -> dict[str, Any]:
        """The content of vehicle.json."""
        return {
            "driftlab": __version__,
            "product": self.product,
            "sensors": [
                {
                    "channel": one.channel,
                    "number": one.number,
                    "device_id": one.device or None,
                    "recordings": list(one.recordings),
                    "map": one.file if one.result else None,
                    "verdict": one.result.verdict.sentences(one.result.unit) if one.result else [],
                    "problem": one.problem or None,
                    "left_out": one.left_out or None,
                }
                for one in self.sensors
            ],
            "export": None if self.loss is None else plain(self.loss.as_json()),
            "problem": self.problem or None,
        }

    def lines(self) -> list[str]:
        """Return the verdict on each sensor, then what the firmware loses of each."""
        of_sensors = [line for sensor in self.sensors for line in sensor.lines()]
        return [*of_sensors, *([f"no parameter file: {self.problem}"] if self.loss is None else self.loss.lines())]


def vehicle(
    logs: Sequence[str] | Place,
    *,
    out: Place | None = None,
    export: str | None = None,
    latitude: str | None = None,
    heading: str | None = None,
    kind: str | None = None,
    settings: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> VehicleResult:
    """Calibrate all sensors of a vehicle.

    Finds gyros, accelerometers, barometers and magnetometers in its logs, fits a thermal map of each, and writes a page
    and one file of parameters with all, as `export` does; what the firmware loses of each is said. LOG is of PX4 (.ulg)
    or ArduPilot (.bin, or .log as text), of a vehicle at rest; packed with gzip too. Several logs of one vehicle count
    together.

    Parameters
    ----------
    logs : list of paths
        Logs of one vehicle at rest.
        Or parts of them, `PATH::START:STOP`.
    out : path, optional
        Folder for page, maps, parameters and vehicle.json.
        A program writes nothing where it is left out.
    export : str, optional
        Form of the parameters; default: that of the logs.
    latitude : str, optional
        Of the place, e.g. '40.9 deg', to remove Earth rate.
    heading : str, optional
        Of the x axis from north, clockwise.
    kind : str, optional
        Kind of map; default: spline.
    settings : mapping, optional
        A setting of the form; may be repeated.
        As `{"flies_from": "20 degC"}`.
    progress : callable, optional
        Called with the recording's time in s and the number of samples so far, then with texts.

    Returns
    -------
    VehicleResult
        `sensors`, each with its `result` as of `fit_map`, and `loss`.

    Raises
    ------
    ConfigError
        If a log is given twice, the logs are of two vehicles, a setting is wrong, or `out` must not be replaced.
    DataError
        If a log is none of an autopilot, or cannot be read.
    """
    recordings = [logs] if not isinstance(logs, Sequence) or isinstance(logs, str) else list(logs)
    names = [str(name) for name in recordings]
    if not names:
        raise ConfigError("logs: none is given; name the logs of one vehicle")
    if of_one := next((name for name in settings or {} if name in OF_A_SENSOR), None):
        raise ConfigError(f"--set {of_one}: is of one sensor, and the logs say it of each; leave it out")
    product = product_of(names)
    form = export or PLATFORMS[product].export
    if form not in {platform.export for platform in PLATFORMS.values()}:
        raise ConfigError(f"--export {form}: is no autopilot's; write px4 or ardupilot")
    exporter = exporter_of(form, settings)
    site = {name: value for name, value in (("latitude", latitude), ("heading", heading)) if value is not None}

    # what must not be replaced is refused before anything is fitted
    with (
        tempfile.TemporaryDirectory(prefix="driftlab-")
        if out is None
        else output_folder(Path(out), COMMAND, paths_of(names))
    ) as place:
        found, folder = sensors_of(product, names, site), Path(place)
        sensors = [_fitted(product, one, found, site, kind, progress) for one in found]
        result = _exported(product, exporter, sensors, folder)
        if out is None:
            return result
        _write(result, names, folder)
        files = sorted(path.name for path in folder.iterdir() if path.suffix in (".json", ".html", exporter.suffix))
    return replace(result, written=tuple(Path(out) / name for name in files))


def _write(result: VehicleResult, names: Sequence[str], folder: Path) -> None:
    """Write maps, summary and page."""
    for one in result.sensors:
        if one.result is not None:
            save(one.result.map, folder / one.file, COMMAND)
    write_json(folder / "vehicle.json", result.summary)
    (folder / PAGE).write_text(_page(result, names, folder), encoding="utf-8")


def _fitted(
    product: str,
    sensor: LogSensor,
    sensors: Sequence[LogSensor],
    site: Mapping[str, str],
    kind: str | None,
    progress: Progress | None,
) -> VehicleSensor:
    """Return the sensor with its map, or with the reason why it has none."""
    try:
        config, data = config_and_data(product, sensor, sensors, site)
        result = fit_map(config, data, kind=kind, channel=sensor.channel, progress=progress)
    except MissingChannel as error:  # what to do about it is about a config
        return VehicleSensor(**vars(sensor), problem=str(error).partition(";")[0])
    except (DataError, MapError) as error:
        return VehicleSensor(**vars(sensor), problem=str(error))
    assert isinstance(result, FitMapResult)
    result.map = result.map.noting(provenance={**result.map.record.provenance, **sensor.about})
    return VehicleSensor(**vars(sensor), result=result)


def _exported(product: str, exporter: Exporter, sensors: Sequence[VehicleSensor], folder: Path) -> VehicleResult:
    """Write the parameters of all sensors that the firmware can use, each alone where all together are refused."""
    sensors = tuple(replace(one, left_out=one.left_out or one.drifts()) for one in sensors)
    kept = (one for one in sensors if not one.left_out)
    of_maps = tuple(calibrated(one.name, one.result.map) for one in kept if one.result is not None)
    if not of_maps:
        why = "no sensor has a map" + (" that could be used" if any(one.left_out for one in sensors) else "")
        return VehicleResult(product, sensors, None, why)
    try:
        return VehicleResult(product, sensors, exporter.export(Export(of_maps), folder / f"{COMMAND}{exporter.suffix}"))
    except ConfigError as error:
        refused, problem = {one.channel: _refused(exporter, one) for one in of_maps}, str(error)
    if not any(refused.values()):
        return VehicleResult(product, sensors, None, problem)
    rest = [replace(one, left_out=one.left_out or refused.get(one.name, "")) for one in sensors]
    return _exported(product, exporter, rest, folder)


def _refused(exporter: Exporter, sensor: Calibrated) -> str:
    """Return the reason why the firmware could not use a map; empty where it can."""
    try:
        with tempfile.TemporaryDirectory(prefix="driftlab-") as temporary:
            exporter.export(Export((sensor,)), Path(temporary) / COMMAND)
    except ConfigError as error:
        return str(error)
    return ""


def _page(result: VehicleResult, recordings: Sequence[str], folder: Path) -> str:
    """Return the page with all sensors."""
    mapped = [(one, one.result) for one in result.sensors if one.result is not None]
    lost = {} if result.loss is None else {loss.sensor.channel: loss for loss in result.loss.sensors}
    sections = []
    for one in result.sensors:
        verdict, unit = (None, None) if one.result is None else (one.result.verdict, one.result.unit)
        sections.append(report.SensorReport(one.title, one.sentences, verdict, unit, lost.get(one.name)))
    if not mapped:
        return report.page_of(result.product, recordings, sections, None, result.loss, result.problem)
    sheet = sheet_of(mapped[0][1].config, recordings)
    facts = [map_facts(found.map, found.unit, folder / one.file) for one, found in mapped]
    facts = [fact | {"file": one.file, "channel": one.title} for fact, (one, _) in zip(facts, mapped, strict=True)]
    return report.page_of(result.product, recordings, sections, replace(sheet, maps=facts), result.loss, result.problem)


def show(result: VehicleResult, given: Mapping[str, Any]) -> None:
    """Print how good each map is, what is lost, and the files."""
    say_lines(result.lines())
    say(f"written to {', '.join(map(str, result.written))}\n")
