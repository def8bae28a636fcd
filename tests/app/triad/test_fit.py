from dataclasses import fields, replace

import numpy as np
import pytest
from turned_units import bias_of, matrix_of, sensitivity_of, sensor_frame, strained, tumble, turntable

from driftlab.reports.triad import untested_lines, verdict
from driftlab.triad.fit import fit_triad
from driftlab.triad.model import TERMS
from fusion_core.chunk import Chunk
from fusion_core.contracts import KnownRates, PlacedForces, Stimulus, ThermalMap
from fusion_core.errors import ConfigError, SingularFit
from fusion_core.host.registry import registry

KINDS = registry().classes(ThermalMap)
POLYNOMIAL = KINDS["polynomial"].model_validate({"kind": "polynomial", "order": 3})
TUMBLE = registry().classes(Stimulus)["tumble"].model_validate({})
TEMPERATURES = [-20.0, 0.0, 20.0, 40.0, 60.0]
AT = np.array([-20.0, 20.0, 60.0])


def known_rates(seed=0, temperatures=TEMPERATURES, made=turntable, **how):
    """The segments of a turntable, cut by its table with nothing of the reader."""
    t, y, T, table, *force = made(seed, temperatures, **how)
    rows = [line.split(",") for line in table.splitlines()[1:]]
    parts = [slice(*np.searchsorted(t, [float(start) + 1, float(stop)])) for start, stop, _, _ in rows]
    ways = [(-1 if axis[0] == "-" else 1) * np.eye(3)["xyz".index(axis[-1])] for _, _, axis, _ in rows]
    u = [np.deg2rad(float(row[3])) * way for row, way in zip(rows, ways, strict=True)]
    means = (np.stack([values[part].mean(axis=0) for part in parts]) for values in (y, T, t, *force))
    return KnownRates(np.stack(u), *means)


def placed_forces(seed=0, temperatures=TEMPERATURES, **how):
    t, y, T = tumble(seed, temperatures, **how)
    places = TUMBLE._places(Chunk(t, {"accel": y}), 0)
    return PlacedForces(*(np.stack([v[a:b].mean(axis=0) for a, b in places]) for v in (y, T, t)), 9.80665)


def truth(sensor, size):
    return np.array([np.concatenate([bias_of(T, size), sensor(matrix_of(T)).ravel()]) for T in AT])


@pytest.mark.parametrize(
    ("stimulus", "sensor", "size", "usual"),
    [(known_rates, lambda M: M, np.deg2rad(1.0), 0.02), (placed_forces, sensor_frame, 0.3, 0.5)],
    ids=["rate table", "tumble"],
)
def test_terms_over_temperature_are_within_their_sigma(stimulus, sensor, size, usual):
    """Of 50 seeds `benchmarks/triad.py sigma` counts how many are within one and two sigma."""
    z = []
    for seed in range(200, 205):
        fit = fit_triad(stimulus(seed), POLYNOMIAL, usual, walk=1e-6)
        z.append(((fit.terms.at(AT) - truth(sensor, size)) / fit.sigma(AT))[:, fit.observable])
    z = np.array(z)
    assert z.shape[2] == (12 if stimulus is known_rates else 9)
    assert 0.6 < np.mean(np.abs(z) < 1) < 0.85
    assert np.mean(np.abs(z) < 1.96) > 0.9
    assert 0.75 < np.sqrt(np.mean(z**2)) < 1.25
    sigma = fit.sigma(AT)[:, 3:]
    assert np.max(sigma) < 1e-4  # 100 ppm, 0.1 mrad


def by_recordings(seed, made, turn_on):
    """A recording at each temperature, all by clocks from zero; the level of the bias is another in each."""
    parts = [made(100 * seed + k, [T]) for k, T in enumerate(TEMPERATURES)]
    names = [one.name for one in fields(parts[0]) if np.ndim(getattr(parts[0], one.name))]
    whole = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    own = np.repeat(range(len(parts)), [len(part.T) for part in parts])
    whole["y"] = whole["y"] + np.random.default_rng(seed).normal(0, turn_on, (len(parts), 3))[own]
    return replace(parts[0], **whole, recordings=own)


