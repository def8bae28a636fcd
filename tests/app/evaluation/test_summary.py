"""What a run says of itself in sentences."""

import numpy as np
import pytest

from driftlab.evaluation.scores import ScoreAccumulator
from driftlab.evaluation.summary import remarks
from fusion_plugins.measurement_models.zupt import Zupt

MODEL = Zupt.examples()[0]


def nis(mean):
    return {"mean_per_component": mean, "low": 0.99, "high": 1.01, "consistent": False}


def summary(**changes):
    quiet = {
        "t": {"first_row_s": 0.0, "start_s": 0.0, "aligned_s": 60.0, "end_s": 600.0},
        "updates": {"count": 6000, "interval_s": 0.1, "used": 5990},
        "axes": {"gyro": ["x", "y", "z"]},
        "noise_ratio": {"gyro": np.ones(3)},
        "aligned_again_s": [],
        "motion_s": [],
        "motion_axes": [],
        "refused_s": [],
        "refused_axes": [],
        "temperature_swing_K": 0.0,
        "filter_rmse_rad_s": {"first 30 s": np.ones(3), "whole": np.ones(3)},
        "coast_rmse_rad_s": {
            "1 min": np.ones(3),
            "5 min": np.ones(3),
            "10 min": np.full(3, np.nan),
            "to the end": np.ones(3),
        },
        "share": {
            "first 30 s": 1.0,
            "whole": 1.0,
            "1 min": 1.0,
            "5 min": 1.0,
            "10 min": 0.9,
            "to the end": 1.0,
            "moved": 0.0,
        },
        "faults": {},
        "nis": {"mean_per_component": 1.01, "low": 0.99, "high": 1.01, "consistent": True},
    }
    return quiet | changes


def test_bounds_that_only_a_long_run_can_miss_are_no_news():
    assert remarks(summary(nis=nis(1.03)), MODEL) == []


def test_a_quiet_run_has_nothing_to_say():
    assert remarks(summary(), MODEL) == []


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"aligned_again_s": [70.5]}, "aligned again at 70.5 s: still"),
        ({"aligned_again_s": [70.5, 90.0, 99.0]}, "aligned again 3 times, first at 70.5 s: still"),
        ({"updates": {"count": 9, "interval_s": 0.1, "used": 0}}, "no update was used: nothing is known of the bias"),
        (
            {"t": {"first_row_s": 0.0, "start_s": 0.0, "aligned_s": 60.0, "end_s": 61.0}},
            "only 1.0 s after the alignment: too short",
        ),
        ({"noise_ratio": {"gyro": np.array([1.0, 2.5, 1.0])}}, "y 2.5); set filter.gyro.noise"),
        ({"nis": nis(1.44)}, "NIS 1.44 a component, 0.99 to 1.01 was expected: innovations are 20 % larger than"),
        ({"nis": nis(0.25)}, "innovations are 50 % smaller than the model says, so its deviations are too large"),
        ({"noise_ratio": {"gyro": np.array([1.0, 1.0, 0.001])}}, "or correct unit and path of source.channels.gyro"),
    ],
)
def test_each_thing_is_said_once(changes, expected):
    (line,) = remarks(summary(**changes), MODEL)
    assert expected in line


def test_no_reference_no_heading_error():
    """Where nothing was used there is no average to measure against: the error is not known, and not zero."""
    tally, none = ScoreAccumulator(3), np.zeros((400, 3))
    moved = {"t": np.arange(400.0), "tau": np.ones(400), "still": np.zeros(400), "bias": none, "coast": none}
    tally.add({**moved, "coast_sigma": none, "rate": none + 1}, none * np.nan)
    found = tally.yardsticks(np.array([0.0, 0.0, 1.0]), ("x", "y", "z"))
    assert all(np.isnan(value) for value in found.heading.values())
    assert np.all(np.isnan(found.filter_whole))
    assert found.share["whole"] == 0.0
    assert found.moved == pytest.approx(1.0)


def test_a_score_without_a_value_says_why():
    found = summary()
    found["filter_rmse_rad_s"]["first 30 s"] = np.full(3, np.nan)
    found["share"]["first 30 s"] = 0.1
    (line,) = remarks(found, MODEL)
    assert line.startswith("no score for first 30 s (10 %)")
