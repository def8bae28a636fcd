"""A config that `driftlab init` writes reads its file, and what it could not guess is asked for."""

import io
import re
import struct
import sys
from datetime import UTC, datetime
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
import yaml
from bags import FIELDS, unit
from bags import write as bag
from bench import FRAMING, frame
from dataflash_writer import write_log
from device_frames import kvh, one, vectornav, xsens
from scipy.io import savemat
from typer.testing import CliRunner
from typists import STOP, at_a_terminal
from ulog_writer import sensor, write_ulog
from units_at_rest import unit_at_rest

from driftlab.cli import app
from driftlab.commands import init as init_command
from driftlab.commands.allan import allan
from driftlab.commands.init import init
from driftlab.commands.simulate import simulate
from driftlab.config import load_config
from driftlab.starter.config_text import with_map
from fusion_core.chunk import concatenate
from fusion_core.errors import ConfigError, MissingChannel, UnreadableFile
from fusion_core.faults import Faults, usable
from fusion_core.units import convert

UNIT = unit_at_rest(seconds=400, rate=20, temperature=lambda t: 15 + t / 20, walk=1e-8)


def driftlab(*args):
    return CliRunner().invoke(app, [str(arg) for arg in args])


def samples(path):
    return concatenate(list(load_config(path).source.chunks(100_000, Faults())))


def table(names, gyro="rad/s", accel="m/s^2", time="s"):
    t, gx, ax, T = names
    columns = {t: convert(UNIT.t, "s", time)}
    columns |= {gx.replace("?", a): convert(UNIT.gyro[:, k], "rad/s", gyro) for k, a in enumerate("xyz")}
    columns |= {ax.replace("?", a): convert(UNIT.accel[:, k], "m/s^2", accel) for k, a in enumerate("xyz")}
    return columns | {T: UNIT.temperature}


def written(tmp_path, content, **more):
    file = tmp_path / "rec.csv"
    pl.DataFrame(content).write_csv(file)
    return init(file, out=tmp_path / "rec.yaml", **more)


LOGS = {
    "short": ("t", "g?", "a?", "temp"),
    "spoken": ("Time", "Gyro ? (deg/s)", "Accel ? (g)", "Temperature (C)"),
    "terms": ("timestamp", "omega_?", "specific_force_?", "T"),
}


@pytest.mark.parametrize(("names", "gyro", "accel", "time"), [
    ("short", "rad/s", "m/s^2", "s"), ("short", "deg/s", "g", "ms"), ("short", "deg/s", "mg", "us"),
    ("spoken", "deg/s", "g", "ms"), ("terms", "rad/s", "m/s^2", "ns"),
])  # fmt: skip
def test_a_csv_is_read_as_it_was_written(tmp_path, names, gyro, accel, time):
    done = written(tmp_path, table(LOGS[names], gyro, accel, time))
    assert done.asked == ()
    got = samples(done.path)
    np.testing.assert_allclose(got.t, UNIT.t, atol=1e-6)
    np.testing.assert_allclose(got["gyro"], UNIT.gyro, rtol=1e-9)
    np.testing.assert_allclose(got["accel"], UNIT.accel, rtol=1e-9)
    np.testing.assert_allclose(got["temperature"], UNIT.temperature)


def test_every_guess_is_marked_and_nothing_else(tmp_path):
    said = written(tmp_path, table(LOGS["spoken"], "deg/s", "g", "ms")).text
    lines = {line.split(":")[0].strip(): line for line in said.splitlines() if line.startswith("    ")}
    assert "# by the name" in lines["gyro"]
    assert "# by the name" in lines["accel"]
    assert re.search(r"unit: ms\}   # guess: steps of 50 ms are 20 Hz", lines["time"])
    assert "# guess: " in lines["noise"]
    assert re.search("# (guess|unknown): ", lines["bias"])


def test_three_rates_without_axes_of_one_unit_in_a_line_of_its_own_are_a_triad(tmp_path):
    file, rows = tmp_path / "rec.csv", np.column_stack([UNIT.t, np.rad2deg(UNIT.gyro), UNIT.temperature])
    with file.open("w") as stream:
        stream.write("Time;Alpha rate;Beta rate;Gamma rate;Temp\ns;deg/s;deg/s;deg/s;degC\n")
        np.savetxt(stream, rows, fmt="%.9g", delimiter=";")
    gyro = yaml.safe_load(init(file, out=tmp_path / "rec.yaml").text)["source"]["channels"]["gyro"]
    assert gyro == {"path": ["Alpha rate", "Beta rate", "Gamma rate"], "unit": "deg/s"}


