"""A calibration in the form of another program, and what it loses on the way: `driftlab export`."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.commands.console import say_lines
from driftlab.commands.fit_map import FitMapResult
from driftlab.commands.inputs import ConfigLike, Place, config_of, is_file
from driftlab.config import Config, understood
from driftlab.filtering.setup import loaded_map, shown_by_soak
from driftlab.maps.fit import axes_of
from driftlab.noise.innovations import SensorReadings, inflation
from driftlab.noise.local_level import walk_of
from driftlab.storage.folders import check_writable, refusals
from driftlab.storage.hdf5 import columns_of, reading
from driftlab.storage.json import plain, write_json
from driftlab.storage.map_file import read_map
from driftlab.storage.ownership import document, foreign, sign
from driftlab.triad.model import GRAVITY
from driftlab.units import BiasUnit
from fusion_core.budget import read_whole
from fusion_core.chunk import Array, Flags
from fusion_core.contracts import (
    Calibrated,
    Effect,
    Export,
    Exporter,
    FittedMap,
    Inflation,
    Loss,
    MeasurementModel,
    Sensor,
    ThermalBias,
)
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, quote
from fusion_core.host.config import Document, document_of, validate
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry
from fusion_core.settings import did_you_mean
from fusion_core.thermal.record_texts import parse_json

CONFIGS = (".yaml", ".yml")
SHOWN = {"rad/s": "deg/h", "m/s^2": "mg", "T": "uT"}  # units in which people read those of a map's file
LOSS = "loss.json"
SCHEMA = 2  # of its layout
NEEDED = ("t", "tau", "rate", "coast", "still", "used", "innovations", "x")


def export(
    kind: str,
    what: ConfigLike | FitMapResult,
    out: Place,
    *,
    settings: Mapping[str, Any] | None = None,
    run: Place | None = None,
    force: bool = False,
) -> Loss:
    """Write a calibration in the form of another program or a vehicle.

    Says what is lost, measured in the target's own arithmetic; it stands in loss.json beside the file.

    \b
    px4        .params for QGroundControl. A map of a PX4 log knows its device,
               another needs --set device_id=N
    ardupilot  .parm for MAVProxy and Mission Planner; --set imu=1 to 5
    c          C99 without libraries, with a self-test; --set 'loss=1 deg/h'.
               The effects of a config come along
    kalibr     imu.yaml: noise and walk of a config; --set 'rate=200 Hz', and
               --run DIR for what the innovations of a run say of them
    openvins   kalibr_imu_chain.yaml, the same way; --set form=vins for VINS
    mat        .mat for MATLAB and Octave
    csv_table  a table of temperature, bias and sigma; --set 'step=0.5 K'

    For px4 and ardupilot, --set 'flies_from=20 degC' (and flies_to) says where the fit is to be best. `driftlab
    plugins` lists what else is installed.

    Parameters
    ----------
    kind : str
        The form: see above.
    what : path of a map's file, config, or FitMapResult
        A map's file, or a config that names one.
        A config's maps are exported with its effects and noise.
    out : path
        The file to write; of c, the folder.
        `loss.json` is written beside the file, or in the folder; it has an entry for each export there.
    settings : mapping, optional
        A setting of the form; may be repeated.
        As `{"flies_from": "20 degC"}`.
    run : path, optional
        A run's folder: noise as its innovations say.
    force : bool
        Replace the file, and what stands beside it.

    Returns
    -------
    Loss
        `lines()` says what is lost, `sensors` has it in numbers, measured in the target's own arithmetic.

    Raises
    ------
    ConfigError, MapError
        If the target could not use it, a setting is wrong, or a file is in the way.
    Unwritable
        If the disk is full, or the like.
    """  # noqa: D301 - what click takes for a paragraph to be left as it is
    exporter = exporter_of(kind, settings)
    file = Path(what) if is_file(what) else None  # type: ignore[arg-type]
    if isinstance(what, FitMapResult):
        calibration = of_map(what.map)
    elif file is not None and file.suffix not in CONFIGS:
        calibration = of_map(read_map(file))
    else:
        calibration = of_config(config_of(what))
    if run is not None:
        calibration = with_inflation(calibration, Path(run))
    return _write(exporter, calibration, Path(out), force, [] if file is None else [file])


def installed(base: type, kind: str, option: str) -> Any:
    """Return the installed class of a kind; raises ConfigError, which names the option, with a near one."""
    classes = registry().classes(base)
    if kind not in classes:
        advice = did_you_mean(kind, classes, f"known: {', '.join(classes)}", cutoff=0.6)
        raise ConfigError(f"{option} {kind}: {advice}")
    return classes[kind]


def exporter_of(kind: str, settings: Mapping[str, Any] | None) -> Exporter:
    """Return the exporter of a kind with settings as a user writes them; raises ConfigError."""
    document = Document(Path("--set"), {"kind": kind, **{name: str(value) for name, value in (settings or {}).items()}})
    return validate(installed(Exporter, kind, "export"), document)  # type: ignore[no-any-return]


def calibrated(name: str, fitted: FittedMap) -> Calibrated:
    """Return the calibration of a sensor that a map has, in the units in which people read it."""
    unit = fitted.record.unit
    return Calibrated(name, unit, SHOWN.get(unit, unit), axes_of(fitted), fitted)


def of_map(fitted: FittedMap) -> Export:
    """Return the calibration that a map has."""
    return Export((calibrated(fitted.record.channel, fitted),))


def of_config(config: Config) -> Export:
    """Return the calibration of a config's sensors.

    Raises
    ------
    ConfigError
        If it has no filter.
    MapError
        If a map cannot be read, or is of another sensor than the one that it is named for.
    """
    if config.filter is None:
        raise ConfigError(f"{config.name or 'config'}: has no filter section, and so no sensor; add one")
    interval = getattr(config.source, "interval", None)
    sensors = tuple(_calibrated(sensor) for sensor in config.filter.sensors)
    return Export(sensors, None if interval is None else 1 / float(interval), config.serial or "")


def _calibrated(sensor: Sensor) -> Calibrated:
    bias, settings = sensor.bias, sensor.calibration
    effects: tuple[Effect, ...] = ()
    if isinstance(bias, ThermalBias):
        settings, effects = bias.map or settings, bias.effects
    return Calibrated(
        sensor.channel,
        sensor.unit,
        sensor.shown,
        sensor.axes,
        None if settings is None else loaded_map(settings, sensor),
        effects,
        sensor.noise,
        walk_of(sensor),
    )


def _write(exporter: Exporter, what: Export, path: Path, force: bool, read: Collection[Path]) -> Loss:
    """Write a calibration to `path`, whole or not at all, and its losses to `loss.json` beside it (in the folder)."""
    if exporter.folder and path.exists() and not path.is_dir():
        raise ConfigError(f"--out {path}: is a file, a folder is written; name another")
    folder = path if exporter.folder else path.parent
    _check(exporter, path, folder, [] if exporter.folder else [key_of(path)], force, read)
    with refusals(f"--out {path}", "make room, or name another file", usage=False):
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
        with tempfile.TemporaryDirectory(prefix=".driftlab-", dir=folder) as temporary:
            written = Path(temporary) / key_of(path)
            if exporter.folder:
                written.mkdir()
            loss = exporter.export(what, written)
            left_out = *loss.left_out, *_sensitivities(exporter.kind, what)
            loss = replace(loss, left_out=left_out, notes=(*loss.notes, *_shown_by_soaks(what)))
            files = sorted(written.iterdir()) if exporter.folder else [written] if written.is_file() else []
            if not files:
                raise ConfigError(f"export {exporter.kind}: wrote no file; mend or remove the plugin")
            before = _check(exporter, path, folder, [file.name for file in files], force, read)
            entry = {
                "driftlab": __version__,
                "plugins": participants(exporter),
                "kind": exporter.kind,
                **plain(loss.as_json()),
            }
            exports = {**before.get("exports", {}), key_of(path): entry}
            write_json(files[0].parent / LOSS, {"schema": SCHEMA, "exports": exports})
            sign(files[0].parent, LOSS, [file.name for file in files], before.get("written"))
            for file in files:  # gone before `loss.json` knows the new ones: whatever is there is known at any moment
                (folder / file.name).unlink(missing_ok=True)
            for file in [files[0].parent / LOSS, *files]:
                os.replace(file, folder / file.name)
    return loss


def _sensitivities(kind: str, what: Export) -> Iterator[str]:
    """Yield the size of the g-sensitivities over temperature, which no form of export holds."""
    for sensor in what.sensors:
        held = None if sensor.map is None else sensor.map.record.sensitivity
        if held is not None:
            G = np.max(np.abs(held.terms(np.linspace(held.T[0], held.T[-1], 100)))) * sensor.factor * GRAVITY
            yield f"{sensor.channel}: g-sensitivity, up to {G:.3g} {sensor.shown}/g; {kind} leaves it out"


def _shown_by_soaks(what: Export) -> Iterator[str]:
    """Yield the differences between up and down that soaks of maps showed, and neither curve nor sigma has."""
    for sensor in what.sensors:
        unit = BiasUnit(sensor.unit, sensor.shown)
        if sensor.map is not None and (text := shown_by_soak(sensor.map, sensor.axes, unit)):
            yield f"{sensor.channel}: the soak of its map {text}, which neither curve nor sigma has"


def key_of(path: Path) -> str:
    """Return the name of an export in its `loss.json`; of `.` too."""
    return Path(os.path.abspath(path)).name


def _check(
    exporter: Exporter, path: Path, folder: Path, names: list[str], force: bool, read: Collection[Path]
) -> dict[str, Any]:
    """Return the `loss.json` of earlier exports; raises ConfigError where a file is not to be written."""
    if LOSS in names:
        raise ConfigError(f"--out {path}: what is lost is written to {LOSS}; name another file")
    for place in (folder / name for name in (LOSS, *names)):
        if any(os.path.realpath(place) == os.path.realpath(other) for other in read):
            raise ConfigError(f"--out {place}: is read here, and would be lost; name another file")
        if place.is_dir():
            raise ConfigError(f"--out {place}: is a folder; name another file")
    there = [name for name in (LOSS, *names) if os.path.lexists(folder / name)]
    if not force and (others := foreign(folder, LOSS, there)):
        raise ConfigError(
            f"--out {path}: {', '.join(others[:5])} exists, and is not as `driftlab export` wrote it; name another "
            "file, or give --force to replace it"
        )
    before = document(folder / LOSS)
    if before.get("schema") != SCHEMA or foreign(folder, LOSS, [LOSS]):
        return {}
    earlier = before["exports"].get(key_of(path), {}).get("kind", exporter.kind)
    if earlier != exporter.kind and not force:
        raise ConfigError(
            f"--out {path}: is of `driftlab export {earlier}`; name another file, or give --force to replace it"
        )
    return before


def inflations(folder: Path) -> dict[str, dict[str, Inflation]]:
    """Return by channel the inflation of noise that the innovations of a run's folder show, where walk is declared.

    `compensated` is about readings less what map and effects say of their bias, `raw` about readings as they are; one
    is missing where the run does not show it.

    Raises
    ------
    ConfigError
        If the folder is none of a run.
    UnreadableFile, SingularFit
        If its files are damaged, or too little of it was at rest.
    """
    path = folder / "estimates.h5"
    if not path.is_file():
        raise ConfigError(f"run {folder}: has no estimates.h5; name the folder that `driftlab run --out` wrote")
    with reading(path) as file:
        if missing := [name for name in NEEDED if name not in file]:
            raise UnreadableFile(f"{path}: has no {', '.join(missing)}; write it anew with `driftlab run`")
        columns = {name: rows[: len(rows.node)] for name, rows in columns_of(path, file, NEEDED).items()}
        text = str(attribute(path, file, "config"))
    document = document_of(text)
    document.data.pop("source", None)  # which may have been in memory
    model = understood(document).filter
    assert model is not None, "a run has a filter"
    still, fresh = columns["still"].astype(bool), _fresh(folder, columns["t"])
    ratios: dict[str, dict[str, Inflation]] = {}
    for sensor in model.sensors:
        walk = walk_of(sensor)
        if walk is None:
            continue
        ratios[sensor.channel] = {}
        for name, d in _series(model, sensor, columns).items():
            readings = SensorReadings(columns["t"], columns["tau"], np.where(still[:, None], d, np.nan), fresh)
            ratios[sensor.channel][name] = inflation(readings, sensor.noise, walk)
    return ratios


def _fresh(folder: Path, t: Array) -> Flags:
    """Return the epochs (N,) at which a prediction starts anew: after each further alignment."""
    fresh = np.zeros(len(t), dtype=bool)
    path = folder / "summary.json"
    if path.is_file():
        try:
            summary: dict[str, Any] = parse_json(read_whole(path))
            moments = np.asarray(summary.get("aligned_again_s", []), dtype=np.float64)
        except (OSError, ValueError, TypeError, AttributeError, RecursionError) as error:
            raise UnreadableFile(
                f"{path}: is damaged ({quote(error, 120)}); write it anew with `driftlab run`"
            ) from None
        again = np.searchsorted(t, moments.ravel(), side="right")
        fresh[again[again < len(t)]] = True
    return fresh


def _series(model: MeasurementModel, sensor: Sensor, columns: dict[str, Array]) -> dict[str, Array]:
    """Return the readings (N, d) of a sensor: raw, and less what map and effects say of its bias."""
    if sensor.channel == model.tracked.channel:
        return {"raw": columns["rate"], "compensated": columns["rate"] - columns["coast"]}
    if sensor.bias.as_random_walk() is None:
        return {}
    rows = [k for k, (channel, _, unit) in enumerate(model.components) if channel == sensor.channel]
    bias = columns["x"][:-1, model.places[sensor.channel]]
    # what an update measures is the integral of the reading less the bias before it, and it is to be zero
    after = bias - columns["innovations"][1:, rows] / columns["tau"][1:, None]
    d = np.concatenate([np.full((1, len(rows)), np.nan), after])
    return {"compensated": d} if sensor.calibration is not None else {"raw": d, "compensated": d}


def with_inflation(what: Export, folder: Path) -> Export:
    """Return the same with what the run in a folder says of each sensor; raises as `inflations`."""
    ratios = inflations(folder)
    if unknown := [channel for channel in ratios if what.sensor(channel) is None]:
        raise ConfigError(f"run {folder}: is of {', '.join(unknown)}, which the config has not; name a run of its own")
    of_sensors = [ratios.get(sensor.channel, {}) for sensor in what.sensors]
    sensors = [
        replace(sensor, compensated=ratio.get("compensated"), raw=ratio.get("raw"))
        for sensor, ratio in zip(what.sensors, of_sensors, strict=True)
    ]
    return replace(what, sensors=tuple(sensors))


def content_of(result: Loss, given: Mapping[str, Any]) -> Any:
    """Return the entry of `loss.json`."""
    return json.loads(_beside(given).read_text(encoding="utf-8"))["exports"][key_of(given["out"])]


def show(result: Loss, given: Mapping[str, Any]) -> None:
    """Print what is lost."""
    say_lines([*result.lines(), f"written to {given['out']}, {_beside(given)}"])


def _beside(given: Mapping[str, Any]) -> Path:
    folder = registry().classes(Exporter)[given["kind"]].folder  # type: ignore[attr-defined]
    out: Path = given["out"]
    return (out if folder else out.parent) / LOSS
