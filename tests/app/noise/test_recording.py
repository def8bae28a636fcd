"""Allan deviation: coefficients against what was simulated, and the command on a real file."""

import json

import h5py
import numpy as np
import pytest
from scipy import signal
from sensors_at_rest import DT, simulated
from typer.testing import CliRunner

from driftlab.config import Config, Limits, load_config
from driftlab.evaluation.limits import check_limits
from driftlab.evaluation.measurements import of_allan
from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import KEYS, fit
from driftlab.noise.recording import Analysis, TooShort, analyse
from driftlab.reports.allan import UNITS, config_lines, document, used
from fusion_core.errors import DataError
from fusion_core.faults import Faults
from fusion_core.units import to_si

Q, N, B, K, R = range(5)


CASES = {
    "white": {"white": 1.0},
    "white and walk": {"white": 1.0, "walk": 0.05},
    "quantised": {"quantization": 2.0, "white": 1.0, "walk": 0.03},
    "drifting": {"white": 1.0, "ramp": 2e-3},
}


@pytest.mark.parametrize("case", CASES)
def test_limits_cover_the_truth(case):
    """95 % limits of five coefficients over eight seeds: at most 5 of 40 may miss (probability below 5 %)."""
    truth = np.zeros(5)
    for name, value in CASES[case].items():
        truth[("quantization", "white", "bias", "walk", "ramp").index(name)] = value
    found = [fit(curve(simulated(20_000, seed, **CASES[case]), DT)) for seed in range(8)]
    missed = sum(int(np.sum((item.low > truth * (1 + 1e-9)) | (item.high < truth))) for item in found)
    assert missed <= 5
    for item in found:
        assert np.all((item.low <= item.value) & (item.value <= item.high))
        assert np.all((item.value > 0) == (item.low > 0))
    spurious = sum(int(np.sum(item.value[truth == 0] > 0)) for item in found)
    assert spurious <= 3
    white = [item.value[N] for item in found]
    np.testing.assert_allclose(np.median(white), 1.0, rtol=0.04)


def test_a_ramp_is_named_and_the_walk_is_not_made_of_it():
    item = fit(curve(simulated(20_000, 1, white=1.0, ramp=5e-2), DT))
    assert item.low[R] < 5e-2 < item.high[R]
    assert item.value[R] == pytest.approx(5e-2, rel=0.1)
    assert item.low[K] == 0
    assert item.high[K] < 1.0
    assert any("Hadamard" in note for note in item.notes)


def test_a_filter_in_the_sensor_moves_the_begin_of_the_fit():
    rate = simulated(60_000, 1, white=1.0)
    smooth = np.convolve(rate, np.ones(20) / 20, mode="valid")
    item = fit(curve(smooth, DT))
    assert item.first > 5
    assert item.low[N] < 1.0 < item.high[N]
    assert any("fitted from" in note for note in item.notes)


def held(rate):
    return np.repeat(rate, 10)


def interpolated(rate):
    return np.interp(np.arange(10 * len(rate)) / 10, np.arange(len(rate)), rate)


def low_passed(rate, corner=0.2):
    return signal.lfilter(*signal.butter(2, corner), rate)[2_000:]


SMOOTHED = {"low-passed": (low_passed, DT), "held": (held, DT / 10), "interpolated": (interpolated, DT / 10)}


@pytest.mark.parametrize("kind", SMOOTHED)
def test_the_noise_before_a_filter_is_covered(kind):
    """95 % limits of the white noise over eight seeds: at most 2 may miss (probability of more below 1 %)."""
    smoothed, dt = SMOOTHED[kind]
    found = [fit(curve(smoothed(simulated(14_000, seed, white=1.0, walk=0.01)), dt)) for seed in range(8)]
    assert sum(not item.low[N] <= 1.0 <= item.high[N] for item in found) <= 2
    assert np.median([item.high[N] / item.low[N] for item in found]) < 1.25
    assert all(np.isinf(item.high[Q]) for item in found)


