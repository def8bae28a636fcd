"""Tables of the C code: knots are whole numbers of 16 bits, whatever the loss."""

import numpy as np
import pytest

from fusion_core.contracts.effect import TEMPERATURE
from fusion_plugins.exporters.c.program import fewest


@pytest.mark.parametrize("share", [0.001, 0.02, 0.1, 0.3])
def test_knots_fit_into_16_bits_where_lines_overshoot_the_curve(share):
    """Knots of a parabola are beyond its ends by up to the loss; integers that overflow are another curve."""

    def curve(T):
        return np.stack([(T - 12) ** 2, -((T - 12) ** 2), T], axis=1) * 1e-5

    loss = share * np.ptp(curve(np.linspace(5, 20, 100)), axis=0)
    table = fewest(TEMPERATURE, curve, (5.0, 20.0), loss, floats=False)
    assert table.whole
    assert np.all(np.abs(table.knots) <= 32767)
    T = np.linspace(5, 20, 1501)
    knots = np.linspace(5, 20, len(table.knots))
    values = table.offset + table.scale * table.knots
    lines = np.stack([np.interp(T, knots, column) for column in values.T], axis=1)
    assert np.all(np.abs(lines - curve(T)) <= 1.01 * loss)