@pytest.mark.parametrize(
    ("stimulus", "sensor", "size", "usual", "turn_on"),
    [(known_rates, lambda M: M, np.deg2rad(1.0), 0.02, 1e-4), (placed_forces, sensor_frame, 0.3, 0.5, 2e-3)],
    ids=["rate table", "tumble"],
)
def test_terms_of_several_recordings_are_within_their_sigma(stimulus, sensor, size, usual, turn_on):
    """Taken for one recording, the level of each power-up makes the bias far too sure."""
    true, z, levels = truth(sensor, size), [], []
    for seed in range(400, 405):
        own = by_recordings(seed, stimulus, turn_on)
        fit = fit_triad(own, POLYNOMIAL, usual, walk=1e-6)
        z.append(((fit.terms.at(AT) - true) / fit.sigma(AT))[:, fit.free])
        levels.append(fit.level)
    z, one = np.array(z), fit_triad(replace(own, recordings=None), POLYNOMIAL, usual, walk=1e-6)
    for part in (z[..., :3], z[..., 3:]):
        assert 0.6 < np.sqrt(np.mean(part**2)) < 1.4
    assert np.sqrt(np.mean(((one.terms.at(AT) - true) / one.sigma(AT))[:, :3] ** 2)) > 2
    assert 0.6 * turn_on < np.median(levels) < 1.8 * turn_on


def test_a_clock_goes_on_where_a_recording_begins_after_the_end_of_the_one_before():
    """Then the bias walks between them: the later half is as unsure as it is of one recording."""
    own = known_rates(seed=2)
    parts = np.repeat([0, 1], [len(own.T) - 15, 15])
    one, on = (fit_triad(replace(own, recordings=names), POLYNOMIAL, 0.02, walk=1e-4) for names in (None, parts))
    sigma = [fit.sigma(AT)[2, :3].mean() for fit in (one, on)]
    assert sigma[1] > 0.9 * sigma[0]
    assert one.level == on.level == 0.0  # the bias has as many coefficients as the recordings have levels


ALL = np.ones(21, dtype=bool)


def test_g_sensitivity_over_temperature_is_within_its_sigma():
    true = np.hstack([truth(lambda M: M, np.deg2rad(1.0)), [sensitivity_of(T).ravel() for T in AT]])
    z = []
    for seed in range(210, 214):
        fit = fit_triad(known_rates(seed, made=strained), POLYNOMIAL, 0.02, ALL, walk=1e-6)
        z.append((fit.terms.at(AT) - true) / fit.sigma(AT))
    z = np.array(z)
    assert fit.observable.all()
    assert fit.names[12:14] == ("g-sensitivity xx", "g-sensitivity xy")
    assert np.max(fit.sigma(AT)[:, 12:]) < 2e-6  # 0.001 deg/s/g
    for part in (z[..., :12], z[..., 12:]):
        assert 0.75 < np.sqrt(np.mean(part**2)) < 1.25
        assert np.mean(np.abs(part) < 1.96) > 0.9
    held = fit.sensitivity()
    np.testing.assert_allclose(held.at(AT), fit.terms.sensitivity(AT), rtol=0, atol=1e-12)
    np.testing.assert_allclose(held.sigma(AT), fit.sigma(AT)[:, 12:], rtol=1e-2)


def test_g_sensitivity_goes_with_the_bias_where_no_axis_points_both_ways():
    """Of b + G f with f along +x, +y, +z alone, one sum an axis stays open: the error of all four has it."""
    fit = fit_triad(known_rates(made=strained, ways=(1,)), POLYNOMIAL, 0.02, ALL, walk=1e-6)
    assert np.sum(~fit.observable[12:]) == 3
    assert np.all(fit.sigma(AT)[:, :3] > 0.4 * 1.78e-4 * 9.8)
    assert np.all(fit.sigma(AT)[:, 12:] > 0.4 * 1.78e-4)
    line = next(line for line in verdict(fit) if "not observable, and taken as zero" in line)
    assert "from 0 to 9.8 m/s^2; add segments with" in line
    assert np.max(fit.sigma(AT)[:, 3:12]) < 1e-4  # M is not touched by it


def test_without_a_known_force_no_g_sensitivity_is_told():
    own = known_rates()
    fit = fit_triad(own, POLYNOMIAL, 0.02, ALL, walk=1e-6)
    assert not fit.observable[12:].any()
    assert np.all(fit.terms.at(AT)[:, 12:] == 0)
    assert sum("no specific force is known; record the accelerometers too" in line for line in verdict(fit)) == 9
    plain = fit_triad(own, POLYNOMIAL, 0.02, walk=1e-6)
    np.testing.assert_allclose(fit.terms.at(AT)[:, :12], plain.terms.at(AT), atol=2e-5)


