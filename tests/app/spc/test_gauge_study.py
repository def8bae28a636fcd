"""Gauge R&R against the worked example of AIAG, statsmodels, and the truth of simulated studies."""

import numpy as np
import pandas as pd
import pytest
import statsmodels.formula.api as smf
from lines import DEG_H, record
from statsmodels.stats.anova import anova_lm

from driftlab.config import Limits
from driftlab.family.record import Figure, RepeatedSoak
from driftlab.spc.gauge_study import MIN_UNITS, components, gauge_study

# AIAG, Measurement Systems Analysis, 4th edition, table III-B 6: appraiser, trial, then ten parts
AIAG = """
A 0.29 -0.56 1.34 0.47 -0.80 0.02 0.59 -0.31 2.26 -1.36
A 0.41 -0.68 1.17 0.50 -0.92 -0.11 0.75 -0.20 1.99 -1.25
A 0.64 -0.58 1.27 0.64 -0.84 -0.21 0.66 -0.17 2.01 -1.31
B 0.08 -0.47 1.19 0.01 -0.56 -0.20 0.47 -0.63 1.80 -1.68
B 0.25 -1.22 0.94 1.03 -1.20 0.22 0.55 0.08 2.12 -1.62
B 0.07 -0.68 1.34 0.20 -1.28 0.06 0.83 -0.34 2.19 -1.50
C 0.04 -1.38 0.88 0.14 -1.46 -0.29 0.02 -0.46 1.77 -1.49
C -0.11 -1.13 1.09 0.20 -1.07 -0.67 0.01 -0.56 1.45 -1.77
C -0.15 -0.96 0.67 0.11 -1.45 -0.49 0.21 -0.49 1.87 -2.16
"""


def example():
    """Return parts, appraisers and values (90,) of the manual's example."""
    rows = [row.split() for row in AIAG.strip().splitlines()]
    cells = [(f"{k}", row[0], float(text)) for row in rows for k, text in enumerate(row[1:])]
    return tuple(map(np.array, zip(*cells, strict=True)))


def study(p, a, r, ev, av, interaction, pv, rng):
    """Return units, appraisers and values of a simulated study, and its GRR and TV."""
    parts, who, both = rng.normal(0, pv, p), rng.normal(0, av, a), rng.normal(0, interaction, (p, a))
    x = 7 + parts[:, None, None] + who[:, None] + both[:, :, None] + rng.normal(0, ev, (p, a, r))
    units = np.repeat([f"{k}" for k in range(p)], a * r)
    appraisers = np.tile(np.repeat([f"K{k}" for k in range(a)], r), p)
    grr = np.sqrt(ev**2 + (a > 1) * (av**2 + interaction**2))
    return (units, appraisers, x.ravel()), grr, np.hypot(grr, pv)


def test_the_worked_example_of_the_manual():
    found, used = components(*example())
    assert used == 90
    assert (found.parts, found.appraisers, found.soaks) == (10, 3, 90)
    # its ANOVA report: figures B 7 to B 9, standard deviations and their shares
    assert (round(found.ev, 6), round(found.av, 6), round(found.grr, 4)) == (0.199933, 0.226838, 0.3024)
    assert (round(found.pv, 5), round(found.tv, 4), found.interaction) == (1.04233, 1.0853, 0.0)
    assert round(100 * found.share, 1) == 27.9
    assert found.ndc == 4
    assert found.pooled
    assert round(found.p_interaction, 3) == 0.974


@pytest.mark.parametrize(("interaction", "seed"), [(0.0, 3), (2.0, 4)])
def test_components_are_those_of_the_mean_squares_of_statsmodels(interaction, seed):
    p, a, r = 9, 3, 2
    (units, who, x), *_ = study(p, a, r, 1.0, 1.5, interaction, 3.0, np.random.default_rng(seed))
    table = pd.DataFrame({"u": units, "w": who, "x": x})
    both = anova_lm(smf.ols("x ~ C(u) * C(w)", table).fit())
    pooled = both.loc["C(u):C(w)", "PR(>F)"] > 0.25
    ms = anova_lm(smf.ols("x ~ C(u) + C(w)", table).fit())["mean_sq"] if pooled else both["mean_sq"]
    inner = ms["Residual"] if pooled else ms["C(u):C(w)"]
    found, _ = components(units, who, x)
    assert found.pooled == pooled
    assert found.pooled == (interaction == 0)
    assert found.ev**2 == pytest.approx(ms["Residual"])
    assert found.av**2 == pytest.approx(max((ms["C(w)"] - inner) / (p * r), 0))
    assert found.pv**2 == pytest.approx((ms["C(u)"] - inner) / (a * r))
    assert found.interaction**2 == pytest.approx((inner - ms["Residual"]) / r)


@pytest.mark.parametrize(
    ("p", "a", "r", "ev", "av", "interaction", "pv"),
    [(10, 3, 3, 1, 0.5, 0, 3), (10, 2, 2, 1, 0.5, 0.8, 2), (12, 1, 2, 1, 0, 0, 2), (10, 1, 3, 1, 0, 0, 8)],
)
def test_intervals_hold_the_truth_as_often_as_they_say(p, a, r, ev, av, interaction, pv):
    rng, studies, hits = np.random.default_rng(11), 200, np.zeros(2)
    for _ in range(studies):
        given, grr, tv = study(p, a, r, ev, av, interaction, pv, rng)
        found, _ = components(*given)
        hits += [found.grr_95[0] <= grr <= found.grr_95[1], found.share_95[0] <= grr / tv <= found.share_95[1]]
    assert np.all(np.abs(hits / studies - 0.95) < 0.05)


