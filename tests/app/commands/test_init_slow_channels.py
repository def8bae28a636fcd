"""A file in which channels come at rates of their own: what `init` writes, says, and what follows it."""

import re

import numpy as np
import polars as pl
import pytest
from typer.testing import CliRunner
from units_at_rest import unit_at_rest

from driftlab.cli import app
from driftlab.commands.check import check
from driftlab.commands.init import init
from driftlab.config import load_config
from fusion_core.chunk import concatenate
from fusion_core.faults import Faults

UNIT = unit_at_rest(seconds=400, rate=20, temperature=lambda t: 15 + t / 20, walk=1e-8)
EMPTY = {"gyro": 1, "accel": 1, "temp": 1}


def written(path, rows):
    """Write the unit's rows, each channel in every so many of them, and return the place of a config."""
    at = np.arange(len(UNIT.t))
    sparse = {name: np.where(at % every == 0, 1.0, np.nan) for name, every in (EMPTY | rows).items()}
    axes = {f"{c}{a} ({u})": sparse[name] * values[:, k] for c, u, name, values in (
        ("g", "rad/s", "gyro", UNIT.gyro), ("a", "m/s^2", "accel", UNIT.accel),
    ) for k, a in enumerate("xyz")}  # fmt: skip
    supply = np.where(at % 25 == 7, 12.0 + np.sin(UNIT.t / 100), np.nan)
    columns = {"t (s)": UNIT.t, **axes, "temp (degC)": sparse["temp"] * UNIT.temperature, "supply (V)": supply}
    pl.DataFrame(columns).fill_nan(None).write_csv(path / "rec.csv")
    return path / "rec.yaml"


def noise(config, sensor):
    return getattr(load_config(config).filter, sensor).noise


@pytest.mark.parametrize("rows", [{"accel": 10}, {"temp": 50}, {"accel": 20, "temp": 10}, {"temp": 3000}])
def test_slow_accelerometers_and_thermometers_are_no_problem(tmp_path, rows):
    config = written(tmp_path, rows)
    done = init(tmp_path / "rec.csv", out=config)
    assert (done.asked, done.problems) == ((), ())
    assert "8,000 rows at 20 Hz" in done.text
    assert 'path: "supply (V)", unit: V}' in done.text
    lines = check(config).remarks
    assert any(re.match(r"recording: .*, 20 Hz at its start", line) for line in lines)
    assert sum("it is interpolated in time between them" in line for line in lines) == len(rows)


def test_the_rows_of_a_slow_gyro_are_those_that_count(tmp_path):
    """An accelerometer that is read as it is in these: its noise is that of so many samples."""
    (tmp_path / "other").mkdir()
    config, other = written(tmp_path, {"gyro": 10}), written(tmp_path / "other", {"gyro": 10, "accel": 10})
    done = init(tmp_path / "rec.csv", out=config)
    init(tmp_path / "other" / "rec.csv", out=other)
    assert "# From rec.csv: 8,000 rows, the gyro's at 2 Hz." in done.text
    assert done.problems == ("gyro: 90% of the first 8,000 rows have no number, and are left out",)
    for sensor in ("gyro", "accel"):
        assert noise(config, sensor) == noise(other, sensor)
    white = float(np.std(UNIT.accel[:, 0])) / np.sqrt(2.0)  # of 2 samples a second
    assert noise(config, "accel") == pytest.approx(white, rel=0.2)


def test_what_speaks_against_the_data_is_not_missing_from_the_command(tmp_path):
    written(tmp_path, {"gyro": 10})
    said = CliRunner().invoke(app, ["init", str(tmp_path / "rec.csv"), "--out", str(tmp_path / "rec.yaml")])
    assert said.exit_code == 1
    assert (
        "is not ready for a map; mend what speaks against it, or go on all the same with `driftlab fit-map`"
        in said.stderr
    )


def test_sensors_in_rows_of_their_own_are_a_table(tmp_path):
    """Each line has few of the columns, as a phone's log of all its sensors."""
    t, nan = UNIT.t, np.full(len(UNIT.t), np.nan)
    gyro = {f"g{a} (rad/s)": UNIT.gyro[:, k] for k, a in enumerate("xyz")}
    accel = {f"a{a} (m/s^2)": UNIT.accel[:, k] for k, a in enumerate("xyz")}
    field = {f"m{a} (uT)": 30 + UNIT.gyro[:, k] for k, a in enumerate("xyz")}
    warm = {"temp (degC)": UNIT.temperature, "baro (hPa)": np.full(len(t), 1013.0)}
    names = [*gyro, *accel, *field, *warm]
    parts = [
        pl.DataFrame({"t (s)": t + late} | {name: own.get(name, nan) for name in names})
        for late, own in ((0.0, gyro), (0.012, accel), (0.02, field), (0.03, warm))
    ]
    pl.concat(parts).sort("t (s)").fill_nan(None).write_csv(tmp_path / "rec.csv")
    done = init(tmp_path / "rec.csv", out=tmp_path / "rec.yaml")
    assert (done.asked, done.problems) == ((), ())
    assert "separator" not in done.text
    got = concatenate(list(load_config(tmp_path / "rec.yaml").source.chunks(1000, Faults())))
    np.testing.assert_allclose(got.t, t)
    np.testing.assert_allclose(got["gyro"], UNIT.gyro)
    np.testing.assert_allclose(got["accel"][1:], UNIT.accel[1:])  # of 12 ms later, the first one too
    np.testing.assert_allclose(got["temperature"][1:], UNIT.temperature[1:], atol=5e-3)
