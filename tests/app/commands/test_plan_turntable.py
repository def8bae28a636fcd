"""The plan of a turntable: what it promises is what a fit to a recording of that plan has."""

import csv
import json
from itertools import pairwise

import numpy as np
import pytest
from turned_units import AXES, Readings, matrix_of

import driftlab
from driftlab.errors import ConfigError

GYRO = {
    "noise": "8e-5 rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"},
    "calibration": {"kind": "polynomial"},
}  # fmt: skip
CONFIG = {"latitude": "0 deg", "filter": {"gyro": GYRO}}
CHAMBER = {"range": "-20..60 degC", "rate": "10 K/min", "lag": "1 min", "start": "20 degC"}
SEEDS, AT = 8, np.array([-20.0, 20.0, 60.0])


def bent(T):
    """M (3, 3) whose terms are all parabolas that show."""
    x = (T - 20.0) / 40.0
    return matrix_of(20.0) + 0.004 * x * (AXES - 0.5) + 0.003 * x**2 * (0.7 - AXES)


def recorded(folder, seed):
    """A gyro's readings at 10 Hz as the folder of a plan has it: turned by its segments, at rest between them."""
    made = Readings(seed, 10.0, white=8e-5, walk=1e-6, bias=np.deg2rad(1.0))
    set_points = np.loadtxt(folder / "setpoints.csv", delimiter=",", skiprows=1)
    with (folder / "segments.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    for start, stop, axis, rate in rows:
        T = float(np.interp(float(start), *set_points.T))  # a body that has settled
        made.stretch(float(start) - made.now, np.zeros(3), T, bent(T))
        turned = np.deg2rad(float(rate)) * AXES["xyz".index(axis[-1])] * (-1 if axis[0] == "-" else 1)
        made.stretch(float(stop) - made.now, turned, T, bent(T))
    made.stretch(1.0, np.zeros(3), T, bent(T))
    return made.arrays()


def test_a_recording_of_the_plan_has_the_sigma_that_it_promises(tmp_path):
    plan = driftlab.plan(
        CONFIG, 1.0, terms="bias,scale,misalignment", table="90 deg/s", out=tmp_path / "plan", **CHAMBER
    )
    promised = np.array([np.interp(AT, plan.temperature, column) for column in plan.sigma.T]).T
    off = []
    for seed in range(SEEDS):
        t, y, T = recorded(tmp_path / "plan", seed)
        data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
        stimulus = {"kind": "rate_table", "segments": str(tmp_path / "plan" / "segments.csv")}
        fit = driftlab.fit_map({**CONFIG, "stimulus": stimulus}, data, terms="bias,scale,misalignment").fit
        assert fit.observable.all()
        off.append(fit.terms.at(AT)[:, 3:] - np.array([bent(T).ravel() for T in AT]))
    ratio = np.sqrt(np.mean(np.array(off) ** 2, axis=0)) / promised[:, 3:]
    assert 0.8 < np.sqrt(np.mean(ratio**2)) < 1.2  # of 8 units with 27 values each
    assert np.max(ratio) < 2.0


def test_the_plan_is_the_best_of_those_that_it_tried(tmp_path):
    plan = driftlab.plan(CONFIG, 2.0, terms="scale,misalignment", out=tmp_path / "plan", **CHAMBER)
    best = plan.found.chosen
    assert best.criterion <= 1.05 * min(one.criterion for one in plan.found.tried)
    assert len({one.levels for one in plan.found.tried}) > 2
    segments = plan.summary["segments"]
    assert all(b["start"] > a["stop"] for a, b in pairwise(segments))
    assert segments[-1]["stop"] <= plan.found.chosen.profile.duration + 1e-6
    assert len(segments) == 6 * best.levels * best.rounds
    summary = json.loads((tmp_path / "plan" / "plan.json").read_text())
    assert "segments.csv" in summary["written"]
    assert "100 deg/s both ways" in plan.headline
    more = driftlab.plan(CONFIG, 6.0, terms="scale,misalignment", **CHAMBER)
    assert np.max(more.sigma[:, 3:]) < np.max(plan.sigma[:, 3:])
    faster = driftlab.plan(CONFIG, 2.0, terms="scale,misalignment", table="200 deg/s", **CHAMBER)
    assert np.max(faster.sigma[:, 3:]) == pytest.approx(np.max(plan.sigma[:, 3:]) / 2, rel=0.05)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"terms": "scale", "hours": 0.05}, "hours 0.05: are too few for 3 temperatures with 6 segments each"),
        ({"terms": "scale", "sigma": "1 deg/h"}, "terms: plans a turntable; leave family"),
        ({"table": "10 deg/s"}, "table: is the rate of a turntable; say which terms"),
        ({"terms": "scala"}, "'scala' is none of bias, scale, misalignment"),
        ({"terms": "scale", "table": "-5 deg/s"}, "a turntable tells of a gyro of three axes at a rate"),
    ],
)
def test_what_cannot_be_planned_is_refused(given, message):
    with pytest.raises(ConfigError, match=message):
        driftlab.plan(CONFIG, **{"hours": 1.0, **CHAMBER, **given})
