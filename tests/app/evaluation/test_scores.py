"""The scores are integrals over time, and no filter has a say in what they are taken over."""

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from driftlab.evaluation.overview import OverviewAccumulator
from driftlab.evaluation.scores import HORIZONS, ScoreAccumulator, errors_of, rms_over_time, score

UP = np.array([0.6, 0.0, -0.8])
AXES = ("x", "y", "z")
seeds = st.integers(0, 10_000)


def rows_of(t, tau, *, still=None, bias=0.0, coast=0.0, rate=0.0, sigma=1.0):
    """Return estimates of three axes with errors (N, 1) or (N, 3) as given; the true bias is `rate`."""
    shape = (len(t), 3)
    columns = {"bias": bias, "coast": coast, "rate": rate, "coast_sigma": sigma}
    still = np.ones(len(t), bool) if still is None else still
    return {"t": t, "tau": np.broadcast_to(tau, t.shape).astype(float), "still": still} | {
        name: np.broadcast_to(values, shape).astype(float) for name, values in columns.items()
    }


def recording(seed):
    """Return rows with gaps, epochs of any length and motion: their errors, and which of them have a reference."""
    rng = np.random.default_rng(seed)
    N = int(rng.integers(100, 700))
    tau = rng.choice([0.47, 0.97, 1.31], size=N)
    gaps = np.where(rng.random(N) < rng.choice([0.0, 0.02, 0.1]), rng.exponential(40.0, N), 0.0)
    t = 1000.0 + np.cumsum(tau + gaps)
    still = np.ones(N, bool)
    for _ in range(int(rng.integers(0, 5))):
        begin = int(rng.integers(0, N))
        still[begin : begin + int(rng.integers(1, 80))] = False
    walk = np.cumsum(rng.normal(size=(N, 3)), axis=0)
    rows = rows_of(t, tau, still=still, bias=rng.normal(size=(N, 3)), coast=walk + 3, sigma=1 + rng.random((N, 3)))
    aligned = int(rng.integers(1, 60))
    rows["coast"][:aligned] = rows["coast_sigma"][:aligned] = np.nan
    reference = np.where((still & (rng.random(N) > 0.03))[:, None], rng.normal(size=(N, 3)), np.nan)
    return rows, reference


def drawn(rows, error, known, end):
    """Return nodes of the error over time, straight over what is not known, and the time it covers up to `end`."""
    t, tau = rows["t"], rows["tau"]
    s, e, last = [], [], None
    bridge = np.linspace(0, 1, 1501)[1:-1]
    for k in np.flatnonzero(known):
        begin = t[k] - tau[k]
        if last is not None and begin - t[last] > 1e-9:
            s.append(t[last] + bridge * (begin - t[last]))
            e.append(error[last] + bridge[:, None] * (error[k] - error[last]))
        s.append([begin, t[k]])
        e.append([error[k], error[k]])
        last = k
    s, e = np.concatenate(s), np.concatenate(e)
    keep = s < end
    if np.any(~keep):
        cut = int(np.argmin(keep))
        share = (end - s[cut - 1]) / (s[cut] - s[cut - 1])
        last = e[cut - 1] * (1 - share) + e[cut] * share
        s, e = np.append(s[:cut], end), np.vstack([e[:cut], last])
    return s, e


def integrated(rows, error, known, start, horizon, length):
    """Return the rms and the integral by the trapezoidal rule, NaN where less than half of the span is known."""
    span = min(horizon, length)
    if not np.any(known) or rows["t"][known][0] - rows["tau"][known][0] >= start + span:
        return np.full(3, np.nan), np.full(3, np.nan)
    s, e = drawn(rows, error, known, start + span)
    if s[-1] - s[0] < 0.5 * span:
        return np.full(3, np.nan), np.full(3, np.nan)
    return np.sqrt(np.trapezoid(e**2, s, axis=0) / (s[-1] - s[0])), np.trapezoid(e, s, axis=0)


