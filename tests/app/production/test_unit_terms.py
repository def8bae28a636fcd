"""Scale factor and misalignment of the units of a fleet, against units that are simulated by code of their own."""

import json
from pathlib import Path

import family
import fleets
import numpy as np
import other_families
import polars as pl
import pytest
from turned_units import matrix_of, turntable

from driftlab.config import load_config
from driftlab.errors import ConfigError
from driftlab.family.mixed_model import fit_family
from driftlab.family.outliers import find_outliers
from driftlab.family.record import TERM_FIGURES, Figure
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


@pytest.fixture(scope="module")
def found(folder):
    return work(task(folder))


@pytest.fixture(scope="module")
def alone(folder):
    return work(task(folder, stimulus=()))


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


def test_terms_are_as_far_from_the_truth_as_their_deviations_say(folder, found, tmp_path):
    z = [off_by(found.record, own_matrix(1))]
    (tmp_path / "soak.h5").write_bytes((folder / "soak.h5").read_bytes())
    for seed in (11,):
        write_stimulus(tmp_path, "turned.h5", seed, own_matrix(seed))
        record = work(task(tmp_path)).record
        assert record.state == "done", record.error
        z.append(off_by(record, own_matrix(seed)))
    z = np.concatenate([np.ravel(one) for one in z])
    z = z[z != 0]  # a change that was found to be none is none in truth
    assert len(z) > 15
    assert np.max(np.abs(z)) < 4.5
    assert 0.2 < np.mean(z**2) < 2.0
    terms = record.parabolas  # as a family takes them: in the middle the second polynomial is -1
    middle = terms.c @ [1.0, 0.0, -1.0] - own_matrix(11)(np.mean(terms.T)).ravel()
    sigma = np.sqrt(np.einsum("i,kij,j->k", [1.0, 0.0, -1.0], terms.covariance, [1.0, 0.0, -1.0]))
    assert pytest.approx((TEMPERATURES[0], TEMPERATURES[-1]), abs=0.5) == terms.T
    assert np.max(np.abs(middle) / sigma) < 4.5
    assert np.max(sigma) < 1e-4


def test_the_map_has_the_bias_of_the_soak_and_m_of_the_stimulus(found, alone, tmp_path):
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


def test_limits_of_scale_and_misalignment_are_judged(folder, found, alone):
    tight = TEXT.replace("scale: 20000 ppm, misalignment: 50 mrad", "scale: 500 ppm, misalignment: 1 mrad")
    for result, verdict in (
        (found, "pass"),
        (work(task(folder, tight)), "fail"),
        (alone, "not measured"),
    ):
        rows = {row["name"]: row["verdict"] for row in result.record.limits}
        assert (rows["scale"], rows["misalignment"]) == (verdict, verdict)


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


def test_a_fleet_has_the_terms_in_its_table_and_its_summary(tmp_path, monkeypatch):
    count = 2
    units = fleets.write_fleet(tmp_path, count, lots=1)
    rows = (tmp_path / "units.csv").read_text().splitlines()
    rows = ["unit,role,path", *(f"{row.split(',')[0]},soak,{row.split(',')[1]}" for row in rows[1:])]
    for k, unit in enumerate(units):
        write_stimulus(tmp_path, f"{unit.name}.h5", k, own_matrix(k))
        rows.append(f"{unit.name},stimulus,{unit.name}.h5")
    (tmp_path / "units.csv").write_text("\n".join(rows))
    (tmp_path / "family.yaml").write_text(TEXT)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(units_pass, "Pool", lambda workers: fleets.Here())
    job.fleet(load_config(Path("family.yaml")), "units.csv", Path("made"))
    told = json.loads(Path("made/fleet.json").read_text())
    assert told["terms"]["units"] == count
    true = np.array([own_matrix(k)(20.0) for k in range(count)])
    for name, i, j in (("scale x", 0, 0), ("misalignment xy", 0, 1), ("misalignment zx", 2, 0)):
        assert told["terms"][name]["median"] == pytest.approx(np.median(true[:, i, j]), abs=2e-4)
        spread = 1.4826 * abs(true[0, i, j] - true[1, i, j]) / 2
        assert told["terms"][name]["spread"] == pytest.approx(spread, abs=3e-4)
    assert any(line.startswith("scale factor and misalignment of 2 units") for line in told["lines"])
    table = pl.read_parquet("made/units.parquet").filter(pl.col("unit") == units[1].name)
    off = table["scale_factor"].to_numpy() - np.diag(true[1])
    assert np.all(np.abs(off) < 4.5 * table["scale_factor_sigma"].to_numpy())
    assert table["misalignment_x"].to_list()[0] is None


