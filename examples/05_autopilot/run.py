"""From the logs of an autopilot to its parameters, and what each compensation leaves on a day that none has seen.

The CATS recording plays the part of the sensor: placements 1 and 2 are two soaks, written as a vehicle would have
logged them (DataFlash and ULog), placement 3 is flown. Read back through the sources, fitted, exported, and judged by
the firmware's own arithmetic.

    python examples/05_autopilot/run.py
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml
from rich.console import Console
from rich.table import Table
from rich.text import Text

sys.path.insert(0, str(Path(__file__).parent.parent))
import cats
import ways
from coasts import DEG_H
from days import DEVICE, HORIZONS, Errors, Placement, of_filter, of_firmware
from pictures import BLUE, GREY, picture, save

from driftlab.commands.explain import explain
from driftlab.commands.export import export
from driftlab.commands.fit_map import FitMapResult, fit_map
from driftlab.commands.run import run
from driftlab.config import Config, load_config

HERE = Path(__file__).parent
Span = tuple[float, float | None]
OUT = cats.ROOT / "demo_out" / "autopilot"
LOGS = {"ardupilot": ".bin", "px4": ".ulg"}


def fitted(which: str, folder: Path) -> tuple[FitMapResult, Config]:
    """Return the map of the soak logs of an autopilot, of the kind that predicts best, and the config that names it."""
    logs = [str(folder / f"soak{k}{LOGS[which]}") for k in (1, 2)]
    found = fit_map(load_config(HERE / f"{which}.yaml"), logs, compare=True)
    path = folder / f"{which}.json"
    found.save(path)
    settings = json.loads(found.map.record.provenance["settings"])
    named = {"kind": found.map.record.kind, **settings, "path": str(path), "outside": "clamp"}
    content = yaml.safe_load((HERE / f"{which}.yaml").read_text())
    content["filter"]["gyro"]["bias"]["map"] = named
    (folder / f"{which}.yaml").write_text(yaml.safe_dump(content, sort_keys=False))
    return found, load_config(folder / f"{which}.yaml")


def exported(config: Config, folder: Path) -> dict[str, Path]:
    """Write the map in every form, and return their paths by kind."""
    found = {}
    for kind, name in ways.FORMS:
        given = {"device_id": str(DEVICE)} if kind == "px4" else {}
        found[kind] = folder / name
        export(kind, config, found[kind], settings=given, force=True)
    return found


def table(rows: Mapping[str, Errors]) -> Table:
    """Return the errors of each way in deg/h, an axis each and their norm."""
    made = Table(title="what is left of the gyro's bias on the day that is flown, deg/h rms", title_justify="left")
    made.add_column("compensation")
    for name in HORIZONS:
        for axis in ("x", "y", "z", "norm"):
            made.add_column(Text(f"{name}\n{axis}"), justify="right")
    for way, found in rows.items():
        values = [v for each in found.values() for v in (*each / DEG_H, np.linalg.norm(each) / DEG_H)]
        made.add_row(way, *(f"{value:.0f}" for value in values))
    return made


def prove(
    folder: Path, source: Path, console: Console, spans: Sequence[Span] = cats.SPANS, *, search: bool = True
) -> dict[str, Errors]:
    """Go from two soaks and a flight, spans of a recording, to parameters in a folder; return what each way leaves."""
    folder.mkdir(parents=True, exist_ok=True)
    days = [Placement.of(source, span) for span in spans]
    for name, day in zip(("soak1", "soak2", "flight"), days, strict=True):
        day.write(folder, name)
    flown, soaks = days[2], days[:2]
    console.print("1. two soaks and a flight, written as ArduPilot (.bin) and PX4 (.ulg) log them, and read back")
    maps = {which: fitted(which, folder) for which in LOGS}
    _, config = maps["ardupilot"]
    for which, (found, _) in maps.items():
        low, high = found.map.domain
        kind = f"{found.map.record.kind} {json.loads(found.map.record.provenance['settings']).get('order', '')}".strip()
        console.print(f"   {which}: {kind}, {found.map.record.samples:,} samples, {low:.2f} to {high:.2f} °C")
    T = np.linspace(*maps["px4"][0].map.domain, 500)
    apart = np.max(np.abs(maps["px4"][0].map.bias(T) - maps["ardupilot"][0].map.bias(T))) / DEG_H
    console.print(f"   the two maps differ by {apart:.2g} deg/h at most: one calibration, two kinds of log")
    console.print("2. exported; what each target loses of the map, deg/h rms x/y/z:")
    files = exported(config, folder)
    _print_losses([folder / "loss.json", folder / "c" / "loss.json"], console)
    taken = ways.firmware(soaks, flown, files, console)
    rows = {name: of_firmware(values, flown) for name, values in taken.items()}
    rows["ours in driftlab"] = _coasted(folder / "ardupilot.yaml", folder, flown)
    if search:
        rows |= _explained(folder, flown, console)
    return rows


def _print_losses(files: Sequence[Path], console: Console) -> None:
    """Print what each target loses of the map, from the `loss.json` of the exports."""
    for name, found in ((n, f) for path in files for n, f in json.loads(path.read_text())["exports"].items()):
        for lost in found["loss"]:
            said = ["/".join(f"{value:.2g}" for value in lost[over]["rms"]) for over in ("domain", "warm_up")]
            console.print(f"   {name}: {said[0]} over its range, {said[1]} over a warm-up of an hour")


def _explained(folder: Path, flown: Placement, console: Console) -> dict[str, Errors]:
    """Ask what the map lacks, and return the errors with it, where anything is found."""
    known = [str(folder / f"soak{k}.bin") for k in (1, 2)]
    closed = explain(
        load_config(HERE / "ardupilot.yaml"), known, known, [str(folder / "flight.bin")], out=folder / "explained"
    ).closed
    effects = ", ".join(effect["kind"] for effect in closed.content["effects"])
    console.print(f"3. driftlab explain: {closed.verdict.word.replace('_', ' ')}; {effects or 'nothing is added'}")
    if not effects:
        return {}
    return {f"ours in driftlab, and {effects}": _coasted(folder / "explained" / "explained.yaml", folder, flown)}


def _coasted(config: Path, folder: Path, flown: Placement) -> Errors:
    """Return the errors of the filter's prediction from its departure on."""
    result = run(load_config(config, str(folder / "flight.bin")))
    return of_filter(np.asarray(result["coast"]), np.asarray(result["t"]), flown)


