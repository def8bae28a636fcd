"""The laws of effects. N samples, d axes, p coefficients."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts import effect as made_of
from fusion_core.contracts.effect import TEMPERATURE, Domain
from fusion_core.testing import samples
from fusion_core.testing.samples import check_any_split, check_memory, recording

Method = Callable[[Chunk, Memory], tuple[Array | None, Memory]]


def shapes_fit_together(effect: Effect) -> None:
    """The signature is (N, d, p), with a label and a unit for each coefficient; on one sample and one axis too."""
    for variant in (effect, effect.model_copy(update={"axes": ("r",)})):
        for regular in (True, False):
            chunk = _recording(variant, regular=regular)
            for part in (chunk, chunk.part(0, 1)):
                signature, _ = variant.signature(part, None)
                shape = (len(part), len(variant.axes), len(variant.labels))
                assert signature.shape == shape, f"the signature has shape {signature.shape}, {shape} was expected"
                assert np.all(np.isfinite(signature)), "the signature is not finite"
        assert len(set(variant.labels)) == len(variant.labels) == len(variant.units), (
            "labels differ, with a unit for each"
        )


def any_split_gives_the_same(effect: Effect) -> None:
    """Cut anywhere, signature, input and fading are the same."""
    for name, method in _methods(effect).items():
        for regular in (True, False):
            check_any_split(_under(name, method), _recording(effect, regular=regular))


def the_memory_that_came_in_is_not_changed(effect: Effect) -> None:
    """The memory is a value: after the next chunk it is what it was."""
    for name, method in _methods(effect).items():
        check_memory(name, method, _recording(effect, regular=False))


def what_it_began_at_fades(effect: Effect) -> None:
    """The factors of `fading` are from 0 to 1, and 1 at the first sample of a recording."""
    if effect.fades:
        factors, _ = effect.fading(_recording(effect, regular=False), None)
        assert factors is not None and factors.ndim == 1, "fading gives no factors (N,)"  # noqa: PT018
        assert factors[0] == 1, f"the first factor is {factors[0]}, 1 was expected"
        assert np.all((factors >= 0) & (factors <= 1)), "factors are not from 0 to 1"


def the_search_can_begin_and_go_on(effect: Effect) -> None:
    """The class needs no argument but axes; candidates and proposals are of it, and can be written to a config."""
    cls = type(effect)
    bare = cls.model_validate({"kind": effect.kind, "axes": list(effect.axes)})
    chunk = recording(
        {*_channels(effect), *_channels(bare), "temperature"}, regular=True, columns=effect.channel_columns
    )
    chunk = chunk.having(residual=np.random.default_rng(1).normal(size=(len(chunk), len(effect.axes))))
    grid = list(bare.candidates())
    assert grid, "candidates() yields nothing"
    for candidate in (*grid, *bare.proposals([chunk, chunk])):
        assert isinstance(candidate, cls), f"{candidate!r} is proposed, a {cls.__name__} was expected"
        assert cls.model_validate(candidate.model_dump()) == candidate, f"{candidate!r} is written as other settings"
        assert candidate.axes == effect.axes, f"{candidate!r} has other axes"
    for name, factor in cls.continuous.items():
        assert bare.hyper_parameters.get(name, 0) > 0, f"continuous names {name}, which is not positive"
        assert factor > 1, f"continuous: the factor of {name} is {factor}, more than 1 was expected"


def says_what_it_is_about(effect: Effect) -> None:
    """`explanation` is a sentence, and `requires` names channels."""
    assert len(effect.explanation.split()) > 4, "explanation is no sentence"
    assert all(isinstance(name, str) and name for name in effect.requires), "requires are no names"


def what_it_is_made_of_is_the_signature(effect: Effect, **channels: Array) -> None:
    """Regressors and map input, evaluated from the signals that the effect names, are those of its methods."""
    chunk = _recording(effect, regular=False).having(**channels)
    d = len(effect.axes)
    for variant in (effect, _within_half(effect, chunk)):
        signals = variant.realised
        if signals is None:
            break
        assert len(signals) == len(effect.terms), f"{len(signals)} signals, one for each of {effect.terms} was expected"
        made = [_evaluated(signal, chunk) for signal in signals]
        terms = np.stack(made, axis=1) if made else np.zeros((len(chunk), 0))
        signature, _ = variant.held(chunk, None)
        scale = 1 + np.max(np.abs(signature), initial=0.0)
        np.testing.assert_allclose(on_each_axis(terms, d) / scale, signature / scale, rtol=0, atol=1e-6)
    at_map = effect.realised_input(TEMPERATURE)
    if effect.acts_on_input and at_map is not None:
        np.testing.assert_allclose(_evaluated(at_map, chunk), effect.input(chunk, None)[0], rtol=1e-9)


def it_holds_beyond_its_domain(effect: Effect) -> None:
    """Cut anywhere, it holds alike; what it holds at is what it was fitted on."""
    chunk = _recording(effect, regular=False)
    limited = _within_half(effect, chunk)
    assert type(limited).model_validate(limited.model_dump(mode="json")) == limited, (
        "a domain is written as another one"
    )
    check_any_split(_under("held", limited.held), chunk)
    whole, _ = limited.held(chunk, None)
    if limited.regressors:
        low, high = np.asarray(limited.regressors).T
        assert np.all((whole == 0) | ((whole >= low) & (whole <= high))), "a regressor is beyond its ends"
    else:
        inside = {name: np.clip(chunk[name], *limited.ends(name).T) for name in limited.domain or {}}
        np.testing.assert_array_equal(effect.signature(chunk.having(**inside), None)[0], whole)


def _within_half(effect: Effect, chunk: Chunk) -> Effect:
    """Return an effect that was fitted on the middle half of what a recording shows, of regressors if it remembers."""
    domain = Domain()
    for name in effect.requires:
        low, high = np.quantile(chunk[name].reshape(len(chunk), -1), [0.25, 0.75], axis=0)
        pairs = tuple(zip(map(float, low), map(float, high), strict=True))
        domain[name] = pairs[0] if len(pairs) == 1 else pairs
    signature, memory = effect.signature(chunk, None)
    regressors = None
    if memory is not None and effect.requires:
        d, p = signature.shape[1:]
        axis = np.arange(p) // max(p // d, 1) % d
        low, high = np.quantile(signature[:, axis, np.arange(p)], [0.25, 0.75], axis=0)
        regressors = tuple(zip(map(float, low), map(float, high), strict=True))
    return effect.model_copy(update={"domain": domain, "regressors": regressors})


def _recording(effect: Effect, *, regular: bool) -> Chunk:
    return recording(_channels(effect), regular=regular, columns=effect.channel_columns)


def _channels(effect: Effect) -> set[str]:
    return {*effect.requires, "temperature"} if effect.acts_on_input else set(effect.requires)


def _methods(effect: Effect) -> dict[str, Method]:
    methods: dict[str, Method] = {"signature": effect.signature}
    methods |= {"input": effect.input} if effect.acts_on_input else {}
    return methods | ({"fading": effect.fading} if effect.fades else {})


def _under(name: str, method: Method) -> samples.Method:
    """Return a method whose array has a name."""

    def named(chunk: Chunk, memory: Memory) -> tuple[dict[str, Array], Memory]:
        values, memory = method(chunk, memory)
        return {name: np.asarray(values, dtype=np.float64)}, memory

    return named


def _evaluated(signal: made_of.Signal, chunk: Chunk) -> Array:
    """Return a signal (N,) over a recording, memories begun in equilibrium at its first sample."""
    from fusion_core.recursions import lag, play

    match signal:
        case made_of.Reading():
            return np.asarray(chunk[signal.channel].reshape(len(chunk), -1)[:, signal.column])
        case made_of.Elapsed():
            return np.asarray(chunk.t - chunk.t[0])
        case made_of.Fading():
            return np.asarray(np.exp(-(chunk.t - chunk.t[0]) / signal.tau))
        case made_of.Behind():
            u = np.ascontiguousarray(_evaluated(signal.of, chunk))
            dt = np.ascontiguousarray(np.broadcast_to(chunk.dt, u.shape))
            return np.asarray(u - lag(dt, u, signal.tau, u[0], u[0]))
        case made_of.PlayState():
            u = _evaluated(signal.of, chunk)
            return np.asarray(play(u, signal.width, u[0]) - u)
        case made_of.Weighted():
            return np.asarray(sum(w * _evaluated(part, chunk) for w, part in signal.terms) + signal.offset)
        case made_of.Product():
            return np.asarray(_evaluated(signal.a, chunk) * _evaluated(signal.b, chunk))
        case made_of.Limited():
            return np.clip(_evaluated(signal.of, chunk), signal.low, signal.high)
        case made_of.Function():
            return signal.at(_evaluated(signal.of, chunk))
