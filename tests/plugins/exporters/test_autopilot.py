"""The polynomial that firmware gets: the best where it flies, and as well conditioned as single precision asks."""

import numpy as np
import pytest
from flying_units import DEG_H, cubic, fitted, sensor

from fusion_core.errors import ConfigError
from fusion_plugins.exporters.ardupilot import Ardupilot
from fusion_plugins.exporters.autopilot import places, polynomial, powers, uncorrected


def left(spline, flown, T_ref=20.0):
    """Rms (3,) that a cubic leaves of a map from 25 to 45 degC, in deg/h."""
    T = np.linspace(25, 45, 999)
    c = polynomial(spline, 3, T_ref, flown)
    return np.sqrt(np.mean((powers(T, T_ref, c) - spline.bias(T)) ** 2, axis=0)) * DEG_H


def test_a_cubic_comes_back_whole():
    found, T = cubic(), np.linspace(-10, 50, 777)
    for T_ref in (20.0, 35.0, 0.0):
        np.testing.assert_allclose(powers(T, T_ref, polynomial(found, 3, T_ref, None)), found.bias(T), atol=1e-15)


def test_weights_where_it_flies_pay_there_and_keep_the_rest_bounded():
    found = fitted()
    alike, weighted = left(found, None), left(found, (25.0, 45.0))
    assert weighted[1] < 0.25 * alike[1]  # the wave, which no cubic follows over the whole domain
    T = np.linspace(-10, 50, 999)
    elsewhere = np.abs(powers(T, 20.0, polynomial(found, 3, 20.0, (25.0, 45.0))) - found.bias(T))
    assert np.max(elsewhere) < 5 * np.max(np.abs(found.bias(T)))


def test_a_fit_beats_the_first_terms_of_a_better_one():
    found = fitted()
    better = polynomial(found, 9, 20.0, None)
    T = np.linspace(*found.domain, 999)
    cut = np.sqrt(np.mean((powers(T, 20.0, better[:4]) - found.bias(T)) ** 2, axis=0))
    fit = np.sqrt(np.mean((powers(T, 20.0, polynomial(found, 3, 20.0, None)) - found.bias(T)) ** 2, axis=0))
    assert fit[1] < 0.5 * cut[1]


@pytest.mark.parametrize("T_ref", [20.0, 35.0])
def test_single_precision_costs_less_than_a_hundredth_of_a_degree_an_hour(T_ref):
    found, T = fitted(), np.linspace(-10, 50, 999)
    c = polynomial(found, 3, T_ref, None)
    rounded = c.astype(np.float32).astype(float)
    assert np.max(np.abs(powers(T, T_ref, rounded) - powers(T, T_ref, c))) * DEG_H < 0.01


def test_axes_are_put_where_the_firmware_has_them():
    found = fitted(axes=2)
    assert places("px4", sensor(found, ("z", "x"))) == [2, 0]
    assert uncorrected(sensor(found, ("z", "x"))) == ("gyro: the map has no y, which stay uncorrected",)
    with pytest.raises(ConfigError, match="has the axes u, v, expected some of x, y, z"):
        places("px4", sensor(found, ("u", "v")))


def test_nothing_flies_outside_the_domain():
    settings = Ardupilot.model_validate({"kind": "ardupilot", "flies_from": "55 degC"})
    with pytest.raises(ConfigError, match=r"55 to 50 °C is nothing of the map's domain \(-10, 50\); give"):
        settings.flown((-10.0, 50.0))
    wide = Ardupilot.model_validate({"kind": "ardupilot", "flies_from": "-30 degC", "flies_to": "30 degC"})
    assert wide.flown((-10.0, 50.0)) == (-10.0, 30.0)
