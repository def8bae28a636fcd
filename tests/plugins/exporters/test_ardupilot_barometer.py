"""The exponent of ArduPilot's barometer: that of a curve that has one, its arithmetic in C, and what it cannot hold."""

import numpy as np
import pytest
from flying_units import in_c, sensor

from fusion_core.contracts import Export
from fusion_core.errors import ConfigError
from fusion_plugins.exporters.ardupilot import Ardupilot
from fusion_plugins.exporters.ardupilot_barometer import BarometerExponent
from fusion_plugins.thermal_maps.spline import Spline

FORMULA = """
#include <math.h>
static float f(const float *c, float T) {  /* exponent: pressure += powf(MAX(T - 25, 0), exponent) */
  float above = T - 25.0f;
  return -powf(above > 0.0f ? above : 0.0f, c[0]);
}
"""


def barometer(bias, low=0.0, high=60.0):
    T = np.linspace(low, high, 2001)
    return Export((sensor(Spline().fit(T, bias(T)[:, None], {}), ("x",), "baro", "Pa", "Pa"),))


@pytest.mark.parametrize("exponent", [0.6, 1.0, 1.37])
def test_the_exponent_of_a_curve_that_has_one_is_found_and_loses_nothing(exponent, tmp_path):
    path = tmp_path / "a.parm"
    loss = Ardupilot().export(barometer(lambda T: 40 - np.maximum(T - 25, 0) ** exponent), path)
    values = dict(line.split() for line in path.read_text().splitlines() if line[0] != "#")
    assert float(values["TCAL_BARO_EXP"]) == pytest.approx(exponent, abs=0.01)
    assert values["TCAL_ENABLED"] == "1"
    swing = 35**exponent
    assert loss.sensors[0].domain.rms < 0.01 * swing
    (back,) = Ardupilot().read(path)
    T = np.linspace(26, 60, 50)
    np.testing.assert_allclose(back.bias(T)[:, 0], -((T - 25) ** exponent), atol=0.02 * swing)


def test_what_does_not_fall_is_refused(tmp_path):
    for curve in (lambda T: 2.0 * T, lambda T: 9 * np.sin(T / 2)):
        with pytest.raises(ConfigError, match="does not fall by a power of the temperature above 25 °C"):
            Ardupilot().export(barometer(curve), tmp_path / "a.parm")
    with pytest.raises(ConfigError, match="the map of the mag is in T, ArduPilot corrects gyros"):
        Ardupilot().export(
            Export((sensor(barometer(np.sin).sensors[0].map, ("x",), "mag", "T", "uT"),)), tmp_path / "b"
        )


def test_its_arithmetic_is_that_of_the_formula_in_c(tmp_path):
    T = np.random.default_rng(2).uniform(-40, 90, 20_000).astype(np.float32)
    for exponent in np.float32([0.0, 0.4, 1.0, 1.73, 2.0]):
        found = BarometerExponent(exponent, np.float32(0), np.float32(60)).bias(T)[:, 0]
        expected = in_c(tmp_path, FORMULA, [exponent], T)
        # powf is not the same to the bit from one library to the next: two units of the last place
        apart = np.abs(found.view(np.int32).astype(np.int64) - expected.view(np.int32))
        assert np.max(apart) <= 2
