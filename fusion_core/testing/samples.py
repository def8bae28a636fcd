"""Machinery of the laws: samples to try plugins on, checks that several families share, and the laws of every plugin.

Samples are read-only, with nothing in them but the channels that a plugin says it reads.
"""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable, Iterable, Iterator, Mapping
from types import MappingProxyType
from typing import Any

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import USUAL, Memory, Plugin

N = 120
CUTS = ((), (1,), (60,), (7, 8, 9, 100), tuple(range(1, N)))
"""Rows at which recordings are cut; the first is not cut."""

NONE: Mapping[str, int] = MappingProxyType({})
Method = Callable[[Chunk, Memory], tuple[Mapping[str, Array], Memory]]


def recording(channels: Iterable[str], *, regular: bool, columns: Mapping[str, int] = NONE, seed: int = 0) -> Chunk:
    """Return N samples with the channels, some of several columns: each step 0.5 s, or anything from 0.1 s to 100 s."""
    rng = np.random.default_rng(seed)
    dt = np.full(N, 0.5) if regular else rng.choice([0.1, 0.1, 0.3, 5.0, 100.0], N)
    t = np.cumsum(dt)
    made = {name: _values(name, t, rng, columns.get(name)) for name in channels if name != "dt"}
    return Chunk(t, {**made, "dt": dt})


def pieces(chunk: Chunk, cuts: tuple[int, ...]) -> Iterator[Chunk]:
    """Yield the chunk cut into pieces, each with the sample before it."""
    for start, stop in zip((0, *cuts), (*cuts, len(chunk)), strict=True):
        yield chunk.part(start, stop)


def _values(name: str, t: Array, rng: np.random.Generator, columns: int | None) -> Array:
    """Return a channel (N,), or (N, d) of a triad or as it is declared; temperatures move between 15 and 25 degC."""
    if columns is not None:
        return rng.normal(size=(len(t), columns))
    T: Array = 20 + 4 * np.sin(t / t[-1] * 9) + np.cumsum(rng.normal(size=len(t))) * 0.02
    if name.endswith("_rate"):
        return np.asarray(np.gradient(T, t))
    if name.startswith("temperature"):
        return T
    axes = USUAL[name].axes if name in USUAL else 1
    return rng.normal(size=(len(t), axes)) if axes and axes > 1 else rng.normal(size=len(t))


def joined(method: Method, chunk: Chunk, cuts: tuple[int, ...]) -> dict[str, Array]:
    """Return the arrays that a method gives over a recording cut into pieces, its memory passed on."""
    memory, parts = None, []
    for piece in pieces(chunk, cuts):
        arrays, memory = method(piece, memory)
        parts.append(arrays)
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def check_any_split(method: Method, chunk: Chunk, ways: Iterable[tuple[int, ...]] = CUTS[1:]) -> None:
    """Raise AssertionError where a method gives other arrays once the recording is cut."""
    whole = joined(method, chunk, ())
    for cuts in ways:
        for name, values in joined(method, chunk, cuts).items():
            message = f"{name}, cut at {cuts[:5]}"
            np.testing.assert_allclose(values, whole[name], rtol=1e-12, atol=1e-300, err_msg=message)


def check_memory(name: str, method: Callable[[Chunk, Memory], Any], chunk: Chunk, start: Memory = None) -> None:
    """Raise AssertionError where a method changes the memory, which it returns last, that it is given."""
    first, second = pieces(chunk, (50,))
    *_, memory = method(first, start)
    before = pickle.dumps(memory)
    method(second, memory)
    assert pickle.dumps(memory) == before, f"{name} changes the memory that it is given; return a new one"


def check_refused(error: type[Exception], text: str, action: Callable[..., Any], *arguments: Any) -> None:
    """Raise AssertionError with a text where an action does not raise an error."""
    try:
        action(*arguments)
    except error:
        return
    raise AssertionError(text)


def settings_can_be_written_and_read_again(plugin: Plugin) -> None:
    """`model_validate(model_dump())` gives the same plugin, also through JSON."""
    cls = type(plugin)
    assert cls.model_validate(plugin.model_dump()) == plugin, "model_dump() is read as other settings"
    again = cls.model_validate(json.loads(plugin.model_dump_json()))
    assert again == plugin, "model_dump_json() is read as other settings"


def says_what_it_is(plugin: Plugin) -> None:
    """The class has a docstring, and `kind` a default."""
    assert type(plugin).__doc__, "the class has no docstring; say in a sentence what it is"
    assert type(plugin).model_fields["kind"].default == plugin.kind, "kind has no default; write it beside its type"
