"""What plugins answer, checked before anyone uses it: shapes, finite numbers, covariances.

N samples or steps, n states, m measured components, d axes, p coefficients, K blocks, G points of a grid. A defect of a
plugin is reported by its name, and never becomes an estimate. Each check is `check(plugin, answer, *arguments)`: it
returns the answer, or raises PluginError.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.exporter import Loss, ReadBack
from fusion_core.contracts.framing import Counter, Frames
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.plugin import Check, Memory, broken, built_in
from fusion_core.contracts.report_section import Section
from fusion_core.contracts.sensor import Alignment, Detector, Patience, Sensor
from fusion_core.contracts.source import Source
from fusion_core.contracts.thermal_map import Basis, ThermalMap
from fusion_core.faults import Faults
from fusion_core.model import Measurement, Prior, Transition
from fusion_core.statespace import Block
from fusion_core.thermal.curve_uncertainty import Smoother
from fusion_core.thermal.fitted_map import FittedMap, MapRecord
from fusion_core.thermal.soak_noise import Blocks

ROUNDING = 1e-9  # relative to the largest variance: less below zero is rounding
DEEPEST = 8  # containers of a memory within one another, in which arrays are looked for
LOOKED_AT = 8  # of N matrices, spread evenly, whose eigenvalues are computed; the others by finiteness and variances
KINDS = {"fiu": "numbers", "iu": "whole numbers", "b": "true or false"}

Shape = tuple[int, ...]


def check_prior(model: BiasModel | MeasurementModel, prior: Prior) -> None:
    """Raise PluginError where a prior is not a mean (n,) and a covariance (n, n), or not every state has a unit."""
    units = model.units("1") if isinstance(model, BiasModel) else model.units
    n, what = len(model.labels), "labels" if isinstance(model, BiasModel) else "states"
    if len(units) != n:
        raise broken(model, f"has {len(units)} units for {n} labels")
    expect_instance(model, "prior", prior, Prior)
    why = f"its {n} {what} ask for "
    expect_array(model, "prior x", prior.x, ((n,),), why)
    expect_array(model, "prior P", prior.P, ((n, n),), why)
    _covariance(model, "prior P", prior.P)


def check_transition(model: BiasModel, step: Transition, N: int) -> None:
    """Raise PluginError where N steps are not F, Q (n, n) or (N, n, n), u (n,) or (N, n) and C (d, n) or (N, d, n)."""
    n, d = len(model.labels), len(model.axes)
    _steps(model, step, N, n, d, f"its {n} labels ask for ")
    if step.C is None and n != d:
        raise broken(model, f"has {n} labels for {d} axes and no C; a C ({d}, {n}) says how the bias follows")


def _steps(model: BiasModel | MeasurementModel, step: Transition, N: int, n: int, d: int, why: str) -> None:
    expect_instance(model, "transition", step, Transition)
    for name, array in (("F", step.F), ("Q", step.Q)):
        expect_array(model, name, array, ((n, n), (N, n, n)), why)
    expect_array(model, "u", step.u, ((n,), (N, n)), why, finite=False)
    expect_finite(model, "the drift u", step.u)
    _covariance(model, "Q", step.Q)
    if step.C is not None:
        expect_array(model, "C", step.C, ((d, n), (N, d, n)), why)


def _prior(model: BiasModel | MeasurementModel, prior: Prior, *arguments: object) -> Prior:
    check_prior(model, prior)
    return prior


def _transition(model: BiasModel, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Transition, Memory]:
    step, memory = _with_memory(model, "transition", answer)
    check_transition(model, step, len(chunk))
    return step, memory


def _sensors(model: MeasurementModel, answer: Any) -> tuple[Sensor, ...]:
    sensors: tuple[Sensor, ...] = several("sensors", Sensor, least=1)(model, answer)
    for sensor in sensors:
        expect_instance(model, f"the bias of its sensor {sensor.channel}", sensor.bias, BiasModel)
        expect_array(model, f"the noise of its sensor {sensor.channel}", sensor.noise, ((len(sensor.axes),),))
    if len({sensor.channel for sensor in sensors}) < len(sensors):
        raise broken(model, "two of its sensors are of one channel, each of its own was expected")
    return sensors


def _components(model: MeasurementModel, answer: Any) -> list[tuple[str, str, str]]:
    components = list(each_of(model, "components", answer))
    for component in components:
        if len(_names(model, component)) != 3:
            raise broken(model, f"a component is {component}, channel, axis and unit were expected")
    return components


def _equations(
    model: MeasurementModel, answer: Any, chunk: Chunk, steps: object, alignment: Alignment
) -> tuple[Transition, Measurement]:
    if built_in(model):  # held by its laws, and its bias blocks are checked; uneven epochs ask a few hundred at a time
        return answer  # type: ignore[no-any-return]
    step, measured = _pair(model, "equations", answer, "the steps and the measurement")
    N, n, m = len(chunk), model.n, model.m
    _steps(model, step, N, n, len(model.tracked.axes), f"its {n} states ask for ")
    expect_instance(model, "the measurement", measured, Measurement)
    why = f"its {n} states, {m} components and {N} epochs ask for "
    expect_array(model, "z", measured.z, ((N, m),), why, finite=False)
    expect_array(model, "H", measured.H, ((m, n), (N, m, n)), why, finite=False)
    expect_array(model, "R", measured.R, ((m, m), (N, m, m)), why, finite=False)
    expect_array(model, "used", measured.used, ((N,), (N, m)), why, kinds="b")
    used, z, H, R = measured.used, measured.z, measured.H, measured.R
    if not used.all():  # what is not used is not looked at
        whole = used if used.ndim == 1 else used.all(axis=1)
        z, H, R = z[used], H if H.ndim == 2 else H[used], R if R.ndim == 2 else R[whole]
    expect_finite(model, "z", z)
    expect_finite(model, "H", H)
    _covariance(model, "R", R)
    if not np.min(R.diagonal(axis1=-2, axis2=-1), initial=np.inf) > 0:
        raise broken(model, "R has a variance of zero; leave a component that is not measured out by used")
    return step, measured


def _white(model: MeasurementModel, answer: Any, chunk: Chunk) -> Array:
    n = model.n
    expect_array(model, "white", answer, ((n, n), (len(chunk), n, n)), f"its {n} states ask for ")
    _covariance(model, "white", answer)
    return np.asarray(answer)


def _known(model: MeasurementModel, answer: Any, chunk: Chunk, *arguments: object) -> Array:
    d = len(model.tracked.axes)
    expect_array(model, "known", answer, ((d,), (len(chunk), d)), f"the {d} axes of its tracked sensor ask for ")
    return np.asarray(answer)


def _aligned(model: MeasurementModel, answer: Any, *arguments: object) -> Alignment:
    expect_instance(model, "aligned", answer, Alignment)
    axes = {sensor.channel: len(sensor.axes) for sensor in model.sensors}
    missing = sorted(axes.keys() - answer.inputs.keys())
    if missing:
        raise broken(model, f"the alignment has no input of {', '.join(missing)}")
    for name in ("inputs", "noise_ratio", "levels"):
        for channel, values in getattr(answer, name).items():
            d = axes.get(channel, np.size(values))
            expect_array(model, f"{name} of {channel} in the alignment", values, ((d,),))
    expect_array(model, "unsure in the alignment", answer.unsure, ((axes[model.tracked.channel],),))
    return answer  # type: ignore[no-any-return]


def _length(model: MeasurementModel, answer: Any, *arguments: object) -> tuple[float, float] | None:
    if answer is not None and not (np.shape(answer) == (2,) and np.all(np.isfinite(answer))):
        raise broken(model, f"length_of_input is {answer!r}, a length and its deviation, or None, were expected")
    return answer  # type: ignore[no-any-return]


def _true_or_false(model: MeasurementModel, answer: Any, *arguments: object) -> bool:
    if not isinstance(answer, bool | np.bool_):
        raise broken(model, f"still answers {said_of(answer)}, true or false was expected")
    return bool(answer)


def _simulated(model: MeasurementModel, answer: Any, N: int, *arguments: object) -> Mapping[str, Array]:
    expect_instance(model, "simulated", answer, Mapping)
    for sensor in model.sensors:
        shapes = ((N, len(sensor.axes)),)
        expect_array(model, f"the simulated channel '{sensor.channel}'", answer.get(sensor.channel), shapes)
    return answer  # type: ignore[no-any-return]


def _look(detector: Detector, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Any, Any, Memory]:
    if not (isinstance(answer, tuple) and len(answer) == 3):
        raise broken(detector, f"look answers {said_of(answer)}, three were expected: still, standing out, memory")
    N, D = len(chunk), len(detector.axes)
    expect_array(detector, "still of its detector", answer[0], ((N,),), kinds="b")
    expect_array(detector, "what stands out of its detector", answer[1], ((N, D),), kinds="b")
    _lock(answer[2], DEEPEST)
    return answer


def instance(name: str, expected: type | None = None, *, optional: bool = False) -> Check:
    """Return the check of an answer of a class, by default the plugin's own; with `optional`, None will do too."""

    def check(plugin: Any, answer: Any, *arguments: object, **named: object) -> Any:
        if not (optional and answer is None):
            expect_instance(plugin, name, answer, expected or type(plugin))
        return answer

    return check


