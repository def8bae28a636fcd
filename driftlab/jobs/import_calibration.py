"""`driftlab import`: the thermal calibration that a vehicle has today, as a map's file."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from driftlab import __version__
from driftlab.jobs.export import SHOWN
from driftlab.storage.map_file import check_place, save
from fusion_core.contracts import Calibrated, Exporter, FittedMap, ReadBack, ThermalMap
from fusion_core.errors import ConfigError, shown
from fusion_core.host.registry import registry
from fusion_core.settings import nearest

PLACES = 2001  # temperatures at which a calibration is taken over
ORDERED = "polynomial"  # the kind that holds what firmware holds


@dataclass(frozen=True)
class Imported:
    """A calibration that was read, the map that holds it, and how far the two are apart at most (d,), SI."""

    read: ReadBack
    map: FittedMap
    apart: tuple[float, ...]

    def lines(self, path: Path) -> list[str]:
        """Return what there is to say of it, and what to write into a config so that it is used."""
        record, read = self.map.record, self.read
        unit = Calibrated(read.channel, read.unit, SHOWN.get(read.unit, read.unit), read.axes)
        swing = unit.said(np.ptp(read.bias(np.linspace(*record.domain, PLACES)), axis=0))
        return [
            *read.notes,
            f"{record.channel}: moves by {swing} {unit.shown} from {record.domain[0]:.4g} to {record.domain[1]:.4g} "
            f"°C; the map is within {unit.said(np.array(self.apart))} {unit.shown} of it",
            "in a config, as the vehicle uses it:",
            "filter:",
            f"  {record.channel}:",
            f"    calibration: {{kind: {record.kind}, path: {path}, outside: clamp}}",
        ]


def import_to_file(
    exporter: Exporter, path: Path, out: Path, *, kind: str = ORDERED, channel: str | None = None
) -> Imported:
    """Read a file of a target, and write what it has for one sensor as a map.

    Raises
    ------
    ConfigError
        If there is no calibration in use, none of that channel, or `out` is in the way.
    """
    found = _of_channel(exporter.read(path), channel, path)
    settings = _settings(kind, found.order)
    check_place(out, [path])
    T = np.linspace(*found.domain, PLACES)
    bias = found.bias(T)
    provenance = {
        "imported_from": path.name,
        "format": exporter.kind,
        "imported_at": datetime.now(UTC).isoformat(timespec="seconds"),
        "driftlab": __version__,
    }
    fitted = settings.fit(T, bias, provenance)
    # nothing is known of the samples that it once was fitted to
    unknown = {"residual": None, "samples": 0, "error": None}
    sensor = {"channel": found.channel, "unit": found.unit, "axes": found.axes}
    try:
        fitted = replace(fitted, record=fitted.record.model_copy(update={**unknown, **sensor}))
    except ValidationError as error:
        raise ConfigError(
            f"{path}: is of no sensor that can be named ({shown(error.errors()[0]['msg'], 120)}); mend its channel, "
            "unit and axes"
        ) from None
    save(fitted, out)
    apart = np.max(np.abs(fitted.bias(T) - bias), axis=0)
    return Imported(found, fitted, tuple(apart.tolist()))


def _of_channel(found: Sequence[ReadBack], channel: str | None, path: Path) -> ReadBack:
    wanted = found[0].channel if channel is None else channel
    for one in found:
        if one.channel == wanted:
            return one
    have = ", ".join(one.channel for one in found)
    raise ConfigError(f"--channel {wanted}: {path} has a thermal calibration of {have} alone; name that one")


def _settings(kind: str, order: int) -> ThermalMap:
    classes = registry().classes(ThermalMap)
    if kind not in classes:
        hint = nearest(kind, classes)
        raise ConfigError(f"--kind {kind}: " + (f"did you mean {hint}?" if hint else f"known: {', '.join(classes)}"))
    more = {"order": order} if kind == ORDERED else {}
    return classes[kind].model_validate({"kind": kind, **more})  # type: ignore[return-value]
