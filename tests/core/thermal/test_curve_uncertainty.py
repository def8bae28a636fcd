"""The sigma of a map's curve, against what it is off by."""

import numpy as np
import pytest
from doses import draws
from scipy.signal import lfilter

from fusion_core.errors import OutsideDomain, SingularFit
from fusion_core.thermal.curve_error import CurveError
from fusion_core.thermal.curve_uncertainty import _share_of_misfit, find_holes
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

DEG_H = np.deg2rad(1) / 3600
NOISE, WALK = 3.18 * DEG_H, 0.05 * DEG_H  # rad/s/sqrt(Hz), rad/s/sqrt(s)
SIZES = np.array([1.0, -0.5, 0.7])  # of three axes
ONCE = [0, 0.05, 0.35, 0.45, 0.75, 0.8, 0.95, 1], [15, 15, 45, 45, 10, 10, 30, 30]
TWICE = [0, 0.03, 0.22, 0.27, 0.49, 0.52, 0.73, 0.78, 0.97, 1], [10, 10, 45, 45, 10, 10, 45, 45, 10, 10]


def bend(width):
    """A tanh bend of 120 deg/h and a parabola."""
    return lambda T: DEG_H * (60 * np.tanh((T - 27) / width) + 0.02 * (T - 20) ** 2)[:, None] * SIZES


def soak(curve, seed, profile=ONCE, hours=4.0, N=3600, walk=WALK, noise=NOISE):
    """Return temperatures and bias in the order of time: the curve, a walk, and white noise."""
    rng = np.random.default_rng(seed)
    dt = hours * 3600 / N
    T = np.interp(np.arange(N) / N, *profile)
    steps = walk * np.sqrt(dt) * rng.normal(size=(N, 3))
    return T, curve(T) + np.cumsum(steps, axis=0) + noise / np.sqrt(dt) * rng.normal(size=(N, 3))


def rms(values, axis=None):
    return np.sqrt(np.mean(np.square(values), axis=axis))


# coverage


@pytest.mark.parametrize(
    ("maps", "width", "fits"),
    [(Spline(), 4, True), (Polynomial(order=9), 12, True), (Polynomial(), 4, False)],
    ids=["spline", "order 9", "cubic on a bend"],
)
def test_the_bands_hold_what_they_say(maps, width, fits):
    """Of 40 soaks, what a map is off by in going from T_0 to T, over its sigma(T, T_0)."""
    curve, T_0 = bend(width), 20.0
    at = np.linspace(10.5, 44.5, 35)
    at = at[np.abs(at - T_0) > 0.6]
    start = np.array([T_0])
    z = []
    for seed in range(40):
        found = maps.fit(*soak(curve, seed), {})
        error = found.bias(at) - found.bias(start) - (curve(at) - curve(start))
        z.append(error / found.sigma(at, T_0))
    within = [np.mean(np.abs(z) < limit) for limit in (1.0, 1.96)]
    if fits:
        assert within[0] == pytest.approx(0.68, abs=0.06)
        assert within[1] == pytest.approx(0.95, abs=0.04)
    else:
        assert within[1] >= 0.90
        assert 0.8 < rms(z) < 1.3, "and not because the bands are too wide"


def test_what_smoothing_takes_of_a_curve_is_in_its_sigma():
    """White noise alone, curves that bend at their ends, where a penalty lets them go straight on."""

    def curve(T):
        u = (T - 27.5) / 17.5
        return 150 * DEG_H * np.stack([np.exp(u), np.sin(4 * u + 1), u**2 + u**3], axis=1)

    ends, within, swings = [], [], []
    for seed in range(15):
        T, bias = soak(curve, seed, N=1800, walk=0.0)
        found = Spline().fit(T, bias, {})
        at = np.linspace(*found.domain, 141)
        error = found.bias(at) - curve(at) - np.mean(found.bias(T) - curve(T), axis=0)
        z = error / found.sigma(at)
        ends.append(z[[0, -1]])
        within.append(z[20:-20:10])
        lowest, highest = found.bias(at)[:, 0][[0, -1]]
        swings.append((highest - lowest - np.ptp(curve(at)[:, 0])) / found.sigma(at[-1:], at[0])[0, 0])
    assert 0.6 < rms(ends) < 1.3  # 2 without
    assert 0.75 < rms(within) < 1.2
    assert np.mean(np.array(swings) < -2.132) <= 0.1  # 95 % of one side by Student's law of four squares, of 15


