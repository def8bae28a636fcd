"""The thermal calibration that a vehicle has today, as a map's file: `driftlab import`."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from driftlab import __version__
from driftlab.commands.console import say_lines
from driftlab.commands.export import SHOWN, exporter_of, installed
from driftlab.commands.inputs import Place
from driftlab.maps.fit import axes_of, term_lines
from driftlab.starter import reading
from driftlab.storage.map_file import check_place, save
from fusion_core.contracts import Calibrated, Exporter, FittedMap, ReadBack, ThermalMap
from fusion_core.errors import ConfigError, quote
from fusion_core.escaping import json_of

PLACES = 2001  # temperatures at which a calibration is taken over
ORDERED = "polynomial"  # the kind that holds what firmware holds


@dataclass(frozen=True)
class Imported:
    """A calibration that was read, the map that holds it, and how far the two are apart at most (d,), SI."""

    read: ReadBack
    map: FittedMap
    apart: tuple[float, ...]


def import_map(
    kind: str,
    file: Place,
    out: Place,
    *,
    map_kind: str = "polynomial",
    channel: str | None = None,
    settings: Mapping[str, Any] | None = None,
) -> Imported:
    """Write the thermal calibration that a vehicle has today as a map.

    `driftlab compare` then tells what a new one buys.

    \b
    px4        TC_G, TC_A, TC_B of a .params file, or NAME VALUE a line;
               --set instance=N or device_id=N says which sensor
    ardupilot  INS_TCAL of a .parm file; --set imu=1 to 5
    mat        a .mat file of the form that `driftlab export mat` writes

    Parameters
    ----------
    kind : str
        The form of the file: see above.
    file : path
        The vehicle's parameters, as a ground station saves them.
    out : path
        The map's file to write.
    map_kind : str
        Kind of map.
    channel : str, optional
        Sensor: gyro, accel or baro; default: the first that is corrected.
    settings : mapping, optional
        A setting of the form; may be repeated.
        As `{"instance": 1}`.

    Returns
    -------
    Imported
        `map` (`bias(T)`, `domain`), and `apart` (d,), how far it is from the file at most, SI.

    Raises
    ------
    ConfigError, DataError
        If the file holds no calibration that is in use, or cannot be read, or `out` is in the way.
    """  # noqa: D301 - what click takes for a paragraph to be left as it is
    exporter = exporter_of(kind, settings)
    path, place = Path(file), Path(out)
    calibration = _of_channel(_read(exporter, path), channel, path)
    model = installed(ThermalMap, map_kind, "--kind")
    order = {"order": calibration.order} if map_kind == ORDERED else {}
    check_place(place, [path], "import")
    T = np.linspace(*calibration.domain, PLACES)
    bias = calibration.bias(T)
    provenance = {
        **calibration.about,
        "imported_from": path.name,
        "format": exporter.kind,
        "imported_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "driftlab": __version__,
    }
    fitted = model.model_validate({"kind": map_kind, **order}).fit(T, bias, provenance)
    # nothing is known of the samples that it once was fitted to
    unknown = {"residual": None, "samples": 0, "error": None, "matrix": calibration.matrix}
    sensor = {"channel": calibration.channel, "unit": calibration.unit, "axes": calibration.axes}
    try:
        fitted = replace(fitted, record=fitted.record.model_copy(update={**unknown, **sensor}))
    except ValidationError as error:
        raise ConfigError(
            f"{path}: is of no sensor that can be named ({quote(error.errors()[0]['msg'], 120)}); mend its channel, "
            "unit and axes"
        ) from None
    save(fitted, place, "import")
    apart = np.max(np.abs(fitted.bias(T) - bias), axis=0)
    return Imported(calibration, fitted, tuple(apart.tolist()))


def _read(exporter: Exporter, path: Path) -> list[ReadBack]:
    """Return the calibrations of a file of parameters, or of a log that has its vehicle's."""
    kinds = reading.file_sources(path, reading.beginning(path, reading.HEAD)) if path.is_file() else []
    parameters = next((values for cls in kinds if (values := cls.parameters(path))), None)
    if parameters is None:
        return exporter.read(path)
    lines = [f"{name} {value!r}" for name, value in parameters.items() if name.isidentifier() and np.isfinite(value)]
    with tempfile.TemporaryDirectory(prefix="driftlab-") as temporary:
        place = Path(temporary) / f"{path.name}.parameters"
        place.write_text("\n".join(lines), encoding="utf-8")
        try:
            return exporter.read(place)
        except ConfigError as error:
            raise ConfigError(str(error).replace(str(place), str(path))) from None


def _of_channel(calibration: Sequence[ReadBack], channel: str | None, path: Path) -> ReadBack:
    wanted = calibration[0].channel if channel is None else channel
    for one in calibration:
        if one.channel == wanted:
            return one
    have = ", ".join(one.channel for one in calibration)
    raise ConfigError(f"--channel {wanted}: {path} has a thermal calibration of {have} alone; name that one")


def content_of(result: Imported, given: Mapping[str, Any]) -> Any:
    """Return the record of the map."""
    return json_of(result.map.record.model_dump_json(indent=2))


def show(result: Imported, given: Mapping[str, Any]) -> None:
    """Print the calibration's size, and the lines of a config by which it is used."""
    record, read = result.map.record, result.read
    unit = Calibrated(read.channel, read.unit, SHOWN.get(read.unit, read.unit), read.axes)
    swing = unit.text(np.ptp(read.bias(np.linspace(*record.domain, PLACES)), axis=0))
    say_lines(
        [
            *read.notes,
            f"{record.channel}: moves by {swing} {unit.shown} from {record.domain[0]:.4g} to {record.domain[1]:.4g} "
            f"°C; the map is within {unit.text(np.array(result.apart))} {unit.shown} of it",
            *(() if record.matrix is None else term_lines(record.matrix, axes_of(result.map))),
            "in a config, as the vehicle uses it:",
            "filter:",
            f"  {record.channel}:",
            f"    calibration: {{kind: {record.kind}, path: {given['out']}, outside: clamp}}",
            f"written to {given['out']}",
        ]
    )
