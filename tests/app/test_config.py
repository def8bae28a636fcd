"""The serial number and the limits of a unit in its config."""

import numpy as np
import pytest
from written_configs import GOOD, load

from driftlab.commands.check import check
from fusion_core.errors import ConfigError

HELD = """
filter:
  kind: held
  channel: resistance
  noise: 0.06 ppm/sqrt(Hz)
  bias: {kind: random_walk, walk: 5e-4 ppm/sqrt(s)}
"""
HOUR = np.deg2rad(1) / 3600


def test_limits_are_in_any_unit_of_the_tracked_sensor(tmp_path):
    config = load(tmp_path, GOOD + "limits: {coast: 2 deg/h, swing: 0.1 mrad/s, noise: 0.05 deg/sqrt(h)}\n")
    assert config.limits.declared == pytest.approx({"coast": 2 * HOUR, "swing": 1e-4, "noise": 0.05 * 60 * HOUR})
    config = load(tmp_path, HELD + "limits: {residual: 2 ppm, noise: 1e-7/sqrt(Hz)}\n")
    assert config.limits.declared == pytest.approx({"residual": 2e-6, "noise": 1e-7})


def test_check_lists_them_in_SI(tmp_path):
    found = check(load(tmp_path, GOOD + "limits: {coast: 2 deg/h}\n")).quantities
    assert (found["limits.coast"].text, found["limits.coast"].unit) == ("2 deg/h", "rad/s")
    assert float(found["limits.coast"]) == pytest.approx(2 * HOUR)


@pytest.mark.parametrize(
    ("config", "limits", "says"),
    [
        (GOOD, "coast: 5 ppm", "limits.coast: '5 ppm' cannot be converted to rad/s; .*here e.g. '5 deg/h'"),
        (GOOD, "noise: 5 deg/h", "limits.noise: .* cannot be converted to rad/s/sqrt.*'4 deg/h/sqrt"),
        (HELD, "swing: 5 deg/h", "limits.swing: '5 deg/h' cannot be converted to 1; .*here e.g. '0.1 ppm'"),
        (HELD, "noise: 5 deg/h", r"limits.noise: .*here e.g. '0.1 ppm/sqrt\(Hz\)'"),
        (GOOD, "coast: 5", "limits.coast: 5 has no unit; write e.g. '5 deg/h'"),
        (HELD, "coast: 5", "limits.coast: 5 has no unit; write e.g. '5 ppm'"),
        (GOOD, "coast: -5 deg/h", "'-5 deg/h' must be greater than zero"),
        (GOOD, "coats: 5 deg/h", "limits.coats: unknown key; did you mean 'coast'?"),
    ],
)
def test_a_limit_of_another_dimension_says_what_to_write(tmp_path, config, limits, says):
    with pytest.raises(ConfigError, match=says) as caught:
        load(tmp_path, config + f"limits: {{{limits}}}\n")
    assert f"config.yaml:{(config + 'x').count(chr(10)) + 1}: " in str(caught.value)


@pytest.mark.parametrize(("written", "text"), [("CRS-17 b", "CRS-17 b"), ("1234", "1234"), ("'0012.50'", "0012.50")])
def test_a_serial_number_is_kept_as_it_is_on_the_label(tmp_path, written, text):
    config = load(tmp_path, GOOD + f"serial: {written}\n")
    assert config.serial == text
    assert load(tmp_path, config.as_yaml()).serial == text


@pytest.mark.parametrize("written", ["12.50", "true", "''", "' 12'", '"a\\nb"', f"'{'9' * 65}'", "[1]"])
def test_what_may_not_be_what_is_on_the_label_is_refused(tmp_path, written):
    with pytest.raises(ConfigError, match="serial: "):
        load(tmp_path, GOOD + f"serial: {written}\n")


def test_a_wrong_filter_is_not_told_twice(tmp_path):
    text = GOOD.replace("3.18 deg/h/sqrt(Hz)", "3.18 ppm") + "limits: {coast: 5 deg/h}\n"
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    assert "limits" not in str(caught.value)


def test_a_product_in_the_place_of_a_config_is_named_with_what_to_write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"mems_crs05: is a packaged product.*; write one with extends: mems_crs05"):
        check("mems_crs05", None)
    (tmp_path / "mems_crs05").write_text("extends: mems_crs05\n")  # a file of that name is a config
    assert check("mems_crs05", None).config.filter is not None