def test_a_part_of_the_soak_that_was_left_out_agrees():
    """The last descent about the map of all before it: sigma(T, T_0), the walk since T_0, and the means' noise."""
    curve, N, hours = bend(4), 7200, 8.0
    dt, block = hours * 3600 / N, 30
    ratios = []
    for seed in range(12):
        T, bias = soak(curve, seed, TWICE, hours, N)
        stop, begin, end = int(0.73 * N), int(0.78 * N), int(0.97 * N)
        found = Spline().fit(T[:stop], bias[:stop], {})
        left = bias[begin - block : end] - found.bias(np.clip(T[begin - block : end], *found.domain))
        rows = len(left) // block
        means = left[: rows * block].reshape(rows, block, 3).mean(axis=1)
        T_k = T[begin - block :][: rows * block].reshape(rows, block).mean(axis=1)
        away = (means - means[0])[1:]
        t = np.arange(1, rows) * block * dt
        variance = found.sigma(T_k[1:], T_k[0]) ** 2 + WALK**2 * t[:, None] + 2 * NOISE**2 / (block * dt)
        ratios.append(rms(away) / np.sqrt(np.mean(variance)))
    assert 1 / 1.5 < rms(ratios) < 1.5


def test_shuffled_samples_have_the_sigma_of_white_noise():
    """Out of the order of time no walk is seen: what is left is least squares as numpy.polyfit has it."""
    curve, T_0 = bend(12), 20.0
    T, bias = soak(curve, 3, walk=0.0)
    k = np.random.default_rng(0).permutation(len(T))
    at = np.linspace(11, 44, 40)
    at = at[np.abs(at - T_0) > 1]
    for order in (3, 7):
        y = bias[:, :1] - curve(T)[:, :1]
        found = Polynomial(order=order).fit(T[k], y[k], {})
        _, covariance = np.polyfit(T - 27, y[:, 0], order, cov=True)
        V = np.vander(at - 27, order + 1) - np.vander([T_0 - 27], order + 1)
        expected = np.sqrt(np.einsum("Nm,mn,Nn->N", V, covariance, V))
        np.testing.assert_allclose(found.sigma(at, T_0)[:, 0], expected, rtol=0.2)


def test_a_walk_in_the_soak_makes_a_map_less_sure():
    at = np.linspace(11, 44, 40)
    calm, wandering = (
        Polynomial(order=9).fit(*soak(bend(12), 5, walk=walk), {}).sigma(at, 20.0) for walk in (0.0, 4 * WALK)
    )
    assert rms(wandering) > 5 * rms(calm)


# the shape of sigma


@pytest.mark.parametrize("maps", [Spline(), Polynomial(order=5)], ids=lambda maps: maps.kind)
def test_sigma_is_small_where_sampled_and_grows_in_a_hole_and_beyond_the_ends(maps):
    T, bias = soak(bend(20), 0, walk=0.2 * WALK)
    keep = (T < 22) | (T > 30)
    found = maps.fit(T[keep], bias[keep], {})
    ((low, high),) = found.record.error.holes
    assert low == pytest.approx(22, abs=0.1)
    assert high == pytest.approx(30, abs=0.1)
    sampled, hole = found.sigma(np.linspace(12, 20, 20)), found.sigma(np.linspace(24, 28, 20))
    assert np.all(rms(hole, axis=0) > 2 * rms(sampled, axis=0))
    held = maps.model_copy(update={"outside": "tangent"}).fit(T[keep], bias[keep], {})
    for edge, direction in ((found.domain[1], 1), (found.domain[0], -1)):
        beyond = held.sigma(edge + direction * np.array([0.0, 1.0, 3.0, 10.0, 30.0]))
        assert np.all(np.diff(beyond, axis=0) > 0)
        assert np.all(beyond[-1] > 20 * beyond[0])