def units_with_terms(seed, count=30):
    """Units as of a family, with terms that spread by SPREAD and are known to a tenth of it; the soak says nothing."""
    units = other_families.deal("polynomial", count, seed)
    rng = np.random.default_rng([5, seed])
    pairs, records = [], []
    for unit in units:
        M, sigma = rng.normal(0.002, SPREAD, (4, 1)), 0.1 * SPREAD
        M += sigma * rng.normal(size=M.shape)
        terms = {n: Figure(value=tuple(v), sigma=(sigma,)) for n, v in zip(TERM_FIGURES, M.tolist(), strict=True)}
        record = unit.record(seed, ("x",))
        records.append(record.model_copy(update={"figures": {**record.figures, **terms}}))
        pairs.append((unit.soaked(seed, ("x",)), unit.lot))
    return pairs, records


def with_term(record, figure, value, sigma):
    return record.model_copy(update={"figures": {**record.figures, figure: Figure(value=(value,), sigma=(sigma,))}})


def test_a_term_far_from_the_others_is_the_reason_and_an_unsure_one_is_none():
    """Of either sign, and not one that is as far off but known no better; units without a term stay judged."""
    pairs, records = units_with_terms(1)
    records[3] = with_term(records[3], "scale_factor", 0.002 - 10 * SPREAD, 0.1 * SPREAD)
    records[4] = with_term(records[4], "misalignment_y", 0.002 + 10 * SPREAD, 0.1 * SPREAD)
    records[5] = with_term(records[5], "misalignment_z", 0.002 + 10 * SPREAD, 10 * SPREAD)
    records[6] = records[6].model_copy(update={"figures": {"noise": records[6].figures["noise"]}})
    odd = find_outliers(fit_family(pairs), pairs, records).odd
    said = {(name, one.what): one.sentence for name, why in odd.items() for one in why if one.what in TERM_FIGURES}
    assert set(said) == {(records[3].unit, "scale_factor"), (records[4].unit, "misalignment_y")}
    scale = said[records[3].unit, "scale_factor"]
    assert scale.startswith("error of the scale factor of gyro x is -8000 ppm, of most units")
    assert "mrad, of most units" in said[records[4].unit, "misalignment_y"]


def test_hardly_an_ordinary_unit_is_odd_for_a_term():
    found = 0
    for seed in range(20, 26):
        pairs, records = units_with_terms(seed)
        odd = find_outliers(fit_family(pairs), pairs, records).odd
        found += sum(any(one.what in TERM_FIGURES for one in why) for why in odd.values())
    assert found <= 5  # of 180 units; at FALSE one of twenty families has one


@pytest.mark.parametrize(
    ("config", "said"),
    [
        (TEXT.replace("stimulus:", "# "), "and the config no stimulus; add `stimulus: {kind: rate_table}`"),
        (
            TEXT.replace("filter:\n", "filter:\n  track: accel\n").replace("residual: 3 deg/h, ", ""),
            "which is for gyros; fit other sensors",
        ),
    ],
    ids=["no stimulus", "accelerometers"],
)
def test_a_stimulus_that_the_config_does_not_know_is_refused(tmp_path, config, said):
    (tmp_path / "units.csv").write_text("unit,role,path\n1,soak,a.h5\n1,stimulus,b.h5\n")
    (tmp_path / "line.yaml").write_text(config)
    with pytest.raises(ConfigError, match="unit 1 has a recording of the role stimulus") as error:
        job.fleet(load_config(tmp_path / "line.yaml"), str(tmp_path / "units.csv"), tmp_path / "made")
    assert said in str(error.value)