def test_of_one_soak_on_each_appraiser_the_interaction_is_in_the_repeatability():
    given, *_ = study(8, 3, 1, 1.0, 0.5, 0.0, 3.0, np.random.default_rng(2))
    found, _ = components(*given)
    table = pd.DataFrame(dict(zip("uwx", given, strict=True)))
    ms = anova_lm(smf.ols("x ~ C(u) + C(w)", table).fit())["mean_sq"]
    assert found.ev**2 == pytest.approx(ms["Residual"])
    assert found.p_interaction is None


def test_units_soaked_two_or_three_times_are_weighted_as_searle_has_it():
    rng, share = np.random.default_rng(8), []
    for _ in range(400):
        n = rng.integers(2, 4, 12)
        units = np.repeat([f"{k}" for k in range(12)], n)
        x = np.repeat(rng.normal(0, 2, 12), n) + rng.normal(0, 1, np.sum(n))
        found, used = components(units, np.full(len(x), ""), x)
        assert used == len(x)
        share.append((found.ev**2, found.pv**2))
    assert np.mean(share, axis=0) == pytest.approx([1, 4], rel=0.1)  # unbiased


def test_what_is_not_balanced_is_left_out_and_what_is_not_crossed_has_no_reproducibility():
    units, who, x = example()
    more = (np.append(units, ["0", "new"]), np.append(who, ["A", "A"]), np.append(x, [9.0, 9.0]))
    assert components(*more) == components(units, who, x)
    own = np.array([f"K{int(unit) % 2}" for unit in units])  # each part on one appraiser alone
    assert components(units, own, x)[0].appraisers == 1


def soaked(count, soaks=2, spread=0.02, **more):
    """Return records of units with repeated soaks, in which the noise of x varies by a share of itself."""
    rng, records = np.random.default_rng(1), []
    for k in range(count):
        own = 2 * DEG_H * np.exp(0.2 * rng.normal(size=3))
        repeats = [
            RepeatedSoak(
                name=f"{k}/{j}.h5",
                place=j,
                figures={"noise": Figure(value=tuple(own * (1 + spread * rng.normal(size=3))), sigma=(None,) * 3)},
            )
            for j in range(soaks)
        ]
        records.append(record(k, {"noise": own}, repeats=repeats, **more))
    return records


def test_a_study_has_a_row_a_figure_and_axis_and_its_share_of_the_tolerance():
    limit = Limits.model_validate({"noise": "4 deg/h/sqrt(Hz)"})
    found = gauge_study(soaked(12), limit)
    assert [row.name for row in found.rows] == ["x noise", "y noise", "z noise"]
    one = found.rows[0]
    assert one.tolerance == pytest.approx(3 * one.found.grr / (limit.noise - one.found.mean))
    (said,) = found.sentences()
    assert said.startswith("gauge R&R of 12 units, 24 soaks, of the total variation, worst axes: ")
    assert "ndc" in said
    assert "% of the tolerance" in said
    assert found.as_json()["rows"][0]["units"] == 12
    assert gauge_study(soaked(12), Limits.model_validate({"noise": "1 deg/h/sqrt(Hz)"})).rows[0].tolerance is None


def test_a_class_is_named_only_where_the_whole_interval_is_in_it():
    good, poor = (gauge_study(soaked(20, 3, spread)).rows for spread in (0.005, 0.5))
    assert {row.verdict for row in good} == {"acceptable"}
    assert {row.verdict for row in poor} == {"not acceptable"}
    assert {row.verdict for row in gauge_study(soaked(6, 2, 0.02)).rows} == {""}


def test_of_appraisers_that_are_a_column_of_the_manifest():
    records = soaked(10, 4)
    columns = {one.unit: [{"chamber": f"K{soak.place % 2}"} for soak in one.repeats] for one in records}
    found = gauge_study(records, None, "chamber", columns)
    assert {row.found.appraisers for row in found.rows} == {2}
    assert " by chamber" in found.sentences()[0]
    apart = {unit: [{"chamber": unit} for _ in of_unit] for unit, of_unit in columns.items()}
    assert "no reproducibility: " in gauge_study(records, None, "chamber", apart).sentences()[0]


def test_too_few_repeats_are_said_with_what_to_record():
    assert gauge_study([record(0, {})]) is None
    (none,) = gauge_study([record(0, {})], None, "chamber").sentences()
    assert none.startswith("gauge R&R: no unit was soaked twice or more over the same range; soak 10 units or more")
    (few,) = gauge_study(soaked(MIN_UNITS - 1)).sentences()
    assert few.startswith(f"gauge R&R: {MIN_UNITS - 1} units were soaked twice")
    (alone,) = gauge_study(
        soaked(6), None, "chamber",
        {one.unit: [{"chamber": s.name} for s in one.repeats] for one in soaked(6)},
    ).sentences()  # fmt: skip
    assert "too few soaks are repeated on one appraiser" in alone
