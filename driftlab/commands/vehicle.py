"""All inertial units of a vehicle in one command: `driftlab vehicle`."""

from __future__ import annotations

import hashlib
import tempfile
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

from driftlab import __version__
from driftlab.commands.console import say, say_lines
from driftlab.commands.export import SHOWN, exporter_of
from driftlab.commands.fit_map import FitMapResult, fit_map
from driftlab.commands.inputs import Place, Progress, config_of
from driftlab.config import Config, part_of, paths_of
from driftlab.maps.fit import axes_of
from driftlab.starter import reading
from driftlab.storage.folders import output_folder
from driftlab.storage.json import plain, write_json
from driftlab.storage.map_file import save
from fusion_core.contracts import Calibrated, Export, Exporter, FileSource, Loss
from fusion_core.errors import ConfigError, DataError, MapError, MissingChannel
from fusion_core.faults import Faults

COMMAND = "vehicle"  # by which its files are known
NUMBERS = range(8)  # of sensors of a kind that are looked for
BLOCK = 1 << 20  # bytes of a log at a time
OF_A_SENSOR = ("device_id", "accel_device_id", "baro_device_id", "instance", "calibration", "imu")  # settings


class Platform(NamedTuple):
    """An autopilot: the form of its parameters, and the topics of its sensors, with the fields of their axes."""

    export: str
    topics: Mapping[str, tuple[str, tuple[str, str, str], str]]  # by channel: topic, axes and temperature
    first: int  # number of the first sensor in the parameters' names


PLATFORMS = {  # by the packaged config
    "px4_log": Platform(
        "px4",
        {name: (f"sensor_{name}", ("x", "y", "z"), "temperature") for name in ("gyro", "accel")},
        0,
    ),
    "ardupilot_log": Platform(
        "ardupilot",
        {
            name: ("IMU", (f"{short}X", f"{short}Y", f"{short}Z"), "T")
            for name, short in (("gyro", "Gyr"), ("accel", "Acc"))
        },
        1,
    ),
}


@dataclass(frozen=True)
class VehicleSensor:
    """A gyro or an accelerometer of a vehicle.

    Attributes
    ----------
    channel : str
        gyro or accel.
    number : int
        As in the parameters' names: from 0 for PX4, from 1 for ArduPilot.
    device : str
        Its device id; empty where the logs have none.
    recordings : tuple of str
        The logs that have it.
    result : FitMapResult or None
        Its map; None where none could be fitted.
    problem : str
        The reason for that.
    """

    channel: str
    number: int
    device: str
    recordings: tuple[str, ...]
    result: FitMapResult | None = None
    problem: str = ""

    @property
    def name(self) -> str:
        """Channel and number, e.g. `gyro 0`."""
        return f"{self.channel} {self.number}"

    @property
    def file(self) -> str:
        """Name of its map's file."""
        return f"{self.channel}{self.number}.map.json"

    def lines(self) -> list[str]:
        """Return the verdict on its map, a sentence each, or the reason why it has none."""
        of = f"{self.name}, device id {self.device}" if self.device else self.name
        sentences = self.result.verdict.sentences(self.result.unit) if self.result else [f"no map: {self.problem}"]
        return [f"{of}: {sentence}" for sentence in sentences]


