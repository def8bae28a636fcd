"""What a user writes: quantities, and the errors that answer."""

import copy
import pickle
from fractions import Fraction
from typing import Annotated

import numpy as np
import pytest
import yaml
from pydantic import ValidationError
from written_configs import GOOD, load

from driftlab.config import Config
from fusion_core.contracts import BiasModel, ThermalMap
from fusion_core.errors import ConfigError, UnitError
from fusion_core.host.registry import registry
from fusion_core.settings import Settings
from fusion_core.units import Quantity, Unit, along_axes, convert, si_unit_of, to_si
from fusion_core.units import registry as pint_registry
from fusion_core.units.conversion import of_pint, ordinary_units, si_unit
from fusion_core.units.grammar import read_scaled_unit


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("3.18 deg/h/sqrt(Hz)", "rad/s/sqrt(Hz)", np.deg2rad(3.18) / 3600),
        ("0.012 deg/sqrt(h)", "rad/s/sqrt(Hz)", np.deg2rad(0.012) / 60),
        ("0.05 m/s/sqrt(h)", "m/s^2/sqrt(Hz)", 0.05 / 60),
        ("2 m/s/h/sqrt(s)", "m/s^2/sqrt(s)", 2 / 3600),
        ("34 ug/sqrt(Hz)", "m/s^2/sqrt(Hz)", 34e-6 * 9.80665),
        ("100 rpm", "rad/s", 100 * 2 * np.pi / 60),
        ("1.5 √(h)", "sqrt(s)", 90.0),
        ("9 K", "delta_degC", 9.0),
        ("40.9 deg", "rad", np.deg2rad(40.9)),
        ("5 mg", "m/s^2", 5e-3 * 9.80665),
        ("2 kg*m/s^2/kg", "m/s^2", 2.0),
        ("1013.25 hPa", "Pa", 101325.0),
        ("2.5 mH2O", "Pa", 2.5 * 9806.65),
        ("30 uT", "gauss", 0.3),
        ("90 min", "h", 1.5),
        ("25 degC", "degC", 25.0),
        ("25 °C", "K", 298.15),
        ("1 deg/s/degC", "rad/s/K", np.deg2rad(1)),
        ("2 degC/min", "K/s", 2 / 60),
        ("9 degF/min", "K/min", 5.0),
        ("3 m/s2", "m/s^2", 3.0),
        ("3 rad s-1", "rad/s", 3.0),
        ("5e-4 m s-2", "m/s^2", 5e-4),
    ],
)
def test_quantities_by_hand(text, unit, value):
    assert to_si(text, unit) == pytest.approx(value, rel=1e-12)


@pytest.mark.parametrize(
    ("text", "unit", "message"),
    [
        ("5 Hz", "rad/s", "cannot be converted to rad/s"),
        ("5 furlong_per", "rad/s", "unknown unit 'furlong_per'"),
        ("fast", "rad/s", "it begins with 'f' and not with a number"),
        ("3.18", "rad/s", "has no unit"),
        ("nan deg/s", "rad/s", "not a"),
        ("1 deg/s (", "rad/s", "is not a quantity"),
    ],
)
def test_wrong_quantities(text, unit, message):
    with pytest.raises(UnitError, match=message.replace("(", r"\(")):
        to_si(text, unit)


def test_arrays_are_converted_with_factor_and_offset():
    np.testing.assert_allclose(convert([1.0, 2.0], "0.5 mrad/s"), [5e-4, 1e-3])
    np.testing.assert_allclose(convert([0.0, 100.0], "degF", "degC"), [-160 / 9, 340 / 9])
    np.testing.assert_allclose(convert([300.0], "K"), [26.85])
    np.testing.assert_allclose(convert([1013.25], "hPa"), [101325.0])
    assert si_unit_of("hPa") == "kilogram/meter/second**2"
    with pytest.raises(UnitError, match="unit 'm/s' cannot be converted to rad/s"):
        convert([1.0], "m/s", "rad/s")


