"""The command line: thin commands over the application, and errors in one sentence.

Exit status: 0 done, 1 the data or the run failed, 2 usage or config.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

app = typer.Typer(
    name="driftlab",
    help="Thermal calibration and zero-velocity filtering of inertial units.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

ConfigFile = Annotated[Path, typer.Argument(metavar="CONFIG", help="The config, a YAML file.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs instead of text.")]


@app.command()
def run(
    config: ConfigFile,
    input: Annotated[str | None, typer.Option("--input", metavar="PATH[::START:STOP]", help="The recording.")] = None,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for the results.")] = Path("driftlab_out"),
    json: Json = False,
) -> None:
    """Run the filter on a recording: estimates.h5, summary.json and report.html."""
    from driftlab.config import load_config
    from driftlab.filtering import run_to_folder
    from driftlab.summary import remarks, yardstick_table

    loaded = load_config(config, input)
    with _progress("filtering") as progress:
        result = run_to_folder(loaded, out, title=f"{config.stem}: {_title(loaded)}", progress=progress)
    if json:
        sys.stdout.write((out / "summary.json").read_text(encoding="utf-8"))
        return
    from rich.console import Console

    console = Console()
    console.print(yardstick_table({config.stem: result.yardsticks}, f"{_title(loaded)}"))
    for line in remarks(result.summary):
        console.print(f"note: {line}", highlight=False)
    console.print(f"written to {out}/: estimates.h5, summary.json, report.html", highlight=False)


@app.command("fit-map")
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
    with _progress("fitting") as progress:
        fitted = fit_map(loaded, input or [], kind, faults, progress)
    path.parent.mkdir(parents=True, exist_ok=True)
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


@app.command()
def plugins(json: Json = False) -> None:
    """List every plugin with its distribution, version and state."""
    import json as codec

    from fusion_core.registry import registry

    entries = sorted(registry().entries, key=lambda e: (e.error is not None, e.family, e.kind))
    if json:
        fields = ("family", "kind", "distribution", "version", "module", "error")
        sys.stdout.write(codec.dumps([{name: getattr(e, name) for name in fields} for e in entries], indent=2) + "\n")
        return
    from rich.console import Console
    from rich.table import Table

    table = Table("family", "kind", "distribution", "version", "state")
    for e in entries:
        table.add_row(e.family, e.kind, e.distribution, e.version, "ok" if e.error is None else f"broken: {e.error}")
    Console().print(table)


@app.command()
def schema() -> None:
    """Print the JSON schema of the config, with every installed plugin in it."""
    import json

    from driftlab.config import Config

    sys.stdout.write(json.dumps(Config.model_json_schema(), indent=2) + "\n")


@app.command()
def check(
    config: ConfigFile,
    input: Annotated[str | None, typer.Option("--input", metavar="PATH[::START:STOP]", help="The recording.")] = None,
    json: Json = False,
) -> None:
    """Check a config, its maps and the head of its recording; print the config as it is understood."""
    from driftlab.config import load_config
    from driftlab.intake import head

    loaded = load_config(config, input)
    for settings in loaded.maps():
        if settings.path is not None:
            settings.load()
    channels = head(loaded)
    if json:
        sys.stdout.write(loaded.model_dump_json(indent=2, exclude_none=True) + "\n")
        return
    sys.stdout.write(loaded.as_yaml())
    for line in channels:
        sys.stdout.write(f"# {line}\n")


def _title(config: Any) -> str:
    return config.source.name if config.source is not None else ""


@contextmanager
def _progress(what: str) -> Iterator[Callable[[float, int], None]]:
    """Show progress on standard error from the first second on, where a person is looking."""
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    console = Console(stderr=True)
    bar = Progress(
        SpinnerColumn(), TextColumn("{task.description}"), TimeElapsedColumn(), console=console, transient=True
    )
    task = bar.add_task(what, total=None)
    begun = time.monotonic()

    def report(t: float, count: int) -> None:
        if console.is_terminal and time.monotonic() - begun > 1.0:
            bar.start()
        bar.update(task, description=f"{what}: t = {t:,.0f} s, {count:,} samples")

    try:
        yield report
    finally:
        if bar.live.is_started:
            bar.stop()


def main() -> None:
    """Run the command line; errors that a user can cause end in one message and no traceback."""
    from fusion_core.errors import ConfigError, FusionError, UnitError

    try:
        app()
    except (ConfigError, UnitError) as error:
        sys.stderr.write(f"driftlab: {error}\n")
        sys.exit(2)
    except FusionError as error:
        sys.stderr.write(f"driftlab: {error}\n")
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except KeyboardInterrupt:
        sys.stderr.write("driftlab: interrupted; what was written so far is in the folder with the suffix .partial\n")
        sys.exit(130)
