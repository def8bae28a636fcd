"""Scale factor and misalignment of the units of a fleet, against units that are simulated by code of their own."""

import json
from pathlib import Path

import family
import fleets
import numpy as np
import polars as pl
import pytest
from turned_units import matrix_of, turntable

from driftlab.config import load_config
from driftlab.errors import ConfigError
from driftlab.production import fleet as job
from driftlab.production import units_pass
from driftlab.production.unit import Task, key_of, work
from driftlab.storage.map_file import read_map

SPREAD, TEMPERATURES = 1e-3, [-15.0, 20.0, 55.0]
TEXT = fleets.EXAMPLE.read_text().replace("noise: 3 deg/h/sqrt(Hz)}", "scale: 20000 ppm, misalignment: 50 mrad}")
TEXT += "stimulus: {kind: rate_table, segments: table.csv}\n"


def own_matrix(seed):
    """M of unit `seed` at T: that of the simulation, and what this unit has beside it."""
    own = np.random.default_rng([77, seed]).normal(0, SPREAD, (3, 3))
    return lambda T: matrix_of(T) + own


def write_stimulus(folder, name, seed, matrix, temperatures=TEMPERATURES, axes=range(3)):
    """Write the recording of a horizontal turntable, and the table of its segments beside the config."""
    t, gyro, T, table = turntable(seed, temperatures, hold=8.0, matrix=matrix, axes=axes)
    accel = np.random.default_rng(seed).normal([0.0, 0.0, 9.8], 0.01, gyro.shape)
    family.write(folder / name, {"time": t, "gyro": gyro, "accel": accel, "temperature": T})
    (folder / "table.csv").write_text(table)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    family.write(folder / "soak.h5", family.soak(family.deal(3, seed=8)[1], 0.5))
    write_stimulus(folder, "turned.h5", 1, own_matrix(1))
    return folder


def task(folder, config=TEXT, **roles):
    roles = {"calibration": ("soak.h5",), "stimulus": ("turned.h5",), **roles}
    return Task("u", recordings=roles, config=config, folder=str(folder))


def both(record, name):
    figure = record.figures[name]
    return np.array([figure.value, figure.sigma], dtype=float)


def off_by(record, matrix):
    """Errors of the terms, and of their changes, in their deviations."""
    low, high = TEMPERATURES[0], TEMPERATURES[-1]
    found = []
    for end, M in (("", matrix((low + high) / 2)), ("_change", matrix(high) - matrix(low))):
        value, sigma = both(record, f"scale_factor{end}")
        found.append((value - np.diag(M)) / sigma)
        for j, axis in enumerate("xyz"):
            value, sigma = both(record, f"misalignment_{axis}{end}")
            rows = np.arange(3) != j
            assert np.isnan(value[j])
            assert np.isnan(sigma[j])
            found.append((value - M[:, j])[rows] / sigma[rows])
    return np.concatenate(found)


def test_terms_are_as_far_from_the_truth_as_their_deviations_say(folder, tmp_path):
    z = []
    (tmp_path / "soak.h5").write_bytes((folder / "soak.h5").read_bytes())
    for seed in (11, 12, 13):
        write_stimulus(tmp_path, "turned.h5", seed, own_matrix(seed))
        record = work(task(tmp_path)).record
        assert record.state == "done", record.error
        z.append(off_by(record, own_matrix(seed)))
    assert np.max(np.abs(z)) < 4.5
    assert 0.3 < np.mean(np.square(z)) < 2.0


def test_the_map_has_the_bias_of_the_soak_and_m_of_the_stimulus(folder, tmp_path):
    found, alone = work(task(folder)), work(task(folder, stimulus=()))
    for name, one in (("with.json", found), ("alone.json", alone)):
        (tmp_path / name).write_bytes(one.files["map.json"])
    with_m, bias = read_map(tmp_path / "with.json"), read_map(tmp_path / "alone.json")
    T = np.linspace(-10, 50, 7)
    np.testing.assert_array_equal(with_m.bias(T), bias.bias(T))
    assert bias.record.matrix is None
    u = np.tile(np.deg2rad([50.0, -30.0, 20.0]), (7, 1))
    read = np.array([row + own_matrix(1)(x) @ row for row, x in zip(u, T, strict=True)]) + bias.bias(T)
    assert np.max(np.abs(with_m.corrected(read, T) - u)) < 5e-4 * np.linalg.norm(u[0])
    assert np.max(np.abs(read - bias.bias(T) - u)) > 5e-3 * np.linalg.norm(u[0])
    assert "scale_factor" not in alone.record.figures


def test_limits_of_scale_and_misalignment_are_judged(folder):
    def decided(limits, **roles):
        config = TEXT.replace("scale: 20000 ppm, misalignment: 50 mrad", limits)
        return {row["name"]: row["verdict"] for row in work(task(folder, config, **roles)).record.limits}

    assert (
        decided("scale: 30000 ppm, misalignment: 50 mrad").items() >= {"scale": "pass", "misalignment": "pass"}.items()
    )
    assert decided("scale: 500 ppm, misalignment: 1 mrad").items() >= {"scale": "fail", "misalignment": "fail"}.items()
    assert decided("scale: 500 ppm", stimulus=())["scale"] == "not measured"


