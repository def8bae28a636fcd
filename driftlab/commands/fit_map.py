"""`driftlab fit-map`."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from driftlab.commands.common import ConfigFile, Json, progress, terminal


def fit_map(
    config: ConfigFile,
    input: Annotated[
        list[str] | None, typer.Option("--input", metavar="SOAK[::START:STOP]", help="A recording; may be repeated.")
    ] = None,
    kind: Annotated[str | None, typer.Option("--kind", help="Kind of map, instead of the config's.")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="MAP", help="The map's file; default: the config's.")
    ] = None,
    select: Annotated[
        bool, typer.Option("--select", help="Choose the number of neurons first (onnx_network), and show why.")
    ] = False,
    neurons_max: Annotated[
        int, typer.Option("--neurons-max", metavar="N", min=1, max=20, help="Largest number that --select tries.")
    ] = 10,
    report: Annotated[
        Path | None, typer.Option("--report", metavar="DIR", help="Folder for select.json and select.svg.")
    ] = None,
    json: Json = False,
) -> None:
    """Fit a thermal map on a soak at rest, and write it to a file."""
    from driftlab.config import load_config, part_of
    from driftlab.files.map_file import check_place, check_report, save
    from driftlab.maps.fit import map_settings
    from fusion_core.errors import ConfigError
    from fusion_core.faults import Faults

    loaded, faults = load_config(config), Faults()
    path = out or map_settings(loaded, kind).path
    if path is None:
        raise ConfigError("--out is missing, and the config names no path for the map; give one of the two")
    if report is not None and not select:
        raise ConfigError("--report is of the selection, and --select is missing; give both, or neither")
    used = [config, *loaded.model_copy(update={"filter": None}).files()]
    check_place(path, [*used, *(part_of(name)[0] for name in input or [])])
    if select:
        check_report(_stem(path, report))
    sizes = range(1, neurons_max + 1) if select else None
    fitted, found = _fit(loaded, input or [], kind, sizes, faults)
    save(fitted, path)
    written = _write_selection(found, path, report) if found is not None else []
    if json:
        _print_json(fitted, found)
        return
    if found is not None:
        _print_selection(found)
    _print_map(fitted, faults)
    sys.stdout.write(f"written to {', '.join(map(str, [path, *written]))}\n")


def _fit(config: Any, recordings: list[str], kind: str | None, sizes: range | None, faults: Any) -> tuple[Any, Any]:
    """Return the map and, where there are sizes to select from, the selection."""
    from driftlab.maps.fit import fit_map
    from driftlab.maps.network_size import fit_selected

    with progress("fitting") as show:
        if sizes is None:
            return fit_map(config, recordings, kind, faults, show), None
        return fit_selected(config, recordings, kind, sizes, faults, show)


def _stem(path: Path, report: Path | None) -> Path:
    """Return what the files of the selection are called: in the folder, or beside the map under its name."""
    return path.with_name(f"{path.stem}.select") if report is None else report / "select"


def _write_selection(found: Any, path: Path, report: Path | None) -> list[Path]:
    """Write select.json and select.svg."""
    from driftlab.files.estimates import write_json
    from driftlab.reports.network_size import as_json, figure
    from driftlab.reports.plots import svg
    from fusion_core.errors import Unwritable

    stem = _stem(path, report)
    names = [stem.with_name(stem.name + end) for end in (".json", ".svg")]
    try:
        write_json(names[0], as_json(found))
        names[1].write_text(svg(figure(found)), encoding="utf-8")
    except OSError as error:
        raise Unwritable(f"{names[0]}: cannot be written ({error.strerror}); name a folder that can be") from None
    return names


def _print_json(fitted: Any, found: Any) -> None:
    import json

    from driftlab.files.estimates import plain
    from driftlab.reports.network_size import as_json

    content = fitted.record.model_dump(mode="json")
    if found is not None:
        content["selection"] = plain(as_json(found))
    sys.stdout.write(json.dumps(content, indent=2) + "\n")


def _print_selection(found: Any) -> None:
    from driftlab.reports.network_size import comparison, table

    console = terminal()
    console.print(table(found))
    for line in comparison(found):
        console.print(line, soft_wrap=True)


def _print_map(fitted: Any, faults: Any) -> None:
    from driftlab.judging.summary import DEG_H

    record = fitted.record
    low, high = record.domain
    sys.stdout.write(f"{record.kind}: fitted on {record.samples:,} samples from {low:.2f} to {high:.2f} degC\n")
    for axis, residual in zip("xyz", record.residual or (), strict=False):
        sys.stdout.write(
            f"  residual {axis}: {residual * DEG_H:10.2f} deg/h  {residual:.3e} rad/s (rms of the samples)\n"
        )
    from driftlab.maps.fit import map_lines

    for line in map_lines(fitted)[1:]:
        sys.stdout.write(f"  {line.partition(': ')[2]}\n")
    for line in faults.lines():
        sys.stdout.write(f"note: {line}\n")