def several(name: str, expected: type | None = None, least: int = 0) -> Check:
    """Return the check of an answer of at least so many of a class, by default the plugin's own."""

    def check(plugin: Any, answer: Any, *arguments: object, **named: object) -> tuple[Any, ...]:
        items = tuple(each_of(plugin, name, answer))
        for item in items:
            expect_instance(plugin, f"one of {name}", item, expected or type(plugin))
        if len(items) < least:
            raise broken(plugin, f"{name} is empty, at least {least} was expected")
        return items

    return check


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
        expect_array(source, "t", chunk.t, ((N,),), finite=False)
        for name, values in chunk.channels.items():
            shape = np.shape(values)
            rest = widths.setdefault(name, shape[1:]) if N else shape[1:]
            expect_array(source, f"channel '{name}'", values, ((N, *rest),), finite=False)
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
        expect_array(framing, f"channel '{name}'", values, (shape,), finite=False)
    if frames.count is not None:
        expect_array(framing, "count", frames.count, ((frames.N,),), kinds="iu")
    return frames, memory


def _signature(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
    signature, memory = _with_memory(effect, "signature", answer)
    p = len(effect.labels)
    expect_array(effect, "signature", signature, ((len(chunk), len(effect.axes), p),), f"its {p} labels ask for ")
    return signature, memory


def _input(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array, Memory]:
    T, memory = _with_memory(effect, "input", answer)
    expect_array(effect, "the map's input", T, ((len(chunk),),))
    return T, memory


def _fading(effect: Effect, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Array | None, Memory]:
    factor, memory = _with_memory(effect, "fading", answer)
    if factor is not None:
        expect_array(effect, "fading", factor, ((len(chunk),),))
    return factor, memory


def _effects(effect: Effect, answer: Any, *arguments: object) -> Iterator[Effect]:
    for candidate in each_of(effect, "candidates", answer):
        expect_instance(effect, "what it proposes", candidate, type(effect))
        yield candidate


def _loss(exporter: Any, answer: Any, *arguments: object) -> Loss:
    expect_instance(exporter, "what it says is lost", answer, Loss)
    for lost in answer.sensors:
        for name, found in (("domain", lost.domain), ("warm-up", lost.warm_up), *lost.causes.items()):
            for values in (found.rms, found.largest):
                expect_array(exporter, f"the error over the {name}", values, ((len(lost.sensor.axes),),))
    return answer  # type: ignore[no-any-return]


def _section(plugin: Any, answer: Any, *arguments: object) -> Section | None:
    if answer is not None:
        expect_instance(plugin, "section", answer, Section)
        for value in vars(answer).values():
            _text(plugin, value)
    return answer  # type: ignore[no-any-return]


def _fitted(settings: ThermalMap, answer: Any, *arguments: object) -> FittedMap:
    expect_instance(settings, "the fitted map", answer, FittedMap)
    expect_instance(settings, "the record of the fitted map", answer.record, MapRecord)
    return answer  # type: ignore[no-any-return]


def _basis(settings: ThermalMap, answer: Any, domain: tuple[float, float]) -> Basis:
    """Check the curves where they are made; what they give afterwards, whenever they are evaluated."""
    expect_instance(settings, "basis", answer, Basis)
    q = np.shape(answer.penalty)[0] if np.ndim(answer.penalty) else 0
    expect_array(settings, "the basis' penalty", answer.penalty, ((q, q),))

    def values(T: Array) -> Array:
        found = answer.values(T)
        expect_array(settings, "values of the basis", found, ((len(T), q),))
        return np.asarray(found)

    return Basis(values, answer.penalty)


def _smoother(settings: ThermalMap, answer: Any, T: Array, bias: Array) -> Smoother:
    if not callable(answer):
        raise broken(settings, f"its smoother is {said_of(answer)}, a function was expected")

    def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
        found = answer(blocks, grid, axis)
        expect_array(settings, "its answer to noise", found, ((len(grid), len(blocks.T)),))
        return np.asarray(found)

    return smoother


def _curve(fitted: FittedMap, answer: Any, T: Array, *arguments: object) -> Array:
    expect_array(fitted, "its curve", answer, ((len(T), fitted.record.d),))
    return np.asarray(answer)


OF_BIAS_MODELS: Mapping[str, Check] = {
    "labels": _labels,
    "units": _names,
    "requires": _names,
    "prior": _prior,
    "prior_at": _prior,
    "prior_again": _prior,
    "transition": _transition,
}
OF_THERMAL_MAPS: Mapping[str, Check] = {
    "fit": _fitted,
    "following": _fitted,
    "read": _fitted,
    "load": _fitted,
    "basis": _basis,
    "smoother": _smoother,
    "variants": several("variants", least=1),
    "called": _text,
    "looser": _text,
}
OF_SOURCES: Mapping[str, Check] = {
    "chunks": _chunks,
    "name": _text,
    "about": instance("about", Mapping),
    "of_file": instance("of_file", Source, optional=True),
}
_COUNTER = instance("device_counter", Counter, optional=True)
OF_FRAMINGS: Mapping[str, Check] = {"decode": _frames, "device_counter": _COUNTER}
OF_EFFECTS: Mapping[str, Check] = {
    "requires": _names,
    "terms": _names,
    "labels": _labels,
    "units": _names,
    "explanation": _text,
    "subject": _text,
    "variant": _text,
    "candidates": _effects,
    "proposals": _effects,
    "signature": _signature,
    "input": _input,
    "fading": _fading,
}
OF_MEASUREMENT_MODELS: Mapping[str, Check] = {
    "sensors": _sensors,
    "tracked": instance("tracked", Sensor),
    "_tracking": instance("tracking"),
    "with_tracked": instance("with_tracked"),
    "only": instance("only"),
    "requires": _names,
    "patience": instance("patience", Patience),
    "own": several("own", Block),
    "components": _components,
    "prior": _prior,
    "equations": _equations,
    "white": _white,
    "known": _known,
    "length_of_input": _length,
    "still": _true_or_false,
    "aligned": _aligned,
    "detector": instance("detector", Detector),
    "simulated": _simulated,
}
OF_EXPORTERS: Mapping[str, Check] = {"export": _loss, "read": several("what it reads back", ReadBack)}
OF_REPORT_SECTIONS: Mapping[str, Check] = {"section": _section}
OF_PARTS: Mapping[type, Mapping[str, Check]] = {  # what a plugin makes, which answers for it
    FittedMap: {"_bias": _curve, "_slope": _curve, "sigma": _curve},
    Detector: {"look": _look},
}


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


def _pair(plugin: Any, name: str, answer: Any, what: str) -> tuple[Any, Any]:
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise broken(plugin, f"{name} answers {said_of(answer)}, a pair of {what} was expected")
    return answer


def _with_memory(plugin: Any, name: str, answer: Any) -> tuple[Any, Memory]:
    """Return what a method answers beside its memory, and the memory, whose arrays cannot be written to any more."""
    pair = _pair(plugin, name, answer, "what was asked and the memory")
    _lock(pair[1], DEEPEST)
    return pair


def _lock(memory: Memory, depth: int) -> None:
    if isinstance(memory, np.ndarray):
        memory.flags.writeable = False
    elif depth and isinstance(memory, tuple | list | dict):
        for item in memory.values() if isinstance(memory, dict) else memory:
            _lock(item, depth - 1)


def expect_array(
    plugin: Any,
    name: str,
    array: Any,
    expected: tuple[Shape, ...],
    why: str = "expected ",
    kinds: str = "fiu",
    *,
    finite: bool = True,
) -> None:
    """Raise PluginError where a value is not an array of finite numbers with one of the shapes."""
    if not isinstance(array, np.ndarray) or array.dtype.kind not in kinds or np.ma.isMaskedArray(array):
        plain = isinstance(array, np.ndarray) and not np.ma.isMaskedArray(array)
        what = f"an array of {array.dtype}" if plain else said_of(array)
        raise broken(plugin, f"{name} is {what}, an array of {KINDS[kinds]} was expected")
    if array.shape not in expected:
        raise broken(plugin, f"{name} has shape {array.shape}, {why}{' or '.join(map(str, expected))}")
    if finite and "f" in kinds:
        expect_finite(plugin, name, array)


def expect_finite(plugin: Any, name: str, array: Array) -> None:
    """Raise PluginError where an array holds NaN or infinity."""
    if not np.isfinite(np.vdot(array, array)) and not np.isfinite(array).all():  # the first in one pass, unwarned
        raise broken(plugin, f"{name} is not finite")


def _covariance(model: Any, name: str, matrices: Array) -> None:
    """Raise where any of the matrices (n, n) or (N, n, n) is not symmetric with no negative eigenvalue."""
    expect_finite(model, name, matrices)
    diagonal = np.ascontiguousarray(matrices.diagonal(axis1=-2, axis2=-1))
    scale, lowest = diagonal.max(initial=0.0), diagonal.min(initial=0.0)
    if matrices.ndim == 3 and len(matrices) > LOOKED_AT:
        matrices = matrices[np.linspace(0, len(matrices) - 1, LOOKED_AT).astype(int)]
        diagonal = matrices.diagonal(axis1=-2, axis2=-1)
    if np.count_nonzero(matrices) > np.count_nonzero(diagonal):  # where it is diagonal, its eigenvalues are known
        uneven = np.max(np.abs(matrices - np.swapaxes(matrices, -1, -2)))
        lowest = min(lowest, -uneven)
        try:  # which succeeds, quickly, where no eigenvalue is further below zero than that
            np.linalg.cholesky(matrices + ROUNDING * scale * np.eye(matrices.shape[-1]))
        except np.linalg.LinAlgError:
            lowest = min(lowest, np.min(np.linalg.eigvalsh(matrices)))
    if lowest < -ROUNDING * scale or (scale == 0 and lowest < 0):
        raise broken(model, f"{name} is not a covariance (symmetric, no eigenvalue below zero)")
