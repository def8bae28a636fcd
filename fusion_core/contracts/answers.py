"""What plugins answer, checked before anyone uses it: shapes, finite numbers, covariances.

N samples or steps, n states, d axes, p coefficients. A defect of a plugin is reported by its name, and never becomes an
estimate. Each check is `check(plugin, answer, *arguments)`: it returns the answer, or raises PluginError.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.family import Check
from fusion_core.contracts.framing import Counter, Frames
from fusion_core.contracts.loss import Loss
from fusion_core.contracts.plugin import Memory, broken
from fusion_core.contracts.report_section import Section
from fusion_core.faults import Faults
from fusion_core.model import Prior, Transition

ROUNDING = 1e-9  # relative to the largest variance: less below zero is rounding
DEEPEST = 8  # containers of a memory within one another, in which arrays are looked for

Shape = tuple[int, ...]


def check_prior(model: BiasModel, prior: Prior) -> None:
    """Raise PluginError where a prior is not a mean (n,) and a covariance (n, n), or not every state has a unit."""
    n, units = len(model.labels), len(model.units("1"))
    if units != n:
        raise broken(model, f"has {units} units for {n} labels")
    expect_instance(model, "prior", prior, Prior)
    why = f"its {n} labels ask for "
    expect_array(model, "prior x", prior.x, ((n,),), why)
    expect_array(model, "prior P", prior.P, ((n, n),), why)
    expect_finite(model, "prior x", prior.x)
    _covariance(model, "prior P", prior.P)


def check_transition(model: BiasModel, step: Transition, N: int) -> None:
    """Raise PluginError where N steps are not F, Q (n, n) or (N, n, n), u (n,) or (N, n) and C (d, n) or (N, d, n)."""
    n, d = len(model.labels), len(model.axes)
    expect_instance(model, "transition", step, Transition)
    why = f"its {n} labels ask for "
    for name, array in (("F", step.F), ("Q", step.Q)):
        expect_array(model, name, array, ((n, n), (N, n, n)), why)
    expect_array(model, "u", step.u, ((n,), (N, n)), why)
    expect_finite(model, "F", step.F)
    expect_finite(model, "the drift u", step.u)
    _covariance(model, "Q", step.Q)
    if step.C is not None:
        expect_array(model, "C", step.C, ((d, n), (N, d, n)), why)
        expect_finite(model, "C", step.C)


def _a_prior(model: BiasModel, prior: Prior, *arguments: object) -> Prior:
    check_prior(model, prior)
    return prior


def _a_transition(model: BiasModel, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
    step, memory = _with_memory(model, "transition", answer)
    check_transition(model, step, len(chunk))
    return step, memory


def _names(plugin: Any, answer: Any, *arguments: object) -> tuple[str, ...]:
    if not (isinstance(answer, tuple | list) and all(isinstance(name, str) for name in answer)):
        raise broken(plugin, f"has {said_of(answer)} where a tuple of texts was expected")
    return tuple(answer)


def _labels(plugin: Any, answer: Any) -> tuple[str, ...]:
    labels = _names(plugin, answer)
    if len(set(labels)) != len(labels):
        raise broken(plugin, f"its labels {', '.join(labels)} are not all different")
    return labels


def _text(plugin: Any, answer: Any) -> str:
    if not isinstance(answer, str):
        raise broken(plugin, f"has {said_of(answer)} where a text was expected")
    return answer


def _chunks(source: Any, answer: Any, size: int, faults: Faults) -> Iterator[Chunk]:
    widths: dict[str, Shape] = {}
    for chunk in each_of(source, "chunks", answer):
        expect_instance(source, "what it yields", chunk, Chunk)
        N = len(chunk.t)
        expect_array(source, "t", chunk.t, ((N,),))
        for name, values in chunk.channels.items():
            shape = np.shape(values)
            rest = widths.setdefault(name, shape[1:]) if N else shape[1:]
            expect_array(source, f"channel '{name}'", values, ((N, *rest),))
            if len(shape) > 2:
                raise broken(source, f"channel '{name}' has shape {shape}, (N,) or (N, d) was expected")
        yield chunk


def _frames(framing: Any, answer: Any, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
    frames, memory = _with_memory(framing, "decode", answer)
    expect_instance(framing, "what it decodes", frames, Frames)
    for name, values in frames.channels.items():
        shape = np.shape(values)
        if len(shape) not in (1, 2) or shape[0] != frames.N:
            raise broken(framing, f"channel '{name}' has shape {shape} in {frames.N} frames")
        expect_array(framing, f"channel '{name}'", values, (shape,))
    if frames.count is not None:
        expect_array(framing, "count", frames.count, ((frames.N,),), kinds="iu")
    return frames, memory


def _counter(framing: Any, answer: Any) -> Counter | None:
    if answer is not None:
        expect_instance(framing, "device_counter", answer, Counter)
    return answer  # type: ignore[no-any-return]


def _signature(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
    signature, memory = _with_memory(effect, "signature", answer)
    p = len(effect.labels)
    expect_array(effect, "signature", signature, ((len(chunk), len(effect.axes), p),), f"its {p} labels ask for ")
    expect_finite(effect, "signature", signature)
    return signature, memory


def _input(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
    T, memory = _with_memory(effect, "input", answer)
    expect_array(effect, "the map's input", T, ((len(chunk),),))
    expect_finite(effect, "the map's input", T)
    return T, memory


def _fading(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array | None, Memory]:
    factor, memory = _with_memory(effect, "fading", answer)
    if factor is not None:
        expect_array(effect, "fading", factor, ((len(chunk),),))
        expect_finite(effect, "fading", factor)
    return factor, memory


def _effects(effect: Effect, answer: Any, *arguments: object) -> Iterator[Effect]:
    for candidate in each_of(effect, "candidates", answer):
        expect_instance(effect, "what it proposes", candidate, type(effect))
        yield candidate


def _loss(exporter: Any, answer: Any, *arguments: object) -> Loss:
    expect_instance(exporter, "what it says is lost", answer, Loss)
    loss: Loss = answer
    for lost in loss.sensors:
        for name, found in (("domain", lost.domain), ("warm-up", lost.warm_up), *lost.causes.items()):
            for values in (found.rms, found.largest):
                expect_array(exporter, f"the error over the {name}", values, ((len(lost.sensor.axes),),))
                expect_finite(exporter, f"the error over the {name}", values)
    return loss


def _section(plugin: Any, answer: Any, *arguments: object) -> Section | None:
    if answer is not None:
        expect_instance(plugin, "section", answer, Section)
        for value in vars(answer).values():
            _text(plugin, value)
    return answer  # type: ignore[no-any-return]


OF_BIAS_MODELS: Mapping[str, Check] = {
    "labels": _labels,
    "units": _names,
    "requires": _names,
    "prior": _a_prior,
    "prior_at": _a_prior,
    "prior_again": _a_prior,
    "transition": _a_transition,
}
OF_SOURCES: Mapping[str, Check] = {"chunks": _chunks, "name": _text}
OF_FRAMINGS: Mapping[str, Check] = {"decode": _frames, "device_counter": _counter}
OF_EFFECTS: Mapping[str, Check] = {
    "requires": _names,
    "terms": _names,
    "labels": _labels,
    "units": _names,
    "explanation": _text,
    "subject": _text,
    "candidates": _effects,
    "proposals": _effects,
    "signature": _signature,
    "input": _input,
    "fading": _fading,
}
OF_EXPORTERS: Mapping[str, Check] = {"export": _loss}
OF_REPORT_SECTIONS: Mapping[str, Check] = {"section": _section}


def said_of(value: Any) -> str:
    """Return what a value is, for a message."""
    return f"a {type(value).__name__}"


def expect_instance(plugin: Any, name: str, value: Any, expected: type) -> None:
    """Raise PluginError where a value is not of a class; `name` is what messages call it."""
    if not isinstance(value, expected):
        raise broken(plugin, f"{name} is {said_of(value)}, a {expected.__name__} was expected")


def each_of(plugin: Any, name: str, answer: Any) -> Iterable[Any]:
    """Return what can be gone through, else raise PluginError."""
    if not isinstance(answer, Iterable):
        raise broken(plugin, f"{name} is {said_of(answer)}, an iterator was expected")
    return answer


def _with_memory(plugin: Any, name: str, answer: Any) -> tuple[Any, Memory]:
    """Return what a method answers beside its memory, and the memory, whose arrays cannot be written to any more."""
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise broken(plugin, f"{name} answers {said_of(answer)}, a pair of what was asked and the memory was expected")
    _lock(answer[1], DEEPEST)
    return answer


def _lock(memory: Memory, depth: int) -> None:
    if isinstance(memory, np.ndarray):
        memory.flags.writeable = False
    elif depth and isinstance(memory, tuple | list | dict):
        for item in memory.values() if isinstance(memory, dict) else memory:
            _lock(item, depth - 1)


def expect_array(
    plugin: Any, name: str, array: Any, expected: tuple[Shape, ...], why: str = "expected ", kinds: str = "fiu"
) -> None:
    """Raise PluginError where a value is not an array of numbers with one of the shapes."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds:
        what = f"an array of {array.dtype}" if isinstance(array, np.ndarray) else said_of(array)
        raise broken(plugin, f"{name} is {what}, an array of {'whole ' if kinds == 'iu' else ''}numbers was expected")
    if array.shape not in expected:
        raise broken(plugin, f"{name} has shape {array.shape}, {why}{' or '.join(map(str, expected))}")


def expect_finite(plugin: Any, name: str, array: Array) -> None:
    """Raise PluginError where an array holds NaN or infinity."""
    if not np.isfinite(array).all():
        raise broken(plugin, f"{name} is not finite")


def _covariance(model: BiasModel, name: str, matrices: Array) -> None:
    """Raise where any of the matrices (n, n) or (N, n, n) is not symmetric with no negative eigenvalue."""
    expect_finite(model, name, matrices)
    diagonal = matrices.diagonal(axis1=-2, axis2=-1)
    scale, lowest = diagonal.max(initial=0.0), diagonal.min(initial=0.0)
    if np.count_nonzero(matrices) > np.count_nonzero(diagonal):  # where it is diagonal, its eigenvalues are known
        uneven = np.max(np.abs(matrices - np.swapaxes(matrices, -1, -2)))
        lowest = min(lowest, -uneven, np.min(np.linalg.eigvalsh(matrices)))
    if lowest < -ROUNDING * scale or (scale == 0 and lowest < 0):
        raise broken(model, f"{name} is not a covariance (symmetric, no eigenvalue below zero)")
