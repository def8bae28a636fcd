"""What an effect answers, checked: one that is broken is blamed by its name, and a loop can go on without it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import FusionError, PluginError, shown


@contextmanager
def blamed(effect: Effect, what: str) -> Iterator[None]:
    """Raise PluginError for whatever the effect raises while it is asked; errors with a message pass as they are."""
    try:
        yield
    except FusionError:
        raise
    except Exception as error:
        text = f"{what} raises {type(error).__name__}: {shown(error, 200)}"
        raise PluginError(f"{effect.kind}: {text}; this is a defect of the plugin") from error


def proposals(effect: Effect, recordings: Sequence[Chunk]) -> list[Effect]:
    """Return what an effect proposes for these recordings; raises PluginError where it is broken."""
    with blamed(effect, "proposals"):
        return list(effect.proposals(recordings))


def signature(effect: Effect, chunk: Chunk) -> Array:
    """Return the regressors (N, d, p) over a recording; raises PluginError where the effect is broken."""
    with blamed(effect, "signature"):
        found, _ = effect.signature(chunk, None)
        p = np.shape(found)[-1] if np.ndim(found) else 0
    return _checked(effect, "signature", found, (len(chunk), len(effect.axes), p))


def map_input(effect: Effect, chunk: Chunk) -> Array:
    """Return the temperature (N,) that the map sees; raises PluginError where the effect is broken."""
    with blamed(effect, "input"):
        found, _ = effect.input(chunk, None)
    return _checked(effect, "input", found, (len(chunk),))


def fading(effect: Effect, chunk: Chunk) -> Array | None:
    """Return the factors (N,) by which an unknown start fades, None where there is none; raises PluginError."""
    with blamed(effect, "fading"):
        found, _ = effect.fading(chunk, None)
    return None if found is None else _checked(effect, "fading", found, (len(chunk),))


def _checked(effect: Effect, what: str, values: object, expected: tuple[int, ...]) -> Array:
    """Return an answer as an array; raises PluginError where it is of another shape or not finite."""
    with blamed(effect, what):
        array = np.asarray(values, dtype=np.float64)
    if array.shape != expected:
        raise PluginError(
            f"{effect.kind}: {what} has shape {array.shape}, {expected} was expected; this is a defect of the plugin"
        )
    if not np.all(np.isfinite(array)):
        raise PluginError(f"{effect.kind}: {what} is not finite; this is a defect of the plugin")
    return array
