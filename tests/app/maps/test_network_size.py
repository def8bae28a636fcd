"""The number of neurons that a network needs, on curves that are made of a known number of them."""

import json
import re
import time

import numpy as np
import pytest
from command_line import driftlab
from units_at_rest import unit_at_rest

from driftlab.maps.network_size import BINS, PARTS, BinnedPart, select, split
from driftlab.reports.figures import figure_of
from driftlab.reports.map_selection import TITLES, chart, comparison, selection_document, selection_table
from driftlab.units import RATE
from fusion_core.contracts import ThermalMap
from fusion_core.errors import ConfigError, EmptyRecording, SwingTooSmall
from fusion_core.host.registry import registry

NOISE = 3e-5  # rad/s, of a sample


def network(**settings):
    return registry().classes(ThermalMap)["onnx_network"].model_validate({"kind": "onnx_network", **settings})


def two_by_two(T):
    """Three axes of 2-2 tanh networks, rad/s."""
    x = (T - 15) / 35
    hidden = np.tanh(np.stack([3 * x - 1, -2 * x - 0.5], axis=1))
    last = np.tanh(hidden @ [[1.5, -0.7], [0.6, 1.2]] + [0.2, -0.3])
    return 1e-3 * last @ [[0.8, -0.5, 0.9], [-1.1, 0.7, 0.4]] + [1e-3, 0, -2e-3]


def waves(T):
    """More bends than two neurons can make."""
    return 3e-4 * np.stack([np.sin(T / 4), np.cos(T / 5), np.sin(T / 6)], axis=1)


def soak(curve, N=60_000, seed=0):
    rng = np.random.default_rng(seed)
    T = rng.uniform(-20, 50, N)
    return T, curve(T) + NOISE * rng.normal(size=(N, 3))


@pytest.fixture(scope="module")
def easy():
    return select(network(starts=4), *soak(two_by_two), neurons=range(1, 5), seed=3)


def test_the_split_is_disjoint_whole_and_of_the_right_sizes():
    parts = split(10_001, 0)
    assert [len(part) for part in parts] == [6501, 2000, 1500]
    assert np.array_equal(np.sort(np.concatenate(parts)), np.arange(10_001))
    for part in parts:  # spread evenly over the recording: 4 sigma of a uniform mean
        assert abs(part.mean() / 10_000 - 0.5) < 4 / np.sqrt(12 * len(part))
    assert all(np.array_equal(a, b) for a, b in zip(parts, split(10_001, 0), strict=True))
    assert not np.array_equal(parts[1], split(10_001, 1)[1])


def test_two_neurons_are_enough_for_two(easy):
    assert easy.bias.chosen == 2
    # more neurons leave what two leave: the noise
    np.testing.assert_allclose(easy.bias.Sr[1:, 1], easy.bias.noise[1], rtol=0.3)
    assert easy.bias.Sr[0, 1] > 3 * easy.bias.limit
    assert easy.slope.chosen <= 4
    assert easy.samples == (39_000, 12_000, 9_000)


def test_a_curve_with_more_bends_needs_more():
    found = select(network(starts=4), *soak(waves), neurons=range(1, 6))
    assert found.bias.chosen > 2
    assert found.slope.chosen > 2
    at = found.bias.neurons.index(found.bias.chosen)
    assert np.all(found.bias.Sr[:at, 1] > found.bias.limit)
    assert found.bias.Sr[at, 1] <= found.bias.limit


def test_without_noise_two_are_still_enough():
    T = np.linspace(-20, 50, 20_000)
    found = select(network(starts=4), T, two_by_two(T), neurons=range(1, 4))
    assert found.bias.chosen <= 3


class Known:
    """A stand-in for a fitted map: bias of a curve."""

    def __init__(self, curve):
        self.bias = curve