def test_noise_that_a_filter_hides_is_not_measured():
    """A corner at 1/400 of the rate leaves no decade and a half of averaging times beyond its reach."""
    item = fit(curve(low_passed(simulated(12_000, 1, white=1.0), 0.005), DT))
    assert not np.any(item.value)
    assert np.all(np.isinf(item.high))
    measured = of_allan([item], ["x"], 1000.0)
    for row in check_limits(Limits(noise=10.0, bias_instability=10.0), measured):
        assert (row.verdict, row.decision) == ("not measured", "undecided")
        assert "filtered" in row.note


def test_what_does_not_move_has_no_coefficient():
    item = fit(curve(np.full(1000, 0.1), DT))
    assert not np.any(item.value)
    assert np.all(np.isinf(item.high))
    assert "does not move" in item.notes[0]


CONFIG = """
extends: mems_crs05
source:
  kind: hdf5
  channels:
    time:  {path: time, unit: s}
    gyro:  {path: gyro, unit: rad/s}
    accel: {path: accel, unit: m/s^2}
filter:
  gyro:
    bias: {kind: random_walk, walk: 1e-4 deg/s/sqrt(s)}
"""
NOISE, WALK = 1.54e-5, 2.6e-6  # of the gyro, SI


def write(path, *, samples=12_000, gap=None, jitter=0.0, kick=None):
    rng = np.random.default_rng(7)
    t = np.arange(samples) * DT + rng.uniform(-jitter, jitter, samples) * DT
    gyro = np.stack(
        [simulated(samples, s, white=NOISE * scale, walk=WALK) for s, scale in enumerate((1, 1, 3))], axis=1
    )
    accel = np.stack([simulated(samples, s, white=8e-4) for s in (10, 11, 12)], axis=1)
    accel[:, 2] += 9.8
    if kick is not None:
        gyro[kick : kick + 20] += 0.1
    keep = np.ones(samples, dtype=bool)
    if gap is not None:
        keep[gap[0] : gap[1]] = False
    with h5py.File(path, "w") as file:
        file["time"], file["gyro"], file["accel"] = t[keep], gyro[keep], accel[keep]


def command(*args):
    from driftlab.cli import app

    return CliRunner().invoke(app, ["allan", *map(str, args)], env={"COLUMNS": "160"})


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("allan")
    (folder / "unit.yaml").write_text(CONFIG)
    write(folder / "rest.h5")
    return folder


def test_json_and_files(bench):
    out = bench / "out"
    done = command(bench / "unit.yaml", "--input", bench / "rest.h5", "--out", out, "--json")
    assert done.exit_code == 0, done.output
    content = json.loads(done.stdout)
    units = {"gyro": ("rad", "rad/s/sqrt(Hz)", "rad/s", "rad/s/sqrt(s)", "rad/s/s")}
    units["accel"] = ("m/s", "m/s^2/sqrt(Hz)", "m/s^2", "m/s^2/sqrt(s)", "m/s^2/s")
    for channel in ("gyro", "accel"):
        assert list(content[channel]) == ["x", "y", "z"]
        for axis in content[channel].values():
            assert tuple(axis) == KEYS
            for entry, unit in zip(axis.values(), units[channel], strict=True):
                assert list(entry) == ["value", "low", "high", "unit"]
                assert entry["unit"] == unit
                assert entry["low"] <= entry["value"] <= entry["high"]
    white = content["gyro"]["z"]["white"]
    assert white["low"] < 3 * NOISE < white["high"]
    assert content["sample_interval_s"] == pytest.approx(DT)
    assert sorted(p.name for p in out.iterdir()) == ["allan.json", "allan.svg", "report.html", "summary.json"]
    assert json.loads((out / "allan.json").read_text()) == content
    html = (out / "report.html").read_text()
    assert html.count('<figure class="chart"') == 2
    again = command(bench / "unit.yaml", "--input", bench / "rest.h5", "--out", out)
    assert again.exit_code == 0, again.output


