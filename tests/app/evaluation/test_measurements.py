"""Measurements held against limits, and their sigma, beside Monte Carlo and the definitions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter

from driftlab.config import Limits
from driftlab.evaluation.limits import SIDE, check_limits, outcome, verdict
from driftlab.evaluation.measurements import Averages, of_alignment, of_coast, of_map
from driftlab.evaluation.scores import score
from driftlab.units import RATE
from fusion_core.chunk import Chunk
from fusion_core.contracts import Alignment
from fusion_plugins.measurement_models.alignment import noise_ratios
from fusion_plugins.measurement_models.zupt import Zupt
from fusion_plugins.thermal_maps.polynomial import Polynomial

NOISE, AXES = 1.5e-5, ("x", "y", "z")
TAU = 0.5


def coasting(rng, offset, seconds=900.0):
    """Return a run whose prediction is off by `offset` (3,), beside white noise."""
    N = int(seconds / TAU)
    t = TAU * np.arange(1, N + 1)
    rate = offset + rng.normal(size=(N, 3)) * NOISE / np.sqrt(TAU)
    zero = np.zeros((N, 3))
    still = np.ones(N, dtype=bool)
    return {"t": t, "tau": np.full(N, TAU), "still": still, "rate": rate, "bias": zero, "coast": zero,
            "coast_sigma": zero + 1e-6}  # fmt: skip


@pytest.mark.parametrize("walk", [0.0, 3e-7])
def test_the_mean_over_many_coasts_is_between_the_limits_of_one_run(walk):
    """Beside the definition: with a walk k and an alignment over A, E = N^2 / 30 s + N^2 / A + k^2 (T / 2 + A / 3)."""
    rng, align = np.random.default_rng(5), 60.0
    mean = NOISE**2 * (1 / 30 + 1 / align) + walk**2 * (300 + align / 3)
    below, above = [], []
    for _ in range(30):
        run = coasting(rng, np.zeros(3), 5400.0)
        run["rate"] += np.cumsum(rng.normal(size=run["rate"].shape), axis=0) * walk * np.sqrt(TAU)
        first = round(align / TAU)
        run["coast"] = run["coast"] + np.mean(run["rate"][:first], axis=0)
        run["coast"][:first] = np.nan
        one = of_coast(score(run, None, AXES), 5400.0 - align, align)
        below += list(one.low <= np.sqrt(mean))
        above += list(one.high >= np.sqrt(mean))
    assert one.stands_on.startswith("8 predictions of 10 min")
    assert np.mean(below) >= 0.9  # 95 %, of 90 draws
    assert np.mean(above) >= 0.9


def test_a_coast_on_too_little_time_is_not_measured():
    run = coasting(np.random.default_rng(0), np.full(3, 1e-6))
    assert of_coast(score(run, None, AXES), 900.0, 60.0).missing == ""
    run["still"][400:620] = False  # 110 s of the first 600
    found = of_coast(score(run, None, AXES), 900.0, 60.0)
    assert np.all(np.isfinite(found.values))  # there is a score, and it is not enough to sign for
    assert found.missing == "82 % of the first 10 min were measured at rest; 90 % are needed"
    short = {name: values[:1000] for name, values in run.items()}
    assert "8.33 min after the alignment; record 10 or more" in of_coast(score(short, None, AXES), 500, 60.0).missing


def test_the_noise_of_an_alignment_scatters_as_it_says():
    model, rng, N = Zupt.examples()[0], np.random.default_rng(1), 120
    sensor = model.tracked
    found = []
    for _ in range(300):
        scale = sensor.noise / np.sqrt(TAU)
        window = Chunk(np.arange(N) * TAU, {"gyro": rng.normal(size=(N, 3)) * scale, "tau": np.full(N, TAU)})
        ratio = noise_ratios(window, [sensor])
        alignment = Alignment(0.0, TAU, {}, ratio, np.zeros(3))
        found.append(of_alignment(sensor, alignment, N * TAU))
    values = np.array([one.values for one in found])
    sigma = np.array([(one.high - one.low) / (2 * SIDE) for one in found])
    np.testing.assert_allclose(np.mean(values, axis=0), sensor.noise, rtol=0.02)
    np.testing.assert_allclose(np.std(values, axis=0), np.mean(sigma, axis=0), rtol=0.13)  # of 300: 4 %


def fitted(curve):
    T = np.linspace(-10, 40, 4000)
    bias = curve(T) + 1e-6 * np.random.default_rng(3).normal(size=(len(T), 2))
    return Polynomial(order=3).fit(T, bias, {})


def test_the_swing_of_a_map_is_from_its_lowest_to_its_highest():
    found = of_map(fitted(lambda T: np.stack([1e-5 * T, 1e-6 * (T - 15) ** 2], axis=1)))
    np.testing.assert_allclose(found["swing"].values, [50e-5, 625e-6], rtol=1e-3)
    assert np.all(found["swing"].low < found["swing"].values)
    assert np.all(found["swing"].high - found["swing"].low < 1e-5)


def test_the_residual_of_a_map_is_of_averages_and_not_of_the_noise_of_samples():
    one = fitted(lambda T: np.stack([1e-5 * T, 1e-6 * T], axis=1))
    assert of_map(one)["residual"].missing == "the map's file does not say its residual in averages; fit it anew"
    known = one.record.model_copy(update={"averaged_residual": (2e-7, 3e-7), "averaged_over": 30.0})
    found = of_map(replace(one, record=known))
    np.testing.assert_array_equal(found["residual"].values, [2e-7, 3e-7])
    (row,) = check_limits(Limits(residual=1.0), found)
    assert row.decision == "undecided"
    assert row.needs == "the map's file does not say how sure its residual is; fit it anew"
    sure = known.model_copy(update={"averaged_bounds": ((1e-7, 4e-7), (2e-7, 4.5e-7)), "lasted": 3600.0})
    (row,) = check_limits(Limits(residual=5e-7), of_map(replace(one, record=sure)))
    assert (row.decision, row.axis, row.guard) == ("pass", "y", pytest.approx(1.5e-7))


def remembering(**memory):
    one = fitted(lambda T: np.stack([1e-5 * T, 1e-6 * T], axis=1))
    unknown = {"kinds": [], "size": [None, None], "sigma": [None, None], "none_larger_than": [None, None], "why": ""}
    return replace(one, record=one.record.model_copy(update={"memory": {**unknown, **memory}}))


def test_hysteresis_is_judged_by_what_the_soak_says_of_it():
    def decided(limit, **memory):
        return check_limits(Limits(hysteresis=limit), of_map(remembering(**memory)))[0]

    seen = {"answer": "seen", "kinds": ["hysteresis"], "size": [-5e-6, 1e-6], "sigma": [1e-6, 1e-6]}
    assert [decided(limit, **seen).decision for limit in (7.2e-6, 5e-6, 2.8e-6)] == ["pass", "undecided", "fail"]
    assert decided(7.2e-6, **seen).guard == pytest.approx(2.132e-6)  # Student's t, of four squares of slow noise
    none = {"answer": "none", "none_larger_than": [2e-6, 4e-6], "size": [1e-7, 0.0]}
    assert [decided(limit, **none).decision for limit in (5e-6, 3e-6)] == ["pass", "undecided"]
    assert decided(5e-6, answer="none", none_larger_than=[2e-6, None]).decision == "undecided"
    row = decided(1.0, answer="undecided", why="more is there than usual; go up and down again", log_evidence=2.0)
    assert (row.verdict, row.needs) == ("undecided", "more is there than usual; go up and down again")
    row = decided(1.0, answer="undecided", why="only ever warms; come back down", log_evidence=None)
    assert (row.verdict, row.note) == ("not measured", "only ever warms; come back down")
    plain = of_map(fitted(lambda T: np.stack([1e-5 * T, 1e-6 * T], axis=1)))
    assert check_limits(Limits(hysteresis=1.0), plain)[0].verdict == "not measured"


def test_a_hysteresis_that_is_seen_stands_beside_the_verdict_where_no_limit_is_set_for_it():
    size = np.deg2rad(24) / 3600
    seen = {"answer": "seen", "kinds": ["hysteresis"], "size": [1e-6, -size], "sigma": [1e-6, 1e-6]}
    rows = check_limits(Limits(swing=1.0), of_map(remembering(**seen)))
    beside = "a hysteresis or lag of y 24 deg/h between warming and cooling is seen; no limit is set for it"
    assert verdict(rows) == f"PASS: 1 of 1 limit kept; {beside}"
    assert [row.as_json(RATE).get("beside") for row in rows] == [beside]
    assert outcome(verdict(rows)) == "pass"
    two = verdict(check_limits(Limits(swing=1.0, coast=1.0), of_map(remembering(**seen))))
    assert two.startswith("INCOMPLETE: 1 of 2 limits kept; not measured: prediction")
    assert two.endswith(f"; {beside}")
    for memory in ({"answer": "none", "none_larger_than": [1e-7, 1e-7]}, {"answer": "undecided"}):
        assert "hysteresis" not in verdict(check_limits(Limits(swing=1.0), of_map(remembering(**memory))))
    assert "no limit" not in verdict(check_limits(Limits(swing=1.0, hysteresis=1.0), of_map(remembering(**seen))))


def test_the_noise_of_a_run_is_of_all_that_was_at_rest():
    found = averaged(rest(60_000, np.random.default_rng(2), bias=1e-4), 7000).noise()
    np.testing.assert_allclose(found.values, NOISE, rtol=0.03)
    np.testing.assert_allclose(found.high - found.values, SIDE * found.values * np.sqrt(0.75 / 5999), rtol=0.01)
    short = averaged(rest(600, np.random.default_rng(2)), 600).noise()
    assert short.missing == "59 s at rest in a row; record 100 s or more"


@pytest.mark.parametrize(("rows", "measured"), [
    (lambda white: white, True),
    (lambda white: white + np.cumsum(0.02 * white, axis=0), True),  # a walk
    (lambda white: lfilter([0.005], [1, -0.995], white, axis=0), False),  # a low pass of 20 s
    (lambda white: np.repeat(white[::100], 100, axis=0) + 0.1 * white, False),  # 0.1 Hz held at 10 Hz
])  # fmt: skip
def test_the_noise_of_filtered_or_interpolated_rates_is_not_measured(rows, measured):
    block = rest(36_000, np.random.default_rng(5))
    block["rate"] = rows(block["rate"])
    assert (averaged(block, 7000).noise().missing == "") is measured


def rest(N, rng, tau=0.1, bias=0.0):
    t = 7.0 + tau * np.arange(1, N + 1)
    rate = bias + rng.normal(size=(N, 2)) * NOISE / np.sqrt(tau)
    return {"t": t, "tau": np.full(N, tau), "still": np.ones(N), "rate": rate, "temperature": t / 10}


def averaged(block, size, **how):
    averages = Averages(0.1, ("x", "y"), **how)
    for start in range(0, len(block["t"]), size):
        averages.add({name: values[start : start + size] for name, values in block.items()})
    return averages


def test_averages_are_the_means_over_a_second_however_the_rows_come():
    block = rest(5000, np.random.default_rng(2))
    cut, values = averaged(block, 5000)._whole()
    again, others = averaged(block, 333)._whole()
    assert again.rows.tolist() == cut.rows.tolist()
    np.testing.assert_allclose(others, values, rtol=1e-12)
    np.testing.assert_allclose(values[1:-1], block["rate"].reshape(-1, 10, 2).mean(axis=1)[1:-1], rtol=1e-9)


def test_what_the_map_explains_is_no_instability():
    block = rest(60_000, np.random.default_rng(4))
    curve = 3e-5 * np.sin(block["t"] / 100)[:, None] * [1, 2]
    block["rate"] += curve
    flat = averaged(block, 7000, less=lambda part: 3e-5 * np.sin(part["t"] / 100)[:, None] * [1, 2]).measured()
    moving = averaged(block, 7000).measured()
    assert np.all(flat.values == 0)  # white noise alone: the floor does not show
    assert np.all(flat.high < 1.5e-6)
    assert np.all((moving.values > 3e-6) | (moving.high > 1e-5))
    assert flat.stands_on.startswith("Allan deviation of the rest less the map, 6000 s")


def test_motion_and_gaps_cut_the_rest():
    block = rest(1600, np.random.default_rng(4))
    block["still"][500:900] = 0
    block["still"][1100:1400] = 0
    found = averaged(block, 500).measured()
    said = "90 s at rest, 50 s without a gap; record 100 s or more, 30 s of it without a gap"
    assert found.missing == said
    assert check_limits(Limits(bias_instability=1.0), {"bias_instability": found})[0].verdict == "not measured"


def test_lost_samples_do_not_end_the_averaging_times():
    """1.5 s lost every 60 s: what may hide in it grows little; much, where it is motion."""
    block = rest(60_000, np.random.default_rng(4))
    block["rate"] += np.cumsum(np.random.default_rng(5).normal(size=(60_000, 2)), axis=0) * 3e-8
    gone = np.arange(60_000) % 600 >= 585
    whole = averaged(block, 7000).measured()
    lossy = averaged({name: values[~gone] for name, values in block.items()}, 7000).measured()
    moved = averaged(block | {"still": block["still"] * ~gone}, 7000).measured()
    np.testing.assert_allclose(lossy.high, whole.high, rtol=0.35)
    assert np.all(moved.high > 1.8 * whole.high)
