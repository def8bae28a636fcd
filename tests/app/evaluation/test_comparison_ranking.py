"""The ranking by coast, told from yardsticks that are written down here."""

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest

from driftlab.evaluation.comparison import coast_verdict, ranking
from driftlab.evaluation.scores import HORIZONS, Scores
from driftlab.units import RATE, BiasUnit

DEG_H = np.deg2rad(1.0) / 3600


def coasting(error, sigma=5.0, axes="xyz", unit=DEG_H):
    """Yardsticks of a run that coasts this far off on each axis over every horizon, in deg/h."""
    error, sigma = (np.broadcast_to(np.asarray(v, dtype=float) * unit, len(axes)) for v in (error, sigma))
    each = dict.fromkeys(HORIZONS)
    return Scores(
        axes=tuple(axes),
        filter_first=error,
        filter_whole=error,
        coast=dict.fromkeys(each, error),
        coast_sigma=dict.fromkeys(each, sigma),
        heading=dict.fromkeys(HORIZONS, np.nan),
        share=dict.fromkeys(HORIZONS, 1.0),
        moved=0.0,
    )


def of(runs, span=2400.0, unit=RATE):
    return coast_verdict(runs, unit, span)


def test_the_best_is_named_with_its_error_whatever_the_order():
    runs = {"standard": coasting(34.1), "tczupt": coasting([12.0, 12.0, 12.9]), "plain": coasting(90)}
    for order in permutations(runs):
        assert of({name: runs[name] for name in order}) == (
            "On this one recording tczupt predicts best: to the end (40 min) 12.31 deg/h rms over the axes, "
            "standard 34.10, plain 90.00 deg/h; they differ by more than the sigma (5.00 deg/h), and all axes agree. "
            "Itself it is off by 2.5 times its sigma, which is too small to tell chance by. Over 10 min the same."
        )


def test_within_the_sigma_is_no_difference_whatever_the_order():
    """An error of 3 against 7 deg/h, where either says that it may be off by 5."""
    runs = {"a": coasting(7.0), "b": coasting(3.0)}
    for order in (["a", "b"], ["b", "a"]):
        text = of({name: runs[name] for name in order})
        assert "no difference is proven between b and a: to the end (40 min) 3.00 and 7.00 deg/h rms over" in text
        assert "within the sigma (5.00 deg/h)" in text
        assert "best" not in text


@pytest.mark.parametrize(("gap", "tie"), [(4.99, True), (5.01, False)])
def test_the_bound_is_the_larger_sigma(gap, tie):
    found = ranking({"a": coasting(4.0, sigma=1.0), "b": coasting(4.0 + gap, sigma=5.0)})
    assert found is not None
    assert found.best == (("a", "b") if tie else ("a",))


def test_the_same_config_twice_is_a_tie():
    assert "no difference is proven between a and b" in of({"a": coasting(3.0), "b": coasting(3.0)})


def test_a_third_that_is_worse_is_named_beside_a_tie():
    text = of({"a": coasting(30.0), "b": coasting(3.0), "c": coasting(4.0)})
    assert "no difference is proven between b and c" in text
    assert "; worse: a 30.00 deg/h." in text


def test_axes_that_do_not_agree_are_named():
    text = of({"a": coasting([2.0, 2.0, 20.0]), "b": coasting([60.0, 6.0, 2.0])})
    assert "a predicts best" in text
    assert "more than the sigma (5.00 deg/h), but not on y and on z b is better." in text
    tied = of({"a": coasting([10.0, 2.0, 0.0]), "b": coasting([2.0, 10.0, 0.0])})
    assert "no difference is proven" in tied
    assert ", but a is better on y and b is better on x." in tied


def test_ten_minutes_may_tell_another_story():
    slow, fast = coasting(1.0), coasting(30.0)
    slow = replace(slow, coast={**slow.coast, "10 min": np.full(3, 50 * DEG_H)})
    assert of({"slow": slow, "fast": fast}).endswith("Over 10 min fast predicts best.")
    level = replace(slow, coast={**slow.coast, "10 min": np.full(3, 28 * DEG_H)})
    assert of({"slow": level, "fast": fast}).endswith("Over 10 min none is proven between slow and fast.")
    assert "10 min" not in of({"slow": slow, "fast": fast}, span=500.0)


def test_a_horizon_that_one_run_has_no_score_for_decides_nothing():
    none = np.full(3, np.nan)
    a, b = coasting(1.0), coasting(30.0)
    a = replace(a, coast={**a.coast, "to the end": none, "10 min": none})
    found = ranking({"a": a, "b": b})
    assert found is not None
    assert found.horizon == "5 min"
    nothing = replace(a, coast=dict.fromkeys(HORIZONS, none))
    assert of({"a": nothing, "b": b}).startswith("The config that predicts best is not known")


def test_one_axis_has_no_axes_to_agree():
    ppm = BiasUnit("1", "ppm")
    one, other = (coasting(v, sigma=1.0, axes=("R",), unit=1e-6) for v in (1.5, 20.0))
    text = of({"one": one, "other": other}, unit=ppm)
    assert (
        "one predicts best: to the end (40 min) 1.5 ppm, other 20 ppm; they differ by more than the sigma (1 ppm)."
        in text
    )


def test_one_config_has_nothing_to_compare_with():
    assert of({"a": coasting(3.0)}) == (
        "a predicts with an error of 3.00 deg/h, to the end (40 min); there is nothing to compare it with."
    )
