"""Bands of predictions: the share of true biases within them, over many simulated units.

Each unit is made by the simulator in this file, which shares no code with driftlab: a bend in its thermal curve, white
noise, a random walk, accelerometers with a bias, a coarse thermometer. A map is fitted on its soak, its filter departs
after a minute at rest of another day, and the prediction is held against the true bias once a minute, to the end.

    python benchmarks/coast_bands.py [--seeds 50] [--only NAME ...] [--figure FILE.svg] [--thermometers]

`--thermometers` draws coarse thermometers in place of these (`foreign_thermometers.py`): steps with noise before the
rounding, single readings and means of ten, updates of 10 ms to 10 s.
"""

from __future__ import annotations

import argparse
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import h5py
import numpy as np
from loop_cases.signatures import late

DEG_H = np.deg2rad(1) / 3600
OMEGA = 7.292115e-5
LATITUDE = np.deg2rad(40.9)
G = 9.802058
LEVELS = (0.6827, 0.95, 0.9973)
WIDTHS = (1.0, 1.96, 3.0)


@dataclass(frozen=True)
class Kind:
    """A type of unit: densities of white noise and walk, sizes of curve and accelerometer bias, in SI."""

    name: str
    noise: float
    walk: float
    curve: float
    accel_noise: float
    accel_bias: float
    gyro_noise_text: str
    walk_text: str


MEMS = Kind("MEMS", 3.18 * DEG_H, 0.05 * DEG_H, 60 * DEG_H, 8.3e-4, 0.02, "3.18 deg/h/sqrt(Hz)", "0.05 deg/h/sqrt(s)")
FOG = Kind("FOG", 0.72 * DEG_H, 3e-3 * DEG_H, 2 * DEG_H, 3.3e-4, 0.01, "0.012 deg/sqrt(h)", "3e-3 deg/h/sqrt(s)")


@dataclass(frozen=True)
class Case:
    """Varied conditions: seconds of an update, kelvin of a thermometer's step, gaps, and the map that is declared."""

    name: str
    kind: Kind
    interval: float = 0.1
    step: float = 0.1
    gaps: bool = False
    map: str = "{kind: spline}"
    hours: float = 3.0
    honest: bool = True  # whether the map can follow the curve


def cases() -> list[Case]:
    """Return the cases: one condition after another varied, for each kind of unit."""
    found = []
    for kind in (MEMS, FOG):
        base = Case(f"{kind.name}", kind)
        found += [replace(base, name=f"{base.name}, update {s:g} s", interval=s, hours=h)
                  for s, h in ((0.01, 1.0), (0.1, 3.0), (1.0, 3.0))]  # fmt: skip
        found += [replace(base, name=f"{base.name}, thermometer {k:g} K", step=k) for k in (0.01, 0.5, 1.0)]
        found.append(replace(base, name=f"{base.name}, gaps", gaps=True))
        found.append(replace(base, name=f"{base.name}, network", map="{kind: onnx_network}"))
        cubic = "{kind: polynomial, order: 3}"
        found.append(replace(base, name=f"{base.name}, cubic on a bend", map=cubic, honest=False))
    return found


class Unit:
    """One unit, drawn from a seed."""

    def __init__(self, kind: Kind, seed: int) -> None:
        self.kind, self.rng = kind, np.random.default_rng(seed)
        self.at, self.over = self.rng.uniform(10, 35, 3), self.rng.uniform(3, 6, 3)
        self.bend = kind.curve * self.rng.choice([-1, 1], 3) * self.rng.uniform(0.6, 1.4, 3)
        self.line = kind.curve / 40 * self.rng.normal(size=3)
        self.accel_bias = kind.accel_bias * self.rng.normal(size=3)

    def curve(self, T: np.ndarray) -> np.ndarray:
        return self.line * T[:, None] + self.bend * np.tanh((T[:, None] - self.at) / self.over)

    def record(self, path: Path, t: np.ndarray, T: np.ndarray, dt: float, step: float) -> np.ndarray:
        """Write a recording and return the true bias of each sample."""
        r, N = self.rng, len(t)
        elapsed = np.diff(t, prepend=t[0] - dt)
        walk = np.cumsum(r.normal(size=(N, 3)) * self.kind.walk * np.sqrt(elapsed)[:, None], axis=0)
        bias = self.curve(T) + walk + r.normal(0, 20 * self.kind.curve, 3)
        omega = OMEGA * np.array([np.cos(LATITUDE), 0, np.sin(LATITUDE)])
        gyro = bias + omega + r.normal(size=(N, 3)) * self.kind.noise / np.sqrt(dt)
        accel = np.array([0, 0, G]) + self.accel_bias + r.normal(size=(N, 3)) * self.kind.accel_noise / np.sqrt(dt)
        with h5py.File(path, "w") as file:
            for name, values, unit in (("time", t, "s"), ("gyro", gyro, "rad/s"), ("accel", accel, "m/s^2"),
                                       ("temperature", np.round(T / step) * step, "degC")):  # fmt: skip
                file.create_dataset(name, data=values).attrs["unit"] = unit
        return bias


