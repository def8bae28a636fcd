"""Earth rate and gravity against closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion_core.errors import ConfigError
from fusion_plugins.earth import RATE, earth_rate, gravity


def test_gravity_at_the_pole_and_the_equator_is_that_of_wgs84():
    assert gravity(0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert gravity(np.pi / 2) == pytest.approx(9.8321849379, abs=1e-9)


@given(st.floats(-1.5, 1.5), st.floats(-3, 3), st.lists(st.floats(-1, 1), min_size=3, max_size=3))
def test_earth_rate_has_its_length_and_its_vertical_part(latitude, heading, up):
    up = np.array(up)
    if np.linalg.norm(up) < 0.1 or np.linalg.norm(np.cross(up, [1, 0, 0])) < 0.1 * np.linalg.norm(up):
        return
    up /= np.linalg.norm(up)
    omega = earth_rate(up, latitude, heading)
    assert np.linalg.norm(omega) == pytest.approx(RATE)
    assert omega @ up == pytest.approx(RATE * np.sin(latitude), abs=1e-12)
    np.testing.assert_allclose(earth_rate(up, latitude, None), (omega @ up) * up, atol=1e-12)


def test_earth_rate_with_x_to_the_east_and_z_up_lies_in_y():
    omega = earth_rate(np.array([0.0, 0.0, 1.0]), 0.0, np.pi / 2)
    np.testing.assert_allclose(omega, [0, RATE, 0], atol=1e-18)


def test_heading_of_a_vertical_x_axis_is_refused():
    with pytest.raises(ConfigError, match="heading: the x axis stands vertical"):
        earth_rate(np.array([1.0, 0.0, 0.0]), 0.5, 0.0)