def test_what_a_stimulus_does_not_tell_is_none(folder, tmp_path):
    (tmp_path / "soak.h5").write_bytes((folder / "soak.h5").read_bytes())
    write_stimulus(tmp_path, "turned.h5", 1, own_matrix(1), [20.0, 20.0, 20.0], axes=[0, 2])
    record = work(task(tmp_path)).record
    assert record.state == "done", record.error
    assert np.isnan(both(record, "scale_factor")[0]).tolist() == [False, True, False]
    assert np.all(np.isnan(both(record, "misalignment_y")))
    assert np.all(np.isnan(both(record, "scale_factor_change")))
    assert any("scale y: not observable" in line for line in record.verdict)


def test_another_table_of_segments_is_another_unit(folder, tmp_path):
    for name in ("soak.h5", "turned.h5", "table.csv"):
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    before, stamp = key_of(task(tmp_path)), units_pass.stamp_of(task(tmp_path), "1")
    assert (key_of(task(tmp_path)), units_pass.stamp_of(task(tmp_path), "1")) == (before, stamp)
    with (tmp_path / "table.csv").open("a") as file:
        file.write("\n")
    assert key_of(task(tmp_path)) != before
    assert units_pass.stamp_of(task(tmp_path), "1") != stamp != ""


def test_an_odd_scale_factor_is_the_reason(tmp_path, monkeypatch):
    """Of twelve units one has a scale factor off by 12 times their spread, and no other stands out for a term."""
    count, odd = 12, 7
    units = fleets.write_fleet(tmp_path, count, lots=1)
    rows = (tmp_path / "units.csv").read_text().splitlines()
    rows = ["unit,role,path", *(f"{row.split(',')[0]},soak,{row.split(',')[1]}" for row in rows[1:])]
    for k, unit in enumerate(units):
        matrix = own_matrix(k)
        more = 12 * SPREAD * np.diag([0.0, k == odd, 0.0])
        write_stimulus(tmp_path, f"{unit.name}.h5", k, lambda T, M=matrix, more=more: M(T) + more)
        rows.append(f"{unit.name},stimulus,{unit.name}.h5")
    (tmp_path / "units.csv").write_text("\n".join(rows))
    (tmp_path / "family.yaml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units_pass, "Pool", lambda workers: fleets.Here())
    job.fleet(load_config(Path("family.yaml")), "units.csv", Path("made"))
    told = json.loads(Path("made/fleet.json").read_text())
    named = {unit: "; ".join(why) for unit, why in told["family"]["odd"].items()}
    of_terms = {unit: why for unit, why in named.items() if "scale factor" in why or "misalignment" in why}
    assert list(of_terms) == [units[odd].name], named
    assert "error of the scale factor of y is" in of_terms[units[odd].name]
    assert "ppm, of most units" in of_terms[units[odd].name]
    assert told["terms"]["units"] == count
    true = np.array([np.diag(own_matrix(k)(20.0))[0] for k in range(count)])
    assert told["terms"]["scale x"]["median"] == pytest.approx(np.median(true), abs=2e-4)
    assert 0.3 * SPREAD < told["terms"]["misalignment xy"]["spread"] < 3 * SPREAD
    assert any(line.startswith("scale factor and misalignment of 12 units") for line in told["lines"])
    table = pl.read_parquet("made/units.parquet").filter(pl.col("unit") == units[odd].name)
    of_odd = own_matrix(odd)(20.0) + 12 * SPREAD * np.diag([0.0, 1.0, 0.0])
    sigma = table["scale_factor_sigma"].to_numpy()
    assert np.all(np.abs(table["scale_factor"].to_numpy() - np.diag(of_odd)) < 4.5 * sigma)
    assert table["misalignment_x"].to_list()[0] is None


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (TEXT.replace("stimulus:", "# "), "and the config no stimulus; add `stimulus: {kind: rate_table}`"),
        (TEXT.replace("filter:\n", "filter:\n  track: accel\n"), "which is for gyros; fit other sensors"),
    ],
    ids=["no stimulus", "accelerometers"],
)
def test_a_stimulus_that_the_config_does_not_know_is_refused(tmp_path, config, said):
    (tmp_path / "units.csv").write_text("unit,role,path\n1,soak,a.h5\n1,stimulus,b.h5\n")
    (tmp_path / "line.yaml").write_text(config.replace("# {", "# {"))
    with pytest.raises(ConfigError, match="unit 1 has a recording of the role stimulus") as error:
        job.fleet(load_config(tmp_path / "line.yaml"), str(tmp_path / "units.csv"), tmp_path / "made")
    assert said in str(error.value)
