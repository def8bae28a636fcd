"""An accelerometer's bias from its placements, held to units that are made up from the equation of the module."""

import numpy as np
import pytest

from driftlab.maps.assessment import sentences
from driftlab.soak.placements import placed
from driftlab.units import BiasUnit
from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

G = 9.80665
UNSURE = 0.0015  # m/s^2, of gravity
NOISE, WALK = 1e-3, 2e-6  # m/s^2/sqrt(Hz), m/s^2/sqrt(s)
MG = BiasUnit("m/s^2", "mg")
CUBIC = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 3})


def nearly(axis, sign):
    """A direction near an axis, as a unit on a bench lies."""
    up = sign * (np.eye(3)[axis] + 0.02 * np.array([1.0, -1.0, 0.5]))
    return up / np.linalg.norm(up)


SIX = [nearly(axis, sign) for axis in range(3) for sign in (1, -1)]


def curve(T):
    x = (T - 25) / 25
    return np.outer(x, [0.02, -0.03, 0.05]) + np.outer(x**2, [0.01, 0.005, -0.01]) + np.outer(x**3, [2e-3, 4e-3, -3e-3])


def unit(rng, ups, *, bias=(0.05, -0.03, 0.08), scale=(0, 0, 0), change=(0, 0, 0), spans=((0, 50),) * 6, hours=0.7):
    """Return temperature, reading and placement of a unit that warms and cools in each placement; 2 s a sample."""
    T, f, number = [], [], []
    for k, (up, (low, high)) in enumerate(zip(ups, spans, strict=False)):
        n = round(hours * 1800)
        own = low + (high - low) * (1 - np.abs(np.linspace(-1, 1, n)))
        factor = 1 + np.array(scale) + np.outer((own - 25) / 50, change)
        walk = np.cumsum(rng.normal(size=(n, 3)) * WALK * np.sqrt(2), axis=0)
        T.append(own)
        f.append(G * up * factor + bias + curve(own) + walk + rng.normal(size=(n, 3)) * NOISE / np.sqrt(2))
        number.append(np.full(n, k))
    return np.concatenate(T), np.concatenate(f), np.concatenate(number)


def mapped(T, bias, told):
    return told.widened(CUBIC.fit(T, bias, {}), CUBIC.smoother(T, bias))


def errors_in_sigma(fitted, T):
    grid = np.linspace(2, 48, 24)
    error = fitted.bias(grid) - curve(grid)
    level = np.mean(fitted.bias(T) - curve(T), axis=0)  # which the map's deviation leaves out
    return (error - level) / fitted.sigma(grid)


def test_six_placements_tell_bias_and_scale_factor_within_their_deviations():
    rng = np.random.default_rng(3)
    scale, change = np.array([1e-3, -2e-3, 3e-3]), np.array([1e-3, 0.0, 3e-3])
    b = rng.normal(size=3) * 0.1
    T, f, number = unit(rng, SIX, bias=b, scale=scale, change=change)
    bias, told = placed(T, f, number, G, UNSURE)
    levels = told.levels
    assert [levels.level(axis) for axis in range(3)] == ["told"] * 3
    assert np.all(levels.scale_determined)
    true = b + curve(T).mean(axis=0)
    assert np.all(np.abs(levels.bias - true) < 4 * levels.sigma)
    assert np.all(levels.sigma < 1e-3)
    # gravity itself is known to 1.5e-4 of its length, and a scale factor no better
    assert np.all(np.abs(levels.scale - scale) < 3 * levels.scale_sigma)
    for axis in range(3):
        found = told.changes[axis]
        assert found.determined
        assert abs(found.value - change[axis]) < 4 * found.sigma
    np.testing.assert_allclose(bias.mean(axis=0), levels.bias, atol=1e-6)


@pytest.mark.parametrize("ups", [SIX[4:5], SIX], ids=["one placement", "six"])
def test_nineteen_of_twenty_curves_are_within_two_deviations(ups):
    found = []
    for seed in range(3):
        T, f, number = unit(np.random.default_rng(seed), ups)
        bias, told = placed(T, f, number, G, UNSURE)
        found.append(errors_in_sigma(mapped(T, bias, told), T))
    assert np.mean(np.abs(found) < 1.96) > 0.85
    assert 0.4 < np.sqrt(np.mean(np.square(found))) < 1.4


def test_placements_at_other_temperatures_are_joined_by_what_they_share():
    """The less temperature they share, the less is known of the step between them."""
    across = []
    for spans in ([(0, 26), (24, 50)], [(0, 30), (20, 50)], [(0, 40), (10, 50)]):
        T, f, number = unit(np.random.default_rng(1), [SIX[4]] * 2, spans=spans)
        bias, told = placed(T, f, number, G, UNSURE)
        fitted = mapped(T, bias, told)
        assert np.all(np.abs(errors_in_sigma(fitted, T)) < 4)
        across.append(np.sqrt(np.mean((fitted.sigma(np.array([48.0]), 2.0)) ** 2)))
    assert across[0] > 1.1 * across[1] > 1.1**2 * across[2]


def test_what_one_placement_does_not_tell_is_said():
    T, f, number = unit(np.random.default_rng(0), [np.array([0.0, 0.0, 1.0])])
    _, told = placed(T, f, number, G, UNSURE)
    assert [told.levels.level(axis) for axis in range(3)] == ["tilt", "tilt", "scale"]
    assert not any(change.determined for change in told.changes)
    assert abs(told.levels.bias[2] - (0.08 + curve(T)[:, 2].mean())) < 0.01
    np.testing.assert_allclose(told.levels.bias[:2], 0, atol=1e-3)
    lines = sentences(told, "xyz", MG)
    assert any("the level of x, y is one with the tilt" in line for line in lines)
    assert any("one more placement with z down tells them apart" in line for line in lines)
    assert any(line.startswith("z: the change with temperature may be of its scale factor") for line in lines)
    assert not any(line.startswith(("x:", "y:")) for line in lines)


def test_a_scale_factor_that_changes_is_no_bias_once_a_placement_shows_the_other_side():
    rng, change = np.random.default_rng(0), (0, 0, 3e-3)
    up = np.array([0.0, 0.0, 1.0])
    grid = np.linspace(5, 45, 9)
    apart = []
    for ups in ([up], [up, -up]):
        T, f, number = unit(rng, ups, change=change)
        bias, told = placed(T, f, number, G, UNSURE)
        error = mapped(T, bias, told).bias(grid)[:, 2] - curve(grid)[:, 2]
        apart.append(np.ptp(error))
    assert apart[0] == pytest.approx(3e-3 * G * 40 / 50, rel=0.05)  # one placement takes it for bias
    assert apart[1] < 0.02 * apart[0]