def draw(rows: Mapping[str, Errors], path: Path) -> None:
    """Draw the error of each way to the end of the day, all axes together."""
    errors = {way: float(np.linalg.norm(found["to the end"])) / DEG_H for way, found in rows.items()}
    best = min(errors[way] for way in errors if way != "none")
    share = 100 * (1 - best / errors["none"])
    title = f"A calibration takes {share:.0f} % of a day's drift away; who fits it decides little"
    figure, (panel,) = picture(title, columns=1, height=3.2)
    bars = panel.barh(list(errors), list(errors.values()), color=[GREY, *[BLUE] * (len(errors) - 1)])
    panel.bar_label(bars, fmt="%.0f", padding=4)
    panel.invert_yaxis()
    panel.margins(x=0.1)
    panel.set_xlabel("error of the gyro's bias on the day that is flown, rms [deg/h]")
    save(figure, path)


def main() -> None:
    """Run the proof."""
    console = Console(soft_wrap=True, highlight=False)
    rows = prove(OUT, cats.recording(console), console)
    console.print()
    Console(width=120).print(table(rows))
    draw(rows, OUT / "autopilot.png")
    console.print(f"written to {OUT.relative_to(cats.ROOT)}/: logs, maps, parameters, code, loss.json")


if __name__ == "__main__":
    main()
