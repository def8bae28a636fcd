"""A line of 200 gyros, from its soaks to new units that need 40 % of one: results beside the planted faults.

python examples/06_family/run.py
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl
from rich.console import Console
from rich.table import Table
from rich.text import Text

sys.path.insert(0, str(Path(__file__).parent.parent))
sys.path.insert(0, str(Path(__file__).parent))
import planted
from family import DEG_H, HIGH, LOW, Unit
from pictures import BLUE, GREY, RED, picture, save
from planted import Line

import driftlab
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.host.registry import registry

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
OUT = ROOT / "demo_out" / "family"
RANGE = np.linspace(LOW, HIGH, 161)  # degC


@dataclass(frozen=True)
class Found:
    """Results of the fleet, for comparison with the planted faults.

    Attributes
    ----------
    odd : dict of str to str
        Why, by unit.
    told : dict
        Content of `fleet.json`.
    errors : dict of str to (units,) array
        Rms over range and axes of the map of each new unit, deg/h, by where the map is from.
    held : float
        Share of temperatures and axes at which the error is within two deviations of the family's map.
    day : dict
        Content of `fleet.json` of the later day.
    """

    odd: dict[str, str]
    told: Mapping[str, Any]
    errors: dict[str, np.ndarray]
    held: float
    day: Mapping[str, Any]


def prove(line: Line, out: Path, console: Console) -> Found:
    """Run the fleet, then the new units under its family, and compare with what was planted."""
    console.print(f"1. driftlab fleet: {len(line.units)} units, a soak of {60 * line.hours:.0f} min each")
    told = _fleet(line.folder / "family.csv", out / "fleet", console)
    console.print(
        f"2. {len(line.fresh)} new units, {60 * line.short:.0f} min over {100 * planted.PART:.0f} % of the range"
    )
    known = out / "fleet" / "family.json"
    _fleet(line.folder / "new.csv", out / "short", console, family=known)
    _fleet(line.folder / "whole.csv", out / "whole", console)
    console.print(f"3. a later day, {len(line.later)} units against the limits of the first {len(line.units)}")
    day = _fleet(line.folder / "later.csv", out / "later", console, family=known)
    table = pl.read_parquet(out / "fleet" / "units.parquet")
    why = pl.coalesce("odd_why", pl.concat_str(pl.lit("failed: "), "error"))
    rows = table.filter(pl.col("odd") | (pl.col("state") == "failed")).unique("unit").select("unit", why).rows()
    errors, held = _errors(line, out)
    found = Found(dict(rows), told, errors, held, day)
    for made in (of_the_line(line, found), of_the_soaks(line, found), of_the_day(line, found)):
        console.print()
        console.print(made)
    return found


def _fleet(manifest: Path, out: Path, console: Console, family: Path | None = None) -> Mapping[str, Any]:
    """Do what `driftlab fleet family.yaml --units MANIFEST --out OUT` does."""
    begun = time.monotonic()
    result = driftlab.fleet(HERE / "family.yaml", manifest, out, family=family)
    for said in result.lines():
        console.print(f"   {said}", style="dim")
    console.print(f"   {time.monotonic() - begun:.0f} s")
    return result.summary


def _errors(line: Line, out: Path) -> tuple[dict[str, np.ndarray], float]:
    """Return the errors of the maps of the new units over the whole range, deg/h, and how often the band holds."""
    own, _ = _of(line, out / "short", "map")
    errors = {"own short soak": own}
    errors["short soak and family"], z = _of(line, out / "short", "family_map")
    errors["whole soak"], _ = _of(line, out / "whole", "map")
    return errors, float(np.mean(np.abs(z) < 2))


def _of(line: Line, fleet: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return the rms of the error of the new units' maps in deg/h, and all errors in deviations."""
    rms, z = [], []
    for unit in line.fresh:
        (path,) = (fleet / "units" / unit.name).glob(f"{name}.*")
        fitted = _load(path)
        error = fitted.bias(RANGE) - truth(unit, RANGE)
        rms.append(np.sqrt(np.mean(error**2)) / DEG_H)
        if fitted.record.error is not None:
            z.append(error / fitted.sigma(RANGE))
    return np.array(rms), np.array(z)


def truth(unit: Unit, T: np.ndarray) -> np.ndarray:
    """Return the bias of a unit (N, 3), midway between warming and cooling, rad/s."""
    return unit.bias(T)


def _load(path: Path) -> FittedMap:
    """Read a map; beyond what it has seen it goes straight on."""
    kind = json.loads(path.read_text())["record"]["kind"]
    settings = registry().classes(ThermalMap)[kind].model_validate({"kind": kind, "path": path, "outside": "tangent"})
    assert isinstance(settings, ThermalMap)
    return settings.load()


