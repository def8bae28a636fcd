"""Gains of the thermal derivative and of the larger process noise: both filters at each walk, against the truth.

The paper's TCZUPT filter differs from its standard filter in two ways at once: it follows the map's derivative, and
its walk is 3.3 times larger. Here every filter is run at the walk of table 1, of table 3, and at the one that makes its
innovations most likely; in nominal conditions, with a hysteresis loop that the map cannot know, and with 15 deg/h at
the start. Errors are against the twin's true bias, not against an average that shares its noise with the filter.

    python examples/paper/ablation.py [--seeds 10]
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table
from rich.text import Text
from twin import OUT, filter_config, fit, source

sys.path.insert(0, str(Path(__file__).parent.parent))
from noise_by_likelihood import fit_noise

from driftlab.config import Config
from driftlab.evaluation.comparison import OFFSET, THRESHOLD
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from driftlab.storage.json import plain
from fusion_core.chunk import Chunk, concatenate
from fusion_core.faults import Faults

console = Console(soft_wrap=True, width=120)
FILTERS = {
    "no map": ("none", None),
    "standard": ("standard", None),
    "TCZUPT slope": ("tczupt", "slope"),
    "TCZUPT difference": ("tczupt", "difference"),
}
WALKS = {"table 1": np.deg2rad(1.5e-4), "table 3": np.deg2rad(5e-4)}  # rad/s/sqrt(s)
CASES = {"nominal": (False, 0.0), "hysteresis": (True, 0.0), "15 deg/h": (False, OFFSET)}


def config_of(name: str, recording, walk: float) -> Config:
    """Return a filter of FILTERS at a walk."""
    base, form = FILTERS[name]
    if base != "none":
        return filter_config(base, recording, walk=walk, form=form)
    config = filter_config("standard", recording, walk=walk)
    gyro = config.filter.gyro.model_copy(update={"calibration": None})
    return config.model_copy(update={"filter": config.filter.model_copy(update={"gyro": gyro})})


def errors(config: Config, recording: Chunk, initial_error: float) -> list[float]:
    """Return rms of the first 30 s, rms of the whole, time to converge, rms of 10 min of prediction; axes pooled."""
    estimates = joined(Run(config, RunLog(), initial_error=initial_error).over([recording]))
    t, coast = estimates["t"], estimates["coast"]
    truth = recording["bias_truth"][np.searchsorted(recording.t, t)]
    after = np.isfinite(coast[:, 0])
    start = t[after][0]
    error = estimates["bias"] - truth
    away = np.abs(error[after]).max(axis=1) < THRESHOLD
    converged = float(t[after][np.argmax(away)] - start) if np.any(away) else np.nan
    first, ten = after & (t < start + 30), after & (t < start + 600)
    return [_rms(error[first]), _rms(error[after]), converged, _rms((coast - truth)[ten])]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def likely_walk(name: str, recording: Chunk, config: Config) -> float:
    """Return the walk that makes the filter's innovations most likely (geometric mean over the axes)."""
    factors = fit_noise(config, [recording])["gyro"].walk
    return float(config.filter.gyro.bias.walk * np.exp(np.mean(np.log(factors))))


def main() -> None:
    """Run everything and print one table a case."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="how many ramps for each case (default: 10)")
    seeds = parser.parse_args().seeds
    results: dict[str, dict[str, np.ndarray]] = {}
    for case, (hysteresis, initial_error) in CASES.items():
        fit(hysteresis=hysteresis)
        rows: dict[str, list[list[float]]] = {}
        for seed in track(range(1, seeds + 1), description=f"{case:12s}", console=console):
            ramp = source(100 + seed, ramp=True, hysteresis=hysteresis)
            reader = config_of("standard", ramp, WALKS["table 1"])
            recording = concatenate(list(epochs(read(reader, Faults()), reader.filter.update_interval)))
            for name in FILTERS:
                likely = likely_walk(name, recording, config_of(name, ramp, WALKS["table 1"]))
                for label, walk in {**WALKS, "likely": likely}.items():
                    found = errors(config_of(name, ramp, walk), recording, initial_error)
                    rows.setdefault(f"{name} | {label}", []).append([*found, walk])
        results[case] = {key: np.array(value) for key, value in rows.items()}
        console.print(_table(case, results[case], seeds))
    (OUT / "ablation.json").write_text(json.dumps(plain(results), indent=1) + "\n")


def _table(case: str, results: dict[str, np.ndarray], seeds: int) -> Table:
    title = f"{case}: error against the true bias, urad/s, mean and deviation over {seeds} seeds"
    table = Table(title=title, title_justify="left")
    for heading in ("filter", "walk", "[deg/s/sqrt(s)]", "first 30 s", "whole", "to 1e-5 [s]", "coast 10 min"):
        table.add_column(Text(heading), justify="left" if heading in ("filter", "walk") else "right", no_wrap=True)
    for key, values in results.items():
        name, label = key.split(" | ")
        scaled = values[:, :4] * [1e6, 1e6, 1.0, 1e6]
        cells = [f"{np.nanmean(c):.3g} ± {np.nanstd(c):.2g}" if np.any(np.isfinite(c)) else "-" for c in scaled.T]
        walk = f"{np.rad2deg(np.exp(np.mean(np.log(values[:, 4])))):.2g}"
        table.add_row(name, label, walk, *cells, end_section=label == "likely")
    return table


if __name__ == "__main__":
    main()