@given(seeds)
@settings(max_examples=25)
def test_scores_are_the_integrals_over_time(seed):
    rows, reference = recording(seed)
    tally = ScoreAccumulator(3)
    tally.add(rows, errors_of(rows, reference))
    found = tally.yardsticks(UP, AXES)
    first = int(np.argmax(np.isfinite(rows["coast"][:, 0])))
    rows, reference = {name: values[first:] for name, values in rows.items()}, reference[first:]
    known = np.isfinite(reference[:, 0])
    start = rows["t"][0] - rows["tau"][0]
    length = rows["t"][-1] - start
    error = rows["coast"] - reference
    for name, horizon in HORIZONS.items():
        rms, angle = integrated(rows, error, known, start, horizon, length)
        sigma, _ = integrated(rows, rows["coast_sigma"], known, start, horizon, length)
        if np.isfinite(horizon) and length < horizon:
            rms, angle, sigma = (np.full(3, np.nan) for _ in range(3))
        np.testing.assert_allclose(found.coast[name], rms, rtol=1e-5)
        np.testing.assert_allclose(found.coast_sigma[name], sigma, rtol=1e-5)
        np.testing.assert_allclose(
            found.heading[name], abs(angle @ UP), rtol=1e-5, atol=1e-5 * np.sum(abs(error[known]))
        )
    error = rows["bias"] - reference
    for value, span in ((found.filter_first, 30.0), (found.filter_whole, np.inf)):
        np.testing.assert_allclose(value, integrated(rows, error, known, start, span, length)[0], rtol=1e-5)
    assert found.share["whole"] == pytest.approx(np.sum(rows["tau"][known]) / length)
    assert found.moved == pytest.approx(np.sum(rows["tau"][~rows["still"]]) / length)