def test_Sr_is_that_of_a_known_error():
    """A map that is wrong by 1e-4 + 2e-6 T, on samples without noise, unevenly spread."""
    T = 70 * np.random.default_rng(0).beta(1, 3, 50_000) - 20
    bins = np.minimum((T + 20) / 70 * BINS, BINS - 1).astype(int)
    part = BinnedPart(T, np.stack([1e-4 + 2e-6 * T, -2e-6 * T, 0 * T], axis=1), bins)
    found = part.residual(Known(lambda T: np.zeros((len(T), 3))))
    np.testing.assert_allclose(found.res("slope"), [2e-6, 2e-6, 0], atol=1e-15)
    assert found.Sr("slope") == pytest.approx(np.sqrt(8) * 1e-6)
    # the rms over bins falls short of the one over samples by the line's spread within a bin
    rms = np.sqrt(np.mean(part.bias**2, axis=0))
    np.testing.assert_allclose(found.res("bias"), rms, rtol=1e-3)
    assert found.Sr("bias") == pytest.approx(np.linalg.norm(rms), rel=1e-3)


def test_the_noise_of_Sr_is_that_of_many_draws():
    rng = np.random.default_rng(0)
    T = rng.uniform(0, 50, 20_000)
    bins = np.minimum(T / 50 * BINS, BINS - 1).astype(int)
    draws = [BinnedPart(T, NOISE * rng.normal(size=(20_000, 3)), bins).residual(None) for _ in range(40)]
    for target in ("bias", "slope"):
        Sr = np.array([draw.Sr(target) for draw in draws])
        assert np.sqrt(np.mean(Sr**2)) == pytest.approx(draws[0].noise(target), rel=0.05)
        assert np.mean([draw.error(target) for draw in draws]) == pytest.approx(np.std(Sr), rel=0.35)


def test_the_two_derivatives_are_compared_with_the_data(easy):
    noise = easy.slope.noise[2] / np.sqrt(3)
    for rms in (easy.slope_network, easy.analytic_slope):
        np.testing.assert_allclose(rms, noise, rtol=0.4)
    assert np.all(easy.between < 0.3 * noise)


def test_the_same_seed_gives_the_same(easy):
    again = select(network(starts=4), *soak(two_by_two), neurons=range(1, 3), seed=3)
    np.testing.assert_allclose(again.bias.Sr, easy.bias.Sr[:2], rtol=1e-12)
    other = select(network(starts=4), *soak(two_by_two), neurons=range(1, 3), seed=4)
    assert not np.allclose(other.bias.Sr, again.bias.Sr, rtol=1e-6)


def test_sizes_with_more_weights_than_temperatures_are_left_out():
    T, bias = soak(two_by_two, N=5000)
    found = select(network(starts=2), np.round(T / 4) * 4, bias, neurons=range(1, 5))  # 19 values, 13 and 22 weights
    assert found.bias.neurons == (1, 2)


@pytest.mark.parametrize(
    ("settings", "N", "neurons", "error", "match"),
    [
        ({}, 199, range(1, 3), EmptyRecording, "has 199 samples, expected at least 200; use a longer soak"),
        ({}, 5000, range(1, 1), ConfigError, "expected at least 1; write e.g. --neurons-max 10"),
        ({"min_swing": "90 K"}, 5000, range(1, 3), SwingTooSmall, "needs at least 90 K; fit it on a wider soak"),
    ],
)
def test_what_cannot_be_selected_is_refused(settings, N, neurons, error, match):
    with pytest.raises(error, match=match):
        select(network(**settings), *soak(two_by_two, N=N), neurons=neurons)


def test_a_kind_without_neurons_is_refused():
    spline = registry().classes(ThermalMap)["spline"].model_validate({"kind": "spline"})
    with pytest.raises(ConfigError, match=r"spline is no network, .* give --kind onnx_network, or leave"):
        select(spline, *soak(two_by_two, N=500))


