"""ArduPilot's arithmetic: bit for bit that of its formula in C."""

import numpy as np
import pytest
from flying_units import in_c

from fusion_plugins.exporters.ardupilot import UNCALIBRATED, ArduPilotParameters

# p(t) = (c1 + (c2 + c3 t) t) t 1e-6 about 35 degC, taken off at T and put back at T_cal, both clipped; then the offset
FORMULA = """
static float p(const float *c, float t) { return (c[0] + (c[1] + c[2] * t) * t) * t * 1e-6f; }
static float clip(float T, const float *c) { return T < c[0] ? c[0] : T > c[1] ? c[1] : T; }
static float f(const float *c, float T) {  /* c1, c2, c3, T_min, T_max, offset, T_cal, value */
  float v = c[7];
  v -= p(c, clip(T, c + 3) - 35.0f);
  v += p(c, clip(c[6], c + 3) - 35.0f);
  return v - c[5];
}
"""


@pytest.mark.parametrize("T_cal", [35.0, 22.6, 71.0, UNCALIBRATED])
def test_corrected_values_are_those_of_the_formula_in_c_to_the_bit(T_cal, tmp_path):
    T = np.random.default_rng(5).uniform(-40, 90, 100_000).astype(np.float32)
    c, offset, value = np.float32([[-88.3], [2.41], [0.0483]]), np.float32([1.7e-3]), np.float32(0.0123)
    found = ArduPilotParameters(c, np.float32(-4.9), np.float32(63.2), offset, np.float32(T_cal)).corrected(
        [[value]], T
    )
    expected = in_c(tmp_path, FORMULA, [*c[:, 0], -4.9, 63.2, offset[0], T_cal, value], T)
    assert np.array_equal(found[:, 0].view(np.uint32), expected.view(np.uint32))


def test_what_is_taken_off_is_the_offset_at_the_temperature_at_which_it_was_taken():
    c, offset = np.float32([[700, -20, 3], [10, 1, 2], [0.1, 0, -0.2]]), np.float32([0.01, -0.02, 0.03])
    held = ArduPilotParameters(c, np.float32(0), np.float32(60), offset, np.float32(24.5))
    np.testing.assert_allclose(held.bias([24.5])[0], offset, rtol=1e-6)


def test_a_temperature_of_calibration_that_is_not_set_stands_for_the_lower_limit():
    c, offset = np.float32([[700], [10], [0.1]]), np.float32([0.01])
    never, lowest = (
        ArduPilotParameters(c, np.float32(5), np.float32(60), offset, np.float32(at)).bias([12.0, 44.0])
        for at in (-300, 5)
    )
    assert np.array_equal(never, lowest)
