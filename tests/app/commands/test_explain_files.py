"""Files of `explain`: what it leaves on disk, refuses, and takes besides a map and three recordings."""

import hashlib
import json
import re
import shutil

import h5py
import numpy as np
import pytest
from browsers import assert_drawn_everywhere
from closed_loops import TOLD, assert_same_coast, kinds, left_out, loop
from typer.testing import CliRunner
from units_with_effects import make_unit

from driftlab.cli import app
from driftlab.commands.explain import explain
from driftlab.config import load_config
from fusion_core.errors import ConfigError, EmptyRecording


@pytest.fixture(scope="module")
def hysteresis(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unit")
    closed, error = loop(folder, 3, ("hysteresis",), hours=(1.6, 1.2, 1.0))
    return folder, closed, error


def test_what_is_found_predicts_as_one_that_is_told_the_truth(hysteresis):
    _, closed, error = hysteresis
    assert closed.verdict.word == "explained"
    assert np.all(error["after"] < 1.15 * TOLD)
    assert np.linalg.norm(error["after"]) < 0.5 * np.linalg.norm(error["before"])


def test_the_files_hold_what_was_promised(hysteresis):
    folder, closed, _ = hysteresis
    content = json.loads((folder / "out" / "loop.json").read_text())
    assert content["schema"] == 1
    assert content["verdict"] == "explained"
    (effect,) = content["effects"]
    assert (effect["kind"], effect["channel"], effect["unit"]) == ("hysteresis", "temperature", "rad/s/K")
    assert re.fullmatch(r"[\d.]+ K", effect["parameters"]["width"])
    assert abs(float(effect["parameters"]["width"].split()[0]) - 9) < 0.3
    for axis in "xyz":
        assert 0 < effect["sigma"][axis] < 0.1 * abs(effect["coefficients"][axis])
    assert effect["log_likelihood_gain"] > effect["threshold"] > 0
    assert effect["heldout_gain"] > 0
    assert effect["left_out_ratio"] < 0.1
    assert {"kind", "reason", "left_out_ratio"} <= set(content["rejected"][0])
    before, after = (np.array(content["left_out"][when]) for when in ("before", "after"))
    assert np.all(after < 0.3 * before)
    for role, name in (("calibration", "soak"), ("train", "train"), ("holdout", "holdout")):
        (recording,) = content["recordings"][role]
        file = folder / f"{name}.h5"
        assert recording == {
            "name": str(file),
            "bytes": file.stat().st_size,
            "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        }
    for when in ("before", "after"):
        assert len(content[when]["coast_rmse_rad_s"]) == len(content[when]["filter_rmse_rad_s"]) == 3
        assert content[when]["nis"] > 0
        assert 0 <= content[when]["whiteness_p"] <= 1
    assert np.all(np.array(content["after"]["coast_rmse_rad_s"]) < content["before"]["coast_rmse_rad_s"])
    with h5py.File(folder / "out" / "prediction.h5") as file:
        group = file["holdout"]
        assert group["t"].attrs["unit"] == "s"
        for name in ("reference", "before", "after"):
            assert group[name].shape == (len(group["t"]), 3)
            assert group[name].attrs["unit"] == "rad/s"
    assert closed.content["verdict"] == content["verdict"]


def test_the_new_config_runs_as_it_is(hysteresis):
    """`driftlab run` on the holdout coasts along `after`, and its bias is the prediction's."""
    folder, _, _ = hysteresis
    config, holdout, out = (str(folder / name) for name in ("out/explained.yaml", "holdout.h5", "run"))
    result = CliRunner().invoke(app, ["run", config, "--input", holdout, "--out", out])
    assert result.exit_code == 0, result.output
    with h5py.File(folder / "run" / "estimates.h5") as run, h5py.File(folder / "out" / "prediction.h5") as file:
        coast = run["coast"][()]
        coast = coast[np.isfinite(coast[:, 0])]
        np.testing.assert_allclose(coast, file["holdout"]["after"][()], atol=1e-12)


def test_the_coast_is_what_the_loop_computes_of_a_recording_left_out(hysteresis):
    """The filter's open loop and the regression's own: two roads to the error on the holdout, the mean taken off."""
    folder, closed, _ = hysteresis
    names = [[str(folder / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    t, errors, rate = left_out((folder / "out", closed), load_config(folder / "declared.yaml"), *names)
    assert_same_coast(folder / "out" / "prediction.h5", t, errors, rate)


def test_effects_may_go_on_being_estimated(hysteresis):
    """With --estimate the coefficients are states that start from the fit, and end near it."""
    folder, closed, _ = hysteresis
    names = [["--" + option, str(folder / f"{name}.h5")] for option, name in
             (("calibration", "soak"), ("train", "train"), ("holdout", "holdout"))]  # fmt: skip
    arguments = [
        "explain",
        str(folder / "declared.yaml"),
        *(text for pair in names for text in pair),
        "--out",
        str(folder / "adapting"),
        "--estimate",
    ]
    result = CliRunner().invoke(app, [*arguments, "--json"])
    assert result.exit_code == 0, result.output
    assert json.loads(result.output)["verdict"] == "explained"
    run = [
        "run",
        str(folder / "adapting" / "explained.yaml"),
        "--input",
        str(folder / "holdout.h5"),
        "--out",
        str(folder / "r"),
    ]
    result = CliRunner().invoke(app, run)
    assert result.exit_code == 0, result.output
    with h5py.File(folder / "r" / "estimates.h5") as file:
        labels = [str(label) for label in file["x"].attrs["labels"]]
        at = [k for k, label in enumerate(labels) if "hysteresis" in label]
        x, sigma = file["x"][-1, at], file["sigma"][-1, at]
    fitted = np.array(list(closed.content["effects"][0]["coefficients"].values()))
    assert np.all(np.abs(x - fitted) < 5 * np.maximum(sigma, 1e-8))


def test_the_report_opens_in_a_browser(hysteresis, opened):
    folder, _, _ = hysteresis
    assert_drawn_everywhere(opened, folder / "out" / "report.html", 3)  # holdout, over temperature, what was left out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"holdout": "train"}, "was given for fitting"),
        ({"holdout": "train", "span": "::60:"}, "was given for fitting"),
        ({"span": "::a:b"}, "'a' is not a number of seconds"),
        ({"holdout": "copy of soak"}, "was given for fitting"),
        ({"train": ["train.h5", "train.h5"]}, "would count twice"),
        ({"train": ["train.h5::0:3000", "train.h5::2000:4000"]}, "would count twice"),
        ({"train": ["soak.h5::0:3000"]}, "would count twice"),
        ({"bias": "constant"}, "takes no effects"),
    ],
)
def test_what_cannot_be_explained_is_refused(hysteresis, tmp_path, change, message):
    folder, _, _ = hysteresis
    path = folder / "declared.yaml"
    shutil.copy(folder / "soak.h5", folder / "copy of soak.h5")
    if "bias" in change:
        path = tmp_path / "constant.yaml"
        path.write_text(re.sub(r"bias: {kind: thermal.*", "bias: {kind: constant}", read(folder), count=1))
    holdout = f"{change.get('holdout', 'holdout')}.h5{change.get('span', '')}"
    roles = ["soak.h5"], change.get("train", ["train.h5"]), [holdout]
    with pytest.raises(ConfigError, match=message):
        explain(load_config(path), *[[str(folder / name) for name in names] for names in roles], out=tmp_path / "out")


def test_recordings_that_end_with_the_alignment_teach_nothing(tmp_path):
    make_unit(tmp_path, 7, (), (), hours=(0.018, 0.018, 0.04))
    names = [[str(tmp_path / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    with pytest.raises(EmptyRecording, match="nothing is left to predict; record longer"):
        explain(load_config(tmp_path / "declared.yaml"), *names, out=tmp_path / "out")


def read(folder):
    return (folder / "declared.yaml").read_text()


def test_a_recording_may_serve_as_calibration_and_train(hysteresis, tmp_path):
    """It is evidence once, whatever its name: what is left out is then a fifth of it."""
    folder, _, _ = hysteresis
    shutil.copy(folder / "soak.h5", tmp_path / "again.h5")
    names = [str(folder / "soak.h5")], [str(tmp_path / "again.h5")], [str(folder / "holdout.h5")]
    closed = explain(load_config(folder / "declared.yaml"), *names, out=tmp_path / "out").closed
    assert len(closed.search.columns.evidence.records) == 1
    assert len(closed.left_out) == 5
    assert kinds(closed) == ["hysteresis"]


def test_without_a_map_temperature_is_a_channel_like_any_other(hysteresis, tmp_path):
    """A random walk is declared: the curve of temperature is found, and the new config runs."""
    folder, _, _ = hysteresis
    path = tmp_path / "walk.yaml"
    bias = "bias: {kind: random_walk, walk: 0.02 deg/h/sqrt(s)}"
    path.write_text(re.sub(r"bias: {kind: thermal_derivative.*", bias, read(folder), count=1))
    names = [[str(folder / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    closed = explain(load_config(path), *names, out=tmp_path / "out").closed
    assert "curve" in kinds(closed)
    content = closed.content
    before, after = (np.linalg.norm(content[when]["coast_rmse_rad_s"]) for when in ("before", "after"))
    assert after < 0.5 * before
    assert not list((tmp_path / "out").glob("explained.json"))
    run = ["run", str(tmp_path / "out/explained.yaml"), "--input", names[2][0], "--out", str(tmp_path / "run")]
    result = CliRunner().invoke(app, run)
    assert result.exit_code == 0, result.output


def test_where_nothing_is_added_the_declared_map_stays_to_the_byte(tmp_path):
    closed, error = loop(tmp_path, 7, (), hours=(1.6, 1.2, 1.0))
    assert closed.verdict.word == "nothing_missing"
    out = tmp_path / "out"
    assert (out / "explained.json").read_bytes() == (out / "declared.json").read_bytes()
    np.testing.assert_array_equal(error["after"], error["before"])
    assert "what is left looks like noise" in closed.lines
    names = [[str(tmp_path / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    thirds = ["filter.gyro.noise=1.03 deg/h/sqrt(Hz)", "filter.accel.noise=0.00133 m/s^2/sqrt(Hz)"]
    lines = explain(
        load_config(tmp_path / "declared.yaml", settings=thirds), *names, out=tmp_path / "quiet"
    ).closed.lines
    assert (
        "what is left looks like noise, 3 times as large as declared: set the noise, sigma is as much too small"
        in lines
    )
    with h5py.File(tmp_path / "holdout.h5", "a") as file:  # a jump that no other recording has
        file["gyro"][len(file["gyro"]) // 3 :, 1] += 12 / 3600  # deg/s
    again = explain(load_config(tmp_path / "declared.yaml"), *names, out=tmp_path / "again").closed
    assert again.verdict.word == "unexplained"
    assert again.lines[0].startswith("holdout.h5: prediction, ")


def test_the_standard_filter_can_be_explained_too(hysteresis, tmp_path):
    """A map that is subtracted and a random walk become a bias that follows map and effects."""
    folder, _, _ = hysteresis
    text = (folder / "declared.yaml").read_text()
    standard = "calibration: {kind: spline}\n    bias: {kind: random_walk, walk: 0.02 deg/h/sqrt(s)}"
    path = tmp_path / "standard.yaml"
    path.write_text(re.sub(r"bias: {kind: thermal_derivative.*", standard, text, count=1))
    names = [[str(folder / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    closed = explain(load_config(path), *names, out=tmp_path / "out").closed
    assert kinds(closed) == ["hysteresis"]
    assert "kind: thermal_derivative" in (tmp_path / "out" / "explained.yaml").read_text()
