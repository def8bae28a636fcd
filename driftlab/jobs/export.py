"""`driftlab export`: a calibration in the form of another program, and what it loses on the way."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import Config, load_config
from driftlab.filtering.setup import loaded_map
from driftlab.maps.fit import axes_of
from driftlab.storage.folders import check_writable
from driftlab.storage.hdf5 import reason
from driftlab.storage.json import plain, write_json
from fusion_core.budget import read_whole
from fusion_core.contracts import Calibrated, Effect, Export, Exporter, FittedMap, Loss, Sensor, ThermalBias, ThermalMap
from fusion_core.errors import ConfigError, FusionError, MapError, Unwritable
from fusion_core.host.config import Document, validate
from fusion_core.host.provenance import participants
from fusion_core.host.registry import registry
from fusion_core.settings import nearest
from fusion_core.units import along_axes

CONFIGS = (".yaml", ".yml")
SHOWN = {"rad/s": "deg/h", "m/s^2": "mg"}  # units in which people read those of a map's file
LOSS = "loss.json"
SCHEMA = 2  # of its layout


def exporter_of(kind: str, settings: Mapping[str, str]) -> Exporter:
    """Return the exporter of a kind with settings as a user writes them; raises ConfigError."""
    classes = registry().classes(Exporter)
    if kind not in classes:
        hint = nearest(kind, classes)
        raise ConfigError(f"export {kind}: " + (f"did you mean {hint}?" if hint else f"known: {', '.join(classes)}"))
    found: Any = validate(classes[kind], Document(Path("--set"), {"kind": kind, **settings}))
    return found  # type: ignore[no-any-return]


def read_export(path: Path) -> Export:
    """Return what is known of a unit by a map's file, or by a config.

    Raises
    ------
    MapError, ConfigError
        If no kind of map can read it, or the config has no filter.
    """
    if path.suffix in CONFIGS:
        return of_config(load_config(path))
    return of_map(read_map(path))


def of_map(fitted: FittedMap) -> Export:
    """Return what a map says of a unit."""
    record = fitted.record
    shown = SHOWN.get(record.unit, record.unit)
    return Export((Calibrated(record.channel, record.unit, shown, axes_of(fitted), fitted),))


def of_config(config: Config) -> Export:
    """Return what a config says of a unit.

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
    walk = (bias.as_random_walk() or {}).get("walk")
    if isinstance(bias, ThermalBias):
        settings, effects, walk = bias.map or settings, bias.effects, bias.walk
    return Calibrated(
        sensor.channel,
        sensor.unit,
        sensor.shown,
        sensor.axes,
        None if settings is None else loaded_map(settings, sensor),
        effects,
        sensor.noise,
        None if walk is None else along_axes(walk, len(sensor.axes)),
    )


def read_map(path: Path) -> FittedMap:
    """Read the map of a file, of whatever installed kind it is; raises MapError where none can read it."""
    if not path.is_file():
        raise MapError(f"map file {path} does not exist; fit it with `driftlab fit-map`")
    why = []
    for kind, cls in registry().classes(ThermalMap).items():
        settings: Any = cls.model_validate({"kind": kind, "path": str(path.absolute())})
        try:
            return settings.load()  # type: ignore[no-any-return]
        except FusionError as error:
            if settings.suffix == path.suffix:
                why.append(str(error).partition(";")[0])
    reasons = f" ({', '.join(why)})" if why else ""
    raise MapError(f"{path}: is a map of no installed kind{reasons}; name one that `driftlab fit-map` wrote")


def export(exporter: Exporter, what: Export, path: Path, *, force: bool, read: Collection[Path]) -> Loss:
    """Write a calibration to `path`, whole or not at all, and what it loses to `loss.json` beside it (in the folder).

    `loss.json` has an entry for each export in its folder.

    Raises
    ------
    ConfigError
        If one of the files is there already and `force` is not given, or is read here.
    Unwritable
        If the disk is full, or the like.
    """
    _check(path, exporter.folder, force, read)
    folder = path if exporter.folder else path.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        check_writable(folder)
        with tempfile.TemporaryDirectory(prefix=".driftlab-", dir=folder) as temporary:
            written = Path(temporary) / key_of(path)
            if exporter.folder:
                written.mkdir()
            loss = exporter.export(what, written)
            files = sorted(written.iterdir()) if exporter.folder else [written] if written.is_file() else []
            if not files:
                raise ConfigError(f"export {exporter.kind}: wrote no file; mend or remove the plugin")
            for file in files:
                _check(folder / file.name, False, force, read)
            write_json(Path(temporary) / LOSS, _content(exporter, loss, path, _exports(folder / LOSS, path, force)))
            for file in [*files, Path(temporary) / LOSS]:
                os.replace(file, folder / file.name)
    except OSError as error:
        raise Unwritable(
            f"--out {path}: cannot be written ({reason(error)}); make room, or name another file"
        ) from None
    return loss


def key_of(path: Path) -> str:
    """Return under which name an export stands in its `loss.json`; of `.` too."""
    return Path(os.path.abspath(path)).name


def _check(path: Path, folder: bool, force: bool, read: Collection[Path]) -> None:
    """Raise ConfigError where a file (or folder) is not to be written."""
    if any(os.path.realpath(path) == os.path.realpath(other) for other in read):
        raise ConfigError(f"--out {path}: is read here, and would be lost; name another file")
    if folder:
        if path.exists() and not path.is_dir():
            raise ConfigError(f"--out {path}: is a file, a folder is written; name another")
    elif path.is_dir() or (path.exists() and not force):
        raise ConfigError(f"--out {path}: exists; name another file, or give --force to replace it")


def _exports(beside: Path, path: Path, force: bool) -> dict[str, Any]:
    """Return what the `loss.json` that is there has of exports; raises ConfigError where it is somebody else's."""
    try:
        content = json.loads(read_whole(beside))
        if content["schema"] == SCHEMA and isinstance(content["exports"], dict):
            return dict(content["exports"])
    except FileNotFoundError:
        return {}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        pass
    if not force:
        raise ConfigError(
            f"--out {path}: {beside} exists and is not of earlier exports; name another folder, or give --force to "
            "replace it"
        )
    return {}


def _content(exporter: Exporter, loss: Loss, path: Path, known: dict[str, Any]) -> dict[str, Any]:
    """Return what `loss.json` is to hold: what it has of other exports, and this one."""
    own = {"driftlab": __version__, "plugins": participants(exporter), "kind": exporter.kind, **plain(loss.as_json())}
    return {"schema": SCHEMA, "exports": {**known, key_of(path): own}}
