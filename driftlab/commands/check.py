"""Configs as they are understood, and plugins: `driftlab check`, `driftlab plugins`, and `driftlab schema`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import typer

from driftlab.commands.console import print_json, say, say_lines, terminal
from driftlab.commands.inputs import ConfigLike, DataLike, Units, config_with
from driftlab.config import Config, maps_of
from driftlab.filtering.setup import FORCE, check_channels, loaded_map, prior
from driftlab.recordings.screening import head
from fusion_core.chunk import Chunk
from fusion_core.contracts import FittedMap, MeasurementModel, Sensor, Site
from fusion_core.errors import ConfigError
from fusion_core.host.config import quantities
from fusion_core.host.registry import Entry, registry
from fusion_core.host.schema import config_schema
from fusion_core.units import Quantity

ENOUGH = 8  # rows that show what a sensor reads at rest
TURNING, ROWS = np.deg2rad(1.0), 50  # rad/s, in means of so many rows: a slower unit does not turn


@dataclass(frozen=True)
class CheckResult:
    """A config that can be used: every quantity with its place, and what is to be known, a sentence each."""

    config: Config
    quantities: dict[str, Quantity]
    remarks: tuple[str, ...]


def check(config: ConfigLike, data: DataLike = None, *, units: Units | None = None) -> CheckResult:
    """Check a config, its maps and the head of its recording.

    Prints the config as it is understood.

    Parameters
    ----------
    config, data, units : as those of `run`

    Returns
    -------
    CheckResult
        `config` as it is understood, `quantities` by their place, and `remarks`.

    Raises
    ------
    DataError, ConfigError
        If they cannot be used, or not together.
    """
    understood = config_with(config, data, units)
    if understood.filter is not None:
        prior(understood.filter)  # says what is wrong with deviations
    first, lines = head(understood)
    if first is not None and understood.filter is not None:
        check_channels(understood.filter, first)
    remarks = [*_map_remarks(understood), *lines]
    if first is not None and understood.filter is not None:
        remarks += [*_turns(understood.filter.tracked, first), *_off(understood.filter, understood.site, first)]
    if understood.source is None:
        remarks.append("source: is missing, so no recording can be read; `driftlab init FILE` writes that of a file")
    return CheckResult(understood, dict(quantities(understood)), tuple(remarks))


def _off(model: MeasurementModel, site: Site, first: Chunk) -> list[str]:
    """Return the notes on the first rows, where they are at rest: readings of sensors without a map that are off."""
    model = model.only(first.channels.keys())
    window = first.having(tau=first.each_dt)  # no epochs: loading the compiler would take longer
    window = window.part(1, int(np.searchsorted(window.t, window.t[0] + model.align)))
    if len(window) < ENOUGH or not model.still(window):
        return []
    bare = {sensor.channel for sensor in model.sensors if not maps_of(sensor)}
    return [f"note: {text}" for text in model.aligned(window, site).off if text.partition(":")[0] in bare]


def _map_remarks(config: Config) -> list[str]:
    from driftlab.maps.fit import map_lines

    remarks = []
    for sensor in () if config.filter is None else reversed(config.filter.sensors):
        for settings in maps_of(sensor):
            if settings.path is None:
                remarks.append(f"map {settings.kind}: has no path; `run` needs one, `fit-map` and `explain` do not")
            elif not settings.path.exists():
                remarks.append(f"map {settings.path}: is not there yet; fit it with `driftlab fit-map`")
            else:
                remarks += map_lines(loaded_map(settings, sensor), sensor)
    fitted = [] if config.filter is None else _fitted_maps(config.filter.tracked)
    if config.stimulus is not None and fitted and all(one.record.matrix is None for one in fitted):
        remarks.append(
            "stimulus: lies unused, since the map holds the bias alone; fit the rest with `driftlab fit-map --terms "
            "bias,scale,misalignment`"
        )
    return remarks


def _fitted_maps(sensor: Sensor) -> list[FittedMap]:
    """Return the maps of a sensor whose files are there."""
    return [loaded_map(m, sensor) for m in maps_of(sensor) if m.path is not None and m.path.exists()]


def _turns(sensor: Sensor, chunk: Chunk) -> Iterator[str]:
    """Yield a remark where a map's scale factor and misalignment are of a gyro that does not turn."""
    fitted = next((one for one in _fitted_maps(sensor) if one.record.matrix is not None), None)
    if fitted is None or sensor.unit != "rad/s" or not {sensor.channel, "temperature"} <= set(chunk.channels):
        return
    force = chunk[FORCE] if FORCE in chunk.channels else None
    omega = fitted.corrected(chunk[sensor.channel], np.clip(chunk["temperature"], *fitted.domain), chunk.t, force)
    parts = np.array_split(omega, max(len(omega) // ROWS, 1))
    rate = max(float(np.linalg.norm(part.mean(axis=0))) for part in parts)
    if rate < TURNING:
        yield (
            f"{sensor.channel}: turns by {np.rad2deg(rate):.2g} deg/s at most in its first {len(chunk):,} rows, so "
            "nothing of scale factor and misalignment is seen there; a turn shows whether they are right"
        )


def content_of(result: CheckResult, given: Mapping[str, Any]) -> Any:
    """Return the config as it is understood, with its quantities."""
    values = {at: {"text": q.text, "value": float(q), "unit": _unit(q)} for at, q in result.quantities.items()}
    return {**result.config.model_dump(mode="json", exclude_none=True), "quantities": values}


def show(result: CheckResult, given: Mapping[str, Any]) -> None:
    """Print the config as YAML, with its quantities and the remarks as comments."""
    say(result.config.as_yaml())
    for at, quantity in result.quantities.items():
        say(f"# {at}: {quantity.text} = {float(quantity):.6g} {_unit(quantity)}\n")
    say_lines(result.remarks, "# ")


def _unit(quantity: Quantity) -> str:
    return (quantity.unit or "").replace("delta_degC", "K")


def plugins(*, family: str | None = None, json: bool = False, check: bool = False) -> None:
    """List every plugin with its distribution, version and state.

    Parameters
    ----------
    family : str, optional
        Only those of a family, as bias_models.
    json : bool
        Print JSON for programs instead of text.
    check : bool
        Hold each to the laws of its family.
    """
    from driftlab.reports.tables import TextTable

    entries = [entry for entry in registry().entries if family in (None, entry.family)]
    if not entries:
        known = ", ".join(sorted({entry.family for entry in registry().entries}))
        raise ConfigError(f"--family {family}: is no family of plugins; they are {known}")
    if check:
        _print_laws(entries, json)
        return
    entries.sort(key=lambda e: (e.error is not None, e.family, e.kind))
    if json:
        fields = ("family", "kind", "distribution", "version", "module", "error")
        print_json([{name: getattr(e, name) for name in fields} for e in entries])
        return
    states = ("ok" if e.error is None else f"broken: {e.error}" for e in entries)
    rows = [[e.family, e.kind, e.distribution, e.version, state] for e, state in zip(entries, states, strict=True)]
    terminal().print(TextTable(["family", "kind", "distribution", "version", "state"], rows, texts=5))


def schema() -> None:
    """Print the JSON schema of the config.

    Every installed plugin is in it.
    """
    print_json(config_schema(Config.model_json_schema()))


def law_checks(entry: Entry) -> list[tuple[str, str | None]]:
    """Return every law of a plugin that gives examples, and why it does not hold, None where it does."""
    from fusion_core.testing import laws

    if entry.plugin is None:  # broken, or no class: a product is a file
        return [] if entry.error is None else [("loads", entry.error)]
    try:
        examples = laws(entry.plugin)
    except Exception as error:
        return [("gives examples", f"{type(error).__name__}: {error}")]
    names = (str(law).partition(": ")[2] if law.of == entry.kind else str(law) for law in examples)
    return [(name, law.broken()) for name, law in zip(names, examples, strict=True)]


def _print_laws(entries: list[Entry], json: bool) -> None:
    """Print which laws each plugin keeps, and below the table each that one breaks; exit 1 where there is any."""
    from driftlab.reports.tables import TextTable

    checks = [(entry, law_checks(entry)) for entry in sorted(entries, key=lambda e: (e.family, e.kind))]
    broken = [(entry.kind, law, error) for entry, results in checks for law, error in results if error is not None]
    if json:
        keys = ("family", "kind", "law", "error")
        print_json([dict(zip(keys, (e.family, e.kind, *one), strict=True)) for e, results in checks for one in results])
    else:
        rows = []
        for entry, results in checks:
            held = sum(error is None for _, error in results)
            none = "none: it gives no examples" if entry.plugin is not None else "none: it is a file"
            rows.append([entry.family, entry.kind, f"{held} of {len(results)}" if results else none])
        terminal().print(TextTable(["family", "kind", "laws kept"], rows, texts=3))
        say_lines(map(": ".join, broken))
    if broken:
        raise typer.Exit(1)
