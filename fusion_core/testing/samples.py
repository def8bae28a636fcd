"""Samples to try plugins on: read-only, with nothing in them but the channels that a plugin says it reads."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from types import MappingProxyType

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import USUAL

N = 120
CUTS = ((), (1,), (60,), (7, 8, 9, 100), tuple(range(1, N)))
"""Where recordings are cut: the first is not."""


NONE: Mapping[str, int] = MappingProxyType({})


def recording(channels: Iterable[str], *, regular: bool, columns: Mapping[str, int] = NONE, seed: int = 0) -> Chunk:
    """Return N samples with the channels, some of several columns: each step 0.5 s, or anything from 0.1 s to 100 s."""
    rng = np.random.default_rng(seed)
    dt = np.full(N, 0.5) if regular else rng.choice([0.1, 0.1, 0.3, 5.0, 100.0], N)
    t = np.cumsum(dt)
    made = {name: _values(name, t, rng, columns.get(name)) for name in channels if name != "dt"}
    return _frozen(Chunk(t, {**made, "dt": dt}))


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


def _frozen(chunk: Chunk) -> Chunk:
    for values in (chunk.t, *chunk.channels.values()):
        values.setflags(write=False)
    return chunk
