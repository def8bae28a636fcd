"""Does what `driftlab plan --after` foretells come true?

    python benchmarks/plan_after.py [--seeds N] [--measured]

Twins: four hours are recorded, `plan --after` says what to record and how sure the map will then be, that is recorded
too (its walk goes on), and all is fitted together. Measured: the first half of a soak of CATS is the recording, the
temperatures of the second half are the further profile; then the whole is fitted.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import Row, show

from driftlab.config import load_config
from driftlab.planning.chamber import Chamber, Profile, ramps
from driftlab.planning.continuation import continuation_of, jointly, of_samples, read_parts
from driftlab.planning.unit_model import UnitModel
from driftlab.units import BiasUnit
from fusion_core.faults import Faults
from fusion_plugins.thermal_maps.spline import Spline

WHITE, WALK = np.deg2rad(3.18 / 3600), np.deg2rad(2.2e-5)  # rad/s/sqrt(Hz), rad/s/sqrt(s)
CHAMBER = Chamber(-14.0, 49.0, 25.0, 2 / 60, 300.0)
HOURS = 4.0
WITHIN = 0.15
UNIT = BiasUnit("rad/s", "deg/h")
CATS = Path(__file__).parents[1] / "examples" / "01_cats"


def curve(T):
    """Return a bias of three axes over temperature."""
    x = (T - 17.5) / 32.5
    return np.deg2rad(100 / 3600) * np.stack([x + x**2 / 4, x**3 - x, 2 * x + np.tanh((T - 20) / 6)], axis=1)


def one(seed):
    """Return sigma (3, d) in deg/h: so far, foretold, and of the map fitted to all; and its true error (d,)."""
    subject = UnitModel(
        "gyro", ("x", "y", "z"), UNIT, Spline(), np.full(3, WHITE), np.full(3, 10 * WALK), "a guess", None, ""
    )
    first = ramps(CHAMBER, HOURS, 1)
    T_1 = first.samples(CHAMBER.lag, int(first.duration))[1]
    longest = 2 * len(T_1)
    rng = np.random.default_rng(seed)
    noise = WALK * np.cumsum(rng.normal(size=(longest, 3)), axis=0) + WHITE * rng.normal(size=(longest, 3))
    before = of_samples([(T_1, curve(T_1) + noise[: len(T_1)])], 1.0, subject, CHAMBER)
    foretold = continuation_of(before, HOURS, None).chosen
    T_2 = foretold.profile.samples(CHAMBER.lag, int(foretold.profile.duration))[1]
    own = noise[len(T_1) : len(T_1) + len(T_2)]
    parts = [before.parts[0], (T_2[: len(own)], curve(T_2)[: len(own)] + own)]
    both = of_samples(parts, 1.0, subject, CHAMBER)
    straight = replace(both.map, outside="tangent")
    error = straight.bias(both.temperature) - curve(both.temperature)
    error -= np.mean(straight.bias(both.T) - curve(both.T), axis=0)
    sigmas = [rms(item.sigma) for item in (before, foretold, both)]
    return np.stack(sigmas) * UNIT.factor, rms(error) * UNIT.factor


def rms(values):
    """Return the root mean square (d,) of values (G, d), where they are known."""
    return np.sqrt(np.nanmean(values**2, axis=0))


def twins(seeds):
    """Return the rows of the table for twins."""
    sigmas, errors = zip(*(one(seed) for seed in range(seeds)), strict=True)
    so_far, foretold, fitted = np.stack(sigmas, axis=1)  # (seeds, d) each
    ratio = foretold / fitted
    off = abs(float(np.exp(np.mean(np.log(ratio)))) - 1)
    far = np.sqrt(np.mean(np.square(errors)))
    return [
        Row(f"sigma after {HOURS:g} h", f"{np.mean(so_far):.2f} deg/h"),
        Row(f"foretold for {HOURS:g} h more", f"{np.mean(foretold):.2f} deg/h"),
        Row("of the map fitted to both", f"{np.mean(fitted):.2f} deg/h"),
        Row("foretold over fitted, geometric mean", f"{1 + off:.2f}", f"within {WITHIN:.0%}", off <= WITHIN),
        Row("the same, one twin and axis, 10 to 90 %", "{:.2f} to {:.2f}".format(*np.quantile(ratio, [0.1, 0.9]))),
        Row("true error of the map fitted to both, rms", f"{far:.2f} deg/h"),
    ]  # fmt: skip


def measured(kind):
    """Return the rows of the table for the first placement of CATS, hours 1 to 25, halved."""
    sys.path.insert(0, str(CATS))
    from demo import PLACEMENTS, recording

    config = load_config(CATS / "tczupt.yaml")
    ((T, bias),), dt, _ = read_parts(config, [f"{recording()}{PLACEMENTS[0]}"], Faults())
    low, high = float(T.min()), float(T.max())
    chamber = Chamber(low, high, float(T[0]), 1.0, 0.0)
    subject = UnitModel.of(config, kind, None)
    half = len(T) // 2
    before = of_samples([(T[:half], bias[:half])], dt, subject, chamber)
    t = np.arange(len(T) - half) * dt
    rest = Profile("the rest", "ramps", t[:: round(60 / dt)], T[half :: round(60 / dt)])
    foretold = jointly(rest, before)
    whole = of_samples([(T, bias)], dt, subject, chamber)
    rows = [Row("temperatures of the first half", "{:.1f} to {:.1f} degC".format(*before.seen)),
            Row("of the whole", f"{low:.1f} to {high:.1f} degC")]  # fmt: skip
    for k, axis in enumerate(subject.axes):
        numbers = [rms(item.sigma)[k] * UNIT.factor for item in (before, foretold, whole)]
        rows.append(Row(f"sigma {axis}: first half, foretold, fitted", "{:.0f}, {:.0f}, {:.0f} deg/h".format(*numbers)))
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--measured", action="store_true", help="CATS too")
    given = parser.parse_args()
    show(f"plan --after, {given.seeds} twins", twins(given.seeds))
    if given.measured:
        for kind in (None, "spline"):
            show(f"plan --after, CATS, {kind or 'its own kind'}", measured(kind))


if __name__ == "__main__":
    main()
