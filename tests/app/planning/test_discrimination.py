"""A profile that tells effects apart is preferred among those that are nearly as good for the map."""

import numpy as np

from driftlab.planning.chamber import Chamber, ramps, staircase
from driftlab.planning.discrimination import SIGMA_EXCESS, DiscriminationCriterion, preferred
from driftlab.planning.search import RatedProfile, SearchResult
from driftlab.planning.unit_model import UnitModel
from driftlab.units import BiasUnit
from fusion_plugins.thermal_maps.polynomial import Polynomial

CHAMBER = Chamber(-10.0, 40.0, 20.0, 2 / 60, 120.0)
SUBJECT = UnitModel(
    "gyro", ("x",), BiasUnit("rad/s", "deg/h"), Polynomial(order=3), np.full(1, 1.5e-5), np.full(1, 2e-7), "", None, ""
)
GRID = np.linspace(-10, 40, 11)


def judged(profile, sigma):
    values = np.full((len(GRID), 1), sigma)
    return RatedProfile(profile, GRID, values, values, (-10.0, 40.0), 1.0)


def found(*items):
    return SearchResult(SUBJECT, CHAMBER, 4.0, items, None, ())


def test_ramps_tell_more_of_a_loop_than_one_way_up_and_are_chosen_while_sigma_allows():
    telling = DiscriminationCriterion(SUBJECT.with_curve(-10.0, 40.0), CHAMBER, 4.0, ["hysteresis", "thermal_lag"])
    assert set(telling.names) == {"hysteresis", "thermal_lag"}
    up, again = staircase(CHAMBER, 4.0, 5.0), ramps(CHAMBER, 4.0, 3)
    assert telling.nats(again) > 2 * telling.nats(up)
    near = found(judged(up, 1e-6), judged(again, (1 + SIGMA_EXCESS) * 0.99e-6))
    assert preferred(near, telling).chosen.profile is again
    far = found(judged(up, 1e-6), judged(again, (1 + SIGMA_EXCESS) * 1.01e-6))
    assert preferred(far, telling).chosen.profile is up