def test_a_change_that_does_not_pay_counts_in_the_error():
    """One of two sigma of it stays undecided: at the ends, where it is off by it, the deviation is larger."""
    own = known_rates(seed=3)
    plain = fit_triad(own, POLYNOMIAL, 0.02, walk=1e-6)
    j = TERMS.index("misalignment xy")
    change = 9e-6 * (own.temperatures - 20.0) / 40.0  # some two sigma of a line
    moved = own.y + np.stack([change * own.u[:, 1], 0 * change, 0 * change], axis=1)
    fit = fit_triad(KnownRates(own.u, moved, own.temperatures, own.times), POLYNOMIAL, 0.02, walk=1e-6)
    assert fit.terms.curves[j].name == plain.terms.curves[j].name == "constant"
    low, middle, high = fit.sigma(AT)[:, j]
    assert low > 1.3 * middle
    assert high > 1.3 * middle
    assert fit.change()[1][j] > 3e-6


def test_a_declared_walk_is_where_one_that_is_not_seen_is_looked_for():
    """Placements scatter by their mounting; of a walk below that a fit knows what is declared."""
    own = placed_forces(seed=1)
    wide, narrow = (fit_triad(own, POLYNOMIAL, 0.5, walk=walk).sigma(AT)[:, :3] for walk in (1e-3, 1e-6))
    assert np.all(wide[1:] > 1.3 * narrow[1:])  # the walk begins at the first equation


def test_each_term_has_the_order_that_the_recording_supports():
    kinds = dict(zip(TERMS, (c.name for c in fit_triad(known_rates(), POLYNOMIAL, 0.02).terms.curves), strict=True))
    assert kinds["scale x"] == "order 1"
    assert kinds["scale z"] == "order 2"
    assert kinds["bias x"] == "order 2"
    assert kinds["misalignment yz"] == "order 1"
    assert kinds["scale y"] == kinds["misalignment zx"] == "constant"


@pytest.mark.parametrize("kind", ["spline"])
def test_a_term_may_follow_the_curves_of_an_installed_kind(kind):
    """A scale factor with a bend that no cubic follows."""
    T = np.repeat(np.linspace(-20, 60, 17), 6)
    u = np.tile(np.vstack([np.eye(3), -np.eye(3)]), (17, 1))
    bent = 0.01 * np.tanh((T - 20) / 4)
    y = u + np.random.default_rng(0).normal(0, 1e-4, u.shape)
    y[:, 0] += bent * u[:, 0]
    settings = KINDS[kind].model_validate({"kind": kind})
    wanted = np.array([name.startswith(("bias", "scale")) for name in TERMS])
    fit = fit_triad(KnownRates(u, y, T, 60.0 * np.arange(len(T))), settings, 0.02, wanted)
    assert fit.terms.curves[TERMS.index("scale x")].name == kind
    left = fit.terms.at(T)[:, TERMS.index("scale x")] - bent
    assert np.sqrt(np.mean(left**2)) < 2e-4
    matrix = fit.matrix()  # in the file it is a piecewise cubic through one point a kelvin
    np.testing.assert_allclose(matrix.terms(T), fit.terms.at(T)[:, 3:], rtol=0, atol=1e-5)


def test_the_file_has_terms_and_joint_error_of_the_fit():
    fit = fit_triad(known_rates(), POLYNOMIAL, 0.02)
    T = fit.grid
    matrix, bias = fit.matrix(), fit.curve_error(slice(0, 3))
    np.testing.assert_allclose(matrix.terms(T), fit.terms.at(T)[:, 3:], rtol=0, atol=1e-12)
    np.testing.assert_allclose(matrix.sigma(T), fit.sigma(T)[:, 3:], rtol=1e-2)
    np.testing.assert_allclose(np.sqrt(bias.variance(T)), fit.sigma(T)[:, :3], rtol=1e-2)
    modes = fit.modes(T)
    joint = np.einsum("rn,rn->n", np.array(bias.modes)[:, :, 0], np.array(matrix.error.modes)[:, :, 0])
    np.testing.assert_allclose(joint, np.sum(modes[:, :, 0] * modes[:, :, 3], axis=0), atol=1e-2 * np.abs(joint).max())


def test_what_a_turntable_about_two_axes_does_not_tell_stands_in_the_verdict():
    fit = fit_triad(known_rates(axes=(0, 1)), POLYNOMIAL, 0.02)
    assert [TERMS[j] for j in np.flatnonzero(~fit.observable)] == ["misalignment xz", "misalignment yz", "scale z"]
    assert np.all(fit.terms.at(AT)[:, ~fit.observable] == 0)
    assert np.all(fit.sigma(AT)[:, ~fit.observable] > 0.009)  # its usual size
    lines = verdict(fit)
    assert sum("no segment turns about z; add segments about z" in line for line in lines) == 3


