"""`driftlab import`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import Json, pairs, progress
from driftlab.commands.session import say
from fusion_core.escaping import json_of


def import_map(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="The form of the file: see above.")],
    file: Annotated[
        Path, typer.Argument(metavar="FILE", help="The vehicle's parameters, as a ground station saves them.")
    ],
    out: Annotated[Path, typer.Option("--out", metavar="MAP", help="The map's file to write.")],
    map_kind: Annotated[str, typer.Option("--kind", help="Kind of map.")] = "polynomial",
    channel: Annotated[
        str | None,
        typer.Option(
            "--channel", metavar="CHANNEL", help="Sensor: gyro, accel or baro; default: the first that is corrected."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting of the form; may be repeated.")
    ] = None,
    json: Json = False,
) -> None:
    """Write the thermal calibration that a vehicle has today as a map.

    `driftlab compare` then tells what a new one buys.

    \b
    px4        TC_G, TC_A, TC_B of a .params file, or NAME VALUE a line;
               --set instance=N or device_id=N says which sensor
    ardupilot  INS_TCAL of a .parm file; --set imu=1 to 5
    mat        a .mat file of the form that `driftlab export mat` writes
    """  # noqa: D301 - what click takes for a paragraph to be left as it is
    from driftlab.jobs.export import exporter_of
    from driftlab.jobs.import_calibration import import_to_file

    with progress("importing"):
        exporter = exporter_of(kind, pairs("--set", settings, "KEY=VALUE", "'step=0.5 K'"))
        found = import_to_file(exporter, file, out, kind=map_kind, channel=channel)
    if json:
        sys.stdout.write(json_of(found.map.record.model_dump_json(indent=2)) + "\n")
        return
    for line in found.lines(out):
        say(f"{line}\n")
    say(f"written to {out}\n")
