import json

import numpy as np
import pytest
from command_line import driftlab as run
from turned_units import bias_of, matrix_of, sensor_frame, tumble, turntable

import driftlab
from driftlab.errors import ConfigError

GYRO = """
latitude: 0 deg
source:
  kind: csv
  path: turned.csv
  channels:
    time: {path: t, unit: s}
    gyro: {path: [gx, gy, gz], unit: rad/s}
    temperature: {path: T, unit: degC}
filter:
  gyro:
    noise: 8e-5 rad/s/sqrt(Hz)
    bias: {kind: random_walk, walk: 1e-6 rad/s/sqrt(s)}
    calibration: {kind: polynomial, path: gyro.json}
stimulus: {kind: rate_table, segments: table.csv}
"""
TERMS = "bias,scale,misalignment"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A unit on a turntable, with the map that the command line made of it."""
    folder = tmp_path_factory.mktemp("turned")
    t, y, T, table = turntable(0, [-20.0, 20.0, 60.0], hold=12.0)
    np.savetxt(folder / "turned.csv", np.c_[t, y, T], delimiter=",", header="t,gx,gy,gz,T", comments="", fmt="%.9g")
    (folder / "table.csv").write_text(table)
    (folder / "gyro.yaml").write_text(GYRO)
    done = run("fit-map", "gyro.yaml", "--terms", TERMS, cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "said.txt").write_text(done.stdout)
    return folder


def test_the_terminal_shows_each_term_and_how_to_use_the_map(folder):
    said = (folder / "said.txt").read_text()
    rows = {line.split(" [")[0].strip(): line.split() for line in said.splitlines() if "[" in line}
    assert len([name for name in rows if name.startswith(("bias", "scale", "misalignment"))]) == 12
    assert float(rows["scale x"][3]) == pytest.approx(4000, abs=40)  # ppm at 20 degC
    assert float(rows["scale x"][5]) == pytest.approx(12000, abs=80)
    assert rows["scale y"][5] == "none"
    assert all(len(line) <= 80 for line in said.partition("frame")[0].splitlines())
    assert "frame: that of the stimulus, with the mounting of the unit in it (9 terms of M)" in said
    assert "filter.gyro.calibration: {kind: polynomial, path: gyro.json}" in said


def test_json_says_what_each_term_is(folder):
    done = run("fit-map", "gyro.yaml", "--terms", TERMS, "--json", "--out", "other.json", cwd=folder)
    triad = json.loads(done.stdout)["triad"]
    assert triad["frame"] == "given"
    term = triad["terms"]["scale z"]
    assert (term["unit"], term["told"], term["change_told"], term["curve"]) == ("1", True, True, "order 2")
    np.testing.assert_allclose(term["value"][0], matrix_of(triad["temperature"][0])[2, 2], atol=5 * term["sigma"][0])


@pytest.mark.parametrize("bias", ["calibration", "map"])
def test_a_run_takes_scale_and_misalignment_off(folder, bias):
    """The accelerometer at rest, warming: what is left of it is its own noise."""
    t, y, T = tumble(0, [-20.0, 0.0, 20.0, 40.0, 60.0], placements=14, hold=4.0)
    sensors = {"gyro": {"noise": "1 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1 deg/s/sqrt(s)"}}}
    accel = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)"}}
    config = {"latitude": "45 deg", "filter": {**sensors, "track": "accel", "accel": accel},
              "stimulus": {"kind": "tumble", "gravity": "9.80665 m/s^2"}}  # fmt: skip
    quiet = np.random.default_rng(0).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (quiet, "rad/s"), "temperature": (T, "degC")}
    made = driftlab.fit_map(config, data, terms=TERMS, out=folder / f"{bias}.json")
    assert made.fit.told.sum() == 9

    N, up, g = 3000, np.array([0.6, 0.0, 0.8]), 9.806199
    T = np.linspace(-15, 55, N)
    force = np.array([(np.eye(3) + sensor_frame(matrix_of(x))) @ up * g + bias_of(x, 0.3) for x in T])
    force += np.random.default_rng(1).normal(0, 5e-4 / np.sqrt(0.1), force.shape)
    settings = {"kind": "spline", "path": str(folder / f"{bias}.json")}
    accel = {**accel, "calibration": settings}
    if bias == "map":
        del accel["calibration"]
        accel["bias"] = {"kind": "thermal_derivative", "walk": "1e-5 m/s^2/sqrt(s)", "map": settings}
    warming = {"time": (np.arange(N) * 0.1, "s"), "accel": (force, "m/s^2"), "temperature": (T, "degC"),
               "gyro": (np.random.default_rng(2).normal(0, 1e-3, (N, 3)), "rad/s")}  # fmt: skip
    result = driftlab.run({**config, "filter": {**config["filter"], "accel": accel}}, warming)
    at = np.interp(result.t, np.arange(N) * 0.1, T)
    whole = np.array([sensor_frame(matrix_of(x)) @ up * g + bias_of(x, 0.3) for x in at])
    left = (result.bias - whole)[20:]
    along = left @ up  # across it the tilt of the unit is not known
    assert np.ptp(whole @ up) > 0.2
    assert np.ptp(along) < 5e-3


def test_without_the_bias_that_of_the_configs_map_stays(folder):
    (folder / "both.yaml").write_text(GYRO.replace("gyro.json", "known.json"))
    T = np.linspace(-20, 60, 300)
    known = driftlab.fit_map(GYRO.replace("stimulus", "#"), {
        "time": (np.arange(300.0), "s"), "temperature": (T, "degC"),
        "gyro": (np.random.default_rng(0).normal(0, 1e-6, (300, 3)) + np.outer(T, [1e-6, 2e-6, 3e-6]), "rad/s"),
    }, out=folder / "known.json").map  # fmt: skip
    result = run("fit-map", "both.yaml", "--terms", "scale,misalignment", "--out", "whole.json", cwd=folder)
    assert result.returncode == 0, result.stderr
    from driftlab.storage.map_file import read_map

    whole = read_map(folder / "whole.json")
    T = np.linspace(*known.domain, 20)
    np.testing.assert_array_equal(whole.bias(T), known.bias(T))
    assert whole.record.matrix.at(np.array([20.0]))[0] == pytest.approx(matrix_of(20.0), abs=1e-4)
    alone = run("fit-map", "both.yaml", "--terms", "scale", "--out", "scale.json", cwd=folder)
    assert "misalignment" not in alone.stdout.partition("frame")[0]


def test_what_no_export_holds_is_said(folder):
    done = run("export", "csv_table", "gyro.json", "--out", "table_of_bias.csv", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "left out: gyro: scale factor and misalignment, up to 1" in done.stdout
    assert "csv_table holds the bias alone" in (folder / "loss.json").read_text()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--terms", "bias,scala"], "'scala' is none of bias, scale, misalignment; name those"),
        (["--stimulus", "tumble"], "--stimulus: is that of --terms"),
        (["--terms", TERMS, "--stimulus", "shaker"], "is none of rate_table, positions, tumble; name one of them"),
        (["--terms", TERMS, "--compare"], "--terms: tries the curves of one kind; leave --select, --compare and --family out"),
        (["--terms", TERMS, "--kind", "onnx_network"], "not linear in its coefficients"),
        (["--terms", TERMS, "--stimulus", "positions"], "channel 'accel' is needed"),
        (["--terms", TERMS, "--set", "stimulus.segments=no.csv"], "no.csv: cannot be read"),
    ],
)
def test_what_does_not_go_is_refused_with_a_remedy(folder, options, message):
    done = run("fit-map", "gyro.yaml", *options, "--out", "refused.json", cwd=folder)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert not (folder / "refused.json").exists()


def test_terms_without_a_stimulus_are_refused(folder):
    config = GYRO.partition("stimulus")[0]
    with pytest.raises(ConfigError, match="stimulus: is missing, so the input of the triad is not known; add"):
        driftlab.fit_map(config, str(folder / "turned.csv"), terms=TERMS)