def test_a_quantity_is_written_back_as_it_was(tmp_path):
    config = load(tmp_path, GOOD)
    assert config.model_dump(mode="json")["filter"]["gyro"]["noise"] == "3.18 deg/h/sqrt(Hz)"
    assert load(tmp_path, config.model_dump_json(exclude_none=True)) == config
    value = Quantity(1.0, "1 rad/s")
    for again in (copy.deepcopy(value), pickle.loads(pickle.dumps(value))):
        assert (again, again.text) == (1.0, "1 rad/s")


def test_one_value_an_axis(tmp_path):
    class Part(Settings):
        noise: Annotated[float | tuple[float, ...], Unit("rad/s")]

    part = load(tmp_path, "noise: [1 rad/s, 2 rad/s, 3 rad/s]", Part)
    np.testing.assert_array_equal(along_axes(part.noise, 3), [1, 2, 3])
    wrong = GOOD.replace("noise: 3.18 deg/h/sqrt(Hz)", "noise: [1 deg/h/sqrt(Hz), 2 deg/h/sqrt(Hz)]")
    with pytest.raises(ConfigError, match=r":4: filter\.gyro: noise has 2 values for 3 axes; write one for all"):
        load(tmp_path, wrong)
    wrong = GOOD.replace("walk: 5e-4 deg/s/sqrt(s)", "walk: [1 deg/h/sqrt(s), 2 deg/h/sqrt(s)]")
    with pytest.raises(ConfigError, match=r"filter\.gyro\.bias: walk has 2 values for 3 axes"):
        load(tmp_path, wrong)


def test_in_python_a_bare_number_is_si(tmp_path):
    walk = registry().classes(BiasModel)["random_walk"]
    plain, written = walk(walk=2e-6, axes=("r",)), walk(walk="2e-6 rad/s/sqrt(s)", axes=("r",))
    np.testing.assert_array_equal(plain.prior().P, written.prior().P)
    assert plain.walk == written.walk == 2e-6
    assert walk.model_validate(plain.model_dump()) == plain
    each = walk(walk=(1e-6, np.float32(2e-6).item(), 3))
    np.testing.assert_allclose(each.walk, [1e-6, 2e-6, 3.0], rtol=1e-7)
    for wrong in (True, np.nan, np.inf, -1.0, 1e31, None, b"1"):
        with pytest.raises(ValidationError):
            walk(walk=wrong)

    # where a section says what the bias is, the number gets its unit, and can be written to a config
    config = Config.model_validate(
        {"filter": {"gyro": {"noise": 1e-5, "bias": plain.model_copy(update={"axes": ("x",)})}}}
    )
    content = yaml.safe_load(config.as_yaml())["filter"]["gyro"]
    assert (content["noise"], content["bias"]["walk"]) == ("1e-05 rad/s/sqrt(Hz)", "2e-06 rad/s/sqrt(s)")
    assert load(tmp_path, config.as_yaml()).filter.gyro.bias.walk == 2e-6


def test_a_difference_of_temperatures_is_written_in_kelvin():
    spline = registry().classes(ThermalMap)["spline"](interval=0.5)
    assert spline.model_dump()["interval"] == "0.5 K"
    assert type(spline).model_validate(spline.model_dump()) == spline


@pytest.mark.parametrize("unit", ordinary_units())
def test_ordinary_units_are_what_pint_says(unit):
    si, factors = ordinary_units()[unit]
    names = {name: Fraction(power or 1) for name, _, power in (part.partition("^") for part in unit.split())}
    source = of_pint(names, unit)
    assert si_unit(source) == si
    for target, factor in factors.items():
        wanted = of_pint(read_scaled_unit(target)[1], target)
        for value in (1.0, 0.0, -3.18, 1.5e-4, 9.80665e8, np.pi):  # to the last bit
            assert pint_registry().Quantity(value, source).to(wanted).magnitude == value * factor


def test_ordinary_units_are_known_without_pint(monkeypatch):
    monkeypatch.setattr("fusion_core.units.conversion.registry", None)
    assert to_si("3.18 deg/h/√Hz", "rad/s/sqrt(Hz)") == 3.18 * np.radians(1) / 3600
    assert convert(2.0, "0.5 mg", "m/s^2") == pytest.approx(0.00980665)
    assert si_unit_of("0.5 deg/s") == "radian/second"