@dataclass(frozen=True)
class VehicleResult:
    """The maps of all gyros and accelerometers of a vehicle, and what its firmware loses of them.

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
        """Exit status: 1 where a sensor has no map, or there is no parameter file."""
        return int(self.loss is None or any(sensor.result is None for sensor in self.sensors))

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
    """Calibrate all gyros and accelerometers of a vehicle.

    Finds them in its logs, fits a thermal map of each, and writes one file of parameters with all, as `export` does;
    what the firmware loses of each is said. LOG is of PX4 (.ulg) or ArduPilot (.bin), of a vehicle at rest; packed with
    gzip too. Several logs of one vehicle count together.

    Parameters
    ----------
    logs : list of paths
        Logs of one vehicle at rest.
        Or parts of them, `PATH::START:STOP`.
    out : path, optional
        Folder for maps, parameters and vehicle.json.
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
    product = _product(names)
    form = export or PLATFORMS[product].export
    if form not in {platform.export for platform in PLATFORMS.values()}:
        raise ConfigError(f"--export {form}: is no autopilot's; write px4 or ardupilot")
    exporter = exporter_of(form, {name: str(value) for name, value in (settings or {}).items()})
    site = {name: value for name, value in (("latitude", latitude), ("heading", heading)) if value is not None}

    found = _sensors(product, names, site)
    sensors = tuple(_fitted(product, one, found, site, kind, progress) for one in found)
    if out is None:
        return VehicleResult(product, sensors, *_exported(exporter, sensors, None))
    with output_folder(Path(out), COMMAND, paths_of(names)) as folder:
        result = VehicleResult(product, sensors, *_exported(exporter, sensors, folder))
        for one in sensors:
            if one.result is not None:
                save(one.result.map, folder / one.file, COMMAND)
        write_json(folder / "vehicle.json", result.summary)
        files = sorted(path.name for path in folder.iterdir() if path.suffix in (".json", exporter.suffix))
    return replace(result, written=tuple(Path(out) / name for name in files))


def _product(recordings: Sequence[str]) -> str:
    """Return the packaged config that reads all logs; raises DataError where one is no autopilot's."""
    kinds = dict[str, str]()
    for name in recordings:
        path = part_of(name)[0]
        sources = reading.file_sources(path, reading.beginning(path, reading.HEAD))
        known = next((cls.product for cls in sources if cls.product in PLATFORMS), None)
        if known is None:
            raise MissingChannel(
                f"{path}: is no log of an autopilot, one of PX4 (.ulg) or ArduPilot (.bin) was expected; use fit-map "
                "with a config for other recordings"
            )
        kinds[name] = known
    if len(set(kinds.values())) > 1:
        raise ConfigError(f"{' and '.join(kinds)}: are of PX4 and of ArduPilot; give the logs of one vehicle")
    return next(iter(kinds.values()))


def _config(product: str, site: Mapping[str, str], paths: Mapping[str, Any]) -> Config:
    channels = {name: {"path": path} for name, path in paths.items()}
    return config_of({"extends": product, **site, "source": {"channels": channels}})


def _paths(product: str, channel: str, at: int, gyro: int) -> dict[str, Any]:
    """Return the paths of channels that read the sensor `at` of a kind; `gyro` is that of the rows."""
    topics, places = PLATFORMS[product].topics, {"gyro": gyro, "accel": gyro, channel: at}
    paths: dict[str, Any] = {
        name: [f"{topic}[{places[name]}].{axis}" for axis in axes] for name, (topic, axes, _) in topics.items()
    }
    (topic, _, temperature), rows = topics[channel], topics["gyro"][0]
    clock = "time" if product == "px4_log" else "TimeUS"
    leading = f"{rows}[{gyro if product == 'px4_log' else at}].{clock}"
    return {"time": leading, **paths, "temperature": f"{topic}[{at}].{temperature}"}


def _sensors(product: str, recordings: Sequence[str], site: Mapping[str, str]) -> list[VehicleSensor]:
    """Return the sensors of all logs, none of which is there twice.

    Raises
    ------
    ConfigError
        If a log is there twice, or two devices have one number.
    """
    source = _config(product, site, {}).source
    assert isinstance(source, FileSource)
    found = dict[tuple[str, int], tuple[str, list[str]]]()
    for name in recordings:
        for key, device in _in_log(product, source, part_of(name)[0]):
            before, having = found.setdefault(key, (device, []))
            if before != device:
                raise ConfigError(
                    f"{name}: has the device id {device or 'unknown'} as {key[0]} {key[1]}, {having[0]} has "
                    f"{before or 'none'}; give the logs of one vehicle whose sensors kept their places"
                )
            having.append(name)
    _check_twice(recordings)
    sensors = [VehicleSensor(*key, device, tuple(having)) for key, (device, having) in found.items()]
    return sorted(sensors, key=lambda one: (one.channel != "gyro", one.number))


