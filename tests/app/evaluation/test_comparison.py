"""The comparison by the paper's yardsticks, on units whose answers are known."""

import json

import numpy as np
import pytest
from units_at_rest import unit_at_rest

from driftlab.config import Config
from driftlab.evaluation.comparison import OFFSET, as_json, compare, filter_error, verdict
from driftlab.reports.compare import write_comparison
from driftlab.reports.provenance import sheet_of
from driftlab.storage.json import plain

UNIT = unit_at_rest(seconds=900, rate=10, walk=2.6e-7)


def truth(t):
    return UNIT.bias[np.searchsorted(UNIT.t, t - 1e-6)]


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """Two random walks, the second with a walk 3.33 times larger, as the paper's two filters have."""
    import h5py

    path = tmp_path_factory.mktemp("compare") / "unit.h5"
    with h5py.File(path, "w") as file:
        file["time"], file["gyro"] = UNIT.t, UNIT.gyro

    def config(walk):
        gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": walk}}
        channels = {"time": {"path": "time", "unit": "s"}, "gyro": {"path": "gyro", "unit": "rad/s"}}
        source = {"kind": "hdf5", "path": str(path), "channels": channels}
        return Config.model_validate({"source": source, "filter": {"gyro": gyro}})

    return compare({"slow": config("1.5e-5 deg/s/sqrt(s)"), "fast": config("5e-5 deg/s/sqrt(s)")})


def test_the_initial_error_decays_with_the_steady_gain(found):
    """A random walk's filter forgets with the time constant noise / walk (Kalman-Bucy): 58.9 s and 17.7 s."""
    for name, tau in (("slow", 58.9), ("fast", 17.7)):
        gap = found[name].offset.estimates["bias"] - found[name].nominal.estimates["bias"]
        t = found[name].offset.estimates["t"]
        after = (t > 60.5) & (t < 60 + 2 * tau)
        # the gain has not quite settled after a minute, so a little faster than that
        expected = OFFSET * np.exp(-(t[after] - 60.1) / tau)
        ratio = gap[after] / expected[:, None]
        assert np.all((ratio > 0.6) & (ratio < 1.05)), name


def test_a_larger_walk_alone_converges_faster_and_is_noisier(found):
    slow, fast = found["slow"], found["fast"]
    assert np.all(fast.offset.first < slow.offset.first)
    assert np.mean(fast.offset.convergence) < 0.6 * np.mean(slow.offset.convergence)
    # against the truth; against the 30 s average the fast one looks better, since the two share their noise
    scatter = {
        name: np.std((c.nominal.estimates["bias"] - truth(c.nominal.estimates["t"]))[700:], axis=0)
        for name, c in found.items()
    }
    # sqrt(N^2 / (2 tau) + q tau / 2) with tau = 17.7 s and 58.9 s: 2.7e-6 and 2.0e-6 rad/s
    assert np.mean(scatter["fast"]) > 1.1 * np.mean(scatter["slow"])


def test_the_tables_agree_with_their_definitions(found):
    slow = found["slow"]
    error = filter_error(slow.nominal.estimates)
    t = slow.nominal.estimates["t"]
    whole = error[np.all(np.isfinite(error), axis=1)]
    np.testing.assert_allclose(slow.nominal.whole, np.sqrt(np.mean(whole**2, axis=0)))
    assert np.all(np.isnan(error[t <= 60.0]))
    assert slow.nominal.segments.shape == (5, 3)
    assert np.all(np.isfinite(slow.nominal.segments))
    # mean of N samples less their averages: no larger than white noise over the recording allows
    assert np.all(slow.reference_residual < 5 * 1.54e-5 / np.sqrt(900))


def test_json_and_report(found, tmp_path):
    content = json.loads(json.dumps(plain(as_json(found, "unit.h5"))))
    assert set(content["configs"]) == {"slow", "fast"}
    assert len(content["configs"]["slow"]["nominal"]["segments_rad_s"]) == 5
    assert content["verdict"] == verdict(found)
    write_comparison(tmp_path / "report.html", found, "unit.h5", dict.fromkeys(found, sheet_of(Config())))
    html = (tmp_path / "report.html").read_text()
    assert html.count("<figure") == 4
    assert "slow against fast" in html
    assert content["verdict"] in html


CONFIG = """
source:
  kind: hdf5
  channels: {{time: {{path: time, unit: s}}, gyro: {{path: gyro, unit: rad/s}}}}
filter:
  gyro: {{noise: {noise} deg/h/sqrt(Hz), bias: {{kind: random_walk, walk: 1.5e-5 deg/s/sqrt(s)}}}}
"""


def test_the_notes_are_told_in_the_terminal_on_the_page_and_in_the_json(tmp_path):
    """The unit moves, is not recorded for a fifth of the time, and one config declares another noise."""
    from html import unescape

    import h5py
    from typer.testing import CliRunner

    from driftlab.cli import app

    unit = unit_at_rest(seconds=300, rate=10, walk=2.6e-7, seed=1)
    unit.gyro[1500:1550, 1] += 0.05 * (-1.0) ** np.arange(50)
    unit.gyro[2500] = np.nan
    keep = (unit.t < 170) | (unit.t > 220)
    with h5py.File(tmp_path / "unit.h5", "w") as file:
        file["time"], file["gyro"] = unit.t[keep], unit.gyro[keep]
    configs = {"as_it_is": "3.18", "too_small": "0.9"}
    for name, noise in configs.items():
        (tmp_path / f"{name}.yaml").write_text(CONFIG.format(noise=noise))
    paths = [tmp_path / f"{name}.yaml" for name in configs]
    command = ["compare", *map(str, paths), "--input", str(tmp_path / "unit.h5")]
    terminal = CliRunner().invoke(app, [*command, "--out", str(tmp_path / "out")]).stdout
    printed = json.loads(CliRunner().invoke(app, [*command, "--json"]).stdout)["configs"]
    kept = json.loads((tmp_path / "out" / "summary.json").read_text())["configs"]
    page = unescape((tmp_path / "out" / "report.html").read_text())
    for name in configs:
        notes = kept[name]["notes"]
        assert printed[name]["notes"] == notes
        assert any(line.startswith("motion, not used: ") and line.endswith("seen by gyro y") for line in notes)
        assert any(line.startswith("the scores stand on 7") and "% gaps, 2 % motion" in line for line in notes)
        assert "rows where gyro is not a finite number, left out: 1 (first at 250.0 s)" in notes
        assert any(line.startswith("gyro: white noise is not as declared") for line in notes) == (name == "too_small")
        assert sum(all(line in each["notes"] for each in kept.values()) for line in notes) >= 3  # said once
        for line in notes:
            whose = "all" if all(line in each["notes"] for each in kept.values()) else name
            assert terminal.count(f"{line}\n") == 1
            assert f"note: {whose}: {line}" in terminal
            assert f"<li>{whose}: {line}</li>" in page
