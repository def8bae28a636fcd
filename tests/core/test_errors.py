"""The wording of a moment, and errors from another process."""

import pickle

import pytest

from fusion_core.errors import OutsideDomain, PluginError, moment, seconds


@pytest.mark.parametrize(
    ("t", "first_row", "text"),
    [
        (1760000812.0, 1.76e9, "812.0 s (t = 1760000812.0 s in the file)"),
        (812.0, 0.0, "812.0 s"),
        (812.0, None, "t = 812.0 s"),
        (0.0125, 0.0, "0.013 s"),
        (99.5, 100.0, "-0.5 s (t = 99.5 s in the file)"),
    ],
)
def test_seconds_from_the_first_row_with_the_files_own_time_beside_them(t, first_row, text):
    assert moment(t, first_row) == text


@pytest.mark.parametrize(
    ("t", "text"), [(100.0, "100.0 s"), (0.1, "0.1 s"), (1.9996, "2.0 s"), (float("nan"), "nan s"), (1e30, "1e+30 s")]
)
def test_a_time_is_said_to_the_millisecond(t, text):
    assert seconds(t) == text


def test_what_is_outside_a_map_says_when():
    error = OutsideDomain("polynomial: T = 61 degC", " is outside; refit", 1060.0)
    assert str(error) == "polynomial: T = 61 degC at t = 1060.0 s is outside; refit"
    placed = error.at(lambda t: moment(t, 1000.0))
    assert str(placed) == "polynomial: T = 61 degC at 60.0 s (t = 1060.0 s in the file) is outside; refit"
    assert str(OutsideDomain("T", " is outside").at(seconds)) == "T is outside"


def test_errors_come_whole_from_another_process():
    outside = OutsideDomain("polynomial: T = 61 degC", " is outside; refit", 1060.0)
    for error in (outside, PluginError("broken", plugin="acme", family="sources")):
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is type(error)
        assert str(again) == str(error)
        assert vars(again) == vars(error)
