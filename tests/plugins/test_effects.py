"""Effects: the laws that each installed one keeps, and each one's physics against a derivation of its own."""

import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lsim

from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.host.registry import registry
from fusion_plugins.effects.channel import Channel, auxiliary
from fusion_plugins.effects.curve import Curve
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.g_sensitivity import GSensitivity
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.interaction import Interaction
from fusion_plugins.effects.map_misfit import MapMisfit
from fusion_plugins.effects.periodic import Periodic
from fusion_plugins.effects.recordings import largest_reversal
from fusion_plugins.effects.relaxation import Relaxation
from fusion_plugins.effects.thermal_gradient import ThermalGradient
from fusion_plugins.effects.thermal_lag import ThermalLag
from fusion_plugins.effects.thermal_rate import ThermalRate
from fusion_plugins.effects.turn_on import TurnOn

KINDS = registry().classes(Effect)
SHIPPED = (
    Channel, Curve, Drift, GSensitivity, Hysteresis, Interaction, MapMisfit, Periodic, Relaxation, ThermalGradient,
    ThermalLag, ThermalRate, TurnOn,
)  # fmt: skip
every = pytest.mark.parametrize("kind", sorted(KINDS))


def record(effect=None, N=120, steps="irregular"):
    """A recording with a wandering temperature and whatever the effect reads besides, one repeated stamp in it."""
    rng = np.random.default_rng(11)
    dt = rng.uniform(0.1, 20.0, N) if steps == "irregular" else np.full(N, 2.5)
    if steps == "irregular":
        dt[N // 2] = 0.0
    t = 1e4 + np.cumsum(dt)
    walk = lambda: 20 + np.cumsum(rng.normal(size=N))  # noqa: E731
    channels = {"temperature": walk(), "accel": rng.normal(size=(N, 3)), "residual": rng.normal(size=(N, 3))}
    for name in ("voltage", "temperature_case", *(effect.requires if effect else ())):
        channels.setdefault(name, walk())
    return Chunk(t, channels)


def on_one_axis(effect, chunk):
    """Return what an effect shows on x (N, q); its other axes must show the same."""
    signature, _ = effect.signature(chunk, None)
    q = signature.shape[2] // len(effect.axes)
    x = signature[:, 0, :q]
    for k in range(len(effect.axes)):
        np.testing.assert_array_equal(signature[:, k, k * q : (k + 1) * q], x)
    assert np.count_nonzero(signature) == len(effect.axes) * np.count_nonzero(x)
    return x


def at_temperature(t, T, **channels):
    return Chunk(t, {"temperature": T, **channels})


# -- laws ------------------------------------------------------------------------------------------------------------


def test_what_is_shipped_is_installed():
    assert {kind: KINDS[kind] for kind in sorted(KINDS) if KINDS[kind] in SHIPPED} == {
        cls.model_fields["kind"].default: cls for cls in SHIPPED
    }


@every
def test_an_effect_names_its_source_and_has_valid_candidates(kind):
    effect = KINDS[kind]()
    assert re.search(r"\b(18|19|20)\d\d\b", effect.explanation), "a reference has a year"
    assert effect.explanation.endswith(".")
    candidates = list(effect.candidates())
    assert candidates
    assert len({repr(c) for c in candidates}) == len(candidates)
    for candidate in candidates:
        again = type(effect).model_validate(candidate.model_dump(mode="json"))
        for name in type(effect).continuous:
            assert getattr(again, name) == pytest.approx(getattr(candidate, name), rel=1e-12)
            assert getattr(candidate, name) > 0
        assert all(factor > 1 for factor in type(effect).continuous.values())


@every
def test_candidates_and_proposals_show_what_their_labels_name(kind):
    effect = KINDS[kind]()
    chunk = record(effect)
    found = [*effect.candidates(), *effect.proposals([chunk, record(effect, N=80)])]
    for axes in (("x", "y", "z"), ("y",)):
        for candidate in found:
            one = candidate.model_copy(update={"axes": axes})
            signature, _ = one.signature(chunk, None)
            assert signature.shape == (len(chunk), len(axes), len(one.labels))
            assert len(set(one.labels)) == len(one.labels)
            assert np.all(np.isfinite(signature))
            assert one.input(chunk, None)[0].shape == (len(chunk),)


def in_parts(method, chunk, cuts):
    """Return the method's values over the chunk cut into parts, the memory handed on."""
    parts, memory = [], None
    for start, stop in pairwise([0, *cuts, len(chunk)]):
        values, memory = method(chunk.part(start, stop), memory)
        parts.append(values)
    return np.concatenate(parts)


def methods(effect):
    """All that has a memory."""
    return [effect.signature, effect.input, *([effect.fading] if effect.fades else [])]


@every
@given(
    cuts=st.lists(st.integers(1, 119), unique=True, max_size=12).map(sorted),
    steps=st.sampled_from(["irregular", "regular"]),
)
@settings(deadline=None, max_examples=20)
def test_any_split_of_a_recording_gives_the_same(kind, cuts, steps):
    effect = KINDS[kind]()
    chunk = record(effect, steps=steps)
    for method in methods(effect):
        whole, _ = method(chunk, None)
        scale = np.max(np.abs(whole), initial=1.0)
        np.testing.assert_allclose(in_parts(method, chunk, cuts), whole, rtol=0, atol=1e-12 * scale)


@every
def test_a_single_sample_at_a_time_is_a_split_too(kind):
    effect = KINDS[kind]()
    chunk = record(effect, N=30)
    for method in methods(effect):
        whole, _ = method(chunk, None)
        scale = np.max(np.abs(whole), initial=1.0)
        np.testing.assert_allclose(in_parts(method, chunk, range(1, 30)), whole, rtol=0, atol=1e-12 * scale)


@every
def test_a_config_keeps_hyper_parameters_and_coefficients(kind):
    """What a found effect is written with, is what is read."""
    effect = KINDS[kind]()
    refined = {name: getattr(effect, name) * 1.2345678901234 for name in type(effect).continuous}
    found = effect.model_copy(update=refined)
    p = len(found.labels)
    known = tuple(np.random.default_rng(0).normal(size=p) * 1e-6)
    found = found.model_copy(
        update={"coefficients": known, "sigma": tuple(abs(v) / 7 for v in known), "estimate": True, "axes": effect.axes}
    )
    again = type(effect).model_validate(found.model_dump(mode="json"))
    assert again.coefficients == found.coefficients
    assert again.sigma == found.sigma
    assert again.estimate
    for name in type(effect).model_fields:
        old, new = getattr(found, name), getattr(again, name)
        assert new == (pytest.approx(old, rel=1e-12) if isinstance(old, float) else old), name
    chunk = record(effect)
    np.testing.assert_allclose(again.signature(chunk, None)[0], found.signature(chunk, None)[0], rtol=1e-9, atol=1e-12)


# -- what came before the recording ----------------------------------------------------------------------------------

LATE = (Relaxation(tau="7 min"), Relaxation(tau="7 min", channel="voltage"), ThermalLag(tau="90 s"))


def begun_at(effect, chunk, start):
    """Return what an effect with a lag adds where the lag began at `start`, for a coefficient of one."""
    u = chunk[getattr(effect, "channel", "temperature")]
    memory = (u[0], start)
    if effect.acts_on_input:
        return effect.input(chunk, memory)[0]
    return effect.signature(chunk, memory)[0][:, 0, 0]


@pytest.mark.parametrize("effect", LATE, ids=repr)
@pytest.mark.parametrize("steps", ["irregular", "regular"])
def test_a_lag_that_began_elsewhere_is_what_fades_beside_equilibrium(effect, steps):
    chunk = record(steps=steps)
    start = chunk[getattr(effect, "channel", "temperature")][0]
    fading, _ = effect.fading(chunk, None)
    assert fading.shape == (len(chunk),)
    assert fading[0] == 1
    for off in (-3.0, 0.2):
        a = begun_at(effect, chunk, start - off)[0] - begun_at(effect, chunk, start)[0]
        assert abs(a) == pytest.approx(abs(off))
        expected = begun_at(effect, chunk, start) + a * np.cumprod(fading)
        np.testing.assert_allclose(begun_at(effect, chunk, start - off), expected, atol=1e-12)


def test_what_a_lag_began_at_is_gone_after_so_many_time_constants():
    t = np.arange(0, 3600.0, 2.0)
    fading, memory = Relaxation(tau="10 min").fading(Chunk(t), None)
    np.testing.assert_allclose(np.cumprod(fading), np.exp(-t / 600), rtol=1e-12)
    later, _ = Relaxation(tau="10 min").fading(Chunk(t[1:] + 3600, {}, Chunk(t[:1] + 3600)), memory)
    assert np.ptp(later) == 0  # all steps alike, the first of a later chunk too


@pytest.mark.parametrize("seed", range(5))
def test_a_play_has_forgotten_what_it_began_at_where_the_fading_says_so(seed):
    """Whatever it began at, within its width: equal from there on, and for one of them not a sample before."""
    rng = np.random.default_rng(seed)
    T = 20 + np.cumsum(rng.normal(size=400))
    chunk, effect = at_temperature(np.arange(400.0), T), Hysteresis(width="9 K")
    fading, _ = effect.fading(chunk, None)
    gone = int(np.argmin(np.cumprod(fading)))
    assert set(fading[:gone]) <= {1.0}
    assert set(fading[gone:]) == {0.0}
    starts = [effect.signature(chunk, T[0] + s)[0][:, 0, 0] for s in np.linspace(-4.5, 4.5, 7)]
    spread = np.ptp(starts, axis=0)
    np.testing.assert_allclose(spread[gone:], 0, atol=1e-12)
    assert spread[gone - 1] > 0
    assert np.all(np.diff(spread) <= 1e-12)
    still = at_temperature(np.arange(50.0), 20 + 0.1 * np.sin(np.arange(50.0)))
    np.testing.assert_array_equal(effect.fading(still, None)[0], 1.0)


@every
def test_only_an_effect_with_a_memory_has_an_unknown_start(kind):
    effect = KINDS[kind]
    if effect().fades:
        assert effect(initial=(1e-6, 0.0, 2e-6)).initial == (1e-6, 0.0, 2e-6)
        with pytest.raises(ValueError, match="initial has 2 values for 3 axes; write one for all, or one an axis"):
            effect(initial=(1e-6, 0.0))
    else:
        assert effect().fading(record(effect()), None) == (None, None)
        assert effect(initial=(0.0, 0.0, 0.0)).initial == (0.0, 0.0, 0.0)
        with pytest.raises(ValueError, match=f"{kind} has no memory of what came before; remove initial"):
            effect(initial=(1e-6, 0.0, 2e-6))
    assert {k for k, cls in KINDS.items() if cls().fades and cls in SHIPPED} == {
        "hysteresis",
        "relaxation",
        "thermal_lag",
    }


# -- physics ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "swing"), [(8.0, 40.0), (3.0, 12.0), (15.0, 16.0)])
def test_hysteresis_encloses_its_loop(width, swing):
    """Over a full cycle the loop's area is width (swing - width), run through with the warm branch below."""
    up = np.linspace(0, swing, int(swing * 10) + 1)
    T = np.concatenate([up, up[::-1], up, up[::-1]])
    loop = on_one_axis(Hysteresis(width=f"{width} K"), at_temperature(np.arange(len(T)) * 1.0, T))[:, 0]
    last = slice(len(T) // 2 - 1, None)
    area = np.trapezoid(loop[last], T[last])
    assert area == pytest.approx(-width * (swing - width), rel=1e-9)
    assert np.max(np.abs(loop)) <= width / 2 + 1e-12


def test_hysteresis_differs_by_its_width_between_warming_and_cooling():
    T = np.concatenate([np.linspace(0, 50, 101), np.linspace(50, 0, 101)])
    loop = on_one_axis(Hysteresis(width="6 K"), at_temperature(np.arange(202.0), T))[:, 0]
    assert loop[0] == 0
    assert (loop[50], loop[151]) == (pytest.approx(-3), pytest.approx(3))


def test_thermal_lag_trails_a_ramp_by_tau_times_its_rate():
    t = np.cumsum(np.random.default_rng(1).uniform(0.5, 8.0, 400))
    rate, tau = -0.02, 90.0
    effect = ThermalLag(tau="90 s")
    seen, _ = effect.input(at_temperature(t, 30 + rate * t), None)
    behind = 30 + rate * t - seen
    np.testing.assert_allclose(behind, rate * tau * (1 - np.exp(-(t - t[0]) / tau)), atol=1e-10)
    assert behind[-1] == pytest.approx(rate * tau, rel=1e-6)
    assert effect.labels == ()
    assert effect.coefficients == ()


def test_thermal_rate_is_its_transfer_function():
    """s (1 + 3 tau s) / (1 + tau s)^3 by scipy, on a temperature that bends every minute."""
    t = np.arange(0, 1200, 0.25)
    T = np.interp(t, np.arange(0, 1201, 60), 20 + np.random.default_rng(2).normal(size=21))
    tau = 20.0
    _, expected, _ = lsim(([3 * tau, 1.0, 0.0], [tau**3, 3 * tau**2, 3 * tau, 1.0]), T - T[0], t)
    found = on_one_axis(ThermalRate(tau="20 s"), at_temperature(t, T))[:, 0]
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.max(np.abs(expected)))


def test_thermal_rate_settles_on_a_ramp_and_on_a_bend():
    """A steady rate is met exactly, and a steadily growing one without delay."""
    t = np.cumsum(np.random.default_rng(3).uniform(0.5, 1.5, 1000))
    effect = ThermalRate(tau="20 s")
    assert on_one_axis(effect, at_temperature(t, 5 + 0.03 * t))[-1, 0] == pytest.approx(0.03, rel=1e-9)
    bend = on_one_axis(effect, at_temperature(t, 5 + 0.5 * 1e-4 * t**2))[:, 0]
    np.testing.assert_allclose(bend[500:], 1e-4 * t[500:], atol=1e-4 * 0.05)  # 0.05 s late at most


def test_turn_on_and_drift_count_from_the_first_sample():
    t = 5000 + np.array([0.0, 1.0, 10.0, 600.0, 6000.0])
    chunk = Chunk(t)
    np.testing.assert_allclose(on_one_axis(TurnOn(tau="10 min"), chunk)[:, 0], np.exp(-(t - 5000) / 600), rtol=1e-14)
    np.testing.assert_array_equal(on_one_axis(Drift(), chunk)[:, 0], t - 5000)


def test_channel_gives_the_channel_column_by_column():
    rng = np.random.default_rng(4)
    field, V = rng.normal(size=(20, 2)), rng.normal(size=20)
    chunk = Chunk(
        np.arange(20.0),
        {"field": field, "voltage": V, "temperature": V, "temperature_case": V, "gyro": V},
        sensors=frozenset({"gyro"}),
    )
    np.testing.assert_array_equal(on_one_axis(Channel(), chunk)[:, 0], V)
    assert auxiliary([chunk]) == ["field", "voltage"]
    by_name = {c.channel: c for c in Channel().proposals([chunk])}
    assert set(by_name) == {"field", "voltage"}
    np.testing.assert_array_equal(on_one_axis(by_name["field"], chunk), field)
    assert by_name["field"].labels[:2] == ("x_field_0", "x_field_1")


def test_g_sensitivity_is_a_matrix_on_specific_force():
    f = np.random.default_rng(5).normal(size=(20, 3))
    M = np.arange(9.0).reshape(3, 3)
    signature, _ = GSensitivity().signature(Chunk(np.arange(20.0), {"accel": f}), None)
    np.testing.assert_allclose(signature @ M.ravel(), f @ M.T, rtol=1e-13)
    assert GSensitivity().labels[:4] == ("x_f_x", "x_f_y", "x_f_z", "y_f_x")


def test_interaction_is_the_product_with_its_factors():
    rng = np.random.default_rng(6)
    V, T, p = 12 + rng.normal(size=50), 20 + rng.normal(size=50), rng.normal(size=50)
    chunk = Chunk(np.arange(50.0), {"voltage": V, "temperature": T, "pressure": p})
    one = on_one_axis(Interaction(zero=(12.0, 20.0)), chunk)
    np.testing.assert_allclose(one, np.stack([(V - 12) * (T - 20), V - 12], axis=1), rtol=1e-13)
    assert Interaction().labels[:2] == ("x_product", "x_voltage")
    found = {c.channels: c for c in Interaction().proposals([chunk])}
    pairs = {frozenset(pair) for pair in found}
    assert pairs == {frozenset(s) for s in (("voltage", "temperature"), ("pressure", "temperature"),
                                            ("voltage", "pressure"), ("voltage",), ("pressure",))}  # fmt: skip
    square = on_one_axis(found["pressure", "pressure"], chunk)
    np.testing.assert_allclose(square, np.stack([(p - p.mean()) ** 2, p - p.mean()], axis=1), atol=1e-12)


def test_interaction_spans_the_same_wherever_its_zeros_are():
    """Marginality: with the factors and a map linear in T, moving the zeros changes only the coefficients."""
    chunk = record()
    T = np.stack([np.ones(len(chunk)), chunk["temperature"]], axis=1)
    one, other = (np.hstack([on_one_axis(Interaction(zero=z), chunk), T]) for z in ((0.0, 0.0), (19.0, 21.0)))
    np.testing.assert_allclose(other @ np.linalg.lstsq(other, one, rcond=None)[0], one, rtol=1e-9, atol=1e-8)


def test_relaxation_is_what_a_lag_has_not_followed():
    """(tau s) / (1 + tau s) by scipy; on a ramp it settles at tau times the rate."""
    t = np.arange(0, 6000, 1.0)
    u = np.interp(t, np.arange(0, 6001, 300), 20 + np.random.default_rng(2).normal(size=21))
    _, expected, _ = lsim(([400.0, 0.0], [400.0, 1.0]), u - u[0], t)
    for channel in ("temperature", "voltage"):
        effect = Relaxation(channel=channel, tau="400 s")
        found = on_one_axis(effect, Chunk(t, {channel: u}))[:, 0]
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert effect.requires == ("voltage",)
    ramp = on_one_axis(Relaxation(tau="400 s"), at_temperature(t, 5 - 0.01 * t))[-1, 0]
    assert ramp == pytest.approx(-4.0, rel=1e-6)
    assert Relaxation().units == ("bias/K",) * 3
    assert effect.units == ("bias per SI unit of the channel",) * 3


def test_relaxation_is_proposed_up_to_half_of_the_longest_recording():
    short, long = record(N=40, steps="regular"), record(N=4000, steps="regular")  # 9997.5 s
    found = list(Relaxation().proposals([short, long]))
    assert {c.channel for c in found} == {"temperature", "voltage"}
    taus = [c.tau for c in found if c.channel == "temperature"]
    assert taus[0] == pytest.approx(20)
    assert 0.7 * 4998.75 < taus[-1] <= 4998.75
    ratios = np.diff(np.log(taus))
    np.testing.assert_allclose(ratios, np.log(36000 / 20) / 25)
    assert len(list(Relaxation().candidates())) == 26
    assert len(list(Relaxation(channel="voltage").candidates())) == 8
    assert list(Relaxation().proposals([short])) != []
    wide = Chunk(np.arange(500.0), {"field": np.zeros((500, 2)), "residual": np.zeros((500, 3))})
    assert list(Relaxation().proposals([wide])) == []


def test_curve_is_a_power_series_and_goes_straight_on_beyond():
    u = np.linspace(-2, 12, 141)
    effect = Curve(channel="voltage", powers=3, low=0.0, high=10.0)
    B = on_one_axis(effect, Chunk(np.arange(141.0), {"voltage": u}))
    x = (u - 5) / 5
    inside = np.abs(x) <= 1
    np.testing.assert_allclose(B[inside], np.stack([x, x**2, x**3], axis=1)[inside], atol=1e-14)
    for side in (x < -1, x > 1):
        np.testing.assert_allclose(np.diff(B[side], n=2, axis=0), 0, atol=1e-13)
    slope = np.gradient(B, x, axis=0)
    np.testing.assert_allclose(slope[-1], [1, 2, 3], rtol=1e-9)
    np.testing.assert_allclose(slope[0], [1, -2, 3], rtol=1e-9)
    assert effect.labels[:3] == ("x_c1", "x_c2", "x_c3")
    assert Curve(powers=2, above=3).terms == ("c4", "c5")
    higher = Curve(channel="voltage", powers=2, above=1, low=0.0, high=10.0)
    np.testing.assert_array_equal(on_one_axis(higher, Chunk(np.arange(141.0), {"voltage": u})), B[:, 1:])
    with pytest.raises(ValueError, match="low 50 is not below high 10; write the lower end as low"):
        Curve(low=50, high=10)


def test_curve_is_proposed_over_the_range_of_what_moves():
    rng = np.random.default_rng(9)
    chunk = Chunk(
        np.arange(50.0),
        {"temperature": np.linspace(3, 44, 50), "voltage": 5 + rng.normal(size=50), "still": np.ones(50),
         "field": rng.normal(size=(50, 3)), "residual": rng.normal(size=(50, 3))},
    )  # fmt: skip
    found = [(c.channel, c.powers, c.above) for c in Curve().proposals([chunk])]
    assert found == [("temperature", k, 0) for k in (1, 2, 3)] + [("voltage", 3, 0)]
    assert {(c.low, c.high) for c in Curve().proposals([chunk]) if c.channel == "temperature"} == {(3.0, 44.0)}


def test_a_play_is_no_wider_than_what_temperature_reverses_through():
    def widths(*temperatures):
        return [
            c.width for c in Hysteresis().proposals([at_temperature(np.arange(len(T)) * 1.0, T) for T in temperatures])
        ]

    up, rng = np.linspace(0, 40, 2001), np.random.default_rng(10)
    assert widths(up) == []
    assert widths(up + 0.05 * rng.normal(size=2001)) == []  # the thermometer's noise is no way back
    assert widths(np.round(up / 0.25) * 0.25 + 0.25 * (np.arange(2001) % 2)) == []  # nor a step to and fro
    there_and_back = np.concatenate([up, up[::-1]])
    found = widths(there_and_back)
    np.testing.assert_allclose(found, np.geomspace(0.8, 28, 12))
    partly = np.concatenate([up, np.linspace(40, 33, 300)])
    np.testing.assert_allclose(widths(up, partly), [w for w in found if w <= 7])
    late = np.concatenate([np.linspace(38, 40, 200), up[::-1]])  # dragged by 2 K before it turned: half of 4 K
    np.testing.assert_allclose(widths(late), [w for w in found if w <= 4])
    assert largest_reversal(there_and_back) == pytest.approx(40)
    assert largest_reversal(np.full(9, 3.0)) == 0


def test_turn_on_is_proposed_up_to_a_third_of_the_longest_recording():
    taus = [c.tau for c in TurnOn().proposals([Chunk(np.arange(0, 900.0)), Chunk(np.arange(0, 7201.0))])]
    assert taus[0] == pytest.approx(120)
    assert len(taus) == np.sum(np.geomspace(120, 39600, 18) <= 2400)
    assert list(TurnOn().proposals([Chunk(np.arange(0, 300.0))])) == []


def test_map_misfit_sums_to_one_and_is_constant_beyond():
    T = np.linspace(-60, 120, 700)
    effect = MapMisfit(intervals=7, low="-20 degC", high="60 degC")
    B = on_one_axis(effect, at_temperature(np.arange(700.0), T))
    assert B.shape[1] == 10
    np.testing.assert_allclose(B.sum(axis=1), 1.0, rtol=1e-12)
    assert np.all(B >= 0)
    assert np.ptp(B[T <= -20], axis=0).max() == 0
    assert np.ptp(B[T >= 60], axis=0).max() == 0
    inside = (T > -20) & (T < 60)
    cubic = np.polynomial.Polynomial([1.0, -0.3, 0.02, 1e-4])(T[inside])
    left = cubic - B[inside] @ np.linalg.lstsq(B[inside], cubic, rcond=None)[0]
    assert np.max(np.abs(left)) < 1e-9 * np.max(np.abs(cubic))  # cubic splines contain the cubics


def test_map_misfit_is_proposed_where_temperature_moved():
    warm, still = (at_temperature(np.arange(50.0), T) for T in (np.linspace(3, 44, 50), np.full(50, 20.0)))
    assert {(c.low, c.high) for c in MapMisfit().proposals([warm, still])} == {(3.0, 44.0)}
    assert list(MapMisfit().proposals([still])) == []
    with pytest.raises(ValueError, match="low 50 degC is not below high 10 degC; write the colder one as low"):
        MapMisfit(low="50 degC", high="10 degC")


def test_periodic_finds_a_line_in_noise():
    """A line with a tenth of the noise's variance, in two recordings of different lengths."""
    rng = np.random.default_rng(7)
    recordings = []
    for N in (6000, 4000):
        t = 300 + np.arange(N) * 1.0
        line = 0.45 * np.sin(2 * np.pi * t / 97.0 + rng.uniform(0, 6))
        recordings.append(Chunk(t, {"residual": line[:, None] * [1.0, 0.0, -1.0] + rng.normal(size=(N, 3))}))
    periods = [c.period for c in Periodic().proposals(recordings)]
    assert periods[0] == pytest.approx(97.0, rel=0.005)
    assert len(periods) == 3
    slow = 5 * np.sin(2 * np.pi * np.arange(6000) / 700)[:, None] * np.ones(3)  # 8.6 cycles are a drift
    drifting = [c.having(residual=c["residual"] + slow[: len(c)]) for c in recordings]
    assert min(6000 / c.period for c in Periodic().proposals(drifting)) >= 10
    silent = Chunk(np.arange(100.0), {"residual": np.zeros((100, 3))})
    assert list(Periodic().proposals([silent])) == []


def test_periodic_is_a_line_of_any_phase():
    t = 40 + np.arange(500) * 0.5
    B = on_one_axis(Periodic(period="97 s"), Chunk(t))
    c = np.array([np.cos(0.7), np.sin(0.7)]) * 3
    np.testing.assert_allclose(B @ c, 3 * np.sin(2 * np.pi * t / 97 + 0.7), atol=1e-12)


def test_periodic_has_one_phase_wherever_a_recording_begins():
    t = 1e6 + np.arange(900) * 0.5
    whole, _ = Periodic(period="97 s").signature(Chunk(t), None)
    later, _ = Periodic(period="97 s").signature(Chunk(t[300:]), None)
    np.testing.assert_array_equal(later, whole[300:])


def test_thermal_gradient_has_a_difference_and_its_rate():
    t = np.cumsum(np.random.default_rng(8).uniform(0.5, 3.0, 600))
    T = 20 + 0.01 * t
    chunk = at_temperature(t, T, temperature_case=T + 2 + 0.004 * (t - t[0]), temperature_raw=T, temperature_rate=T)
    both = on_one_axis(ThermalGradient(), chunk)
    np.testing.assert_allclose(both[:, 0], 2 + 0.004 * (t - t[0]), atol=1e-12)
    np.testing.assert_allclose(both[:, 1], 0.004 * (1 - np.exp(-(t - t[0]) / 30)), atol=1e-12)  # window 60 s
    for k, form in enumerate(("difference", "rate")):
        np.testing.assert_array_equal(on_one_axis(ThermalGradient(form=form), chunk)[:, 0], both[:, k])
        assert ThermalGradient(form=form).labels == tuple(f"{axis}_{form}" for axis in "xyz")
    proposed = list(ThermalGradient().proposals([chunk]))
    assert {c.channel for c in proposed} == {"temperature_case"}
    assert {c.form for c in proposed} == {"difference", "rate", "both"}
    for form in ("rate", "both"):
        assert [c.window for c in proposed if c.form == form] == [5, 10, 20, 40, 80, 160, 320]


def test_the_rate_of_a_difference_is_its_relaxation():
    chunk = record()
    difference = chunk["temperature_case"] - chunk["temperature"]
    rate = on_one_axis(ThermalGradient(form="rate", window="80 s"), chunk)
    late = on_one_axis(Relaxation(tau="40 s"), chunk.having(temperature=difference))
    np.testing.assert_allclose(rate, late / 40, rtol=1e-12, atol=1e-14)