def _in_log(product: str, source: FileSource, path: Path) -> Iterator[tuple[tuple[str, int], str]]:
    """Yield channel and number of each sensor of a log, with its device id."""
    platform = PLATFORMS[product]
    with source.model_copy(update={"path": path}).open(path, Faults()) as table:
        for channel, (topic, axes, _) in platform.topics.items():
            for number in NUMBERS:
                place = f"{topic}[{number}].{axes[0]}"
                with suppress(MissingChannel):
                    if table.has(place):
                        about = table.about(place)
                        yield (channel, number + platform.first), about.get("device_id", "")


def _check_twice(recordings: Sequence[str]) -> None:
    """Raise ConfigError where the same rows are there twice: they would count as two soaks that agree."""
    parts = [(name, *part_of(name)) for name in recordings]
    digests = {path: _digest(path) for path in {path for _, path, _ in parts}} if len(parts) > 1 else {}
    for (name, path, span), (again, other, beside) in combinations(parts, 2):
        begin = max(span.get("start") or 0.0, beside.get("start") or 0.0)
        ends = [end for end in (span.get("stop"), beside.get("stop")) if end is not None]
        if digests[path] == digests[other] and (not ends or begin < min(ends)):
            raise ConfigError(
                f"{again}: has the same rows as {name}, which would count twice; give each log once, or parts of it "
                "that do not overlap"
            )


def _digest(path: Path) -> str:
    """Return the SHA-256 of a log's plain bytes."""
    total = hashlib.sha256()
    with path.open("rb") as file:
        packed = file.read(2) == reading.GZIP
        file.seek(0)
        unpacked: Callable[[bytes], bytes] = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress if packed else bytes
        while data := file.read(BLOCK):
            total.update(unpacked(data))
    return total.hexdigest()


def _fitted(
    product: str,
    sensor: VehicleSensor,
    all_of_them: Sequence[VehicleSensor],
    site: Mapping[str, str],
    kind: str | None,
    progress: Progress | None,
) -> VehicleSensor:
    """Return the sensor with its map, or with the reason why it has none."""
    first, about = PLATFORMS[product].first, (sensor.channel, sensor.number, sensor.device, sensor.recordings)
    gyros = [
        one.number for one in all_of_them if one.channel == "gyro" and set(sensor.recordings) <= set(one.recordings)
    ]
    gyro = sensor.number if sensor.number in gyros else next(iter(gyros), sensor.number)
    config = _config(product, site, _paths(product, sensor.channel, sensor.number - first, gyro - first))
    try:
        result = fit_map(config, list(sensor.recordings), kind=kind, channel=sensor.channel, progress=progress)
    except (DataError, MapError) as error:
        return VehicleSensor(*about, problem=str(error))
    assert isinstance(result, FitMapResult)
    return VehicleSensor(*about, result=result)


def _exported(exporter: Exporter, sensors: Sequence[VehicleSensor], folder: Path | None) -> tuple[Loss | None, str]:
    """Write the parameters of all sensors; return what is lost, or why there are none."""
    of_maps = []
    for one in sensors:
        if one.result is not None:
            fitted = one.result.map
            unit = fitted.record.unit
            of_maps.append(Calibrated(one.name, unit, SHOWN.get(unit, unit), axes_of(fitted), fitted))
    if not of_maps:
        return None, "no sensor has a map"
    name = f"{COMMAND}{exporter.suffix}"
    try:
        if folder is not None:
            return exporter.export(Export(tuple(of_maps)), folder / name), ""
        with tempfile.TemporaryDirectory(prefix="driftlab-") as temporary:
            return exporter.export(Export(tuple(of_maps)), Path(temporary) / name), ""
    except ConfigError as error:
        return None, str(error)


def content_of(result: VehicleResult, given: Mapping[str, Any]) -> Any:
    """Return the content of vehicle.json."""
    return result.summary


def show(result: VehicleResult, given: Mapping[str, Any]) -> None:
    """Print how good each map is, what is lost, and the files."""
    say_lines(result.lines())
    say(f"written to {', '.join(map(str, result.written))}\n")
