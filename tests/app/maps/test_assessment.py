"""The assessment of a map holds: its sigma against the truth of twins, its words against what was planted."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from driftlab.maps.assessment import MapVerdict, text
from driftlab.soak.blocks import brief
from driftlab.units import RATE
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.deg2rad(1) / 3600
DT = 4.0
SIZES = np.array([1.0, -0.5, 0.7])
UP_DOWN, UP = [-20, 48, -20], [-20, 48]


def bend(T, width):
    """A bend at 31 degC and a parabola, 3 axes."""
    return DEG_H * (60 * np.tanh((T - 31) / width) + 0.02 * (T - 20) ** 2)[:, None] * SIZES


def soak(seed, width, turns=UP_DOWN, hours=8.0, walk=0.02, planted=0.0):
    rng = np.random.default_rng(seed)
    N = int(hours * 3600 / DT)
    T = np.interp(np.linspace(0, 1, N), np.linspace(0, 1, len(turns)), turns)
    wandering = np.cumsum(walk * np.sqrt(DT) * rng.normal(size=(N, 3)), axis=0)
    differs = (planted * np.sin(np.pi * (T + 20) / 68) * np.sign(np.gradient(T)) / 2)[:, None] * [1, 0, 0]
    return T, bend(T, width) + DEG_H * (wandering + differs + 1.6 * rng.normal(size=(N, 3)))


def verdict(settings, T, bias):
    return MapVerdict(settings.fit(T, bias, {}), settings, brief(T, bias, [0], DT))


@pytest.mark.parametrize(
    ("settings", "width", "fits"), [(Spline(), 4, True), (Polynomial(order=9), 12, True), (Polynomial(), 4, False)],
    ids=["spline", "order 9", "cubic on a bend"],
)  # fmt: skip
def test_good_to_is_what_the_map_is_off_by(settings, width, fits):
    """Of 16 twins: the true error over the range, its mean over the fit aside, against the number that is said."""
    ratios, z = [], []
    for seed in range(16):
        T, bias = soak(seed, width)
        found = verdict(settings, T, bias)
        error = found.fitted.bias(found.T) - bend(found.T, width)
        error -= np.mean(found.fitted.bias(T) - bend(T, width), axis=0)
        ratios.append(np.sqrt(np.mean(error**2, axis=0)) / found.good)
        z.append(np.abs(error) / found.sigma)
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.25)
    if fits:
        assert np.mean(np.array(z) < 1) == pytest.approx(0.68, abs=0.12)
    assert np.mean(np.array(z) < 1.96) > 0.88


def test_a_bend_is_said_with_where_how_much_and_what_to_take():
    T, bias = soak(0, 3)
    found = verdict(Polynomial(), T, bias)
    by_axis = {misfit.axis: misfit for misfit in found.fitted.record.error.misfits}
    away = bend(found.T, 3) - found.fitted.bias(found.T)
    away -= np.mean(bend(T, 3) - found.fitted.bias(T), axis=0)
    for axis, misfit in by_axis.items():
        k = np.argmin(abs(found.T - misfit.T))
        assert misfit.left == pytest.approx(abs(away[k, axis]), rel=0.15)
        assert misfit.left > 0.85 * np.max(np.abs(away[:, axis])), "where it is largest"
        assert misfit.noise < 0.2 * misfit.left
    assert set(by_axis) == {0, 1, 2}
    said = next(line for line in found.sentences(RATE) if "bends" in line)
    assert re.match(r"x bends at \S+ °C more than a cubic can \(\S+ deg/h left, \S+ is noise\), z at", said)
    assert said.endswith(": take kind: spline; `driftlab fit-map --compare` tells whether it predicts better")
    for misfit in verdict(Spline(), T, bias).fitted.record.error.misfits:
        assert misfit.left < 0.05 * by_axis[misfit.axis].left


def test_a_range_that_begins_at_zero_is_said_as_it_is_read():
    T = np.abs(np.linspace(-40, 40, 4001)) + 1e-7
    found = verdict(Polynomial(order=1), T, np.random.default_rng(0).normal(0, 1e-5, (4001, 3)))
    assert "between 0 and 40 °C" in found.sentences(RATE)[0]


def test_a_bend_within_what_is_between_up_and_down_is_not_said():
    found = verdict(Polynomial(), *soak(0, 3, planted=200.0))
    assert found.memory.answer == "seen"
    assert {misfit.axis for misfit in found.fitted.record.error.misfits} == {0, 1, 2}
    said = next(line for line in found.sentences(RATE) if "bends" in line)
    assert re.match(
        r"z bends at \S+ °C .*, y at [^x]*: once it is known why up and down differ, take kind: spline", said
    )


def test_after_a_comparison_no_kind_is_advised_that_it_did_not_prefer():
    T, bias = soak(0, 3)
    found = replace(verdict(Polynomial(), T, bias), compared=True)
    said = next(line for line in found.sentences(RATE) if "bends" in line)
    assert said.endswith(": look at the samples there; of the kinds that were compared none surely predicts better")
    assert "take kind" not in said


def test_hysteresis_is_said_with_its_size_and_is_part_of_what_the_map_is_good_to():
    found = verdict(Spline(), *soak(1, 8, planted=30.0))
    said = next(line for line in found.sentences(RATE) if line.startswith("hysteresis or lag"))
    size, sigma, at = re.search(r"differ in x by (\S+) ± (\S+), .* deg/h at most, near (\S+) °C", said).groups()
    assert float(size) == pytest.approx(30, abs=4 * float(sigma))
    assert float(sigma) < 8
    assert -10 < float(at) < 40
    assert said.endswith("run `driftlab explain`")
    assert found.sentences(RATE)[1] == said, "right after what the map is good to"
    assert found.good[0] > 30 / np.sqrt(2) / 2 * DEG_H * 0.75, "either branch is half of it away from the curve"
    assert found.memory.answer == "seen"
    assert np.all(np.abs(found.memory.size[1:]) < 4 * found.memory.sigma[1:])


def test_a_soak_that_only_warms_says_so():
    found = verdict(Spline(), *soak(2, 8, UP))
    said = "only ever warms: hysteresis cannot be seen, and a walk hardly; come back down by the same steps"
    assert said in found.sentences(RATE)
    judged = found.as_json()["memory"]
    assert (judged["answer"], judged["why"], judged["size"]) == ("undecided", said, [None] * 3)
    assert found.coverage.hours == pytest.approx({"warming": 8.0, "cooling": 0.0, "neither": 0.0}, abs=0.01)


def test_a_map_that_does_not_say_how_sure_it_is_gets_no_number():
    T, bias = soak(3, 8, planted=30.0)
    known = Spline().fit(T, bias, {})
    mute = type(known)(known.record.model_copy(update={"error": None}), known.coefficients, known.spread)
    found = MapVerdict(mute, Spline(), brief(T, bias, [0], DT))
    first, *others = found.sentences(RATE)
    assert first.startswith("a spline with knots 1 K apart does not say how sure its curve is; it leaves x ")
    assert not any("good to" in line for line in (first, *others))
    assert any(line.startswith("hysteresis or lag") for line in others), "the samples say that"
    assert "sigma" not in found.as_json()


def test_holes_and_few_samples_are_said():
    T, bias = soak(4, 8, hours=30.0, walk=1e-4)
    hole, few = (T > 5) & (T < 12), (T > 30) & (np.arange(len(T)) % 50 > 0)
    keep = ~(hole | few)
    found = verdict(Spline(), T[keep], bias[keep])
    ((low, high),) = found.coverage.holes
    assert (low, high) == pytest.approx((5, 12), abs=0.1)
    said = found.sentences(RATE)
    assert any(line.startswith("no sample between 5") and "is a guess, good to" in line for line in said)
    assert any(line.startswith("few samples between 31 and 48 °C: 8 a kelvin") for line in said)
    assert found.coverage.share == pytest.approx(1 - 7 / 68, abs=0.02)


def test_the_numbers_are_json_of_finite_numbers():
    for settings in (Spline(), Polynomial()):
        json.dumps(verdict(settings, *soak(5, 4)).as_json(), allow_nan=False)


def test_numbers_are_written_as_one_says_them():
    assert [text(v) for v in (22.64, 0.03142, 1250.0, 0.0, -3.0, 1e-9)] == [
        "22.6",
        "0.0314",
        "1250",
        "0",
        "-3",
        "1e-09",
    ]
