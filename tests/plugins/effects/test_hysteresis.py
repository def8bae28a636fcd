import numpy as np
import pytest
from effect_recordings import at_temperature, on_one_axis

from fusion_plugins.effects.common import largest_reversal
from fusion_plugins.effects.hysteresis import Hysteresis


@pytest.mark.parametrize(("width", "swing"), [(8.0, 40.0), (3.0, 12.0), (15.0, 16.0)])
def test_hysteresis_encloses_its_loop(width, swing):
    """Over a full cycle the loop's area is width (swing - width), run through with the warm branch below."""
    up = np.linspace(0, swing, int(swing * 10) + 1)
    T = np.concatenate([up, up[::-1], up, up[::-1]])
    loop = on_one_axis(Hysteresis(width=f"{width} K"), at_temperature(np.arange(len(T)) * 1.0, T))[:, 0]
    last = slice(len(T) // 2 - 1, None)
    area = np.trapezoid(loop[last], T[last])
    assert area == pytest.approx(-width * (swing - width), rel=1e-9)
    assert np.max(np.abs(loop)) <= width / 2 + 1e-12


def test_hysteresis_differs_by_its_width_between_warming_and_cooling():
    T = np.concatenate([np.linspace(0, 50, 101), np.linspace(50, 0, 101)])
    loop = on_one_axis(Hysteresis(width="6 K"), at_temperature(np.arange(202.0), T))[:, 0]
    assert loop[0] == 0
    assert (loop[50], loop[151]) == (pytest.approx(-3), pytest.approx(3))


def test_a_play_is_no_wider_than_what_temperature_reverses_through():
    def widths(*temperatures):
        return [
            c.width for c in Hysteresis().proposals([at_temperature(np.arange(len(T)) * 1.0, T) for T in temperatures])
        ]

    up, rng = np.linspace(0, 40, 2001), np.random.default_rng(10)
    assert widths(up) == []
    assert widths(up + 0.05 * rng.normal(size=2001)) == []  # the thermometer's noise is no way back
    assert widths(np.round(up / 0.25) * 0.25 + 0.25 * (np.arange(2001) % 2)) == []  # nor a step to and fro
    there_and_back = np.concatenate([up, up[::-1]])
    found = widths(there_and_back)
    np.testing.assert_allclose(found, np.geomspace(0.8, 28, 12))
    partly = np.concatenate([up, np.linspace(40, 33, 300)])
    np.testing.assert_allclose(widths(up, partly), [w for w in found if w <= 7])
    late = np.concatenate([np.linspace(38, 40, 200), up[::-1]])  # dragged by 2 K before it turned: half of 4 K
    np.testing.assert_allclose(widths(late), [w for w in found if w <= 4])
    assert largest_reversal(there_and_back) == pytest.approx(40)
    assert largest_reversal(np.full(9, 3.0)) == 0
