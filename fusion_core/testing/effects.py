"""The laws of effects. N samples, d axes, p coefficients."""

from __future__ import annotations

import pickle
from collections.abc import Callable

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect, Memory, on_each_axis
from fusion_core.contracts.effect import TEMPERATURE, Domain
from fusion_core.testing.realisations import evaluate
from fusion_core.testing.samples import CUTS, pieces, recording

Method = Callable[[Chunk, Memory], tuple[Array | None, Memory]]


def shapes_fit_together(effect: Effect) -> None:
    """The signature is (N, d, p), with a label and a unit for each coefficient; on one sample and one axis too."""
    for own in (effect, effect.model_copy(update={"axes": ("r",)})):
        for regular in (True, False):
            chunk = _recording(own, regular=regular)
            for part in (chunk, chunk.part(0, 1)):
                found, _ = own.signature(part, None)
                shape = (len(part), len(own.axes), len(own.labels))
                assert found.shape == shape, f"the signature has shape {found.shape}, {shape} was expected"
                assert np.all(np.isfinite(found)), "the signature is not finite"
        assert len(set(own.labels)) == len(own.labels) == len(own.units), "labels differ, with a unit for each"


def any_split_gives_the_same(effect: Effect) -> None:
    """Cut anywhere, signature, input and fading are the same."""
    for name, method in _methods(effect).items():
        for regular in (True, False):
            chunk = _recording(effect, regular=regular)
            whole = _joined(method, chunk, ())
            for cuts in CUTS[1:]:
                other = _joined(method, chunk, cuts)
                np.testing.assert_allclose(other, whole, rtol=1e-12, atol=1e-300, err_msg=f"{name}, cut at {cuts[:5]}")


def memory_that_came_in_is_not_changed(effect: Effect) -> None:
    """The memory is a value: after the next chunk it is what it was."""
    for name, method in _methods(effect).items():
        first, second = pieces(_recording(effect, regular=False), (50,))
        _, memory = method(first, None)
        before = pickle.dumps(memory)
        method(second, memory)
        assert pickle.dumps(memory) == before, f"{name} changes the memory that it is given; return a new one"


def what_it_began_at_fades(effect: Effect) -> None:
    """The factors of `fading` are from 0 to 1, and 1 at the first sample of a recording."""
    if effect.fades:
        factors, _ = effect.fading(_recording(effect, regular=False), None)
        assert factors is not None and factors.ndim == 1, "fading gives no factors (N,)"  # noqa: PT018
        assert factors[0] == 1, f"the first factor is {factors[0]}, 1 was expected"
        assert np.all((factors >= 0) & (factors <= 1)), "factors are not from 0 to 1"


def search_can_begin_and_go_on(effect: Effect) -> None:
    """The class needs no argument but axes; candidates and proposals are of it, and can be written to a config."""
    cls = type(effect)
    bare = cls.model_validate({"kind": effect.kind, "axes": list(effect.axes)})
    chunk = recording(
        {*_channels(effect), *_channels(bare), "temperature"}, regular=True, columns=effect.channel_columns
    )
    chunk = chunk.having(residual=np.random.default_rng(1).normal(size=(len(chunk), len(effect.axes))))
    grid = list(bare.candidates())
    assert grid, "candidates() yields nothing"
    for found in (*grid, *bare.proposals([chunk, chunk])):
        assert isinstance(found, cls), f"{found!r} is proposed, a {cls.__name__} was expected"
        assert cls.model_validate(found.model_dump()) == found, f"{found!r} is written as other settings"
        assert found.axes == effect.axes, f"{found!r} has other axes"
    for name, factor in cls.continuous.items():
        assert bare.hyper_parameters.get(name, 0) > 0, f"continuous names {name}, which is not positive"
        assert factor > 1, f"continuous: the factor of {name} is {factor}, more than 1 was expected"


def says_what_it_is_about(effect: Effect) -> None:
    """`explanation` is a sentence, and `requires` names channels."""
    assert len(effect.explanation.split()) > 4, "explanation is no sentence"
    assert all(isinstance(name, str) and name for name in effect.requires), "requires are no names"


def realisation_is_the_signature(effect: Effect, **channels: Array) -> None:
    """What the effect says that its regressors, and the map's input, are made of is what they are."""
    chunk = _recording(effect, regular=False).having(**channels)
    d = len(effect.axes)
    for own in (effect, _within_half(effect, chunk)):
        signals = own.realised
        if signals is None:
            break
        assert len(signals) == len(effect.terms), f"{len(signals)} signals, one for each of {effect.terms} was expected"
        made = [evaluate(signal, chunk) for signal in signals]
        terms = np.stack(made, axis=1) if made else np.zeros((len(chunk), 0))
        found, _ = own.held(chunk, None)
        scale = 1 + np.max(np.abs(found), initial=0.0)
        np.testing.assert_allclose(on_each_axis(terms, d) / scale, found / scale, rtol=0, atol=1e-6)
    seen = effect.realised_input(TEMPERATURE)
    if effect.acts_on_input and seen is not None:
        np.testing.assert_allclose(evaluate(seen, chunk), effect.input(chunk, None)[0], rtol=1e-9)


def it_holds_beyond_its_domain(effect: Effect) -> None:
    """Cut anywhere, it holds alike; what it holds at is what it was fitted on."""
    chunk = _recording(effect, regular=False)
    own = _within_half(effect, chunk)
    assert type(own).model_validate(own.model_dump(mode="json")) == own, "a domain is written as another one"
    whole = _joined(own.held, chunk, ())
    for cuts in CUTS[1:]:
        np.testing.assert_allclose(_joined(own.held, chunk, cuts), whole, rtol=1e-12, atol=1e-300)
    if own.regressors:
        low, high = np.asarray(own.regressors).T
        assert np.all((whole == 0) | ((whole >= low) & (whole <= high))), "a regressor is beyond its ends"
    else:
        inside = {name: np.clip(chunk[name], *_ends_of(own, name, chunk)) for name in own.domain or {}}
        np.testing.assert_array_equal(effect.signature(chunk.having(**inside), None)[0], whole)


def _ends_of(effect: Effect, name: str, chunk: Chunk) -> tuple[Array, Array]:
    low, high = effect.ends(name).T
    return (low, high) if chunk[name].ndim > 1 else (low[0], high[0])


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
        own = np.arange(p) // max(p // d, 1) % d
        low, high = np.quantile(signature[:, own, np.arange(p)], [0.25, 0.75], axis=0)
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


def _joined(method: Method, chunk: Chunk, cuts: tuple[int, ...]) -> Array:
    memory, parts = None, []
    for piece in pieces(chunk, cuts):
        found, memory = method(piece, memory)
        parts.append(np.asarray(found, dtype=np.float64))
    return np.concatenate(parts)


LAWS = {
    "shapes fit together": shapes_fit_together,
    "any split gives the same": any_split_gives_the_same,
    "the memory that came in is not changed": memory_that_came_in_is_not_changed,
    "what it began at fades": what_it_began_at_fades,
    "the search can begin and go on": search_can_begin_and_go_on,
    "says what it is about": says_what_it_is_about,
    "it holds beyond its domain": it_holds_beyond_its_domain,
    "what it is made of is the signature": realisation_is_the_signature,
}