def test_sigma_of_a_change_vanishes_where_it_begins_and_is_symmetric():
    found = Spline().fit(*soak(bend(4), 1), {})
    at = np.array([12.0, 20.0, 33.3])
    np.testing.assert_allclose(found.sigma(at, 20.0)[1], 0.0, atol=1e-18)
    np.testing.assert_allclose(found.sigma(at[:1], 33.3), found.sigma(at[2:], 12.0), rtol=1e-12)
    # the errors of neighbours are nearly one: their difference is known far better than either
    assert np.all(found.sigma(np.array([20.2]), 20.0) < 0.3 * found.sigma(np.array([20.2])))


def test_clamping_adds_what_it_leaves_out():
    T, bias = soak(bend(12), 2)
    plain, clamp = (Polynomial(order=9, outside=outside).fit(T, bias, {}) for outside in ("tangent", "clamp"))
    edge = plain.domain[1]
    at = edge + np.array([0.0, 1.0, 4.0])
    left_out = (at - edge)[:, None] * plain.slope(np.array([edge]))
    np.testing.assert_allclose(clamp.sigma(at) ** 2, plain.sigma(at) ** 2 + left_out**2, rtol=1e-9)


# beyond the domain


@pytest.mark.parametrize("maps", [Spline(), Polynomial(order=9)], ids=lambda maps: maps.kind)
def test_a_tangent_goes_on_straight(maps):
    T, bias = soak(bend(12), 0)
    found = maps.model_copy(update={"outside": "tangent"}).fit(T, bias, {})
    inside = maps.fit(T, bias, {})
    low, high = found.domain
    for edge, direction in ((high, 1.0), (low, -1.0)):
        ends = np.array([edge])
        at = edge + direction * np.array([0.0, 1e-9, 0.5, 7.0, 40.0])
        value, slope = inside.bias(ends), inside.slope(ends)
        np.testing.assert_allclose(found.bias(at), value + (at - edge)[:, None] * slope, rtol=0, atol=1e-15)
        np.testing.assert_allclose(found.slope(at), np.repeat(slope, 5, axis=0), rtol=1e-12)
    within = np.linspace(low, high, 50)
    np.testing.assert_array_equal(found.bias(within), inside.bias(within))
    mixed = np.array([low - 3, 20.0, high + 3])
    np.testing.assert_allclose(found.bias(mixed)[1:2], inside.bias(mixed[1:2]), rtol=1e-12)


@pytest.mark.parametrize("maps", [Spline(), Polynomial()], ids=lambda maps: maps.kind)
def test_a_map_accepts_the_samples_that_it_was_fitted_on(maps):
    """A mean of equal values is off by rounding, and that is no temperature beyond the fit."""
    T, bias = soak(bend(12), 0)
    found = maps.fit(T, bias, {})
    edge = np.array([found.domain[1]])
    rounded = np.mean(np.full((1, 1000), found.domain[1]) * 1.1 / 1.1, axis=1)
    for at in (rounded, np.nextafter(edge, 99), edge + 1e-9, np.array([found.domain[0] - 1e-9])):
        assert np.all(np.isfinite(found.bias(at)))
        assert np.all(np.isfinite(found.slope(at)))
    np.testing.assert_array_equal(found.bias(np.nextafter(edge, 99)), found.bias(edge))
    with pytest.raises(OutsideDomain, match=r"refit on a wider soak, or set outside: clamp or tangent"):
        found.bias(edge + 1e-6)


# holes


def islands():
    """Return two hours of which one warms from 12 to 14 degC and one from 46 to 48 degC, with a bias that wanders."""
    return soak(bend(12), 0, ([0, 0.5, 0.500001, 1], [12, 14, 46, 48]), hours=2.0, walk=10 * WALK)


@pytest.mark.parametrize("order", [2, 3, 5])
def test_a_polynomial_over_two_islands_of_temperature_is_refused(order):
    message = (
        r"^polynomial: has no sample between (14|13\.99\d*) and 46 °C, where the curve of axis [xyz] would be known "
        r"no better than to \S+ times what it swings by in all that was seen; record the temperatures between, or fit"
    )
    with pytest.raises(SingularFit, match=message):
        Polynomial(order=order).fit(*islands(), {})


