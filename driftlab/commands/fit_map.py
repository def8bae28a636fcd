"""`driftlab fit-map`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from driftlab.commands.common import ConfigFile, Json, progress


def fit_map(
    config: ConfigFile,
    input: Annotated[
        list[str] | None, typer.Option("--input", metavar="SOAK[::START:STOP]", help="A recording; may be repeated.")
    ] = None,
    kind: Annotated[str | None, typer.Option("--kind", help="Kind of map, instead of the config's.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="MAP", help="The map's file; default: the config's.")
    ] = None,
    json: Json = False,
) -> None:
    """Fit a thermal map on a soak at rest, and write it to a file."""
    from driftlab.config import load_config
    from driftlab.fit import fit_map, map_settings
    from fusion_core.errors import ConfigError
    from fusion_core.faults import Faults

    loaded, faults = load_config(config), Faults()
    path = out or map_settings(loaded, kind).path
    if path is None:
        raise ConfigError("--out is missing, and the config names no path for the map; give one of the two")
    with progress("fitting") as report:
        fitted = fit_map(loaded, input or [], kind, faults, report)
    fitted.save(path)
    _print_map(fitted, path, faults, json)


def _print_map(fitted: Any, path: Path, faults: Any, json: bool) -> None:
    from driftlab.summary import DEG_H

    record = fitted.record
    if json:
        sys.stdout.write(record.model_dump_json(indent=2) + "\n")
        return
    low, high = record.domain
    sys.stdout.write(f"{record.kind}: fitted on {record.samples:,} samples from {low:.2f} to {high:.2f} degC\n")
    for axis, residual in zip("xyz", record.residual, strict=False):
        sys.stdout.write(
            f"  residual {axis}: {residual * DEG_H:10.2f} deg/h  {residual:.3e} rad/s (rms of the samples)\n"
        )
    for line in faults.lines():
        sys.stdout.write(f"note: {line}\n")
    sys.stdout.write(f"written to {path}\n")
