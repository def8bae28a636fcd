"""Simulated recordings: written, read back by the sources, and used by the other commands as any recording is."""

import json
import signal
import subprocess
import sys
import threading

import h5py
import numpy as np
import pytest
import yaml
from bench import some
from command_line import driftlab

from driftlab.commands.simulate import simulate, simulation
from driftlab.config import load_config, understood
from driftlab.storage import recorder
from fusion_core.chunk import concatenate
from fusion_core.errors import ConfigError, FusionError
from fusion_core.faults import Faults
from fusion_core.host.config import document_of
from fusion_plugins.sources.csv import Csv
from fusion_plugins.sources.hdf5 import Hdf5

CHANNELS = ("gyro", "accel", "temperature", "bias_truth")
TWIN = """
latitude: 40.9 deg
source: {kind: synthetic, seed: 3, rate: 20 Hz, duration: 30 s, latitude: 40.9 deg}
"""


@pytest.fixture
def config(tmp_path):
    (tmp_path / "twin.yaml").write_text(TWIN)
    return load_config(tmp_path / "twin.yaml")


def whole(source):
    return concatenate(source.chunks(100, Faults()))


def test_hdf5_is_read_back_with_units_from_the_file(config, tmp_path):
    written = simulate(config, out=tmp_path / "twin.h5")
    assert (written.rows, written.span, written.lines()) == (600, (0.0, 29.95), [])
    source = Hdf5(path=tmp_path / "twin.h5", channels={name: {"path": name} for name in ("time", *CHANNELS)})
    got, made = whole(source), whole(config.source)
    np.testing.assert_array_equal(got.t, made.t)
    for name in CHANNELS:
        np.testing.assert_array_equal(got[name], made[name])
    with h5py.File(tmp_path / "twin.h5") as file:
        assert {name: data.attrs["unit"] for name, data in file.items()} == written.channels
        assert json.loads(file.attrs["settings"])["seed"] == 3
    assert [p.name for p in tmp_path.iterdir() if "partial" in p.name] == []


def test_csv_is_read_back_as_its_comments_say(config, tmp_path):
    path = tmp_path / "twin.csv"
    simulate(config, out=path)
    comments = [line.removeprefix("# ") for line in path.read_text().splitlines() if line.startswith("#")]
    settings = yaml.safe_load("\n".join(comments[1:-1]))["source"]
    got, made = whole(Csv.model_validate({**settings, "path": path})), whole(config.source)
    np.testing.assert_array_equal(got.t, made.t)
    for name in CHANNELS:
        np.testing.assert_array_equal(got[name], made[name])
    assert json.loads(comments[-1].removeprefix("settings: "))["seed"] == 3


def test_a_recording_of_several_chunks_is_one_file(config, tmp_path):
    source = simulation(config, None, "1 h")
    for name, kind in (("long.h5", Hdf5), ("long.csv", Csv)):
        simulate(config, out=tmp_path / name, duration="1 h")
        fields = {"time": {"path": "time", "unit": "s"}, "temperature": {"path": "temperature", "unit": "degC"}}
        got = whole(kind(path=tmp_path / name, channels=fields))
        assert len(got) == 72_000
        np.testing.assert_array_equal(got["temperature"], whole(source)["temperature"])


def test_seed_and_duration_of_the_command_line_win(config):
    source = simulation(config, 9, "2 min")
    assert (source.seed, source.samples) == (9, 2400)
    assert source.latitude == config.source.latitude
    assert simulation(config, None, None) is config.source


@pytest.mark.parametrize(
    ("seed", "duration", "message"),
    [
        (None, "20", "command line: duration: '20' has no unit"),
        (None, "-1 s", "duration: '-1 s' must be greater than zero"),
        (None, "1 ms", "have no sample; write a longer duration"),
        (-1, None, "command line: seed: "),
    ],
)
def test_a_wrong_seed_or_duration_is_named(config, seed, duration, message):
    with pytest.raises(ConfigError, match=message):
        simulation(config, seed, duration)


@pytest.mark.parametrize("name", ["twin.h5", "twin.csv", "twin.ulg", "twin.bin", "twin.bag", "twin.mcap"])
def test_a_simulated_file_is_replaced_and_any_other_is_not(config, tmp_path, name):
    out = tmp_path / name
    simulate(config, out=out)
    first = out.read_bytes()
    simulate(config, out=out, seed=9)
    assert out.read_bytes() != first
    edited = out.read_bytes()[:-100] + out.read_bytes()[-90:]
    out.write_bytes(edited)
    with pytest.raises(ConfigError, match="was changed since `driftlab simulate` wrote it; move it away"):
        simulate(config, out=out)
    assert out.read_bytes() == edited
    out.write_text("time,gx\n0,1\n")
    with pytest.raises(ConfigError, match="exists, and nothing in it says that `driftlab simulate` wrote it"):
        simulate(config, out=out)
    assert out.read_text() == "time,gx\n0,1\n"