def test_a_spline_over_a_moderate_hole_is_fitted_and_says_so():
    curve = bend(12)
    T, bias = soak(curve, 0)
    keep = (T < 22) | (T > 30)
    found = Spline().fit(T[keep], bias[keep], {})
    ((low, high),) = found.record.error.holes
    assert 21.9 < low < high < 30.1
    inside = np.linspace(23, 29, 20)
    error = found.bias(inside) - found.bias(np.array([21.0])) - (curve(inside) - curve(np.array([21.0])))
    assert rms(error / found.sigma(inside, 21.0)) < 1.5
    assert Spline().fit(T, bias, {}).record.error.holes == ()


def test_a_coarse_thermometer_leaves_no_holes():
    T = np.round(soak(bend(12), 0)[0] / 2.5) * 2.5
    assert find_holes(T) == ()
    keep = (T < 22) | (T > 35)
    ((low, high),) = find_holes(T[keep])
    assert (low, high) == (20.0, 37.5)


# the record


def test_the_record_keeps_the_steps_and_the_error():
    T, bias = soak(bend(12), 0)
    found = Spline().fit(np.round(T), bias, {})
    assert found.record.resolution == pytest.approx(1.0)
    assert found.record.channel == "gyro"
    assert CurveError.model_validate_json(found.record.error.model_dump_json()) == found.record.error


def test_a_misfit_is_kept_where_it_is_surest_and_a_file_from_before_is_read():
    T, bias = soak(bend(4), 0)
    error = Polynomial().fit(T, bias, {}).record.error
    assert [misfit.axis for misfit in error.misfits] == [0, 1, 2]
    for misfit, size in zip(error.misfits, SIZES, strict=True):
        assert 20 < misfit.T < 35, "about the bend at 27 degC"
        assert misfit.left > 5 * misfit.noise
        assert misfit.left < 60 * abs(size) * DEG_H
    assert Polynomial(order=9).fit(*soak(bend(12), 0), {}).record.error.misfits == ()
    before = {name: value for name, value in error.model_dump(mode="json").items() if name != "misfits"}
    assert CurveError.model_validate(before).misfits == ()


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"T": (0.0, 0.0)}, "the grid T does not rise"),
        ({"T": (0.0,)}, "the grid T does not rise"),
        ({"modes": (((1.0,),),)}, r"modes have the shape \(1, 1, 1\), not \(r, 2, 1\)"),
        ({"bend": (float("nan"),)}, "finite"),
        ({"misfits": ({"axis": 1, "T": 20.0, "left": 1e-5, "noise": 1e-6},)}, "a misfit is of axis 1 of 1"),
    ],
)
def test_an_error_that_is_not_whole_is_refused(changes, match):
    whole = {"T": (0.0, 40.0), "modes": (((1e-5,), (2e-5,)),), "bend": (1e-8,)}
    np.testing.assert_allclose(CurveError(**whole).variance([10.0])[0, 0], 1.25e-5**2, rtol=1e-12)
    with pytest.raises(ValueError, match=match):
        CurveError(**(whole | changes))


def wave(phase):
    """A smooth curve over 80 K: one and a quarter periods of a sine of 300 deg/h."""
    return lambda T: 300 * DEG_H * np.sin((T - 15) / 10 + phase)[:, None] * SIZES


WIDE = [0, 0.05, 0.45, 0.55, 0.95, 1], [-25, -25, 55, 55, -25, -25]


def test_a_spline_does_not_misfit_a_curve_that_it_smooths():
    """Knots 1 K apart can follow a wave of 63 K; the noise of the soak has them smoothed."""
    found = [
        Spline().fit(*soak(wave(seed), seed, WIDE, 8.0, 14_400, 0.03 * DEG_H, noise), {}).record.error.misfits
        for seed in range(draws(4, 10))
        for noise in (3 * DEG_H, 10 * DEG_H)
    ]
    assert found == [()] * len(found)


