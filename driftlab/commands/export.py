"""`driftlab export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import Json, pairs, progress
from driftlab.commands.session import print_json, say


def export(
    kind: Annotated[str, typer.Argument(metavar="KIND", help="The form: see above.")],
    map: Annotated[Path, typer.Argument(metavar="MAP|CONFIG", help="A map's file, or a config that names one.")],
    out: Annotated[Path, typer.Option("--out", metavar="PATH", help="The file to write; of c, the folder.")],
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="A setting of the form; may be repeated.")
    ] = None,
    run: Annotated[
        Path | None, typer.Option("--run", metavar="DIR", help="A run's folder: noise as its innovations say.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file, and what stands beside it.")] = False,
    json: Json = False,
) -> None:
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
    """  # noqa: D301 - what click takes for a paragraph to be left as it is
    from json import loads

    from driftlab.jobs.export import LOSS, export, exporter_of, key_of, read_export

    exporter = exporter_of(kind, pairs("--set", settings, "KEY=VALUE", "'step=0.5 K'"))
    with progress("exporting"):
        what = read_export(map)
        if run is not None:
            from driftlab.jobs.inflation import with_inflation

            what = with_inflation(what, run)
        loss = export(exporter, what, out, force=force, read=[map])
    beside = (out if exporter.folder else out.parent) / LOSS
    if json:
        own = loads(beside.read_text(encoding="utf-8"))["exports"][key_of(out)]
        print_json(own)
        return
    for line in loss.lines():
        say(f"{line}\n")
    say(f"written to {out}, {beside}\n")