def of_the_line(line: Line, found: Found) -> Table:
    """Return the planted faults beside the fleet's results."""
    made = Table(title="the line", title_justify="left", show_lines=True)
    for heading in ("planted", "found"):
        made.add_column(heading)
    named, planted_ones = set(found.odd), set(line.odd)
    hits, missed, false = named & planted_ones, planted_ones - named, named - planted_ones
    said = [f"{len(hits)} of {len(planted_ones)}"]
    said += [f"missed: {unit} ({line.odd[unit]})" for unit in sorted(missed)]
    said += [f"not planted: {unit}: {found.odd[unit]}" for unit in sorted(false)]
    made.add_row(Text(f"{len(planted_ones)} odd units of {len(line.units)}"), Text("\n".join(said)))
    first = next(unit for unit in line.units if unit.lot == line.shifted)
    about = f"lot {line.shifted}, from unit {first.name} on: x shifted by {planted.SHIFT:g} deg/h"
    made.add_row(Text(about), Text("\n".join(_lines(found, f"lot {line.shifted}")) or "nothing is said of it"))
    effect = f"in every unit a hysteresis of {planted.PLAY:g} deg/h a K, a third of what a unit shows alone"
    made.add_row(Text(effect), Text("\n".join(_lines(found, "hysteresis")) or "nothing is said of it"))
    return made


def _lines(found: Found, about: str) -> list[str]:
    """Return the fleet's sentences about a subject."""
    told = found.told["family"]
    return [line for line in [*told["lines"], *told.get("line", [])] if about.lower() in line.lower()]


def of_the_day(line: Line, found: Found) -> Table:
    """Return the planted faults of the later day beside what frozen limits show."""
    made = Table(title="a later day", title_justify="left", show_lines=True)
    for heading in ("planted", "found"):
        made.add_column(heading)
    judged = found.day["family"]
    half = next((unit.name for unit in line.later if unit.lot == planted.LATER), "none")
    for unit in (unit for unit in line.later if unit.odd):
        why = [*judged["odd"].get(unit.name, []), *judged["alarms"].get(unit.name, [])]
        made.add_row(Text(f"{unit.name}: {unit.odd}"), Text(why[0] if why else "nothing is said of it"))
    for about, figure in (
        (f"from {half} on x shifted by {planted.SHIFT:g} deg/h", "x level"),
        (f"noise of y grows by {100 * planted.TREND:g} % a unit", "y noise"),
    ):
        said = [text for text in judged["line"] if figure in text]
        said += [f"{name}: {text}" for name, why in judged["alarms"].items() for text in why if text.startswith(figure)]
        made.add_row(Text(about), Text("\n".join(said[:3]) or "nothing is said of it"))
    return made


def of_the_soaks(line: Line, found: Found) -> Table:
    """Return the errors of the new units' maps, and their time in the chamber."""
    title = f"{len(line.fresh)} new units: error of the map over {LOW:g} to {HIGH:g} °C, deg/h rms"
    made = Table(title=title, title_justify="left")
    made.add_column("map from")
    for heading in ("chamber a unit", "median", "worst"):
        made.add_column(heading, justify="right")
    for name, rms in found.errors.items():
        minutes = 60 * (line.hours if name.startswith("whole") else line.short)
        made.add_row(name, f"{minutes:.0f} min", f"{np.median(rms):.3g}", f"{np.max(rms):.3g}")
    made.caption = f"the band of two sigma of the short soak and family holds {100 * found.held:.0f} % (95 % it should)"
    made.caption_justify = "left"
    return made


def draw(line: Line, found: Found, path: Path) -> None:
    """Draw the error of each new unit's map, by where the map is from."""
    alone, known, whole = (f"{np.median(rms):.2g}" for rms in found.errors.values())
    title = (
        f"{100 * planted.PART:.0f} % of a soak: {alone} deg/h of map error alone, {known} with {len(line.units)} units "
        f"before it ({whole} after a whole soak)"
    )
    figure, (panel,) = picture(title, columns=1, height=2.8)
    for k, (rms, colour) in enumerate(zip(found.errors.values(), (RED, BLUE, GREY), strict=True)):
        panel.semilogx(rms, np.full(len(rms), k) + np.linspace(-0.2, 0.2, len(rms)), "o", ms=5, color=colour)
        panel.plot([np.median(rms)] * 2, [k - 0.35, k + 0.35], color=colour, lw=2)
    panel.set_yticks(range(len(found.errors)), list(found.errors))
    panel.invert_yaxis()
    panel.xaxis.set_major_formatter("{x:g}")
    panel.set_xlabel(
        f"error of the map of {len(line.fresh)} new units, {LOW:g} to {HIGH:g} °C, rms [deg/h]; bars: medians"
    )
    save(figure, path)


def main() -> None:
    """Make the line, run it, and print the results."""
    begun = time.monotonic()
    shutil.rmtree(OUT, ignore_errors=True)
    console = Console(soft_wrap=True, highlight=False)
    line = planted.make(OUT / "line")
    draw(line, prove(line, OUT, console), OUT / "family.png")
    console.print(
        f"\n{time.monotonic() - begun:.0f} s; everything is in {OUT.relative_to(ROOT)}/: look at fleet/report.html"
    )


if __name__ == "__main__":
    main()