def test_the_lines_are_a_config_with_the_numbers_of_the_fit(bench):
    done = command(bench / "unit.yaml", "--input", bench / "rest.h5")
    assert done.exit_code == 0, done.output
    lines = done.stdout[done.stdout.index("filter:\n") :]
    pasted = bench / "pasted.yaml"
    pasted.write_text(lines)
    loaded = load_config(pasted).filter
    config = load_config(bench / "unit.yaml", str(bench / "rest.h5"))
    found = analyse(config, Faults())
    content = document(found)
    noise = [content["gyro"][axis]["white"]["value"] for axis in "xyz"]
    np.testing.assert_allclose(loaded.gyro.noise, noise, rtol=1e-3)  # z has three times the noise: a list
    np.testing.assert_allclose(loaded.accel.noise, 8e-4, rtol=0.05)  # alike: one value
    walk = np.broadcast_to(loaded.gyro.bias.walk, 3)
    high = [content["gyro"][axis]["rate_random_walk"]["high"] for axis in "xyz"]
    assert np.all((walk > 0) & (walk <= np.array(high) * 1.2))
    assert "not seen" in next(line for line in lines.splitlines() if "ug/sqrt(s)" in line)


@pytest.mark.parametrize("channel", ["gyro", "accel"])
def test_units_of_the_table_are_known(channel):
    for key, unit in UNITS[channel].human:
        assert to_si(f"1 {unit}", UNITS[channel].si[key]) > 0


def test_both_sides_of_a_gap_are_used(bench):
    write(bench / "gap.h5", gap=(4000, 4100), jitter=0.1)
    found = analyse(load_config(bench / "unit.yaml", str(bench / "gap.h5")), Faults())
    assert found.used_s == pytest.approx(1190, abs=0.2)
    assert found.total_s == pytest.approx(1200, abs=0.2)
    assert (found.start_s, found.stretches) == (pytest.approx(0, abs=0.02), 2)
    assert found.dt == pytest.approx(DT, rel=1e-4)
    assert any(note.startswith("1 gap is bridged for averaging times from 100 s on") for note in found.notes)
    assert any("steps vary" in note for note in found.notes)
    assert used(found).endswith("10 Hz; 1 gap, bridged for averaging times over 100 s")
    content = document(found)
    assert (content["stretches"], content["longest_stretch_s"]) == (2, pytest.approx(790, abs=0.1))
    assert (content["gaps_bridged"], content["bridged_from_s"]) == (1, pytest.approx(100, rel=1e-3))
    of_x = content["curves"]["gyro"]["x"]
    assert list(of_x["stretches"][[0, -1]]) == [2, 1]
    assert of_x["tau_s"][-1] == pytest.approx(240, rel=0.01)  # as without the gap
    np.testing.assert_allclose(of_x["used_s"][[0, -1]], [1190, 1190], atol=0.2)


def test_a_long_gap_cuts(bench):
    write(bench / "cut.h5", gap=(4000, 6000))
    found = analyse(load_config(bench / "unit.yaml", str(bench / "cut.h5")), Faults())
    (note,) = [note for note in found.notes if "stretches without a gap" in note]
    assert "400 to 600" in note
    content = document(found)
    assert (content["gaps_bridged"], content["bridged_from_s"]) == (0, None)
    assert used(found).endswith("in 2 stretches, 10 Hz")
    of_x = content["curves"]["gyro"]["x"]
    assert of_x["tau_s"][-1] == pytest.approx(400 / 3, rel=0.01)  # a third of the shorter one
    assert set(of_x["stretches"]) == {2}


def test_motion_is_never_bridged(bench):
    """The unit may rest in another attitude behind it: a level that the sensor does not have."""
    write(bench / "kick2.h5", kick=3100, samples=24_000)
    found = analyse(load_config(bench / "unit.yaml", str(bench / "kick2.h5")), Faults())
    assert len(found.first.bridged) == 0
    assert found.stretches == 2


def test_motion_is_left_out(bench):
    write(bench / "kick.h5", kick=3100)
    found = analyse(load_config(bench / "unit.yaml", str(bench / "kick.h5")), Faults())
    (note,) = [note for note in found.notes if note.startswith("motion")]
    assert "left out: 1 of 19 windows of 60 s (first at 300" in note
    assert found.used_s == pytest.approx(1140, abs=0.2)
    still = analyse(load_config(bench / "unit.yaml", str(bench / "rest.h5")), Faults())
    for own, clean in zip(found.coefficients["gyro"], still.coefficients["gyro"], strict=True):
        np.testing.assert_allclose(own.value[N], clean.value[N], rtol=0.03)


