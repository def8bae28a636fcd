"""Each installed effect beside the laws, and what came before a recording."""

import re
from itertools import pairwise

import numpy as np
import pytest
from effect_recordings import at_temperature, record
from hypothesis import given, settings
from hypothesis import strategies as st

from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.contracts.effect import TEMPERATURE, Behind
from fusion_core.host.registry import registry
from fusion_core.testing.effects import what_it_is_made_of_is_the_signature
from fusion_plugins.effects.channel import Channel
from fusion_plugins.effects.curve import Curve
from fusion_plugins.effects.drift import Drift
from fusion_plugins.effects.g_sensitivity import GSensitivity
from fusion_plugins.effects.hysteresis import Hysteresis
from fusion_plugins.effects.interaction import Interaction
from fusion_plugins.effects.map_misfit import MapMisfit
from fusion_plugins.effects.periodic import Periodic
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
@settings(max_examples=20)
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
    """A found effect is read with what it is written with."""
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


@pytest.mark.parametrize(
    "effect",
    [
        Channel(channel="field", columns=3),
        Curve(powers=3, above=2, low=17.0, high=22.0),  # its tangents are seen at both ends
        Curve(channel="voltage", powers=2, low=-0.5, high=0.5),
        Relaxation(form="late", channel="voltage"),
        ThermalGradient(form="difference"),
        ThermalGradient(form="rate"),
        MapMisfit(low=18.0, high=21.0, intervals=3),
        Interaction(channels=("voltage", "voltage"), zero=(0.2, 0.2)),
    ],
    ids=repr,
)
def test_forms_beside_the_defaults_are_made_of_what_they_say(effect):
    what_it_is_made_of_is_the_signature(effect, field=np.random.default_rng(2).normal(size=(120, 3)))


def test_a_realisation_of_another_lag_is_found_out():
    class Wrong(Relaxation):
        def realisation(self):
            return (Behind(TEMPERATURE, 2 * float(self.tau)),)

    with pytest.raises(AssertionError):
        what_it_is_made_of_is_the_signature(Wrong())