def test_bytes_of_a_device_are_replaced_and_those_of_others_are_not(config, tmp_path, monkeypatch):
    """They have no place for a SHA-256: it is in a file beside them, and right whenever the command is stopped."""
    out, put = tmp_path / "unit.dat", recorder.put
    simulate(config, out=out, framing="xsens_mtdata2")
    first = out.read_bytes()
    assert first[:3] == bytes.fromhex("FA FF 36")
    simulate(config, out=out, framing="xsens_mtdata2", seed=9)
    second = out.read_bytes()
    assert second != first

    def stopped(*args):
        raise KeyboardInterrupt

    monkeypatch.setattr(recorder, "put", stopped)
    with pytest.raises(KeyboardInterrupt):
        simulate(config, out=out, framing="xsens_mtdata2")
    monkeypatch.setattr(recorder, "put", put)
    assert out.read_bytes() == second
    (tmp_path / "unit.dat.partial").unlink()
    simulate(config, out=out, framing="xsens_mtdata2")
    assert out.read_bytes() == first
    out.write_bytes(first[:-1])
    with pytest.raises(ConfigError, match=r"unit\.dat: was changed since `driftlab simulate` wrote it; move it away"):
        simulate(config, out=out, framing="xsens_mtdata2")
    (tmp_path / "unit.dat.json").write_text("{}")
    with pytest.raises(
        ConfigError, match=r"unit\.dat: exists, and nothing in it says that `driftlab simulate` wrote it"
    ):
        simulate(config, out=out, framing="xsens_mtdata2")


def test_a_simulated_file_of_hdf5_that_was_edited_stays(config, tmp_path):
    simulate(config, out=tmp_path / "edited.h5")
    with h5py.File(tmp_path / "edited.h5", "r+") as file:
        file["gyro"][3] = 9.0
    with pytest.raises(ConfigError, match="was changed since `driftlab simulate` wrote it"):
        simulate(config, out=tmp_path / "edited.h5")
    with h5py.File(tmp_path / "measured.h5", "w") as file:
        file["gyro"] = [1.0]
    with pytest.raises(ConfigError, match="nothing in it says"):
        simulate(config, out=tmp_path / "measured.h5")


def test_a_run_that_dies_leaves_the_final_name_alone(config, tmp_path):
    def stop(t, rows):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        simulate(config, out=tmp_path / "twin.h5", progress=stop)
    assert not (tmp_path / "twin.h5").exists()
    with h5py.File(tmp_path / "twin.h5.partial") as file:
        assert len(file["time"]) == 600


def test_what_cannot_be_written_is_said(config, tmp_path):
    with pytest.raises(ConfigError, match=r"ends in '.mat'; write a name that ends in one of .h5, .hdf5, .csv, .*.ulg"):
        simulate(config, out=tmp_path / "twin.mat")
    (tmp_path / "file").write_text("")
    with pytest.raises(FusionError, match="cannot be written"):
        simulate(config, out=tmp_path / "file" / "twin.h5")


def test_a_source_that_reads_a_file_does_not_simulate(tmp_path):
    (tmp_path / "a.yaml").write_text("source: {kind: csv, interval: 1 s, channels: {gyro: {path: g, unit: deg/s}}}")
    with pytest.raises(ConfigError, match=r"kind csv does not simulate; write source: \{kind: synthetic\}"):
        simulation(load_config(tmp_path / "a.yaml"), 1, None)
    (tmp_path / "b.yaml").write_text("latitude: 40.9 deg")
    with pytest.raises(ConfigError, match=r"source: is missing; write source: \{kind: synthetic\}"):
        simulation(load_config(tmp_path / "b.yaml"), 1, None)


def test_an_earth_that_stands_still_is_noticed(tmp_path):
    (tmp_path / "a.yaml").write_text(TWIN.replace("30 s, latitude: 40.9 deg", "30 s"))
    config = load_config(tmp_path / "a.yaml")
    written = simulate(config, out=tmp_path / "a.h5")
    assert written.lines() == [
        "the recording has no Earth rate, and latitude is 40.9 deg in the rest of the config; write the same under "
        "source.latitude"
    ]


