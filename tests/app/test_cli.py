"""The command line as a user meets it: real files; what one process says is what the others, in this one, say."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import pytest
from command_line import driftlab
from units_at_rest import unit_at_rest

DRIFTLAB = Path(sys.executable).with_name("driftlab")

CONFIG = """
extends: mems_crs05
latitude: 40.9 deg
heading: 0 deg
source:
  kind: hdf5
  channels:
    time:        {path: time, unit: s}
    gyro:        {path: gyro, unit: deg/s}
    accel:       {path: accel, unit: g}
    temperature: {path: temperature, unit: degC}
filter:
  gyro:
    bias: {kind: thermal_derivative, walk: 1.5e-4 deg/s/sqrt(s), map: {kind: polynomial, order: 5, path: map.json}}
"""


def process(*args, cwd):
    """Run a command as a process of its own: the installed script, a pipe for its texts."""
    return subprocess.run([DRIFTLAB, *map(str, args)], cwd=cwd, capture_output=True, text=True, timeout=300)


def write(path, unit, *, labels=True):
    with h5py.File(path, "w") as file:
        for name, values, label in (
            ("time", unit.t, "s"),
            ("gyro", np.rad2deg(unit.gyro), "deg/s"),
            ("accel", unit.accel / 9.80665, "g"),
            ("temperature", unit.temperature, "degC"),
        ):
            file[name] = values
            if labels:
                file[name].attrs["unit"] = label


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A folder with a config, a soak, a recording, and the map fitted by the command line."""
    folder = tmp_path_factory.mktemp("bench")
    (folder / "unit.yaml").write_text(CONFIG)
    write(folder / "soak.h5", unit_at_rest(seconds=3000, temperature=lambda t: 10 + t / 100, walk=1e-8))
    write(folder / "ramp.h5", unit_at_rest(seconds=300, temperature=lambda t: 20 + t / 100, seed=1))
    done = process("fit-map", "unit.yaml", "--input", "soak.h5", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "polynomial: fitted on 30,000 samples" in done.stdout
    process("run", "unit.yaml", "--input", "ramp.h5", "--out", "first", cwd=folder)  # an installation compiles once
    return folder


def test_a_map_without_a_path_is_used_as_the_fit_says(bench):
    """The line that `fit-map` prints, as settings: that of the bias model where the config has its map there."""
    followed, subtracted = bench / "followed.yaml", bench / "subtracted.yaml"
    followed.write_text(CONFIG.replace(", path: map.json", ""))
    subtracted.write_text(CONFIG.partition("filter:")[0])
    for path in (followed, subtracted):
        done = driftlab("fit-map", path, "--input", "soak.h5", "--out", "used.json", cwd=bench)
        key, value = done.stdout.partition("to use it, write in the config: ")[2].splitlines()[0].split(": ", 1)
        run = driftlab("run", path, "--set", f"{key}={value}", "--input", "ramp.h5", "--out", path.stem, cwd=bench)
        assert run.returncode == 0, run.stderr


def test_a_check_loads_no_library_that_it_does_not_need(bench):
    heavy = ["numba", "scipy", "polars", "pint", "onnx", "onnxruntime", "rich.progress", "jinja2"]
    command = ["check", "unit.yaml", "--input", "ramp.h5"]
    code = f"""
import sys
from driftlab.cli import app
app({command}, standalone_mode=False)
print([name for name in {heavy} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=bench, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_run_writes_whole_outputs(bench):
    done = process("run", "unit.yaml", "--input", "ramp.h5", "--out", "out", cwd=bench)
    assert done.returncode == 0, done.stderr
    assert "prediction, 1 min" in done.stdout
    assert [text for text in done.stderr.splitlines() if not text.startswith("compiling the filter")] == []
    here = driftlab("run", "unit.yaml", "--input", "ramp.h5", "--out", "out", cwd=bench)
    assert (here.returncode, here.stdout, here.stderr) == (done.returncode, done.stdout, done.stderr)
    out = bench / "out"
    assert sorted(p.name for p in out.iterdir()) == ["estimates.h5", "report.html", "summary.json"]
    assert not (bench / "out.partial").exists()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["schema"] == 1
    assert 0.9 < summary["nis"]["mean_per_component"] < 1.05
    assert summary["coast_rmse_rad_s"]["10 min"] == [None] * 3  # the recording is shorter
    assert summary["coast_sigma_rad_s"]["10 min"] == [None] * 3
    assert min(summary["coast_sigma_rad_s"]["1 min"]) > 0
    assert summary["share"]["whole"] == pytest.approx(1.0)
    assert summary["motion_s"] == summary["motion_axes"] == summary["refused_s"] == summary["refused_axes"] == []
    assert summary["temperature_swing_K"] > 1
    with h5py.File(out / "estimates.h5") as file:
        N = len(file["t"])
        assert file["x"].shape == file["sigma"].shape == (N, 12)
        assert file["innovations"].shape == (N, 6)
        assert file["nis"].shape == file["used"].shape == (N,)
        assert list(file["x"].attrs["labels"][[0, 3, 6, 9]]) == [
            "velocity_error_x", "attitude_error_x", "accel_bias_x", "gyro_bias_x",
        ]  # fmt: skip
        assert file["bias"].attrs["unit"] == "rad/s"
        coasts = ("coast", "coast_sigma")
        assert all(np.all(np.isfinite(data[()])) for name, data in file.items() if name not in coasts)
        aligned = file["t"][:] > summary["t"]["aligned_s"]
        for name in coasts:
            np.testing.assert_array_equal(np.isfinite(file[name][:, 0]), aligned)
        assert np.all(file["still"][:])
    html = (out / "report.html").read_text()
    assert html.count('<figure class="chart"') == 4  # bias, errors, NIS, map
    assert "http://" not in html.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    )


def test_run_can_print_json_and_replaces_its_own_output_only(bench):
    for _ in range(2):
        done = driftlab("run", "unit.yaml", "--input", "ramp.h5::20:200", "--out", "twice", "--json", cwd=bench)
        assert done.returncode == 0, done.stderr
    summary = json.loads(done.stdout)
    assert summary["recording"] == "ramp.h5::20:200"
    assert summary["t"]["end_s"] == pytest.approx(200, abs=0.2)
    refused = driftlab("run", "unit.yaml", "--input", "ramp.h5", "--out", ".", cwd=bench)
    assert refused.returncode == 2
    assert "exists and is not the output of an earlier run;" in refused.stderr


def test_fit_map_of_another_kind_and_as_json(bench):
    args = (
        "fit-map",
        "unit.yaml",
        "--kind",
        "spline",
        "--input",
        "soak.h5",
        "--input",
        "ramp.h5",
        "--out",
        "spline.json",
    )
    done = driftlab(*args, "--json", cwd=bench)
    assert done.returncode == 0, done.stderr
    record = json.loads(done.stdout)
    assert record["kind"] == "spline"
    assert record["provenance"]["recordings"] == "soak.h5, ramp.h5"
    assert record["domain"] == pytest.approx([10, 40], abs=0.1)
    assert (bench / "spline.json").exists()


def test_plugins_schema_and_check(bench):
    rows = json.loads(driftlab("plugins", "--json", cwd=bench).stdout)
    assert {("bias_models", "random_walk"), ("thermal_maps", "onnx_network"), ("sources", "csv")} <= {
        (row["family"], row["kind"]) for row in rows
    }
    assert all(row["distribution"] == "driftlab" and row["error"] is None for row in rows)
    schema = json.loads(driftlab("schema", cwd=bench).stdout)
    assert {"extends", "filter"} <= set(schema["properties"])
    checked = driftlab("check", "unit.yaml", "--input", "ramp.h5", cwd=bench)
    assert checked.returncode == 0, checked.stderr
    assert "noise: 3.18 deg/h/sqrt(Hz)" in checked.stdout
    assert "# recording: ramp.h5, 20 Hz at its start" in checked.stdout
    assert "# filter.gyro.noise: 3.18 deg/h/sqrt(Hz) = 1.54171e-05 rad/s/sqrt(Hz)\n" in checked.stdout
    assert "# filter.gyro.bias.map.min_swing: 2 K = 2 K\n" in checked.stdout
    content = json.loads(driftlab("check", "unit.yaml", "--input", "ramp.h5", "--json", cwd=bench).stdout)
    assert content["latitude"] == "40.9 deg"
    noise = content["quantities"]["filter.gyro.noise"]
    assert (noise["text"], noise["unit"]) == ("3.18 deg/h/sqrt(Hz)", "rad/s/sqrt(Hz)")
    assert noise["value"] == pytest.approx(np.deg2rad(3.18) / 3600)
    (bench / "unfitted.yaml").write_text(CONFIG.replace(", path: map.json", ""))
    checked = driftlab("check", "unfitted.yaml", "--input", "ramp.h5", cwd=bench)
    assert checked.returncode == 0, checked.stderr
    assert "# map polynomial: has no path; `run` needs one" in checked.stdout
    (bench / "no_source.yaml").write_text("filter: {gyro: {noise: 1 deg/h/sqrt(Hz), bias: {kind: constant}}}\n")
    checked = driftlab("check", "no_source.yaml", cwd=bench)
    assert "# source: is missing, so no recording can be read; `driftlab init FILE` writes that" in checked.stdout


@pytest.mark.parametrize(
    ("args", "code", "message"),
    [
        (("run", "none.yaml"), 2, "none.yaml: cannot be read (No such file or directory); name an existing YAML file"),
        (("run", "unit.yaml", "--input", "none.h5"), 1, "none.h5"),
        (("run", "unit.yaml", "--input", "ramp.h5::a:b"), 2, "'a' is not a number of seconds; write PATH::START:STOP"),
        (("run", "unit.yaml", "--input", "ramp.h5::1_0:"), 2, "'1_0' is not a number of seconds"),
        (("run", "unit.yaml", "--input", "ramp.h5::nan:"), 2, "'nan' is not a number of seconds"),
        (("run", "unit.yaml", "--input", "ramp.h5::0:inf"), 2, "'inf' is not a number of seconds"),
        (("run", "unit.yaml", "--input", "ramp.h5::٣:"), 2, "'٣' is not a number of seconds"),
        (("run", "unit.yaml", "--input", "ramp.h5::0:1e300"), 2, "'1e300' is not a number of seconds"),
        (("live", "unit.yaml", "--duration", "1,5 min"), 2, "a comma follows the number 1; write a decimal point"),
        (("live", "unit.yaml", "--duration", "0 s"), 2, "--duration '0 s': is not a time to measure"),
        (("run", "unit.yaml", "--input", "ramp.h5::0:30"), 1, "no 60 s at rest were found"),
        (("run", "wrong.yaml", "--input", "ramp.h5"), 2, "wrong.yaml:13: filter.gyro.noise: 3.18 has no unit"),
        (("run", "wide.yaml", "--input", "cold.h5"), 1, "is outside the map's domain"),
        (("fit-map", "unit.yaml", "--input", "ramp.h5::0:90"), 1, "polynomial: T moves by only 0.9"),
        (("fit-map", "unit.yaml", "--kind", "polynomal", "--input", "soak.h5"), 2, "did you mean polynomial?"),
        (("run", "unit.yaml"), 2, "path"),
        (("run", "unit.yaml", "--input", "ramp.h5", "--out", "/proc/none"), 2, "--out /proc/none: cannot be written"),
        (("run", "unit.yaml", "--input", ""), 2, "names no file; write PATH or PATH::START:STOP"),
        (("check", "no_gyro.yaml", "--input", "ramp.h5"), 1, "name it under source.channels, as 'gyros' is"),
        (("run", "no_g.yaml", "--input", "si.h5"), 1, "accel: shows 1.003 m/s^2 at rest, 9.803 was expected"),
        (("fit-map", "no_g.yaml", "--input", "si.h5"), 1, "correct the unit and path of source.channels.accel"),
        (
            ("check", "no_kind.yaml"),
            2,
            "no_kind.yaml:1: source: needs a `kind:`; `driftlab plugins` lists those known, and",
        ),
        (("check", "extend.yaml"), 2, "extend: unknown key; did you mean 'extends'?"),
    ],
)
def test_mistakes_end_in_one_message_and_no_traceback(bench, args, code, message):
    (bench / "no_kind.yaml").write_text("source: {path: log.ulg}\n")
    (bench / "wrong.yaml").write_text(
        CONFIG.replace("  gyro:\n    bias", "  gyro:\n    noise: 3.18\n    bias").lstrip()
    )
    (bench / "wide.yaml").write_text(CONFIG)
    (bench / "no_gyro.yaml").write_text(CONFIG.replace("    gyro:        {path: gyro", "    gyros:       {path: gyro"))
    (bench / "no_g.yaml").write_text(CONFIG.replace("{path: accel, unit: g}", "{path: accel, unit: m/s^2}"))
    (bench / "extend.yaml").write_text(CONFIG.replace("extends:", "extend:"))
    if not (bench / "si.h5").exists():
        write(bench / "si.h5", unit_at_rest(seconds=120), labels=False)
    if not (bench / "cold.h5").exists():
        write(bench / "cold.h5", unit_at_rest(seconds=120, temperature=lambda t: t / 60 - 30))
    done = driftlab(*args, cwd=bench)
    assert done.returncode == code, done.stderr
    assert done.stderr.startswith("driftlab: ")
    assert message in done.stderr
    assert "Traceback" not in done.stderr


def test_a_path_with_brackets_is_printed_as_it_is(bench):
    (bench / "u[b]:key:.yaml").write_text(CONFIG)
    (bench / "r[red]$a$.h5").write_bytes((bench / "ramp.h5").read_bytes())
    done = driftlab("run", "u[b]:key:.yaml", "--input", "r[red]$a$.h5", "--out", "o[final]", cwd=bench)
    assert done.returncode == 0, done.stderr
    assert "written to o[final]/: estimates.h5" in done.stdout
    assert "r[red]$a$.h5" in done.stdout
    assert "u[b]:key" in done.stdout
    done = driftlab("compare", "u[b]:key:.yaml", "--input", "r[red]$a$.h5", "--out", "c[final]", cwd=bench)
    assert done.returncode == 0, done.stderr
    assert "u[b]:key:" in done.stdout


def test_a_name_that_is_not_utf8_is_refused(bench):
    done = process("run", "unit.yaml", "--input", "ramp\udcff.h5", cwd=bench)
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert r"driftlab: 'ramp\udcff.h5': is not UTF-8 text; rename the file" in done.stderr


def test_a_run_that_dies_leaves_what_it_wrote(bench):
    """The domain is left half way through: nothing under the final name, the estimates so far under .partial."""
    write(bench / "half.h5", unit_at_rest(seconds=7200, rate=20, temperature=lambda t: 20 + t / 180))
    done = process("run", "unit.yaml", "--input", "half.h5", "--out", "half", cwd=bench)
    assert done.returncode == 1
    assert "is outside the map's domain" in done.stderr
    assert not (bench / "half").exists()
    with h5py.File(bench / "half.partial" / "estimates.h5") as file:
        assert len(file["t"]) > 1000
        assert file["t"][-1] < 3700


def test_usage_errors_exit_with_2(bench):
    assert process("run", cwd=bench).returncode == 2
    assert process("no-such-command", cwd=bench).returncode == 2
    assert process("--help", cwd=bench).returncode == 0


@pytest.mark.parametrize("name", ["a\x1b[31m.h5", "a\nnote: all is well.h5", "a\x9b2J.h5", "a\u2028b.h5"])
def test_a_name_that_acts_on_a_terminal_is_refused(name, tmp_path):
    done = driftlab("run", "unit.yaml", "--input", name, cwd=tmp_path)
    assert done.returncode == 2
    assert "has a control character; rename the file" in done.stderr
    assert done.stderr.count("\n") == len(done.stderr.splitlines()) == 1
    assert "\x1b" not in done.stderr