@pytest.mark.parametrize("maps", [Polynomial(), Spline(interval=25.0)], ids=["cubic", "knots 25 K apart"])
def test_a_kind_that_is_too_stiff_for_the_same_curve_is_seen(maps):
    for seed in range(draws(2, 5)):
        fitted = maps.fit(*soak(wave(seed), seed, WIDE, 8.0, 7200, 0.03 * DEG_H, 10 * DEG_H), {})
        assert [misfit.axis for misfit in fitted.record.error.misfits] == [0, 1, 2]


LEVELS = np.concatenate([np.arange(-10, 51, 10), np.arange(40, -11, -10)]).astype(float)
SMOOTH = lambda T: np.stack([40 * np.sin(T / 25), 30 * np.exp(-T / 40), 1.5 * T], axis=1) * DEG_H  # noqa: E731


def by_steps(seed, curve, lag, more=lambda T: 0.0):
    """Return temperatures and bias of a soak by steps, which the thermometer shows at once where the sensor lags."""
    rng = np.random.default_rng(seed)
    chamber = np.repeat(LEVELS, 1200)
    T = lfilter([1 / 150], [1, 1 / 150 - 1], chamber + 10) - 10
    bias = curve(T) + more(T) + np.cumsum(0.03 * DEG_H * rng.normal(size=(len(T), 3)), axis=0)
    read = chamber if lag else T
    return read + 0.02 * rng.normal(size=len(T)), bias + 3 * DEG_H * rng.normal(size=bias.shape)


@pytest.mark.parametrize("seed", range(2))
def test_what_a_lag_or_a_hysteresis_leaves_is_no_misfit_of_a_curve_that_knots_can_follow(seed):
    """A thermometer in the air, which is at seven temperatures alone; and a play of 16 deg/h on a smooth curve."""

    def play(T):
        back = np.empty_like(T)
        back[0] = last = T[0]
        for k in range(1, len(T)):
            back[k] = last = max(T[k] - 4, min(T[k] + 4, last))
        return np.outer(back - T, [2.0, -2.0, 0.0]) * DEG_H

    assert Spline().fit(*by_steps(seed, SMOOTH, lag=True), {}).record.error.misfits == ()
    assert Spline().fit(*by_steps(seed, SMOOTH, lag=False, more=play), {}).record.error.misfits == ()


@pytest.mark.parametrize("lag", [False, True])
def test_a_misfit_is_where_samples_are_and_no_larger_than_what_they_are_off(lag):
    """The axis of the smallest bend may be lost in the lag."""
    T, bias = by_steps(0, bend(4), lag)
    fitted = Polynomial(order=2).fit(T, bias, {})
    assert {misfit.axis for misfit in fitted.record.error.misfits} >= {0, 2}
    for misfit in fitted.record.error.misfits:
        near = np.abs(T - misfit.T) < 0.1
        assert np.any(near)
        off = np.mean((bias - fitted.bias(T))[near, misfit.axis])
        assert misfit.left < abs(off) + 3 * misfit.noise


def test_of_a_finding_what_is_hardly_known_is_no_misfit():
    """Of the variance that a misfit has in all shapes, a shape takes the less, the more noise is expected in it."""
    shape, variances = np.array([8.0, -7.0, 6.0, -30.0]), np.array([1.0, 1.0, 4.0, 900.0])
    share = _share_of_misfit(shape, variances)
    assert np.all(np.diff(share) <= 0)
    assert share[0] > 0.95
    assert abs(share[3] * shape[3]) < 3.0
    noise = np.random.default_rng(0).normal(size=40)
    assert np.max(_share_of_misfit(noise, np.ones(40))) < 0.3


@pytest.mark.parametrize("maps", [Spline(), Polynomial()], ids=["spline", "cubic"])
def test_a_misfit_at_one_temperature_takes_nothing_of_sigma_at_others(maps):
    def dipped(T):
        return bend(30)(T) - 300 * DEG_H * np.exp(-(((T - 33) / 0.25) ** 2) / 2)[:, None]

    T = np.linspace(12, 43, 50)
    for seed in range(4):
        smooth, dip = (maps.fit(*soak(curve, seed, TWICE, N=14_400), {}) for curve in (bend(30), dipped))
        assert dip.record.error.misfits
        assert not smooth.record.error.misfits
        assert np.min(dip.sigma(T) / smooth.sigma(T)) > 0.6
