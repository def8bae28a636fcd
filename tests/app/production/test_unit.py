"""One unit of a line: its record and files against the commands, against truth, and with every sort of bad file."""

import json
import os
import pickle
from pathlib import Path

import family
import h5py
import numpy as np
import pytest
from soaked_units import FAMILY, OVEN, compared, soaked

from driftlab.commands.fit_map import fit_map
from driftlab.commands.run import run
from driftlab.config import load_config, understood
from driftlab.family.unit_information import UnitInformation
from driftlab.identification.config_edit import with_map
from driftlab.production import unit as module
from driftlab.production.unit import Task, key_of, work
from driftlab.storage.json import plain
from fusion_core.host.config import document_of

DEG_H = family.DEG_H
TEXT = FAMILY.read_text()
UNIT = family.deal(3, seed=8)[1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A folder with soaks of a unit."""
    place = tmp_path_factory.mktemp("line")
    family.write(place / "soak.h5", family.soak(UNIT, 1.0))
    family.write(place / "again.h5", family.soak(UNIT, 0.5, seed=1))
    family.write(place / "third.h5", family.soak(UNIT, 0.5, seed=2))
    return place


def task(folder, config=TEXT, **roles):
    given = {role: (names,) if isinstance(names, str) else names for role, names in roles.items()}
    return Task("u", recordings=given or {"calibration": ("soak.h5",)}, config=config, folder=str(folder))


def done(folder, config=TEXT, **roles):
    found = work(task(folder, config, **roles))
    assert found.record.state == "done", found.record.error
    return found


def values(record, name):
    figure = record.figures[name]
    return tuple(np.array([np.nan if v is None else v for v in part]) for part in (figure.value, figure.sigma))


def test_figures_are_as_far_from_the_truth_as_their_deviations_say(tmp_path) -> None:
    scores = {"noise": [], "walk": [], "swing": []}
    pairs = []
    for k, one in enumerate(family.deal(12, seed=31)):
        residuals = []
        for seed in (1, 2) if k < 6 else (1,):
            family.write(tmp_path / "soak.h5", family.soak(one, seed=seed))
            record = done(tmp_path).record
            residuals.append(values(record, "residual"))
            T = np.linspace(*record.domain, 1000)
            truth = {"noise": one.noise * DEG_H, "walk": one.walk * DEG_H, "swing": np.ptp(one.bias(T), axis=0)}
            for name, true in truth.items():
                value, sigma = values(record, name)
                if name == "walk":  # its likelihood is that of its logarithm
                    shown = value > 0
                    scores[name] += list(np.log(value[shown] / true[shown]) / (sigma[shown] / value[shown]))
                else:
                    scores[name] += list((value - true) / sigma)
        if len(residuals) == 2:
            (a, s), (b, r) = residuals
            pairs += list((a - b) / np.hypot(s, r))
    least = {
        "noise": 0.6,
        "walk": 0.6,
        "swing": 0.4,
    }  # two hours hardly show how large a walk is, and that doubt counts
    for name, found in scores.items():
        assert least[name] < np.mean(np.square(found)) < 1.7, name
    assert 0.4 < np.mean(np.square(pairs)) < 1.8


def test_the_map_is_that_of_fit_map_to_the_byte(folder, tmp_path) -> None:
    found = done(folder)
    fit_map(load_config(FAMILY), [str(folder / "soak.h5")], out=tmp_path / "map.json")
    assert found.record.map_file == "map.json"
    own, other = (json.loads(text) for text in (found.files["map.json"], (tmp_path / "map.json").read_bytes()))
    assert own["record"]["provenance"].pop("fitted_at")
    assert other["record"]["provenance"].pop("fitted_at")
    assert other["record"]["provenance"].pop("written")  # its SHA-256, which a fleet's has not
    assert json.dumps(own) == json.dumps(other)


@pytest.mark.parametrize("role", ["calibration", "holdout"])
def test_the_coast_is_that_of_a_run_with_the_map(folder, tmp_path, role) -> None:
    roles = {"calibration": "soak.h5"} | ({} if role == "calibration" else {role: "again.h5"})
    name = "soak.h5" if role == "calibration" else "again.h5"
    config = TEXT
    found = done(folder, config, **roles)
    (tmp_path / "map.json").write_bytes(found.files["map.json"])
    known = with_map(understood(document_of(config)), path=tmp_path / "map.json", outside="clamp")
    source = known.source.model_copy(update={"path": folder / name})
    summary = run(known.model_copy(update={"source": source})).summary
    for horizon, figure in (
        ("1 min", "coast_1min"),
        ("5 min", "coast_5min"),
        ("10 min", "coast"),
        ("to the end", "coast_end"),
    ):
        value, sigma = values(found.record, figure)
        np.testing.assert_allclose(value, summary["coast_rmse_rad_s"][horizon], rtol=1e-12)
        assert np.all(sigma > 0)
    assert found.record.coast_of == name
    assert found.record.coast_in_sample == (role == "calibration")
    assert found.record.limits == plain(summary["limits"])


def test_what_is_kept_is_what_the_soak_says(folder) -> None:
    found = done(folder)
    kept = UnitInformation.from_bytes(found.files["unit.npz"])
    same = soaked(str(folder / "soak.h5"))
    np.testing.assert_array_equal(kept.J, same.J)
    np.testing.assert_array_equal(kept.h, same.h)
    assert kept.recordings[0].channels["accel"].shape == (len(kept.recordings[0].t), 3)
    assert found.record.samples == 3600 - 1
    np.testing.assert_allclose(found.record.hours, 1.0, rtol=1e-3)
    np.testing.assert_allclose(kept.recordings[0].span.sum(), found.record.hours * 3600)


BAD = {
    "no file": (None, "cannot be read (No such file"),
    "empty": (b"", "empty"),
    "text": (b"what is this?\n" * 100, "kind hdf5"),
    "a page": (b"<html></html>", "kind hdf5"),
}


@pytest.mark.parametrize(("content", "said"), BAD.values(), ids=BAD)
def test_a_file_that_is_no_recording_is_a_failed_unit(tmp_path, content, said) -> None:
    if content is not None:
        (tmp_path / "soak.h5").write_bytes(content)
    found = work(task(tmp_path))
    assert found.record.state == "failed"
    assert said in found.record.error
    assert "Traceback" not in found.record.error
    assert found.files == {}


def still(**changed):
    recording = family.soak(UNIT, 0.5)
    for name, change in changed.items():
        recording[name] = change(recording[name])
    return recording


WRONG = {
    "time goes back": (still(time=lambda t: np.where(t > 900, t - 500, t)), "time"),
    "no number": (still(gyro=lambda w: w * np.nan), "no usable row"),
    "no temperature moves": (still(temperature=lambda T: 20 + 0 * T), "moves by only"),
    "it moves": (still(gyro=lambda w: w + np.sin(np.arange(len(w)))[:, None]), "nowhere at rest"),
    "another unit": (still(accel=lambda f: f * 9.8), "gravity"),
    "a minute": ({name: values[:40] for name, values in still().items()}, ";"),
}


@pytest.mark.parametrize(("recording", "said"), WRONG.values(), ids=WRONG)
def test_a_recording_that_cannot_be_used_is_a_failed_unit(tmp_path, recording, said) -> None:
    family.write(tmp_path / "soak.h5", recording)
    found = work(task(tmp_path))
    assert found.record.state == "failed"
    assert said in found.record.error or said == "gravity"
    assert found.record.unit == "u"
    assert found.record.recordings["calibration"][0]["name"] == "soak.h5"
    assert found.record.key == key_of(task(tmp_path))


def test_a_recording_that_is_cut_off_or_lacks_a_channel_is_a_failed_unit(folder, tmp_path) -> None:
    whole = (folder / "soak.h5").read_bytes()
    (tmp_path / "soak.h5").write_bytes(whole[: len(whole) // 2])
    assert work(task(tmp_path)).record.state == "failed"
    (tmp_path / "soak.h5").write_bytes(whole)
    with h5py.File(tmp_path / "soak.h5", "r+") as file:
        del file["temperature"]
    assert "temperature" in work(task(tmp_path)).record.error


def test_a_pipe_is_a_failed_unit_and_nobody_waits_for_it(tmp_path) -> None:
    os.mkfifo(tmp_path / "soak.h5")
    found = work(task(tmp_path)).record
    assert found.error == f"{tmp_path / 'soak.h5'}: is a pipe or a device, a file was expected; record it to one first"
    assert found.key == ""
    assert key_of(task(tmp_path))


@pytest.mark.parametrize(("roles", "said"), [
    ({"calibration": ("soak.h5", "copy.h5")}, "copy.h5 (calibration): has the content of {}/soak.h5 (calibration)"),
    ({"calibration": "soak.h5", "holdout": "copy.h5"}, "copy.h5 (holdout): has the content of {}/soak.h5 (cal"),
])  # fmt: skip
def test_a_copy_of_a_soak_is_no_other_soak(folder, tmp_path, roles, said) -> None:
    for name in ("soak.h5", "copy.h5"):
        (tmp_path / name).write_bytes((folder / "again.h5").read_bytes())
    assert said.format(tmp_path) in work(task(tmp_path, **roles)).record.error


def test_a_wrong_config_and_a_unit_without_a_soak_are_failed_units(folder) -> None:
    assert "nois" in work(task(folder, TEXT.replace("noise: 2", "nois: 2"))).record.error
    assert work(task(folder, test="soak.h5")).record.error.endswith("name one in the manifest")


def test_what_nobody_expected_is_in_the_record_and_its_traceback_where_it_is_asked_for(
    folder, monkeypatch, capsys
) -> None:
    def broken(*_):
        raise RuntimeError("a defect")

    monkeypatch.setattr(module, "soaked_of", broken)
    monkeypatch.delenv("DRIFTLAB_DEBUG", raising=False)
    assert work(task(folder)).record.error == "RuntimeError: a defect"
    assert capsys.readouterr().err == ""
    monkeypatch.setenv("DRIFTLAB_DEBUG", "1")
    work(task(folder))
    assert "Traceback" in capsys.readouterr().err


def test_the_key_is_that_of_contents_config_and_versions(folder, tmp_path) -> None:
    family.write(tmp_path / "other.h5", family.soak(UNIT, 1.0))
    key = key_of(task(folder))
    assert key == key_of(
        Task("another", "lot", "2026-01-01", {"calibration": ("other.h5",)}, config=TEXT, folder=str(tmp_path))
    )
    assert key != key_of(task(folder, calibration="again.h5"))
    assert key != key_of(task(folder, calibration="soak.h5::0:1800"))
    assert key != key_of(task(folder, test="soak.h5"))
    assert key != key_of(task(folder, TEXT.replace("3 deg/h,", "4 deg/h,")))
    assert done(folder).record.key == key
    absent = key_of(task(tmp_path))
    family.write(tmp_path / "soak.h5", family.soak(UNIT, 0.5))
    assert key_of(task(tmp_path)) != absent


def test_a_task_and_what_was_found_can_be_sent(folder) -> None:
    sent = pickle.loads(pickle.dumps(task(folder)))
    found = pickle.loads(pickle.dumps(work(sent)))
    assert found.record.state == "done"


CONFIGS = {
    "no map": TEXT.replace("kind: thermal_derivative", "kind: random_walk").replace(", map: {kind: spline}", ""),
    "subtracted first": TEXT.replace("kind: thermal_derivative", "kind: random_walk")
    .replace(", map: {kind: spline}", "")
    .replace("  accel:\n    noise", "    calibration: {kind: polynomial, order: 5}\n  accel:\n    noise"),
    "polynomial": TEXT.replace("kind: spline", "kind: polynomial, order: 7"),
    "accelerometers": TEXT.replace("kind: thermal_derivative", "kind: random_walk")
    .replace(", map: {kind: spline}", "")
    .replace("  accel:\n    noise", "  track: accel\n  accel:\n    noise")
    .partition("limits")[0],
    "10 Hz": TEXT.replace("update_interval: 1 s", "update_interval: 2 s"),
    "no filter": TEXT.partition("filter:")[0],
}


@pytest.mark.parametrize("config", CONFIGS.values(), ids=CONFIGS)
def test_every_config_that_fit_map_and_run_take_works(folder, config) -> None:
    found = done(folder, config)
    kept = UnitInformation.from_bytes(found.files["unit.npz"])
    assert kept.axes == found.record.axes
    value, sigma = values(found.record, "noise")
    assert np.all(value > 0)
    assert np.all(sigma > 0)
    coast = values(found.record, "coast_5min")[0]
    assert np.all(np.isfinite(coast)) == ("filter" in config)


def test_a_network_is_a_map_too(folder) -> None:
    found = done(folder, TEXT.replace("kind: spline", "kind: onnx_network, neurons: 3"))
    assert found.record.map_file == "map.onnx"
    assert found.files["map.onnx"][:1]


def test_several_recordings_with_gaps_and_another_thermometer(tmp_path) -> None:
    names = []
    for k in range(2):
        recording = family.soak(UNIT, 0.5, seed=k) | {"case": np.arange(1800.0)}
        keep = (recording["time"] < 600) | (recording["time"] > 700)
        recording = {name: column[keep] for name, column in recording.items()}
        recording["gyro"][300:320] += 1.0  # it was moved
        family.write(tmp_path / f"{k}.h5", recording)
        names.append(f"{k}.h5")
    config = TEXT.replace("filter:\n", "    case: {path: case, unit: degC}\nfilter:\n", 1)
    found = done(tmp_path, config, calibration=tuple(names))
    kept = UnitInformation.from_bytes(found.files["unit.npz"])
    assert len(kept.recordings) == 2
    assert all(rows.channels["case"].shape == rows.t.shape for rows in kept.recordings)
    assert all(np.max(np.diff(rows.t)) > 100 for rows in kept.recordings)
    assert any("motion" in note for note in found.record.notes)
    noise = values(found.record, "noise")[0]
    np.testing.assert_allclose(noise, UNIT.noise * DEG_H, rtol=0.25)


def test_pages_and_the_loop_are_there_where_they_are_asked_for(folder) -> None:
    asked = Task(
        "u", recordings={"calibration": ("soak.h5",)}, config=TEXT, folder=str(folder), explain=True, page=True
    )
    found = work(asked)
    assert "train and holdout" in found.record.loop["why_not"]
    pages = [found.files[f"page/{name}"].decode() for name in ("report.html", "map.report.html")]
    assert all("map.json" in page and "driftlab-" not in page for page in pages)
    roles = {"calibration": ("soak.h5",), "train": ("again.h5",), "holdout": ("third.h5",)}
    found = work(Task("u", recordings=roles, config=TEXT, folder=str(folder), explain=True))
    assert found.record.loop["verdict"] in ("nothing_missing", "unexplained", "explained", "ambiguous")
    assert found.record.loop["effects"] == json.loads(found.files["explained/loop.json"])["effects"]
    assert found.record.coast_of == "third.h5"


@pytest.mark.recordings
@pytest.mark.parametrize("name", ["control", "lagging"])
def test_soaks_of_one_resistor_differ_as_their_information_says(recordings, name) -> None:
    path = recordings / "data" / "oven_resistors" / f"{name}.csv"
    ramps = [soaked(f"{path}::{part}", OVEN) for part in ("0:9300", "9300:18300", "18300:")]
    ratios = [compared(a, b, level=True)[0] for k, a in enumerate(ramps) for b in ramps[:k]]
    assert np.mean(ratios) < 1.3
    record = done(path.parent, OVEN, calibration=f"{name}.csv::0:9300", holdout=f"{name}.csv::18300:").record
    assert record.bias_unit == "ratio" or record.bias_unit == "1"
    assert values(record, "coast")[0] < 2e-6
