"""`driftlab init`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from driftlab.commands.common import Json, pairs, progress
from driftlab.commands.session import print_json, say


def init(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording, or the bytes that a device sent.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="CONFIG", help="The config to write; by default FILE's name .yaml.")
    ] = None,
    unit: Annotated[
        list[str] | None,
        typer.Option("--unit", metavar="CHANNEL=UNIT", help="A unit that you know, e.g. gyro=deg/s; repeatable."),
    ] = None,
    json: Json = False,
) -> None:
    """Write a first config of a file, with every guess marked.

    Which source reads it, its channels, units and noise. FILE is a log of PX4 (.ulg) or ArduPilot (.bin), a ROS bag,
    CSV (.csv.gz too), HDF5, NetCDF, MATLAB's .mat, Parquet, or the bytes of a device that an installed framing knows.
    What cannot be guessed is asked for.
    """
    from driftlab.jobs.init import init as job

    with progress("reading") as report:
        report(file.name)
        done = job(file, out, pairs("--unit", unit, "CHANNEL=UNIT", "gyro=deg/s"))
    if json:
        content = {"config": str(done.path), "text": done.text, "to_fill_in": list(done.asked)}
        print_json(content)
        return
    say(done.text)
    for sentence in done.asked:
        say(f"fill in: {sentence}\n")
    say(f"written to {done.path}; look at what is guessed, then: driftlab check {done.path}\n")
