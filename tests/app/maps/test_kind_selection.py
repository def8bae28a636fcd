"""Kinds of maps on soaks whose curve is known: what is left out, which is taken, and what a broken one does."""

import numpy as np
import pytest

from driftlab.maps.kind_selection import ErrorScale, candidates, compare, divide
from driftlab.reports.map_selection import comparison_document, comparison_table, config_line, failures, verdict
from driftlab.units import RATE
from fusion_core.contracts import ThermalMap
from fusion_core.errors import ConfigError, SwingTooSmall
from fusion_plugins.thermal_maps.onnx_network import OnnxNetwork
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.degrees(1) * 3600
NOISE, WALK = 6 / DEG_H, 0.03 / DEG_H  # of a block


FEW = [*(Polynomial(order=order) for order in (1, 2, 3, 5)), Spline()]


def triangle(K=400, sweeps=4, low=-20.0, high=50.0):
    """Temperatures up and down again."""
    x = 1 - np.abs(1 - (np.arange(K) * sweeps / K) % 2)
    return low + (high - low) * x


def soak(curve, seed=0, **how):
    rng = np.random.default_rng(seed)
    T = triangle(**how)
    b = curve((T - 15) / 35)
    walk = np.cumsum(rng.normal(size=b.shape) * WALK, axis=0)
    return T, b + walk + rng.normal(size=b.shape) * NOISE


def cubic(x):
    return np.stack([x - 2 * x**3, 0.5 * x**2 + x**3], axis=1) * 60 / DEG_H


def step(x):
    return np.stack([np.tanh(40 * (x - 0.2)), 0.2 * x], axis=1) * 60 / DEG_H


def judged(curve, seed=0, tried=None, **how):
    T, bias = soak(curve, seed, **how)
    tried = FEW if tried is None else tried
    return compare(tried, T, bias, divide([T]))


@pytest.mark.parametrize("seed", range(2))
def test_a_cubic_is_a_polynomial_of_order_3_and_no_larger_one(seed):
    assert judged(cubic, seed).chosen.name == "polynomial, order 3"


@pytest.fixture(scope="module")
def of_step():
    return judged(step)


def test_a_step_is_a_spline_and_the_sentence_says_where_the_polynomials_fail(of_step):
    found = of_step
    assert found.chosen.name == "spline"
    assert config_line(found) == "{kind: spline}"
    lines = verdict(found, RATE, "xy")
    assert lines[0].startswith("left out in turn: ")
    assert "most of it in x at " in lines[1]
    at = float(lines[1].split("most of it in x at ")[1].split()[0])
    assert abs(at - (15 + 0.2 * 35)) < 4
    assert lines[1].endswith("take spline")


def test_the_error_is_that_of_the_curve_and_of_the_noise():
    """With a true curve and no walk, what is left is the noise of the means over 50 ranges in each part."""
    rng = np.random.default_rng(0)
    T = triangle(K=50_000)
    truth = cubic((T - 15) / 35)
    noise = NOISE * rng.normal(size=truth.shape)
    division = divide([T])
    scale = ErrorScale.of(T, division)
    S, w = scale.squares(scale.levelled(noise + 7.0))  # a constant is no temperature's
    count = np.bincount(scale.cell)
    expected = np.sum(scale.weight / count) * NOISE**2 / scale.weight.sum()
    lost = len(np.unique(division.part)) / len(count)  # a constant a part
    np.testing.assert_allclose(S.sum(axis=0) / w.sum(), expected * (1 - lost), rtol=0.2)


def test_a_walk_alone_is_no_shape():
    """Without anything that follows the temperature hardly more than a straight line is taken."""
    rng = np.random.default_rng(1)
    T = triangle()
    bias = np.cumsum(rng.normal(size=(len(T), 1)), axis=0) / DEG_H
    found = compare(FEW, T, bias, divide([T]))
    assert found.chosen.name in ("polynomial, order 1", "polynomial, order 2")


def test_noise_of_zero_is_no_reason_to_fail():
    T = triangle()
    found = compare(FEW, T, cubic((T - 15) / 35), divide([T]))
    assert found.chosen.name == "polynomial, order 3"


@pytest.mark.parametrize(("recordings", "what", "levels"), [
    ([triangle(sweeps=8)], "each of 8 sweeps", True),
    ([triangle(sweeps=2)], "10 parts of time of 2 sweeps", True),
    ([triangle(sweeps=1)], "every 5th of 25 ranges of temperature", False),
    ([triangle(sweeps=2), triangle(sweeps=2)], "each of 2 recordings", True),
    ([triangle(sweeps=2, high=15.0), triangle(sweeps=2, low=16.0)], "10 parts of time of 4 sweeps", True),
])  # fmt: skip
def test_what_is_left_out_depends_on_what_there_is(recordings, what, levels):
    found = divide(recordings)
    assert found.what == what
    assert found.levels is levels
    T = np.concatenate(recordings)
    for fold in set(found.fold) - {-1}:
        out = found.fold == fold
        others = T[~out]
        near = np.min(np.abs(T[out & found.scored][:, None] - others), axis=1)
        assert np.all(near <= 0.025 * np.ptp(T)), "no temperature is scored that nothing else has"
        assert np.all(T[out & found.scored] <= others.max())
    assert found.share > 0.5


def test_the_only_samples_of_a_temperature_are_not_scored():
    T = np.append(triangle(K=1000, sweeps=2), np.linspace(-20, 80, 300))  # beyond 50 degC only at the end
    found = divide([T])
    assert not np.any(found.scored[T > 53])
    assert 0.5 < found.share < 1.0


class Broken(Polynomial):
    """A kind that cannot be fitted."""

    kind: str = "broken"

    def variants(self):
        return (self,)

    def fit(self, T, bias, provenance):
        raise SwingTooSmall("broken: asks for more")


class Demanding(Polynomial):
    """A kind that has no defaults."""

    kind: str = "demanding"
    needed: float


def test_a_kind_that_fails_is_a_row_and_stops_nothing():
    tried = [*candidates([], [Broken, Demanding]), Polynomial(order=3)]
    found = judged(cubic, tried=tried)
    assert found.chosen.name == "polynomial"
    assert {row.name for row in found.tried if row.failed} == {"broken", "demanding"}
    lines = failures(found)
    assert lines[0] == "broken failed: with a part left out, broken: asks for more"
    assert "needed" in lines[1]
    content = comparison_document(found, RATE)
    assert [row["failed"] for row in content["tried"] if row["name"] == "broken"] == [
        "with a part left out, broken: asks for more"
    ]
    with pytest.raises(ConfigError, match="no kind of map can be fitted"):
        judged(cubic, tried=[Broken()])


def test_a_kind_has_the_configs_settings_where_it_names_it():
    named: list[ThermalMap] = [Polynomial(order=9), OnnxNetwork(starts=2)]
    tried = candidates(named, [Polynomial, Spline, OnnxNetwork])
    assert [one.order for one in tried if isinstance(one, Polynomial)] == [1, 2, 3, 4, 5, 6, 7, 9]
    assert [one.starts for one in tried if isinstance(one, OnnxNetwork)] == [2]
    assert Spline() in tried


def test_the_table_begins_with_the_chosen_one_and_ends_with_no_map(of_step):
    table = comparison_table(of_step, RATE, "x").rows
    assert table[0][0] == "spline *"
    assert table[-1][0] == "no map"