def test_noise_that_is_not_as_declared_is_not_taken_for_motion(bench):
    """Of a recording that moves nearly all the time nothing is left out, and the note says what else it may be."""
    (bench / "quiet.yaml").write_text(CONFIG + "    noise: 1e-4 deg/s/sqrt(Hz)\n")
    found = analyse(load_config(bench / "quiet.yaml", str(bench / "rest.h5")), Faults())
    (note,) = [note for note in found.notes if note.startswith("motion")]
    assert "noise far beyond what the config declares: 19 of 19" in note
    assert found.used_s == pytest.approx(1200, abs=0.2)


def test_too_short_is_refused(bench):
    config = load_config(bench / "unit.yaml", f"{bench / 'rest.h5'}::0:9")
    with pytest.raises(TooShort, match="has 90 samples in stretches without a long gap, 1 of them, at most 90"):
        analyse(config, Faults())
    assert issubclass(TooShort, DataError)
    done = analyse(load_config(bench / "unit.yaml", f"{bench / 'rest.h5'}::0:12"), Faults())
    assert len(done.curves["gyro"][0].tau) > 5


def test_a_clock_that_is_coarser_than_the_rows_is_a_doubt(bench):
    """Ten rows a second with stamps of whole seconds: one of ten is left, and no limit passes on those."""
    write(bench / "whole.h5")
    with h5py.File(bench / "whole.h5", "r+") as file:
        file["time"][:] = np.floor(file["time"][:] + 1e-6)
    limited = bench / "limited.yaml"
    limited.write_text(CONFIG + "limits: {noise: 1 deg/s/sqrt(Hz)}\n")
    done = command(limited, "--input", bench / "whole.h5", "--json")
    content = json.loads(done.stdout)
    assert any("set source.interval" in note for note in content["notes"])
    assert [row["verdict"] for row in content["limits"]] == ["undecided"]
    sound = json.loads(command(limited, "--input", bench / "rest.h5", "--json").stdout)
    assert [row["verdict"] for row in sound["limits"]] == ["pass"]


def test_two_axes_are_named_in_the_lines(tmp_path):
    rates = np.stack([simulated(2000, s, white=1e-4) for s in (0, 1)], axis=1)
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["gyro"] = rates
    source = {"kind": "hdf5", "path": str(tmp_path / "two.h5"), "interval": "0.1 s"}
    config = Config.model_validate({"source": {**source, "channels": {"gyro": {"path": "gyro", "unit": "rad/s"}}}})
    lines = config_lines(analyse(config, Faults()))
    assert "axes: [x, y]" in lines
    assert "accel" not in lines


def test_coefficients_of_nothing_make_no_lines(tmp_path):
    """A triad that cannot be fitted is a comment, not a section that the config would refuse."""
    c = curve(np.zeros(200), DT)
    found = Analysis("x", DT, 20.0, 20.0, 0.0, {"gyro": ["x"]}, {"gyro": [c]}, {"gyro": [fit(c)]}, [])
    assert config_lines(found) == ""


@pytest.mark.recordings
def test_a_measured_recording_with_gaps_is_used_whole(recordings):
    """PAN CubeSat: 25 bursts of 250 rows, one every 305 s; the white noise of their means is that of the scatter."""
    path = recordings / "data/pan_tvc_lsm6dsm/pan_tvc_50hz_bursts.csv"
    channels = {
        "time": {"path": "t_s", "unit": "s"},
        "gyro": {"path": ["gx_rad_s", "gy_rad_s", "gz_rad_s"], "unit": "rad/s"},
    }
    found = analyse(
        Config.model_validate({"source": {"kind": "csv", "path": str(path), "channels": channels}}), Faults()
    )
    assert found.stretches == 25
    assert found.used_s == pytest.approx(25 * 250 * found.dt)
    means = np.genfromtxt(path.with_name("pan_tvc_burst_means.csv"), delimiter=",", names=True)
    scatter = np.sqrt(np.mean(means["gy_std_rad_s"] ** 2) * found.dt)
    assert found.coefficients["gyro"][1].value[N] == pytest.approx(scatter, rel=0.15)
