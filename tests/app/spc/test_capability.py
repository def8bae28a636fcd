"""Capability indices against noncentral t and their coverage, the test of normality against scipy and its own size."""

import json

import numpy as np
import pytest
from lines import SPREAD, TYPICAL, line, record
from scipy import stats
from scipy.signal import lfilter

from driftlab.config import Limits
from driftlab.spc.capability import ENOUGH, NORMAL, anderson_darling, indices, share_beyond, why_no_index
from driftlab.spc.line import line_of

NOISE = Limits.model_validate({"noise": "2.5 deg/h/sqrt(Hz)"})


@pytest.mark.parametrize(("n", "true"), [(25, 0.4), (50, 1.33), (400, 2.0)])
def test_the_intervals_hold_the_index_95_times_of_100(n, true):
    rng = np.random.default_rng(n)
    found = [indices(x, 3 * true) for x in rng.normal(size=(1000, n))]
    _, cpk_low, cpk_high, _, ppk_low, ppk_high = np.array(found).T
    assert np.mean((cpk_low <= true) & (true <= cpk_high)) == pytest.approx(0.95, abs=0.02)
    assert np.mean((ppk_low <= true) & (true <= ppk_high)) == pytest.approx(0.95, abs=0.02)


@pytest.mark.parametrize("n", [25, 200, 100_000])
@pytest.mark.parametrize("limit", [1.0, 4.0, 6.0])
def test_the_interval_of_ppk_is_that_of_noncentral_t(n, limit):
    x = stats.norm.ppf((np.arange(n) + 0.5) / n)
    *_, ppk, low, high = indices(x, limit)
    assert ppk == pytest.approx((limit - x.mean()) / (3 * x.std(ddof=1)))
    for end, p in ((low, 0.975), (high, 0.025)):  # at the ends of the interval what was seen is so far out
        assert stats.nct.cdf(3 * np.sqrt(n) * ppk, n - 1, 3 * np.sqrt(n) * end) == pytest.approx(p, abs=2e-4)
    half = 1.96 * np.sqrt(1 / (9 * n) + ppk**2 / (2 * (n - 1)))  # Bissell 1990, for many units
    assert (low, high) == pytest.approx((ppk - half, ppk + half), abs=half / np.sqrt(n))


def test_the_mean_moving_range_is_worth_six_tenths_of_a_variance():
    """At a mean on the limit Cpk is 0; far from it, it varies as the deviation does."""
    rng = np.random.default_rng(1)
    inverse = np.array([1 / indices(x, 1e6)[0] for x in rng.normal(size=(4000, 100))])
    assert np.mean(inverse) ** 2 / (2 * np.var(inverse) * 99) == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize(("n", "draw"), [(8, "normal"), (50, "exponential"), (300, "normal"), (5000, "uniform")])
def test_the_statistic_is_that_of_scipy(n, draw):
    x = getattr(np.random.default_rng(n), draw)(size=n)
    assert anderson_darling(x)[0] == pytest.approx(stats.anderson(x, method="interpolate").statistic, rel=1e-9)


def test_its_p_value_rejects_as_many_normal_samples_as_it_says():
    """Also Stephens' critical values (1974, case 3): 0.752 at 5 %, 1.035 at 1 % of the statistic for small samples."""
    rng = np.random.default_rng(2)
    for n in (25, 200):
        p = np.array([anderson_darling(x)[1] for x in rng.normal(size=(4000, n))])
        for size in (0.05, 0.01):
            assert np.mean(p < size) == pytest.approx(size, abs=3 * np.sqrt(size / 4000))
    x = np.sort(rng.exponential(size=2000))
    pairs = np.array([anderson_darling(x[: k + 100] ** 0.55) for k in range(0, 1900, 10)])
    falling = pairs[np.argsort(pairs[:, 0])][:, 1]
    assert np.all(np.diff(falling) <= 1e-3)  # the more the statistic, the less p, over all four parts of the formula


@pytest.mark.parametrize(
    ("critical", "size"), [(0.561, 0.15), (0.631, 0.10), (0.752, 0.05), (0.873, 0.025), (1.035, 0.01)]
)
def test_its_p_value_at_the_published_critical_values(critical, size, monkeypatch):
    n = 10**6  # whose statistic is that of large samples
    x = np.random.default_rng(0).normal(size=n)
    monkeypatch.setattr(np, "sum", lambda values: -(critical + n) * n)  # whatever the sample: this statistic
    assert anderson_darling(x)[1] == pytest.approx(size, rel=0.06)


def test_a_share_that_was_not_seen_is_known_as_clopper_and_pearson_have_it():
    assert share_beyond(0, 100) == pytest.approx((0.0, 1 - 0.025 ** (1 / 100)))  # closed form of the upper end at 0
    assert share_beyond(100, 100) == pytest.approx((0.025 ** (1 / 100), 1.0))