def test_the_command_makes_a_recording_that_the_others_use(tmp_path):
    (tmp_path / "twin.yaml").write_text("""
extends: mems_crs05
latitude: 40.9 deg
heading: 0 deg
source:
  kind: synthetic
  rate: 10 Hz
  latitude: 40.9 deg
  profile: {kind: table, time: [0 s, 588 s], temperature: [25 degC, 25 degC]}  # what the filter models: a walk
  gyro: {walk: 1.5e-4 deg/s/sqrt(s)}
""")
    (tmp_path / "unit.yaml").write_text("""
extends: mems_crs05
latitude: 40.9 deg
heading: 0 deg
source:
  kind: hdf5
  channels: {time: {path: time}, gyro: {path: gyro}, accel: {path: accel}, temperature: {path: temperature}}
""")
    done = driftlab("simulate", "twin.yaml", "--out", "new/ramp.h5", "--seed", 5, "--json", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    said = json.loads(done.stdout)
    assert (said["rows"], said["last_s"], said["source"]) == (5880, 587.9, "synthetic (seed 5)")
    assert said["units"] == {
        "time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC", "bias_truth": "rad/s",
    }  # fmt: skip
    done = driftlab("run", "unit.yaml", "--input", "new/ramp.h5", "--out", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    with h5py.File(tmp_path / "out" / "estimates.h5") as found, h5py.File(tmp_path / "new" / "ramp.h5") as made:
        bias, sigma = found["bias"][()], found["bias_sigma"][()]
        truth = np.stack([np.interp(found["t"][()], made["time"][()], b) for b in made["bias_truth"][()].T], axis=1)
        late = found["t"][()] > 120
        assert np.sqrt(np.mean(((bias - truth) / sigma)[late] ** 2)) < 1.5
    done = driftlab("simulate", "twin.yaml", "--out", "ramp.csv", "--duration", "10 s", cwd=tmp_path)
    assert done.stdout.splitlines() == [
        "synthetic (seed 0): 100 rows, t = 0 to 9.9 s",
        "written to ramp.csv: time, gyro, accel, temperature, bias_truth",
    ]
    done = driftlab("simulate", "twin.yaml", "--out", "ramp.mat", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("driftlab: --out ramp.mat: ends in '.mat'")


def test_the_filter_runs_on_the_simulation_itself(tmp_path):
    (tmp_path / "twin.yaml").write_text("extends: mems_crs05\nsource: {kind: synthetic, rate: 10 Hz, duration: 90 s}\n")
    done = driftlab("run", "twin.yaml", "--out", "out", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert 0.8 < json.loads(done.stdout)["nis"]["mean_per_component"] < 1.2


def test_a_spreadsheet_has_the_recording_with_units_in_its_heads(config, tmp_path):
    openpyxl = pytest.importorskip("openpyxl")
    out = tmp_path / "twin.xlsx"
    simulate(config, out=out)
    simulate(config, out=out)
    book = openpyxl.load_workbook(out, read_only=True)
    heads, *rows = book["recording"].values
    settings = json.loads(next(book["settings"].values)[0])
    book.close()
    assert heads[:4] == ("time [s]", "gyro_x [rad/s]", "gyro_y [rad/s]", "gyro_z [rad/s]")
    made, table = whole(config.source), np.array(rows)
    np.testing.assert_array_equal(table[:, 0], made.t)
    np.testing.assert_allclose(table[:, 1:4], made["gyro"], rtol=1e-15)  # a cell has 16 digits
    np.testing.assert_allclose(table[:, heads.index("temperature [degC]")], made["temperature"], rtol=1e-15)
    assert settings["seed"] == 3
    out.write_bytes(out.read_bytes().replace(b"PK", b"PQ", 1))
    with pytest.raises(ConfigError, match="was changed since `driftlab simulate` wrote it"):
        simulate(config, out=out)


def test_a_spreadsheet_that_is_too_long_is_refused(config, tmp_path, monkeypatch):
    pytest.importorskip("openpyxl")
    monkeypatch.setattr(recorder, "MOST_ROWS", 599)
    with pytest.raises(ConfigError, match=r"more than 599 rows, as many as a sheet holds; write .csv or .h5"):
        simulate(config, out=tmp_path / "twin.xlsx")
    assert not (tmp_path / "twin.xlsx").exists()


@pytest.mark.parametrize(
    ("ending", "package", "extra"),
    [("xlsx", "openpyxl", "excel"), ("bag", "rosbags", "ros"), ("mcap", "rosbags", "ros")],
)
def test_a_package_that_is_missing_is_named(config, tmp_path, monkeypatch, ending, package, extra):
    monkeypatch.setattr("fusion_core.errors.find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"package {package} is not installed, .*pip install 'driftlab\[{extra}\]'"):
        simulate(config, out=tmp_path / f"twin.{ending}")
    assert list(tmp_path.glob("twin.*")) == [tmp_path / "twin.yaml"]


DEVICE = """
source:
  kind: serial
  port: twin_port
  interval: 50 ms
  framing: {kind: kvh_1775, message: B, interval: 50 ms}
"""


def test_a_file_holds_the_bytes_of_a_device(config, tmp_path):
    (tmp_path / "device.yaml").write_text(DEVICE)
    written = simulate(config, out=tmp_path / "twin.bin", framing=tmp_path / "device.yaml")
    assert written.lines() == ["bias_truth: has no place in the file; the same seed gives it in .h5"]
    got, made = whole(load_config(tmp_path / "device.yaml").source.of_file(tmp_path / "twin.bin")), whole(config.source)
    np.testing.assert_allclose(got.t, made.t, atol=1e-9)
    np.testing.assert_allclose(got["gyro"], made["gyro"], rtol=1e-6)
    np.testing.assert_allclose(got["accel"], made["accel"], rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(got["temperature"], np.rint(made["temperature"]))
    simulate(config, out=tmp_path / "vn.bin", framing="vectornav_imu")
    assert len((tmp_path / "vn.bin").read_bytes()) == 600 * 44


def test_what_serves_nothing_is_named(config, tmp_path):
    with pytest.raises(ConfigError, match=r"--framing .*twin.yaml: its source has no framing"):
        simulate(config, out=tmp_path / "twin.bin", framing=tmp_path / "twin.yaml")
    with pytest.raises(ConfigError, match=r"--speed: is of a recording that is played; add --serve"):
        simulate(config, out=tmp_path / "twin.h5", speed=2.0)
    with pytest.raises(ConfigError, match=r"--speed 0: more than 0 was expected"):
        simulate(config, serve=True, speed=0.0)
    done = driftlab("simulate", "twin.yaml", cwd=tmp_path)
    assert (done.returncode, done.stderr) == (
        2, "driftlab: --out: is missing; name a file, as FILE.h5, or play it out of a device with --serve\n",
    )  # fmt: skip


def test_a_name_that_is_taken_is_no_device_s(config, tmp_path):
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    (tmp_path / "taken").write_text("")
    with pytest.raises(ConfigError, match=r"--out .*taken: cannot be linked \(File exists\); name another"):
        simulate(config, serve=True, out=tmp_path / "taken")


def test_a_config_reads_what_is_served(config, tmp_path):
    """The `source` that is said reads all samples, in the order and at the times at which they were simulated."""
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    begun, chunks = threading.Event(), []

    def listen(said):
        source = understood(document_of({"source": dict(said)})).source
        reader = threading.Thread(target=lambda: chunks.append(some(source.chunks(1000, Faults()), 599)))
        reader.start()
        begun.reader = reader

    served = simulate(config, serve=True, speed=30.0, out=tmp_path / "port", opened=listen)
    begun.reader.join()
    got, made = chunks[0], whole(config.source)
    assert (served.rows, served.lost, served.path) == (600, 0, tmp_path / "port")
    assert not (tmp_path / "port").is_symlink()
    first = 600 - len(got)  # the line that nobody saw begin
    assert first <= 1
    np.testing.assert_allclose(got.t, made.t[first:] - made.t[first], atol=1e-9)
    for name in ("gyro", "accel", "temperature"):
        np.testing.assert_array_equal(got[name], made[name][first:])


def test_a_device_that_nobody_opened_ends_by_ctrl_c(config, tmp_path):
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    command = [sys.executable, "-m", "driftlab", "simulate", "twin.yaml", "--serve", "--out", "port", "--json"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    first = json.loads(process.stdout.readline())["source"]
    assert (first["kind"], first["port"], first["interval"], first["framing"]["kind"]) == (
        "serial", "port", "0.05 s", "text",
    )  # fmt: skip
    assert (tmp_path / "port").exists()
    process.send_signal(signal.SIGINT)
    said = json.loads(process.communicate()[0])
    assert (process.returncode, said["rows"]) == (0, 0)
    assert not (tmp_path / "port").is_symlink()