def test_one_rate_about_an_axis_leaves_its_scale_and_the_bias_one():
    whole = known_rates()
    some = (whole.u[:, 2] >= 0) & (np.abs(whole.u[:, :2]).max(axis=1) < 1e-9)  # about z, one way alone
    fit = fit_triad(
        KnownRates(*(v[some].repeat(4, axis=0) for v in (whole.u, whole.y, whole.temperatures, whole.times))),
        POLYNOMIAL,
        0.02,
    )
    assert not fit.observable[TERMS.index("scale z")]
    assert fit.observable[:3].all()
    assert np.all(fit.sigma(AT)[:, 2] > 0.5 * 0.01 * np.deg2rad(100))  # an unobservable scale counts in the bias


def test_faces_alone_tell_no_misalignment():
    faces = np.repeat(np.vstack([np.eye(3), -np.eye(3)]), 2, axis=0)
    fit = fit_triad(placed_forces(up=faces), POLYNOMIAL, 0.5)
    assert [TERMS[j] for j in np.flatnonzero(fit.free & ~fit.observable)] == [
        "misalignment xy", "misalignment xz", "misalignment yz",
    ]  # fmt: skip
    assert "add some tilted by 45 deg between the two" in verdict(fit)[0]


def test_a_face_that_is_missing_is_named():
    """An accelerometer that stays upright: its z axis sees all of gravity, and nothing else."""
    up = np.random.default_rng(1).normal(size=(20, 3)) * [0.03, 0.03, 0.0] + [0, 0, 1]
    fit = fit_triad(placed_forces(up=up, temperatures=[20.0]), POLYNOMIAL, 0.5)
    lines = {line.split(":")[0]: line for line in verdict(fit)}
    assert "no placement has +x or -x up; add one each" in lines["scale x"]
    assert "no placement has -z up; add one" in lines["scale z"]


def test_a_part_of_the_stimulus_at_one_temperature_tells_no_change():
    whole = known_rates()
    about_y = np.abs(whole.u[:, 1]) > 0
    some = ~about_y | (whole.temperatures == 20.0)
    fit = fit_triad(
        KnownRates(*(v[some] for v in (whole.u, whole.y, whole.temperatures, whole.times))), POLYNOMIAL, 0.02
    )
    assert [TERMS[j] for j in np.flatnonzero(fit.unobservable_changes)] == [
        "misalignment xy",
        "scale y",
        "misalignment zy",
    ]
    sigma = fit.sigma(AT)[:, TERMS.index("scale y")]
    assert sigma[1] < 1e-4 < 5e-3 < sigma[0]
    assert "change from -20.0 to 60.0 °C: not observable for misalignment xy, scale y" in verdict(fit)[-1]


def test_one_temperature_gives_constants_and_says_so():
    fit = fit_triad(known_rates(temperatures=[25.0] * 3), POLYNOMIAL, 0.02)
    assert all(curve.name == "constant" for curve in fit.terms.curves)
    assert "no change over temperature is observable: all of it lies at 25.0 °C" in verdict(fit)[0]
    assert fit.grid.tolist() == [24.0, 26.0]


def bent_matrix(T):
    """The matrix of the turned units with a curvature of 2000 ppm in the middle of -20 to 60 degC, none at its ends."""
    return matrix_of(T) + 2e-3 * (1 - ((T - 20.0) / 40.0) ** 2)


def test_between_two_temperatures_a_curvature_of_usual_size_counts():
    fit = fit_triad(known_rates(temperatures=[-20.0, 60.0] * 2, matrix=bent_matrix), POLYNOMIAL, 0.02)
    error = np.array([bent_matrix(T) for T in AT]).reshape(3, 9) - fit.terms.matrix(AT).reshape(3, 9)
    sigma = fit.sigma(AT)[:, 3:]
    assert np.all(np.abs(error) < 5 * sigma)
    assert np.all(np.abs(error[1, :8]) > 1e-3)  # scale z has the opposite curvature itself
    assert np.all(sigma[[0, 2]] < 3e-5)
    np.testing.assert_allclose(fit.parts(AT)["temperatures"][1, 3:], 0.01)
    assert "2 temperatures: the curve between them is not tested; a curvature of usual size" in untested_lines(fit)[0]


