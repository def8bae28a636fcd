"""A unit with another thermometer, or another unit of it, among units that went through one program of a chamber."""

from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.family.thermometers import with_odd_thermometers

FAMILY = SimpleNamespace(domain=(-20.0, 60.0))


def ranges(n=30, seed=0):
    rng = np.random.default_rng(seed)
    return np.array([-20.0, 60.0]) + 0.05 * rng.normal(size=(n, 2))


def test_units_of_one_program_have_none():
    for seed in range(20):
        assert with_odd_thermometers({}, [str(k) for k in range(30)], ranges(seed=seed)) == {}


def test_degrees_of_fahrenheit_are_named():
    domains = ranges()
    domains[7] = 1.8 * domains[7] + 32
    ((unit, (reason,)),) = with_odd_thermometers({}, [f"U{k}" for k in range(30)], domains).items()
    assert unit == reason.unit == "U7"
    assert "from -4" in reason.sentence
    assert "correct the unit of the temperature" in reason.sentence


@pytest.mark.parametrize("off", [-8.0, 5.0])
def test_another_thermometer_is_off_at_both_ends(off):
    domains = ranges()
    domains[13] += off
    ((_, (reason,)),) = with_odd_thermometers({}, [str(k) for k in range(30)], domains).items()
    assert reason.value == pytest.approx(off, abs=0.3)


def test_a_part_of_the_range_and_a_wider_one_are_other_soaks():
    domains = ranges()
    domains[3], domains[4], domains[5] = (-20, 12), (10, 60), (-40, 80)
    assert with_odd_thermometers({}, [str(k) for k in range(30)], domains) == {}


def test_one_new_unit_is_held_against_its_family():
    assert set(with_odd_thermometers({}, ["new"], np.array([[-4.0, 140.0]]), FAMILY)) == {"new"}
    assert with_odd_thermometers({}, ["new"], np.array([[-4.0, 140.0]])) == {}, "one unit alone says nothing"
    assert with_odd_thermometers({}, ["new"], np.array([[np.nan, np.nan]]), FAMILY) == {}


def test_one_unit_is_not_held_to_what_many_scatter_by():
    """Of units whose thermometers scatter by 1.5 K, each alone against its family."""
    rng = np.random.default_rng(1)
    domains = np.array([-20.0, 60.0]) + 1.5 * rng.normal(size=(100, 1))
    assert sum(bool(with_odd_thermometers({}, ["one"], own[None], FAMILY)) for own in domains) <= 1
