"""`driftlab export`: whole files or none, nothing lost unasked, and a `loss.json` that anyone can work out again."""

import json

import numpy as np
import pytest
from flying_units import DEG_H, fitted
from typer.testing import CliRunner

from driftlab.cli import app
from driftlab.commands.export import exporter_of
from fusion_core.errors import ConfigError

DEVICE = "device_id=2490378"


@pytest.fixture
def unit(tmp_path):
    """Return the file of a map, alone in its folder."""
    fitted().save(tmp_path / "map.json")
    return tmp_path / "map.json"


def export(kind, unit, out, *more):
    return CliRunner().invoke(app, ["export", kind, str(unit), "--out", str(out), *more])


def losses(folder):
    return json.loads((folder / "loss.json").read_text())["exports"]


def test_what_is_there_is_replaced_only_when_asked(unit, tmp_path):
    out = tmp_path / "a.csv"
    out.write_text("mine")
    said = export("csv_table", unit, out).exception
    assert "a.csv exists, and is not as `driftlab export` wrote it; name another file, or give --force" in str(said)
    assert out.read_text() == "mine"
    assert export("csv_table", unit, out, "--force").exit_code == 0
    assert out.read_text().startswith("# spline of the gyro")
    assert "is read here, and would be lost" in str(export("csv_table", unit, unit, "--force").exception)


def test_what_is_refused_leaves_nothing_behind(unit, tmp_path):
    before = sorted(tmp_path.iterdir())
    assert "the device id of the gyro is not known" in str(export("px4", unit, tmp_path / "a.params").exception)
    assert sorted(tmp_path.iterdir()) == before


def test_a_folder_may_be_the_one_that_one_is_in(unit, tmp_path, monkeypatch):
    (tmp_path / "firmware").mkdir()
    monkeypatch.chdir(tmp_path / "firmware")
    done = export("c", unit, ".", "--set", "loss=10 deg/h", "--json")
    assert done.exit_code == 0, done.exception
    assert {path.name for path in (tmp_path / "firmware").iterdir()} == {
        "gyro_bias.h", "gyro_bias.c", "gyro_bias_test.c", "loss.json"
    }  # fmt: skip
    assert losses(tmp_path / "firmware")["firmware"] == json.loads(done.stdout)


def test_each_export_of_a_folder_has_its_own_loss(unit, tmp_path):
    for kind, name in (("px4", "a.params"), ("ardupilot", "a.parm")):
        assert export(kind, unit, tmp_path / name, *(["--set", DEVICE] if kind == "px4" else [])).exit_code == 0
    assert {name: entry["kind"] for name, entry in losses(tmp_path).items()} == {
        "a.params": "px4", "a.parm": "ardupilot"
    }  # fmt: skip


def test_the_loss_of_px4s_stairs_is_what_its_parameters_give_step_by_step(unit, tmp_path):
    """The file's own text, PX4's formula and rule in double precision: a look a second, renewed beyond 1 K."""
    export("px4", unit, tmp_path / "a.params", "--set", DEVICE)
    rows = (line.split("\t") for line in (tmp_path / "a.params").read_text().splitlines() if line[0] != "#")
    held = {name: float(value) for _, _, name, value, _ in rows}
    (lost,) = losses(tmp_path)["a.params"]["loss"]
    low, high = lost["range"]
    error, used = [], -100.0
    for second in range(int(lost["warm_up"]["duration_s"]) + 1):
        T = high - (high - low) * np.exp(-second / lost["warm_up"]["time_constant_s"])
        if abs(T - used) > 1:
            used = T
        d = min(max(used, held["TC_G0_TMIN"]), held["TC_G0_TMAX"]) - held["TC_G0_TREF"]
        taken = [sum(held[f"TC_G0_X{k}_{axis}"] * d**k for k in range(4)) for axis in range(3)]
        error.append(taken - fitted().bias(np.array([T]))[0])
    np.testing.assert_allclose(np.sqrt(np.mean(np.square(error), axis=0)) * DEG_H, lost["warm_up"]["rms"], atol=1e-3)
    np.testing.assert_allclose(np.max(np.abs(error), axis=0) * DEG_H, lost["warm_up"]["largest"], atol=1e-2)


def test_a_kind_that_is_like_no_other_is_answered_with_all():
    with pytest.raises(ConfigError, match=r"export nope: known: .*kalibr.*openvins"):
        exporter_of("nope", {})
    with pytest.raises(ConfigError, match="export openvin: did you mean openvins"):
        exporter_of("openvin", {})