def test_three_temperatures_have_no_curve_that_meets_more_and_say_so():
    """Temperatures that scatter by what a thermometer does are none of their own."""
    whole = known_rates(temperatures=[-20.0, 20.0, 60.0])
    T = whole.temperatures + np.random.default_rng(0).uniform(-0.3, 0.3, len(whole.temperatures))
    fit = fit_triad(KnownRates(whole.u, whole.y, T, whole.times), POLYNOMIAL, 0.02)
    assert {curve.name for curve in fit.terms.curves} <= {"constant", "order 1", "order 2"}
    assert "3 temperatures: the curve between them is not tested where it has order 2" in untested_lines(fit)[0]
    meets = np.array([curve.name == "order 2" for curve in fit.terms.curves])
    between = fit.parts(np.array([0.0, 20.0]))["temperatures"]
    np.testing.assert_allclose(between[:, ~meets], 0)
    # of a Gaussian process of length 60 K, known at -20, 20 and 60, 4.31 % of its size is open at 0 degC
    np.testing.assert_allclose(between[0, meets], 0.0431 * fit.usual[meets], rtol=0.02)
    np.testing.assert_array_less(between[1, meets], 0.002 * fit.usual[meets])
    five = fit_triad(known_rates(), POLYNOMIAL, 0.02)
    (alone,) = untested_lines(five)
    assert alone == (
        "scale factor is that at 100 deg/s: whether it is the same at other rates is not tested; turn at half of it too"
    )
    assert not np.any(five.parts(AT)["temperatures"])


def test_about_a_single_temperature_a_change_of_usual_size_counts():
    """Scale x moves by 6000 ppm over 40 K: 150 ppm/K."""
    fit = fit_triad(known_rates(temperatures=[20.0] * 3), POLYNOMIAL, 0.02)
    T = np.array([19.0, 20.0, 21.0])
    error = np.array([matrix_of(t) for t in T]).reshape(3, 9) - fit.terms.matrix(T).reshape(3, 9)
    assert np.all(np.abs(error) < 4.5 * fit.sigma(T)[:, 3:])
    assert abs(error[0, 0]) > 1e-4
    assert np.all(fit.sigma(T)[1, 3:] < 3e-5)


def test_gravity_that_is_unsure_is_unsure_in_all_scale_factors_alike():
    sure = placed_forces(temperatures=[-20.0, 20.0, 60.0], placements=14)
    unsure = PlacedForces(sure.y, sure.temperatures, sure.times, sure.gravity, unsure=1e-3)
    one, other = (fit_triad(stimulus, POLYNOMIAL, 0.5) for stimulus in (sure, unsure))
    scale = [3, 7, 11]
    np.testing.assert_allclose(other.sigma(AT)[:, scale] ** 2, one.sigma(AT)[:, scale] ** 2 + 1e-6, rtol=1e-6)
    modes = other.modes(AT)
    correlation = np.sum(modes[:, 1, 3] * modes[:, 1, 7]) / np.prod(other.sigma(AT)[1, [3, 7]])
    assert correlation > 0.99


def test_a_stimulus_whose_input_is_not_what_it_says_tells_nothing():
    """Rates that are none of the readings': each term is worse known than a usual unit's, and the reason says why."""
    own = known_rates()
    rng = np.random.default_rng(0)
    wrong = KnownRates(own.u, rng.normal(0, 2.0, own.y.shape), own.temperatures, own.times)
    fit = fit_triad(wrong, POLYNOMIAL, 0.02)
    assert not fit.observable.any()
    assert np.all(fit.sigma(AT) > 0.4 * fit.usual)
    reason = verdict(fit)[0]
    assert all(name in reason for name in TERMS)
    assert "the stimulus is not that of the recording, or contradicts itself" in reason
    assert not any("add segments" in line for line in verdict(fit))


def test_too_few_segments_are_refused():
    whole = known_rates(temperatures=[25.0])
    with pytest.raises(SingularFit, match="12 equations for 12 terms; add placements or segments"):
        fit_triad(KnownRates(whole.u[:4], whole.y[:4], whole.temperatures[:4], whole.times[:4]), POLYNOMIAL, 0.02)


def test_a_network_is_refused():
    network = KINDS["onnx_network"].model_validate({"kind": "onnx_network"})
    with pytest.raises(ConfigError, match=r"not linear in its coefficients, by which .* give --kind spline"):
        fit_triad(known_rates(), network, 0.02)