def test_there_is_no_index_of_what_is_not_normal_and_the_page_says_why():
    found = line_of(line(300, 2, law="skew"), Limits.model_validate({"coast": "40 deg/h"}))
    assert len(found.capability) == 3
    for row in found.capability:
        assert not row.trusted
        assert np.isnan([row.cpk, row.cpk_low, row.cpk_high, row.ppk, row.ppk_low, row.ppk_high]).all()
        assert row.why_not.startswith("not normal (Anderson-Darling, p ")
        said = row.as_json("rad/s", "0000")
        assert (said["cpk"], said["cpk_95"], said["ppk"], said["ppk_95"]) == (None,) * 4
        assert said["why_not"] == row.why_not
        json.dumps(said, allow_nan=False)
    said = next(one for one in found.sentences if one.startswith("prediction, limit"))
    assert "no index of x, y, z: not normal" in said
    assert "units above (95 %: " in said


def test_units_that_are_far_out_are_named_as_the_reason_with_the_index_of_the_others():
    records = line(200, 1, planted=[("noise", "x", 50, 52, 12.0)])
    x, y, _ = line_of(records, NOISE).capability
    others = line_of([one for k, one in enumerate(records) if k not in (50, 51)], NOISE).capability[0]
    assert others.trusted
    said = f"Ppk {others.ppk:.2f} ({others.ppk_low:.2f} to {others.ppk_high:.2f})"
    assert x.why_not.endswith(f", by 2 units that are far out; of the others p = {others.normal:.2g}, {said}")
    assert np.isnan(x.ppk)
    assert y.trusted
    heavy = line(200, 4, law="heavy")
    assert any(row.why_not and "far out" not in row.why_not for row in line_of(heavy, NOISE).capability)


def test_an_index_of_a_line_with_a_trend_says_so():
    drift = [("noise", "x", k, k + 1, 4 * k / 200) for k in range(200)]
    found = line_of(line(200, 1, planted=drift), NOISE)
    assert [row.trend for row in found.capability] == [True, False, False]
    assert found.capability[0].as_json("rad/s", "0000")["trend"]
    assert ("of a line with a trend" in found.sentences[-1]) == found.capability[0].trusted


@pytest.mark.parametrize("count", [ENOUGH - 1, ENOUGH])
def test_there_is_no_index_of_too_few_units(count):
    rows = line_of(line(count, 1), NOISE).capability
    assert [row.trusted for row in rows] == [count == ENOUGH] * 3
    assert all(row.trusted or row.why_not.startswith("24 units; 25 are needed") for row in rows)
    for row in rows:  # which is known all the same
        assert 0 <= row.share_low <= row.beyond / count < row.share_high < 0.3


def test_there_is_no_index_of_values_that_do_not_vary():
    figures = {name: np.full(3, 1.0) for name in TYPICAL}
    rows = line_of([record(k, figures) for k in range(30)], NOISE).capability
    assert [row.why_not for row in rows] == ["the values do not vary"] * 3


def test_an_index_of_a_normal_line_is_there_and_in_json():
    found = line_of(line(300, 1), NOISE)
    true = np.log(2.5 / TYPICAL["noise"]) / (3 * SPREAD["noise"])
    for row in found.capability:
        assert row.trusted
        assert row.normal >= NORMAL
        assert row.cpk_low < true < row.cpk_high
        said = row.as_json("rad/s/sqrt(Hz)", "0000")
        assert said["ppk_95"] == [row.ppk_low, row.ppk_high]
        assert (said["unit"], said["since"], said["units"], said["why_not"]) == ("rad/s/sqrt(Hz)", "0000", 300, None)
    assert any(
        f"Cpk {row.cpk:.2f} (95 %: {row.cpk_low:.2f}" in one for one in found.sentences for row in found.capability
    )


def test_the_worst_axis_is_the_one_with_most_units_above_where_it_has_no_index():
    every_second = [("noise", "x", k, k + 1, 8.0) for k in range(0, 200, 2)]  # two more are by chance
    found = line_of(line(200, 5, planted=every_second), NOISE)
    assert "x is worst, 102 of 200 units above (95 %: 43.9 to 58.1 %)" in found.sentences[-1]
    assert "no index of x: not normal" in found.sentences[-1]


@pytest.mark.parametrize(("phi", "size"), [(0.0, 1), (0.7, 1), (0.0, 10)])
def test_there_is_no_index_of_units_that_resemble_those_before_them(phi, size):
    """Of 60 units that each resemble the one before, or come in lots of ten, intervals would be half as wide as needed.

    Of independent ones nearly all have an index: one of a hundred is refused for this, one for not being normal.
    """
    refused = []
    for seed in range(60):
        rng = np.random.default_rng([seed, size])
        x = lfilter([np.sqrt(1 - phi**2)], [1, -phi], rng.normal(size=200))[-60:]
        x = np.repeat(rng.normal(size=6), size) + 0.5 * x if size > 1 else x
        p, why = why_no_index(x, np.zeros(60, dtype=bool), 5.0, trend=False)
        refused.append("resemble" in why or p < 0.01)
    assert np.mean(refused) > 0.9 if phi or size > 1 else np.mean(refused) < 0.1
