"""`driftlab fit-map`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from driftlab.commands.common import (
    Channel,
    ConfigFile,
    EnforceLimits,
    Json,
    check_limits,
    leave_by_limits,
    print_verdict,
    progress,
    terminal,
)
from driftlab.commands.session import load, print_json, say

if TYPE_CHECKING:
    from driftlab.jobs.fit_map import FitMapResult
    from driftlab.maps.kind_selection import KindComparison
    from driftlab.maps.network_size import Selection
    from driftlab.units import BiasUnit


Select = Annotated[
    bool, typer.Option("--select", help="Choose the number of neurons first (onnx_network), and show why.")
]
NeuronsMax = Annotated[
    int, typer.Option("--neurons-max", metavar="N", min=1, max=20, help="Largest number that --select tries.")
]
Compare = Annotated[
    bool, typer.Option("--compare", help="Choose among all installed kinds first, by what is left out of their fits.")
]

Kind = Annotated[str | None, typer.Option("--kind", help="Kind of map, instead of the config's; else spline.")]
Out = Annotated[
    Path | None, typer.Option("--out", metavar="MAP", help="Its file, instead of the config's; else CONFIG.map.json.")
]
Report = Annotated[
    Path | None,
    typer.Option(
        "--report", metavar="DIR", help="Folder for report.html and what --select shows; default: beside the map."
    ),
]


Input = Annotated[
    list[str] | None, typer.Option("--input", metavar="SOAK[::START:STOP]", help="A recording; may be repeated.")
]
FamilyFile = Annotated[
    Path | None,
    typer.Option("--family", metavar="FAMILY.json", help="Of a fleet: then a part of the range is soak enough."),
]
Lot = Annotated[str | None, typer.Option("--lot", help="Of the unit, where --family knows lots.")]


def fit_map(
    config: ConfigFile,
    input: Input = None,
    kind: Kind = None,
    out: Out = None,
    select: Select = False,
    neurons_max: NeuronsMax = 10,
    compare: Compare = False,
    channel: Channel = None,
    report: Report = None,
    family: FamilyFile = None,
    lot: Lot = None,
    enforce_limits: EnforceLimits = False,
    json: Json = False,
) -> None:
    """Fit a thermal map on a soak at rest, and say how good it is.

    Writes the map's file, and a page beside it.
    """
    from driftlab.jobs.fit_map import fit_map_to_file as job
    from driftlab.jobs.fit_map import with_family

    if with_family(family, lot, more=select or compare or enforce_limits or bool(kind or report)):
        _fit_with_family(config, input or [], family, lot or "", out, channel, as_json=json)
        return
    sizes = range(1, neurons_max + 1) if select else None
    loaded = load(config, channel=channel)
    check_limits(loaded, enforce_limits)
    named = any(settings.path for settings in loaded.tracked_maps())
    out = out if out or named else config.with_name(".".join(filter(None, (config.stem, channel, "map.json"))))
    with progress("fitting") as show:
        how: dict[str, Any] = {"kind": kind, "neurons": sizes, "compare": compare, "report": report}
        fitted = job(loaded, input or [], out, progress=show, read=[config], **how)
    if json:
        print_json(fitted.summary)
    else:
        _print(fitted, config, line=not named and not compare)
    leave_by_limits(fitted.kept, enforce_limits)


def _print(fitted: FitMapResult, config: Path, *, line: bool) -> None:
    if fitted.selection is not None:
        _print_selection(fitted.selection, fitted.unit)
    if fitted.comparison is not None:
        _print_comparison(fitted.comparison, fitted)
    _print_map(fitted)
    say(f"written to {', '.join(map(str, fitted.written))}\n")
    if line:
        _print_line(fitted, config)


def _fit_with_family(
    config: Path, recordings: list[str], family: Path, lot: str, out: Path | None, channel: str | None, *, as_json: bool
) -> None:

    from driftlab.jobs.family_map import fit_family_map

    loaded = load(config, channel=channel)
    out = out or config.with_name(".".join(filter(None, (config.stem, channel, "map.json"))))
    with progress("fitting") as show:
        found = fit_family_map(loaded, recordings, family, lot=lot, out=out, progress=show, read=[config])
    if as_json:
        print_json(found.summary)
        return
    for line in found.sentences():
        say(f"{line}\n")
    terminal().print(found.table())
    for line in found.faults.lines():
        say(f"note: {line}\n")
    say(f"written to {out}\n")


def _print_line(fitted: FitMapResult, config: Path) -> None:
    """Print what puts the map into a config that names none."""
    if fitted.sensor is not None:
        line = f"{{kind: {fitted.map.record.kind}, path: {os.path.relpath(fitted.written[0], config.parent)}}}"
        say(f"in the config: {fitted.sensor.section}.calibration: {line}\n")


def _print_selection(found: Selection, unit: BiasUnit) -> None:
    from driftlab.reports.map_selection import comparison, selection_table

    console = terminal()
    console.print(selection_table(found, unit))
    for line in comparison(found, unit):
        console.print(line, soft_wrap=True)


def _print_comparison(found: KindComparison, fitted: FitMapResult) -> None:
    from driftlab.reports.map_selection import comparison_table, config_line, failures, verdict

    axes, console = fitted.verdict.axes, terminal()
    console.print(comparison_table(found, fitted.unit, axes))
    for line in (*verdict(found, fitted.unit, axes), *failures(found)):
        console.print(line, soft_wrap=True)
    say(f"in the config: {config_line(found, fitted.written[0])}\n\n")


def _print_map(fitted: FitMapResult) -> None:
    record = fitted.map.record
    low, high = record.domain
    say(f"{record.kind}: fitted on {record.samples:,} samples from {low:.2f} to {high:.2f} °C\n")
    unit, factor, spec = fitted.unit.columns[0]
    white = [f"{v * factor:{spec}} {unit}" for v in fitted.verdict.soak.white]
    for axis, residual, alone in zip(fitted.verdict.axes, record.residual or (), white, strict=False):
        widths = zip(fitted.unit.columns, ("10", ""), strict=False)
        texts = [f"{residual * factor:{width}{spec}} {unit}" for (unit, factor, spec), width in widths]
        say(f"  residual {axis}: {'  '.join(texts)} (rms of the samples; white noise alone {alone})\n")
    for line in fitted.verdict.sentences(fitted.unit):
        say(f"{line}\n")
    print_verdict(fitted.kept, "limits: ")
    for row in fitted.limits:
        say(f"  {row.line(fitted.unit)}\n")
    for line in fitted.faults.lines():
        say(f"note: {line}\n")