def soak() -> tuple[np.ndarray, np.ndarray]:
    """Return ten hours of steps of 5 K up and down again, at 1 Hz."""
    t = np.arange(36_000.0)
    stairs = np.concatenate([np.arange(-10, 50, 5.0), np.arange(50, -11, -5.0)])
    return t, late(stairs[np.minimum((t / 36_000 * len(stairs)).astype(int), len(stairs) - 1)], 150.0)


def day(hours: float, dt: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return ramps and holds between temperatures inside the soak's."""
    t = np.arange(0, hours * 3600, dt)
    at, T = [0.0], [rng.uniform(0, 40)]
    while at[-1] < t[-1]:
        target = rng.uniform(-5, 45)
        at += [at[-1] + abs(target - T[-1]) / rng.uniform(0.005, 0.02)]
        at += [at[-1] + rng.uniform(60, 1200)]
        T += [target, target]
    return t, late(np.interp(t, at, T), 120.0, dt)


def config(case: Case) -> str:
    """Return the declared model."""
    kind = case.kind
    return f"""
latitude: 40.9 deg
heading: 0 deg
source:
  kind: hdf5
  channels: {{time: {{path: time}}, gyro: {{path: gyro}}, accel: {{path: accel}}, temperature: {{path: temperature}}}}
filter:
  update_interval: {case.interval} s
  gyro:
    noise: {kind.gyro_noise_text}
    bias: {{kind: thermal_derivative, walk: {kind.walk_text}, map: {case.map}}}
  accel:
    noise: {kind.accel_noise} m/s^2/sqrt(Hz)
    bias: {{kind: random_walk, walk: 1e-6 m/s^2/sqrt(s)}}
"""


def errors(case: Case, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return error over sigma of the prediction, (minutes, 3), and the same of the running estimate."""
    unit = Unit(case.kind, seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "unit.yaml").write_text(config(case))
        unit.record(folder / "soak.h5", *soak(), 1.0, case.step)
        t, T = day(case.hours, case.interval, unit.rng)
        if case.gaps:
            keep = np.ones(len(t), dtype=bool)
            for begin in unit.rng.uniform(600, t[-1], 4):
                keep &= ~((t > begin) & (t < begin + unit.rng.uniform(120, 1200)))
            t, T = t[keep], T[keep]
        bias = unit.record(folder / "day.h5", t, T, case.interval, case.step)
        return _held(folder, case.map, case.interval, t, bias)


def _held(folder: Path, kind: str, interval: float, t: np.ndarray, bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of `errors` of a folder's unit.yaml, soak.h5 and day.h5, of which t and bias are the truth."""
    from driftlab.config import load_config, with_recording
    from driftlab.filtering.run import Run
    from driftlab.filtering.segment import RunLog, joined
    from driftlab.identification.config_edit import with_map
    from driftlab.maps.fit import fit_map
    from fusion_core.faults import Faults

    declared = load_config(folder / "unit.yaml")
    fitted = fit_map(declared, [str(folder / "soak.h5")], None, Faults())
    path = folder / f"map{'.onnx' if 'network' in kind else '.json'}"
    fitted.save(path)
    run = with_recording(with_map(declared, path=path, outside="tangent"), str(folder / "day.h5"))
    found = joined(Run(run, RunLog()))
    rows = np.flatnonzero(np.isfinite(found["coast"][:, 0]))
    rows = rows[:: max(1, int(60 / interval))]
    truth = bias[np.searchsorted(t, found["t"][rows] - 1e-6)]
    coast = (found["coast"][rows] - truth) / found["coast_sigma"][rows]
    return coast, (found["bias"][rows] - truth) / found["bias_sigma"][rows]


@dataclass(frozen=True)
class Coarse:
    """A thermometer of `foreign_thermometers.py`, and seconds of an update."""

    kind: str
    step: float
    noise: float
    averaged: int = 1
    interval: float = 1.0

    @property
    def name(self) -> str:
        means = f", means of {self.averaged}" if self.averaged > 1 else ""
        return f"{self.kind}, {self.step:g} K, noise {self.noise:g} K{means}, update {self.interval:g} s"


def coarse() -> list[Coarse]:
    """Return steps and noise, single readings and means, and updates, for each kind of unit."""
    return [
        Coarse(kind, step, noise, averaged, interval)
        for interval in (1.0, 10.0, 0.01) for kind in ("FOG", "MEMS") for step in (1.0, 0.5, 0.2, 0.05, 0.0)
        for noise in (0.0, 0.02, 0.2) for averaged in (1, 10)
    ]  # fmt: skip


def coarse_errors(case: Coarse, unit: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the errors of `errors` over a day in one of four profiles."""
    from foreign_thermometers import config as declared
    from foreign_thermometers import draw

    thermometer = {"step": case.step, "noise": case.noise, "averaged": case.averaged}
    profile = ("chamber", "day", "warm_up", "chamber")[unit % 4]
    rate, hours = (100.0, 0.7) if case.interval < 0.1 else (10.0, 2.0)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "unit.yaml").write_text(declared(case.kind, f"{case.interval:g} s"))
        draw(unit, 0, case.kind, profile="soak", rate=1.0, hours=6.0, **thermometer).save(folder / "soak.h5")
        day = draw(unit, 1, case.kind, profile=profile, rate=rate, hours=hours, **thermometer)
        day.save(folder / "day.h5")
        return _held(folder, "spline", case.interval, day.t, day.bias)


def _one(job: tuple[Case | Coarse, int]) -> tuple[np.ndarray, np.ndarray]:
    from threadpoolctl import threadpool_limits

    case, seed = job
    with threadpool_limits(1):
        return coarse_errors(case, seed) if isinstance(case, Coarse) else errors(case, seed)


def figure(path: Path, table: dict[str, list[float]]) -> None:
    """Draw what the bands hold beside what they say."""
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(10, 0.32 * len(table) + 1.4), layout="constrained")
    panel = drawn.subplots()
    for k, (colour, level) in enumerate(zip(("#0b6e99", "#c8553d", "#4c8c4a"), LEVELS, strict=True)):
        panel.axvline(100 * level, color=colour, lw=1, ls="--")
        panel.plot([100 * held[k] for held in table.values()], range(len(table)), "o", ms=5, color=colour,
                   label=f"within {WIDTHS[k]:g} sigma, {100 * level:g} % expected")  # fmt: skip
    panel.set_yticks(range(len(table)), list(table))
    panel.invert_yaxis()
    panel.set_xlabel("true biases within the band of coasting [%]")
    panel.legend(fontsize=8, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), frameon=False)
    panel.grid(alpha=0.25)
    drawn.savefig(path)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seeds", type=int, default=50)
    parser.add_argument("--only", nargs="*", default=[])
    parser.add_argument("--figure", type=Path)
    parser.add_argument("--thermometers", action="store_true")
    parser.add_argument("--workers", type=int, default=2)
    options = parser.parse_args()
    drawn: list[Case | Coarse] = list(coarse() if options.thermometers else cases())
    chosen = [case for case in drawn if not options.only or any(word in case.name for word in options.only)]
    table = {}
    print(f"| {options.seeds} units each | 1 sigma (68.3) | 1.96 sigma (95.0) | 3 sigma (99.7) | rms of error / sigma "
          "| running estimate |")  # fmt: skip
    print("|---|---|---|---|---|---|")
    with ProcessPoolExecutor(options.workers) as pool:
        for case in chosen:
            done = list(pool.map(_one, [(case, seed) for seed in range(options.seeds)]))
            z, own = (np.abs(np.concatenate([one[k] for one in done])) for k in (0, 1))
            held = [float(np.mean(z < width)) for width in WIDTHS]
            table[case.name] = held
            cells = " | ".join(f"{100 * v:.1f}" for v in held)
            ran = " / ".join(f"{100 * float(np.mean(own < width)):.0f}" for width in WIDTHS)
            print(f"| {case.name} | {cells} | {np.sqrt(np.mean(z**2)):.2f} | {ran} |", flush=True)
    if options.figure:
        figure(options.figure, table)


if __name__ == "__main__":
    main()