@given(seeds, st.lists(st.integers(0, 700), max_size=8))
@settings(max_examples=40)
def test_rows_may_come_in_any_blocks(seed, cuts):
    rows, reference = recording(seed)
    whole, split = ScoreAccumulator(3), ScoreAccumulator(3)
    errors, N = errors_of(rows, reference), len(reference)
    whole.add(rows, errors)
    for start, stop in pairwise([0, *sorted(min(cut, N) for cut in cuts), N]):
        split.add({name: values[start:stop] for name, values in rows.items()}, errors[start:stop])
    one, two = whole.yardsticks(UP, AXES), split.yardsticks(UP, AXES)
    for name in HORIZONS:
        np.testing.assert_allclose(two.coast[name], one.coast[name], rtol=1e-12)
        np.testing.assert_allclose(two.coast_sigma[name], one.coast_sigma[name], rtol=1e-12)
        np.testing.assert_allclose(two.heading[name], one.heading[name], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(two.filter_first, one.filter_first, rtol=1e-12)
    np.testing.assert_allclose(two.filter_whole, one.filter_whole, rtol=1e-12)
    assert two.share == pytest.approx(one.share, rel=1e-12)
    assert two.moved == pytest.approx(one.moved, rel=1e-12)


@given(seeds, st.floats(0, 1))
@settings(max_examples=30)
def test_refusing_data_never_changes_a_score(seed, part):
    """The mask of used samples is a column that the scores do not read, in a run's overview too."""
    rows, _ = recording(seed)
    rng = np.random.default_rng(seed)
    N = len(rows["t"])
    rows |= {"bias_sigma": rows["coast_sigma"], "nis": np.ones(N), "white": np.zeros((N, 6))}
    model = SimpleNamespace(align=60.0, tracked=SimpleNamespace(axes=AXES, integral=("heading", "deg")), m=6)
    alignment = SimpleNamespace(t=float(rows["t"][0]), up=UP)
    flags = [np.ones(N, bool), rng.random(N) > part]
    flags[1][-1] = flags[0][0] = True
    found = [OverviewAccumulator(model, alignment).read(rows | {"used": used}).overview().yardsticks for used in flags]
    assert repr(found[0]) == repr(found[1])
    assert repr(score(rows | {"used": flags[1]}, UP, AXES)) == repr(score(rows, UP, AXES))


def bursts(seconds, lasting=5.0, every=300.0, dt=0.1):
    t = np.arange(1, int(seconds / dt) + 1) * dt
    return t[(t - 1e-6) % every < lasting]


def test_bursts_count_for_the_time_between_them():
    """5 s every 300 s, an error that grows by c a second: c T / sqrt(3) over T s, and an angle of c T^2 / 2."""
    c = np.array([2.0, -1.0, 0.5])
    t = bursts(3000 + 5)
    error = t[:, None] * c
    found = score(rows_of(t, 0.1, bias=error, coast=error, rate=np.zeros(3)), UP, AXES)
    for name, T in (("1 min", 60.0), ("5 min", 300.0), ("10 min", 600.0), ("to the end", 3005.0)):
        np.testing.assert_allclose(found.coast[name], np.abs(c) * T / np.sqrt(3), rtol=2e-3)
        np.testing.assert_allclose(found.heading[name], abs(c @ UP) * T**2 / 2, rtol=2e-3)
        assert found.share[name] == pytest.approx(5 * np.ceil(T / 300) / T, rel=2e-2)
    np.testing.assert_allclose(found.filter_whole, np.abs(c) * 3005 / np.sqrt(3), rtol=2e-3)
    np.testing.assert_allclose(found.filter_first, np.abs(c) * 30 / np.sqrt(3), rtol=5e-3)


def test_a_horizon_may_end_in_a_gap():
    """From 50 s to 150 s nothing is known; the error goes from 1 to 3 on the way: 1.2 at 60 s."""
    t = np.concatenate([np.arange(1.0, 51), np.arange(151.0, 201)])
    error = np.where(t <= 50, 1.0, 3.0)[:, None]
    found = score(rows_of(t, 1.0, coast=error, rate=np.zeros(3)), np.array([0, 0, 1.0]), AXES)
    squares = 50 + (1.2**3 - 1) / 3 / 0.02  # integral of (1 + 0.02 s)^2 over 10 s
    np.testing.assert_allclose(found.coast["1 min"], np.sqrt(squares / 60), rtol=1e-9)
    assert found.heading["1 min"] == pytest.approx(50 + 11.0)
    assert found.share["1 min"] == pytest.approx(50 / 60)
    assert np.all(np.isnan(found.coast["5 min"]))
    assert np.isnan(found.heading["5 min"])


def test_an_interval_that_is_hardly_known_has_no_score():
    """Moving for the last 80 % of it: no side tells of the error there."""
    t = np.arange(1.0, 1001)
    rows = rows_of(t, 1.0, still=t <= 200, coast=np.ones((1000, 1)))
    found = score(rows, UP, AXES)
    np.testing.assert_allclose(found.coast["1 min"], 1.0)
    for name in ("10 min", "to the end"):
        assert np.all(np.isnan(found.coast[name]))
        assert np.isnan(found.heading[name])
    assert np.all(np.isnan(found.filter_whole))
    assert found.moved == pytest.approx(0.8)


def test_an_error_while_it_moves_is_bridged_and_not_read():
    t = np.arange(1.0, 301)
    moving = (t > 100) & (t <= 120)
    rate = np.where(moving, 50.0, 0.0)[:, None]
    found = score(rows_of(t, 1.0, still=~moving, rate=rate, coast=np.ones((300, 1))), UP, AXES)
    np.testing.assert_allclose(found.coast["to the end"], 1.0)


def test_rms_of_a_gap_free_error_is_the_plain_one():
    rng = np.random.default_rng(0)
    t = np.arange(1, 501) * 0.1
    error = rng.normal(size=(500, 2))
    error[:100] = np.nan
    found = rms_over_time({"t": t, "tau": np.full(500, 0.1)}, error, 10.0)
    np.testing.assert_allclose(found, np.sqrt(np.mean(error[100:] ** 2, axis=0)))
    found = rms_over_time({"t": t, "tau": np.full(500, 0.1)}, error, 10.0, 5.0)
    np.testing.assert_allclose(found, np.sqrt(np.mean(error[100:150] ** 2, axis=0)))
