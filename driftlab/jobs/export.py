"""`driftlab export`: a fitted map in the form of another program, and what it loses on the way."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import load_config
from driftlab.files.folders import check_writable
from driftlab.files.hdf5_stream import reason
from driftlab.jobs.estimates import plain
from fusion_core.contracts import Exporter, FittedMap, ThermalMap
from fusion_core.errors import ConfigError, FusionError, MapError, Unwritable
from fusion_core.host.config import Document, validate
from fusion_core.host.participants import participants
from fusion_core.host.registry import registry
from fusion_core.settings import nearest

CONFIGS = (".yaml", ".yml")


def exporter_of(kind: str, settings: Mapping[str, str]) -> Exporter:
    """Return the exporter of a kind with settings as a user writes them; raises ConfigError."""
    classes = registry().classes(Exporter)
    if kind not in classes:
        hint = nearest(kind, classes)
        raise ConfigError(f"export {kind}: " + (f"did you mean {hint}?" if hint else f"known: {', '.join(classes)}"))
    found: Any = validate(classes[kind], Document(Path("--set"), {"kind": kind, **settings}))
    return found  # type: ignore[no-any-return]


def read_map(path: Path) -> FittedMap:
    """Read the map of a file, of whatever installed kind it is, or the first map that a config names.

    Raises
    ------
    MapError, ConfigError
        If no kind of map can read it, or the config names none.
    """
    if path.suffix in CONFIGS:
        maps = load_config(path).maps()
        if not maps:
            raise ConfigError(f"{path}: names no thermal map; name one with its path, or give the map's file")
        return maps[0].load()
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


def export(exporter: Exporter, fitted: FittedMap, path: Path, *, force: bool, read: Collection[Path]) -> dict[str, Any]:
    """Write the map to `path` and what it loses to `PATH.loss.json`, whole or not at all; return the latter's content.

    Raises
    ------
    ConfigError
        If one of the two is there already and `force` is not given, or is read here.
    Unwritable
        If the disk is full, or the like.
    """
    beside = path.with_name(f"{path.name}.loss.json")
    for place in (path, beside):
        if any(os.path.realpath(place) == os.path.realpath(other) for other in read):
            raise ConfigError(f"--out {path}: {place} is read here, and would be lost; name another file")
        if place.is_dir() or (place.exists() and not force):
            raise ConfigError(f"--out {path}: {place} exists; name another file, or give --force to replace it")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        check_writable(path.parent)
        with tempfile.TemporaryDirectory(prefix=".driftlab-", dir=path.parent) as folder:
            written = Path(folder) / path.name
            loss = exporter.export(fitted, written)
            content = plain(_content(exporter, fitted, loss.largest, loss.left_out))
            text = Path(folder) / beside.name
            text.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
            if not written.is_file():
                raise ConfigError(f"export {exporter.kind}: wrote no file; mend or remove the plugin")
            os.replace(text, beside)
            os.replace(written, path)
    except OSError as error:
        raise Unwritable(
            f"--out {path}: cannot be written ({reason(error)}); make room, or name another file"
        ) from None
    return dict(content)


def _content(exporter: Exporter, fitted: FittedMap, largest: Any, left_out: tuple[str, ...]) -> dict[str, Any]:
    record = fitted.record
    return {
        "schema": 1,
        "driftlab": __version__,
        "plugins": participants(exporter),
        "map": {"kind": record.kind, "channel": record.channel, "domain": record.domain},
        "largest_error": {"value": largest, "unit": record.unit},
        "left_out": list(left_out),
    }
