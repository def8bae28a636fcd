"""Limits of `explain`: an effect holds beyond its inputs; what predicts the test recording worse is refuted."""

import json
import re

import h5py
import numpy as np
import pytest
import yaml
from supplied_resistors import STEP, table, unit, write
from typer.testing import CliRunner

from driftlab.cli import app
from driftlab.commands.explain import explain
from driftlab.config import load_config
from fusion_core.errors import ConfigError


def linear(u):
    return 5.0 * (u - 5)


def explained(folder, *args, **options):
    config, *recordings = unit(folder, *args, **options)
    return explain(config, *recordings, out=folder / "out").closed


def by_command(folder, *args, **options):
    config, *recordings = unit(folder, *args, **options)
    words = [word for option, names in zip(("calibration", "train", "holdout"), recordings, strict=True)
             for name in names for word in (f"--{option}", name)]  # fmt: skip
    return CliRunner().invoke(app, ["explain", str(config), *words, "--out", str(folder / "out")])


def predicted(folder):
    with h5py.File(folder / "out" / "prediction.h5") as file:
        return {name: values[()] for name, values in file["holdout"].items()}


@pytest.fixture(scope="module")
def refuted(tmp_path_factory):
    """A supply that acts the other way in the test recording: what was found is wrong there."""
    folder = tmp_path_factory.mktemp("refuted")
    return folder, by_command(folder, linear, beyond=lambda u: -linear(u))


def test_what_predicts_the_test_recording_worse_is_refuted_in_the_first_line(refuted):
    folder, result = refuted
    assert result.exit_code == 0, result.output
    first, second, *_ = result.output.splitlines()
    assert first == "verdict: refuted"
    assert second.startswith("  holdout.csv: predicted worse with the identified effects than without (")
    content = json.loads((folder / "out" / "loop.json").read_text())
    assert content["verdict"] == "refuted"
    change = content["holdout_change"]
    assert change["after"] > change["before"]
    assert change["sigma"] > 1.645
    assert "The identified effects predict the test recording worse" in (folder / "out" / "report.html").read_text()


def test_the_declared_config_stays_to_the_byte_and_what_was_found_is_the_candidate(refuted):
    folder, _ = refuted
    out = folder / "out"
    assert (out / "explained.yaml").read_bytes() == (folder / "declared.yaml").read_bytes()
    assert (out / "explained.json").read_bytes() == (out / "declared.json").read_bytes()
    candidate = yaml.safe_load((out / "candidate.yaml").read_text())["filter"]["bias"]
    assert [effect["kind"] for effect in candidate["effects"]] == ["channel"]
    assert candidate["map"]["path"] == "candidate.json"
    assert (out / "candidate.json").read_bytes() != (out / "declared.json").read_bytes()
    run = ["run", str(out / "candidate.yaml"), "--input", str(folder / "holdout.csv"), "--out", str(folder / "run")]
    assert CliRunner().invoke(app, run).exit_code == 0


def test_what_holds_in_the_test_recording_is_not_refuted(tmp_path):
    closed = explained(tmp_path, linear)
    assert closed.verdict.word == "explained"
    assert closed.content["holdout_change"]["sigma"] < 0
    assert not (tmp_path / "out" / "candidate.yaml").exists()


def rising(hours=2.5):
    """Return a supply that goes far beyond what was seen, and comes back."""
    t = np.arange(0.0, hours * 3600, STEP)
    return 5 + 2 * np.sin(np.pi * np.clip((t - 3000) / 4000, 0, 1)) + 0.1 * np.sin(t / 500)


@pytest.mark.parametrize("answer", [linear, lambda u: linear(np.clip(u, 4.8, 5.2))])
def test_beyond_the_inputs_that_were_seen_an_effect_holds_and_its_sigma_grows(tmp_path, answer):
    """The prediction is no more than what was seen, the supply acting beyond or not."""
    closed = explained(tmp_path, linear, beyond=answer, supply=rising())
    (effect,) = closed.content["effects"]
    low, high = effect["domain"]["supply"]
    seen = np.concatenate([table(k, linear)[:, 3] for k in range(2)])
    np.testing.assert_allclose((low, high), (seen.min(), seen.max()), rtol=1e-6)
    config = yaml.safe_load((tmp_path / "out" / "candidate.yaml" if closed.verdict.word == "refuted" else
                             tmp_path / "out" / "explained.yaml").read_text())  # fmt: skip
    assert config["filter"]["bias"]["effects"][0]["domain"] == {"supply": [low, high]}
    assert any(
        "updates with supply beyond (" in line and "on which channel was fitted" in line for line in closed.lines
    )
    found = predicted(tmp_path)
    beyond = np.interp(found["t"], STEP * np.arange(len(rising())), rising()) > high + 0.5
    added = (found["after"] - found["before"])[:, 0]
    assert np.ptp(added[beyond]) < 1e-6  # the maps differ a little; went it on, it were 7
    sigma, error = found["after_sigma"][:, 0], (found["after"] - found["reference"])[:, 0]
    assert np.min(sigma[beyond]) > 2 * np.max(sigma[~beyond & (found["t"] < 3000)])
    assert np.mean(np.abs(error[beyond]) < 2 * sigma[beyond]) > 0.95


def test_sizes_are_said_in_the_unit_of_the_sensor(tmp_path):
    result = by_command(tmp_path, linear)
    (line,) = (line for line in result.output.splitlines() if line.startswith("  channel of supply"))
    content = json.loads((tmp_path / "out" / "loop.json").read_text())
    size, sigma = (content["effects"][0][key]["resistance"] for key in ("size", "size_sigma"))
    seen = np.concatenate([table(k, linear)[:, 3] for k in range(2)])
    truth = 5e-6 * np.ptp(seen) / 2
    assert abs(size - truth) < 3 * sigma + 0.01 * truth
    assert 0 < sigma < 0.05 * size
    assert content["effects"][0]["size_text"] in line
    assert f", moves the bias by resistance ±{size * 1e6:.3g} ppm;" in line
    value, off = map(float, re.search(r"resistance (\S+) ± (\S+) ppm per SI unit of the channel,", line).groups())
    assert abs(value - 5) < 3 * off + 0.05


@pytest.mark.parametrize("how", ["cut", "shifted", "rounded", "part"])
def test_one_recording_under_two_names_is_refused(tmp_path, how):
    config, soak, train, _ = unit(tmp_path, linear)
    rows = table(1, linear)
    digits = 9
    if how == "cut":
        rows = rows[:-1]
    elif how == "shifted":
        rows[:, 0] += 86_400
    elif how == "rounded":
        digits = 6
    else:
        rows = np.concatenate([table(8, linear)[:600], rows[200:500]])
        rows[:, 0] = STEP * np.arange(len(rows))
    again = write(tmp_path / "again.csv", rows, digits)
    with pytest.raises(ConfigError, match="was given for fitting, and cannot judge it"):
        explain(load_config(config), soak, train, [again], out=tmp_path / "out")