def test_ten_neurons_on_a_long_soak_take_seconds():
    """About a fifth of a selection of 1 to 10, which is to take less than a minute on two cores."""
    T, bias = soak(two_by_two, N=300_000)
    begun = time.process_time()
    select(network(), T, bias, neurons=(10,))
    assert time.process_time() - begun < 24


def test_the_report_says_what_was_found(easy):
    content = selection_document(easy, RATE)
    assert content["bias"]["chosen"] == 2
    assert list(content["bias"]["Sr"]) == list(PARTS)
    assert content["slope"]["unit"] == "rad/s/K"
    assert len(selection_table(easy, RATE).rows) == 4
    assert len(comparison(easy, RATE)) == 4
    labels = [panel.get_ylabel() for panel in figure_of(chart(easy, RATE)).axes]
    assert labels == [f"Sr of the {TITLES['bias']} [deg/h]", f"Sr of the {TITLES['slope']} [deg/h/K]"]
    chosen = chart(easy, RATE).panels[0].lines[-1]
    assert (chosen.x[0], chosen.name) == (easy.bias.chosen, "chosen")


# The command line

CONFIG = """
extends: mems_crs05
latitude: 40.9 deg
heading: 0 deg
source:
  kind: hdf5
  channels: {time: {path: time}, gyro: {path: gyro}, accel: {path: accel}, temperature: {path: temperature}}
filter:
  gyro:
    bias:
      kind: thermal_derivative
      walk: 1.5e-4 deg/s/sqrt(s)
      map: {kind: onnx_network, target: slope, starts: 3, path: unit.onnx}
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("select")
    (folder / "unit.yaml").write_text(CONFIG)
    unit_at_rest(seconds=3000, temperature=lambda t: 10 + t / 100, walk=1e-8).write(folder / "soak.h5")
    return folder


def fit_map(folder, *args):
    return driftlab("fit-map", "unit.yaml", "--input", "soak.h5", *args, cwd=folder)


def test_fit_map_selects_writes_and_shows(bench):
    done = fit_map(bench, "--select", "--neurons-max", "3")
    assert done.returncode == 0, done.stderr
    assert [text for text in done.stderr.splitlines() if not text.startswith("compiling the filter")] == []
    assert len(re.findall(r"^ +[123] +[\d.]+", done.stdout, re.MULTILINE)) == 3
    assert done.stdout.count("*") == 3  # the title's, and one of each target
    assert "written to unit.onnx, unit.report.html, unit.select.json, unit.select.svg" in done.stdout.replace(
        str(bench) + "/", ""
    )
    found = json.loads((bench / "unit.select.json").read_text())
    assert (bench / "unit.select.svg").read_text().startswith("<svg")
    read = network().read(bench / "unit.onnx")
    assert read.target == "slope"
    settings = json.loads(read.record.provenance["settings"])
    assert settings["neurons"] == found["slope"]["chosen"]
    assert read.record.samples == 30_000  # of all parts


def test_the_selection_as_json_and_in_a_folder(bench):
    args = ("--select", "--neurons-max", "2", "--report", "why/here", "--out", "other.onnx", "--json")
    done = fit_map(bench, *args)
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout)
    assert printed["kind"] == "onnx_network"
    written = json.loads((bench / "why" / "here" / "select.json").read_text())
    assert written.pop("sha256").startswith("driftlab fit-map ")
    assert printed["selection"] == written
    assert {path.name for path in (bench / "why" / "here").iterdir()} == {"report.html", "select.json", "select.svg"}


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (("--select", "--kind", "polynomial"), "kind polynomial is no network, expected one"),
        (("--select", "--neurons-max", "0"), "--neurons-max"),
        (("--select", "--neurons-max", "1", "--report", "unit.yaml/x"), "cannot be written"),
    ],
)
def test_mistakes_end_in_one_message(bench, args, message):
    done = fit_map(bench, *args, "--out", "mistake.map")
    assert done.returncode == 2, done.stderr
    assert message in done.stderr
    assert "Traceback" not in done.stderr