@pytest.mark.parametrize(
    "command", [("check",), ("run", "--out", "out"), ("fit-map", "--kind", "spline", "--out", "m.json")]
)
def test_what_is_written_runs(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    written(tmp_path, table(LOGS["short"], "deg/s", "g", "ms"))
    done = driftlab(command[0], "rec.yaml", *command[1:])
    assert done.exit_code == 0, done.output


def test_the_noise_is_that_of_the_unit(tmp_path):
    rng = np.random.default_rng(0)
    content = table(LOGS["short"]) | {
        f"g{a}": 0.01 + 1e-4 * np.sqrt(20) * rng.standard_normal(len(UNIT.t)) for a in "xyz"
    }
    config = load_config(written(tmp_path, content, units={"gyro": "rad/s"}).path)
    np.testing.assert_allclose(config.filter.tracked.noise, 1e-4, rtol=0.1)


def test_hdf5_takes_the_units_of_the_file(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        for name, values, unit in (
            ("imu/stamp", UNIT.t, "seconds since 2026-01-01"), ("imu/gyro", np.rad2deg(UNIT.gyro), "deg/s"),
            ("imu/acceleration", UNIT.accel / 9.80665, "g"), ("board/temperature", UNIT.temperature, "C"),
        ):  # fmt: skip
            file[name] = values
            file[name].attrs["units"] = unit
        file["note"] = np.array([b"of the bench"])
    done = init(tmp_path / "log.h5", out=tmp_path / "log.yaml")
    assert done.asked == ()
    assert len(re.findall("# (?:guess|unknown)", done.text)) == 4  # noise and walk of both
    got = samples(done.path)
    np.testing.assert_allclose(got["gyro"], UNIT.gyro, rtol=1e-12)
    np.testing.assert_allclose(got["temperature"], UNIT.temperature)


def test_parquet_and_mat_are_read_as_they_were_written(tmp_path):
    pl.DataFrame(table(LOGS["short"], "deg/s", "g", "ms")).write_parquet(tmp_path / "log.parquet")
    imu = {"t": UNIT.t[:, None], "gyro": np.rad2deg(UNIT.gyro), "acc": UNIT.accel / 9.80665, "temp": UNIT.temperature}
    savemat(tmp_path / "log.mat", {"imu": imu, "unit": "bench 7"})
    for file, kind in (("log.parquet", "parquet"), ("log.mat", "mat")):
        done = init(tmp_path / file, out=tmp_path / f"{kind}.yaml")
        assert f"  kind: {kind}\n" in done.text
        got = samples(done.path)
        np.testing.assert_allclose(got["gyro"], UNIT.gyro, rtol=1e-9)
        np.testing.assert_allclose(got["accel"], UNIT.accel, rtol=1e-9)
        np.testing.assert_allclose(got.t, UNIT.t, atol=1e-9)


def test_an_autopilots_log_takes_three_lines(tmp_path):
    write_log(tmp_path / "vehicle.bin", UNIT.t + 1, [(UNIT.gyro, UNIT.accel, UNIT.temperature)])
    topics = [sensor("sensor_gyro", 0, UNIT.t + 1, UNIT.gyro, UNIT.temperature, 1310988)]
    topics += [sensor("sensor_accel", 0, UNIT.t + 1, UNIT.accel, UNIT.temperature, 1310988)]
    write_ulog(tmp_path / "vehicle.ulg", topics)
    for file, product in (("vehicle.bin", "ardupilot_log"), ("vehicle.ulg", "px4_log")):
        done = init(tmp_path / file, out=tmp_path / f"{product}.yaml")
        config = [line for line in done.text.splitlines() if not line.startswith("#")]
        assert config == [f"extends: {product}", f"source: {{path: {file}}}"]
        np.testing.assert_allclose(samples(done.path)["gyro"], UNIT.gyro, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("kind", ["ros1", "sqlite3", "mcap"])
def test_a_bag_is_told_by_the_types_of_its_messages(tmp_path, kind):
    bags = pytest.importorskip("bags")  # which needs rosbags
    made = bags.write(tmp_path / "bag", kind, bags.unit)
    done = init(made, out=tmp_path / "bag.yaml")
    channels = done.text.partition("channels:")[2].partition("filter:")[0]
    assert channels.count("# as the file says") == 4
    got = samples(done.path)
    np.testing.assert_allclose(got["gyro"], bags.GYRO[: len(got)])
    np.testing.assert_allclose(got["temperature"][:1], 20.0)


@pytest.mark.parametrize("ending", ["csv", "h5"])
def test_a_simulated_recording_says_its_units_itself(tmp_path, ending):
    (tmp_path / "twin.yaml").write_text("source: {kind: synthetic, duration: 60 s, rate: 20 Hz}\n")
    simulate(load_config(tmp_path / "twin.yaml"), out=tmp_path / f"sim.{ending}")
    done = init(tmp_path / f"sim.{ending}", out=tmp_path / "sim.yaml")
    channels = done.text.partition("channels:")[2].partition("filter:")[0]
    assert channels.count("# as the file says") == 4
    assert "# guess" not in channels
    assert abs(np.linalg.norm(samples(done.path)["accel"][0]) - 9.8) < 0.1


def test_what_cannot_be_guessed_is_asked_for_and_check_says_where(tmp_path):
    rng = np.random.default_rng(1)
    counts = {f"g{a}": np.rint(40 * rng.standard_normal(2000) + 120) for a in "xyz"}
    done = written(tmp_path, {"t": np.arange(2000) / 100, **counts})
    assert len(done.asked) == 1
    assert "raw counts" in done.asked[0]
    checked = driftlab("check", done.path)
    assert checked.exit_code != 0
    assert "filter.gyro.noise: is required and missing" in str(checked.exception)
    done.path.unlink()
    done = written(tmp_path, {"t": np.arange(2000) / 100, **counts}, units={"gyro": "0.0305 deg/s"})
    assert done.asked == ()
    assert driftlab("check", done.path).exit_code == 0


def test_without_a_time_column_the_interval_is_asked_for(tmp_path):
    content = table(LOGS["short"])
    del content["t"]
    done = written(tmp_path, content)
    assert done.asked[0] == "the interval between rows: no column is a time"
    with pytest.raises(ConfigError, match="neither a time channel nor an interval is given"):
        load_config(done.path)


def test_dates_in_no_known_form_are_named_with_what_to_write(tmp_path):
    content = table(LOGS["short"])
    times = [f"14. Mär 2025 09:{k // 60:02d}:{k % 60:02d}" for k in range(len(UNIT.t))]
    done = written(tmp_path, content | {"t": times})
    assert done.problems == (
        "line 2, column 't': '14. Mär 2025 09:00:00' is neither a number nor a date that is known; write dates as "
        "2026-03-14 09:00:00",
    )


def test_a_sensor_that_is_no_gyro_is_held(tmp_path):
    t = 5.0 * np.arange(3000)
    rng = np.random.default_rng(2)
    done = written(tmp_path, {"time": t, "ppm": rng.standard_normal(3000), "oven": 30 + 10 * np.sin(t / 3000)})
    config = load_config(done.path)
    assert config.filter.kind == "held"
    assert config.filter.tracked.channel == "ppm"
    assert driftlab("check", done.path).exit_code == 0


def test_a_column_that_is_not_read_is_listed_and_a_flag_says_how_it_is_taken(tmp_path):
    N = len(UNIT.t)
    good = np.arange(N) % 50 > 0
    more = {"state": np.where(good, 3, 0), "status": np.where(good, "OK", "ERR, loud"), "who": np.array(["me"] * N)}
    done = written(tmp_path, table(LOGS["short"]) | more | {"good_volts": 3.3 + 0.01 * np.arange(N)})
    text = done.path.read_text()
    assert (
        "    # valid: {path: state}   # leaves out the rows in which it is 0, 2 % of these: where 0 is no reading\n"
        in text
    )
    assert '    # valid: {path: status}   # with source.flags: {status: "ERR, loud"}, where that text is' in text
    assert "    # who is not read: line 2, column 'who': 'me' is not a number" in text
    assert "    # good_volts: {path: good_volts" in text, "of many values: no flag"
    assert done.asked == ()
    taken = text.replace("    # valid: {path: status}   # with", "    valid: {path: status}   # with")
    taken = taken.replace("  channels:", "  flags: {status: OK}\n  channels:")
    (tmp_path / "taken.yaml").write_text(taken)
    source, faults = load_config(tmp_path / "taken.yaml").source, Faults()
    assert sum(map(len, usable(source.chunks(100_000, faults), faults, "rec"))) == np.sum(good)


def test_bytes_of_a_device_are_told_by_the_installed_framings(tmp_path):
    noisy = 0.01 * np.random.default_rng(3).standard_normal((600, 2, 3)) + [[0, 0, 9.8], [0, 0, 0]]
    for name, data in (
        ("vn", b"".join(vectornav(k * 10_000_000, *xyz, temperature=25) for k, xyz in enumerate(noisy))),
        ("mti", b"".join(one(k, 20.0, gyro=xyz[0]) for k, xyz in enumerate(noisy))),
    ):
        (tmp_path / f"{name}.bin").write_bytes(data)
    done = init(tmp_path / "vn.bin", out=tmp_path / "vn.yaml")
    assert "extends: vectornav_imu " in done.text
    assert done.asked == ()
    assert len(samples(done.path)) == 600
    done = init(tmp_path / "mti.bin", out=tmp_path / "mti.yaml")
    assert "extends: xsens_mtdata2 " in done.text
    assert done.asked == ("the noise of accel: no quiet stretch with a known time was found",)
    (tmp_path / "unknown.bin").write_bytes(b"".join(map(frame, range(50))))
    assert FRAMING["sync"] == "A5 5A"  # of no product
    with pytest.raises(
        UnreadableFile, match=r"no installed source reads it.* describe its frames under source\.framing"
    ):
        init(tmp_path / "unknown.bin", out=tmp_path / "unknown.yaml")


def test_a_folder_that_is_no_bag_is_said_to_be_one(tmp_path):
    (tmp_path / "soaks").mkdir()
    (tmp_path / "soaks" / "a.csv").write_text("t,gx\n0,1\n")
    with pytest.raises(
        UnreadableFile, match=r"soaks: is a folder, and none of a bag that can be read; name a file in it$"
    ):
        init(tmp_path / "soaks", out=tmp_path / "soaks.yaml")


def without_a_clock(k, gyro, g):
    """Message of Xsens, with the packet counter alone."""
    three = [(0x4020, struct.pack(">3f", *9.8 * g)), (0x8020, struct.pack(">3f", *gyro))]
    return xsens((0x1020, struct.pack(">H", k)), (0x0810, struct.pack(">f", 20 + k / 100)), *three)


@pytest.mark.parametrize("unit", ["kvh A", "kvh B", "xsens"])
def test_bytes_without_a_clock_need_an_interval_which_is_then_in_the_config(tmp_path, monkeypatch, unit):
    """Angles become rates by it: those of KVH with a clock are 5 ms apart by themselves."""
    monkeypatch.chdir(tmp_path)
    rates = 0.01 + 1e-4 * np.random.default_rng(3).standard_normal((15_000, 3))
    g = [0, 0, 1] + 1e-3 * np.random.default_rng(4).standard_normal((15_000, 3))
    frames = enumerate(zip(rates, g, strict=True))
    if unit == "xsens":
        data = b"".join(without_a_clock(k, *values) for k, values in frames)
    else:
        data = b"".join(kvh(k, unit[-1], 20 + k // 200, 0.005 * rate, f, us=5000) for k, (rate, f) in frames)
    Path("unit.bin").write_bytes(data)
    if unit != "kvh B":
        done = driftlab("init", "unit.bin")
        assert done.exit_code == 1
        assert "fill in: the interval between samples: the frames have no clock" in done.output
    done = driftlab("init", "unit.bin", *(() if unit == "kvh B" else ("--interval", "5 ms")))
    assert done.exit_code == 0, done.output
    got = samples(tmp_path / "unit.yaml")
    np.testing.assert_allclose(got["gyro"], rates, rtol=1e-5)
    np.testing.assert_allclose(np.diff(got.t), 0.005)
    for command in (("check",), ("run", "--out", "out")):
        assert driftlab(command[0], "unit.yaml", *command[1:]).exit_code == 0


def test_a_file_without_a_sensor_says_what_it_has(tmp_path):
    with pytest.raises(
        MissingChannel,
        match=r"no column is called like a gyro; it has one, b, c \(no numbers in c\); name those of its axes, as",
    ):
        written(tmp_path, {"one": [1.0, 2.0], "b": [1.0, 2.0], "c": ["x", "y"]})


def test_a_config_is_made_anew_until_somebody_changes_it_and_wrong_units_are_refused(tmp_path):
    written(tmp_path, table(LOGS["short"]))
    done = written(tmp_path, table(LOGS["short"]), units={"gyro": "deg/s"})
    assert "unit: deg/s}" in done.text
    assert done.path.read_text() == done.text
    done.path.write_text(done.text.replace("60 s", "30 s"))
    with pytest.raises(
        ConfigError, match=r"rec\.yaml: was changed since `driftlab init` wrote it; move it away, or name"
    ):
        written(tmp_path, table(LOGS["short"]))
    done.path.write_text(done.text)
    refused = driftlab("init", tmp_path / "rec.csv", "--out", tmp_path / "b.yaml", "--unit", "gyro=m")
    assert "channel gyro: unit 'm' cannot be converted to rad/s" in str(refused.exception)
    refused = driftlab("init", tmp_path / "rec.csv", "--out", tmp_path / "b.yaml", "--unit", "gyro")
    assert "--unit gyro: is not CHANNEL=UNIT" in str(refused.exception)
    refused = driftlab("init", tmp_path / "rec.csv", "--out", tmp_path / "b.yaml", "--unit", "depth=m")
    assert "no channel is called so; known: time, gyro, accel, temperature" in str(refused.exception)
    assert done.path.read_text() == done.text
    assert not (tmp_path / "b.yaml").exists()


def test_a_bag_of_several_topics_is_about_the_first_inertial_unit(tmp_path):
    """Its rows are that unit's; the thermometer of another topic is taken by its unit, not by its counter or stamp."""
    bag(tmp_path / "bag", "mcap", lambda types: unit(types, 3000))
    done = init(tmp_path / "bag", out=tmp_path / "bag.yaml")
    config = load_config(done.path)
    assert config.source.channels["time"].paths == (FIELDS["time"]["path"],)
    assert [p.partition(".")[0] for p in config.source.channels["gyro"].paths] == [FIELDS["time"]["path"]] * 3
    assert config.source.channels["temperature"].paths == (FIELDS["temperature"]["path"],)


def test_columns_interval_and_decimal_sign_can_be_said(tmp_path):
    content = table(("Elapsed", "w?", "a?", "case"), "deg/s", "g")
    got = samples(
        written(tmp_path, content, columns={"time": "elap", "gyro": "wz,wx,wy"}, units={"gyro": "deg/s"}).path
    )
    np.testing.assert_allclose(got["gyro"], UNIT.gyro[:, [2, 0, 1]], rtol=1e-9)
    config = load_config(
        written(tmp_path, content, interval="50 ms", units={"time": "s"}, columns={"temperature": "case"}).path
    )
    assert config.source.interval == 0.05
    assert "time" not in config.source.channels
    for columns, message in (
        ({"gyro": "w"}, "3 columns begin so"),
        ({"gyro": "rate"}, "no column of numbers is called so"),
    ):
        with pytest.raises(ConfigError, match=message):
            written(tmp_path, content, columns=columns)
    (tmp_path / "rec.csv").write_text("t;gx;temp\n" + "".join(f"{k};{k}00;2{k % 7}\n" for k in range(400)))
    text = init(tmp_path / "rec.csv", decimal="comma", units={"gyro": "0.001 deg/s"}).text
    assert 'decimal: ","' in text
    with pytest.raises(ConfigError, match="--decimal dot: is no decimal sign; write comma or point"):
        init(tmp_path / "rec.csv", decimal="dot")


def test_a_column_whose_head_has_another_unit_is_no_gyro(tmp_path):
    content = table(("t", "Rate ? (deg/s)", "Acc ? (m/s^2)", "temp"), "deg/s")
    message = r"^column 'Acc x \(m/s\^2\)': is in m/s\^2, which is no unit of gyro; name other columns, or its unit"
    with pytest.raises(ConfigError, match=message):
        written(tmp_path, content, columns={"gyro": ",".join(f"Acc {axis} (m/s^2)" for axis in "xyz")})


MOVING = {f"g{a}": np.deg2rad(5) * np.sin(np.arange(len(UNIT.t)) / 40 + k) for k, a in enumerate("xyz")}


@pytest.mark.parametrize(("change", "problem"), [
    ({"temp": None}, "no column is known as a temperature, and a map is fitted over one"),
    ({"temp": np.full(len(UNIT.t), 21.5)}, "temperature does not change: it shows 21.5 in every row"),
    ({"gx": np.where(np.arange(len(UNIT.t)) % 3, UNIT.gyro[:, 0], np.nan)}, "gyro: 33% of the first 8,000 rows"),
    (MOVING, "the gyro is never at rest: its means over 1 s vary by"),
])  # fmt: skip
def test_it_looks_into_the_data_before_it_vouches(tmp_path, change, problem):
    content = {name: values for name, values in (table(LOGS["short"]) | change).items() if values is not None}
    pl.DataFrame(content).write_csv(tmp_path / "rec.csv")
    done = driftlab("init", tmp_path / "rec.csv", "--out", tmp_path / "rec.yaml", "--unit", "gyro=rad/s")
    assert done.exit_code == 1
    assert f"problem: {problem}" in done.output
    assert "then: driftlab fit-map" not in done.output


@pytest.mark.parametrize(("content", "message"), [
    (b"ULog\x01\x12\x35" + np.random.default_rng(6).bytes(4000), "ends before its first row"),
    (b"t,gx,gy,gz,temp\n", "has the columns t, gx, gy, gz, temp and no rows of numbers"),
    (b"t,gx,gy,gz,temp\n" + b"1,nan,nan,nan,nan\n" * 300, "no column is called like a gyro"),
])  # fmt: skip
def test_what_is_no_recording_writes_nothing(tmp_path, content, message):
    (tmp_path / "rec.csv").write_bytes(content)
    done = driftlab("init", tmp_path / "rec.csv", "--out", tmp_path / "rec.yaml")
    assert done.exit_code == 1
    assert re.search(message, str(done.exception))
    assert not (tmp_path / "rec.yaml").exists()


ENTER, DOWN = "\r", "\x1b[B"


def answered(tmp_path, *keys, **environment):
    """Status of `init` of a file that says too little, and what it showed to a person who answers with these keys."""
    content = table(("when", "q?", "b?", "temperature"), "deg/s", "g")
    pl.DataFrame(content).write_csv(tmp_path / "rec.csv")
    asked = [("]:" if environment.get("TERM") == "dumb" else "text:", key) for key in keys]
    return at_a_terminal("init", "rec.csv", cwd=tmp_path, answers=asked, **environment)


def test_in_a_terminal_it_asks_what_it_cannot_know(tmp_path):
    """Arrow keys lead to the answers, the guess first; a number, or text, is an answer too."""
    _, shown = answered(tmp_path, ENTER, "5" + ENTER, "50 ms" + ENTER, DOWN + ENTER, ENTER)
    assert "the columns of the gyro's axes: no name says which they are" in shown
    assert "> 1) qx,qy,qz   (the guess)" in shown
    assert re.search(r"the unit of gyro \(mean .*: rad/s or deg/s\?\)", shown)
    assert re.search(r"the unit of temperature \(15.2 to 34.8\).*> 1\) degC   \(the guess\)", shown, re.DOTALL)
    assert "'5' has no unit" in shown  # and is asked again
    source = load_config(tmp_path / "rec.yaml").source
    assert source.channels["gyro"].paths == ("qx", "qy", "qz")
    assert source.channels["gyro"].unit == "deg/s"  # the first, below the last one
    assert source.interval == 0.05


class Lines(io.StringIO):
    def isatty(self):
        return True


def test_in_a_dumb_terminal_answers_are_lines(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TERM", "dumb")
    pl.DataFrame(table(("when", "q?", "b?", "case"), "deg/s", "g")).write_csv("rec.csv")
    monkeypatch.setattr(sys, "stdout", screen := Lines())
    monkeypatch.setattr(sys, "stdin", Lines("3,4,5\n50 ms\n1\n"))
    arguments = init_command.arguments_of({"file": Path("rec.csv")}, {"json": False})
    assert "1) qx,qy,qz   (the guess)" in screen.getvalue()
    assert arguments["columns"] == {"gyro": "qx,qy,qz"}
    assert arguments["interval"] == "50 ms"
    assert arguments["units"]["gyro"] == "deg/s"
    assert arguments["out"] == Path("rec.yaml")


@pytest.mark.parametrize("kind", ["xterm", "dumb"])
def test_an_interview_that_is_stopped_ends_in_one_line(tmp_path, kind):
    status, shown = answered(tmp_path, STOP, TERM=kind)
    assert status == 130
    assert shown.rstrip().endswith("driftlab: interrupted; nothing was written")
    assert "Traceback" not in shown
    assert [path.name for path in tmp_path.iterdir()] == ["rec.csv"]


def test_go_fits_the_map_at_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pl.DataFrame(table(LOGS["spoken"], "deg/s", "g", "ms")).write_csv(tmp_path / "rec.csv")
    done = driftlab("init", "rec.csv", "--go")
    assert done.exit_code == 0, done.output
    assert f"the page: {tmp_path / 'rec.map.report.html'}" in done.output
    assert "    calibration: {kind: spline, path: rec.map.json}\n" in (tmp_path / "rec.yaml").read_text()
    assert "to use it" not in done.output
    assert "rec.yaml names the map now; next: driftlab run rec.yaml" in done.output
    assert driftlab("run", "rec.yaml").exit_code == 0
    again = driftlab("init", "rec.csv", "--go")  # both files are as they were written
    assert again.exit_code == 0, again.output


def test_the_map_takes_the_place_of_its_comment(tmp_path):
    """A column that is called calibration is none; nor is a config without the comment touched."""
    write_log(tmp_path / "vehicle.bin", UNIT.t + 1, [(UNIT.gyro, UNIT.accel, UNIT.temperature)])
    config = with_map(init(tmp_path / "vehicle.bin").text, "spline", "a \\1.json")
    assert yaml.safe_load(config)["filter"] == {"gyro": {"calibration": {"kind": "spline", "path": "a \\1.json"}}}
    other = "    # calibration: {path: calibration}\n"
    assert with_map(other, "spline", "a.json") == other


def test_allan_measures_the_noise_that_a_config_lacks(tmp_path):
    content = {name: values for name, values in table(LOGS["short"]).items() if name != "temp"}
    done = written(tmp_path, content, units={"gyro": "rad/s"})
    bare = re.sub(r"    noise: .*\n|, walk: [^}]*", "", done.text)
    assert "noise:" not in bare
    (tmp_path / "bare.yaml").write_text(bare)
    assert driftlab("allan", tmp_path / "bare.yaml").exit_code == 0
    assert allan(tmp_path / "bare.yaml").config_lines == allan(done.path).config_lines


def test_the_true_bias_of_a_simulated_recording_is_no_sensor(tmp_path):
    """It has the gyro's unit, and stands before it by its letters."""
    twin = {"source": {"kind": "synthetic", "rate": "1 Hz", "profile": {"kind": "ramp"}}}
    simulate(twin, out=tmp_path / "twin.h5", seed=1, duration="10 min")
    init(tmp_path / "twin.h5", out=tmp_path / "twin.yaml")
    with h5py.File(tmp_path / "twin.h5") as file:
        np.testing.assert_array_equal(samples(tmp_path / "twin.yaml")["gyro"], file["gyro"])


def test_a_recording_over_midnight_whose_clock_has_no_day(tmp_path):
    moments = [f"{int(s) // 3600 % 24:02}:{int(s) // 60 % 60:02}:{s % 60:06.3f}" for s in 86_300 + UNIT.t - UNIT.t[0]]
    content = table(("Time", "g? (rad/s)", "a? (m/s^2)", "T (degC)"))
    text = written(tmp_path, content | {"Time": moments}).text
    assert "%H:%M:%S" in text
    np.testing.assert_allclose(np.diff(samples(tmp_path / "rec.yaml").t), 0.05, atol=1e-6)


def day_of(day, month, **given):
    """The line of `dates` that is written of a recording which begins on a day, and the day of its first time."""
    content = table(("Time", "g? (rad/s)", "a? (m/s^2)", "T (degC)"))
    moments = [f"{day(k)}/{month}/2026 {k // 3600:02}:{k // 60 % 60:02}:{k % 60:02}" for k in range(900)]
    pl.DataFrame({k: v[:900] for k, v in content.items()} | {"Time": moments}).write_csv("rec.csv")
    text = init("rec.csv", out="rec.yaml", **given).text
    first = datetime.fromtimestamp(samples(Path("rec.yaml")).t[0], UTC)
    return next(line for line in text.splitlines() if "dates:" in line), (first.day, first.month)


def test_a_day_that_may_be_a_month_is_a_guess_until_it_is_said_or_a_later_row_tells(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    line, _ = day_of(lambda k: "03", "04")
    assert "# guess: whichever of day and month stands first" in line
    for first, expected in (("day", (3, 4)), ("month", (4, 3))):
        line, date = day_of(lambda k: "03", "04", dates=first)
        assert "guess" not in line
        assert date == expected
    line, date = day_of(lambda k: "12" if k < 800 else "13", "04")
    assert "guess" not in line
    assert date == (12, 4)
    with pytest.raises(ConfigError, match="--dates year: is no part of a date that stands first; write day or month"):
        init("rec.csv", dates="year")


@pytest.mark.parametrize(("number", "guessed"), [("{},{:03}", True), ("0,{}{:03}", False), ("{},{:03}5", False)])
def test_a_comma_before_three_digits_may_part_thousands(tmp_path, number, guessed):
    rng = np.random.default_rng(5)
    rows = [";".join(number.format(*rng.integers([1, 0], [9, 1000])) for _ in range(3)) for _ in range(500)]
    (tmp_path / "rec.csv").write_text("t;gx;gy;gz\n" + "".join(f"{k};{row}\n" for k, row in enumerate(rows)))
    assert ("# guess: all commas have three digits behind" in init(tmp_path / "rec.csv").text) == guessed
    assert "# guess: all commas" not in init(tmp_path / "rec.csv", decimal="comma").text


def test_a_row_without_a_value_does_not_hide_the_names(tmp_path):
    file = tmp_path / "rec.csv"
    pl.DataFrame(table(LOGS["spoken"], "deg/s", "g", "ms")).write_csv(file)
    lines = file.read_text().splitlines()
    file.write_text("\n".join([*lines[:51], "," * lines[0].count(","), *lines[51:]]) + "\n")
    done = init(file, out=tmp_path / "rec.yaml")
    assert not done.problems
    gyro = samples(tmp_path / "rec.yaml")["gyro"]
    np.testing.assert_allclose(np.delete(gyro, 50, 0), UNIT.gyro, atol=1e-12)


def test_a_line_of_units_says_which_column_is_the_thermometer(tmp_path):
    """T1 alone may be a time."""
    file = tmp_path / "rec.csv"
    rows = np.column_stack([UNIT.t, np.rad2deg(UNIT.gyro), UNIT.temperature])
    text = "\n".join(",".join(f"{v:.9g}" for v in row) for row in rows.tolist())
    file.write_text(f"clock,GX,GY,GZ,T1\ns,°/s,°/s,°/s,°C\n{text}\n")
    done = init(file, out=tmp_path / "rec.yaml")
    assert not done.problems
    np.testing.assert_allclose(samples(tmp_path / "rec.yaml")["temperature"], UNIT.temperature, rtol=1e-6)


@pytest.mark.parametrize("cell", ["n/a", "NA", "null"])
def test_a_cell_that_says_it_is_empty_is_empty(tmp_path, cell):
    file = tmp_path / "rec.csv"
    pl.DataFrame(table(LOGS["spoken"], "deg/s", "g", "ms")).write_csv(file)
    lines = file.read_text().splitlines()
    cells = lines[300].split(",")
    lines[300] = ",".join([*cells[:2], cell, *cells[3:]])
    file.write_text("\n".join(lines) + "\n")
    done = init(file, out=tmp_path / "rec.yaml")
    assert not done.problems
    gyro = samples(tmp_path / "rec.yaml")["gyro"]
    assert np.argwhere(np.isnan(gyro)).tolist() == [[299, 1]]
    np.testing.assert_allclose(np.delete(gyro, 299, 0), np.delete(UNIT.gyro, 299, 0), atol=1e-12)


@pytest.mark.parametrize("apart", [False, True])
def test_a_thermometer_that_few_rows_read_is_no_problem(tmp_path, apart):
    """Its cells are empty in between, or its readings have rows of their own."""
    content = table(LOGS["short"], "deg/s", "g")
    read = np.arange(len(UNIT.t)) % 10 == 3
    rows = pl.DataFrame(content | {"temp": np.where(read & (not apart), content["temp"], np.nan)})
    if apart:
        alone = {name: np.where(name in "t temp", values, np.nan)[read] for name, values in content.items()}
        rows = pl.concat([rows, pl.DataFrame(alone | {"t": alone["t"] + 1e-3})]).sort("t")
    rows.fill_nan(None).write_csv(tmp_path / "rec.csv")
    done = init(tmp_path / "rec.csv", out=tmp_path / "rec.yaml", units={"gyro": "deg/s"})
    assert (done.asked, done.problems) == ((), ())
    got = samples(tmp_path / "rec.yaml")
    np.testing.assert_allclose(got["gyro"], UNIT.gyro, atol=1e-12)
    np.testing.assert_allclose(got["temperature"][3:-6], UNIT.temperature[3:-6], atol=1e-3)


def test_a_clock_that_was_set_back_is_a_time_and_a_problem(tmp_path):
    done = written(tmp_path, table(LOGS["short"]) | {"t": np.where(UNIT.t > UNIT.t[4000], UNIT.t - 1, UNIT.t)})
    assert "time: {path: t, unit: s}" in done.text
    assert done.problems[0].startswith("time runs backwards by 0.95 s, 200 s after the first row: sort the rows, or")


@pytest.mark.parametrize(("factor", "problems"), [(1.0, 0), (5.0, 0), (1e-3, 1)])
def test_an_axis_with_far_less_noise_than_the_others_is_a_problem(tmp_path, factor, problems):
    content = table(LOGS["short"])
    done = written(tmp_path, content | {"gy": content["gy"] * factor})
    quiet = [text for text in done.problems if "less noise than the others" in text]
    assert len(quiet) == problems
    assert all(text.startswith(("gyro y has 1,0", "gyro y has 9")) for text in quiet)


def test_a_counter_that_begins_again_is_a_problem_with_its_remedy(tmp_path):
    """In ms and of 32 bits, after 200 s: no sorting puts that in order."""
    counted = (2**32 - 200_000 + np.round(1000 * (UNIT.t - UNIT.t[0]))) % 2**32
    rows = {name: values for name, values in table(LOGS["short"]).items() if name != "t"}
    done = written(tmp_path, {"t_ms": counted, **rows})
    assert "time: {path: t_ms, unit: ms}" in done.text
    assert "after the first row: its counter of 32 bits began again: add 4,294,967,296 ms" in done.problems[0]
