"""Search of a profile: of more hours it is no worse, and the shortest one does not depend on the hours given."""

import numpy as np
import pytest

from driftlab.planning.chamber import Chamber, quickest
from driftlab.planning.search import ALIKE, search
from driftlab.planning.unit_model import UnitModel
from driftlab.units import BiasUnit
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.deg2rad(1 / 3600)
CHAMBER = Chamber(-20.0, 60.0, 25.0, 1.5 / 60, 480.0)
SUBJECT = UnitModel(
    "gyro", ("x", "y"), BiasUnit("rad/s", "deg/h"), Spline(), np.full(2, 2 * DEG_H), np.full(2, 0.03 * DEG_H),
    "a guess", None, "",
)  # fmt: skip


def test_more_hours_are_no_worse_and_the_shortest_is_the_least_that_is_found():
    """Between two hours at which a cycle more just fits, slower ramps are worse by the walk: stop earlier."""
    found = {hours: search(SUBJECT, CHAMBER, hours, 0.5 * DEG_H) for hours in (6.0, 7.0)}
    assert quickest(CHAMBER, 2) < 6.0 < 7.0 < quickest(CHAMBER, 3)
    assert found[7.0].chosen.score <= ALIKE * found[6.0].chosen.score
    for result in found.values():
        sigmas = [point.best.score for point in result.pareto]
        assert sigmas == sorted(sigmas, reverse=True)
        least = min(p.best.profile.hours for p in result.pareto if p.best.score <= result.target)
        assert result.shortest.score <= result.target
        assert result.shortest.profile.hours <= least
    assert found[6.0].shortest.profile.hours == pytest.approx(found[7.0].shortest.profile.hours, rel=0.03)
