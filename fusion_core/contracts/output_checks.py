"""Checks of what plugins return, before anyone uses it: shapes, finite numbers, covariances.

N samples or steps, n states, m measured components, d axes, p coefficients, D axes of a detector, K blocks, G points of
a grid. A defect of a plugin is reported by its name, and never becomes an estimate. Each check is
`check(plugin, answer, *arguments)`: it returns the answer, or raises PluginError. Shapes are written in these letters,
`"n n"` or `"N n n"`; which check is for which method stands in `fusion_core.contracts.families`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from fusion_core.checks import FLOAT, Shape, all_finite
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts.bias_model import BiasModel
from fusion_core.contracts.effect import Effect
from fusion_core.contracts.exporter import Loss
from fusion_core.contracts.framing import Frames
from fusion_core.contracts.measurement_model import MeasurementModel
from fusion_core.contracts.plugin import Check, Memory, built_in, plugin_error
from fusion_core.contracts.sensor import Alignment, Detector, Sensor
from fusion_core.contracts.thermal_map import ThermalMap
from fusion_core.fast import compiled
from fusion_core.faults import Faults
from fusion_core.model import Measurement, Prior, Transition
from fusion_core.thermal.fitted_map import FittedMap
from fusion_core.thermal.penalised import Basis
from fusion_core.thermal.soak_noise import Blocks, Smoother

ROUNDING = 1e-9  # relative to the largest variance: less below zero is rounding
MAX_MATRICES = 8  # of N, spread evenly, whose eigenvalues are computed; the others by finiteness and variances
KINDS = {"fiu": "numbers", "iu": "whole numbers", "b": "true or false"}


class Sizes(dict[str, Any]):
    """The sizes that the letters of a shape stand for, and words of a message, worked out at first use."""

    def __init__(self, plugin: Any, arguments: tuple[Any, ...]) -> None:
        super().__init__()
        self.plugin, self.arguments = plugin, arguments

    def __missing__(self, letter: str) -> int | str:
        plugin, size = self.plugin, 0
        match letter:
            case "N":
                counted = (a for a in self.arguments if isinstance(a, (Chunk, np.ndarray, int)))
                size = next(a if isinstance(a, int) else len(a) for a in counted)
            case "n" | "p":
                size = len(plugin.labels)
            case "m":
                size = int(plugin.m)
            case "states":
                return "states" if isinstance(plugin, MeasurementModel) else "labels"
            case _:  # axes
                of = plugin.tracked if isinstance(plugin, MeasurementModel) else plugin
                size = int(plugin.record.d) if isinstance(plugin, FittedMap) else len(of.axes)
        self[letter] = size
        return size


def array(
    name: str, *shapes: str, why: str = "expected ", kinds: str = "fiu", finite: bool = True, covariance: bool = False,
    optional: bool = False,
) -> Check:  # fmt: skip
    """Return the check of an array of one of the shapes; with `optional`, None will do too."""

    def check(plugin: Any, values: Any, *arguments: Any, **named: Any) -> Any:
        if not (optional and values is None):
            size = Sizes(plugin, (*arguments, *named.values()))
            expected = tuple([tuple([size[letter] for letter in shape.split()]) for shape in shapes])
            reason = why if np.shape(values) in expected else why.format_map(size)
            expect_array(plugin, name, values, expected, reason, kinds, finite=finite)
            if covariance:
                expect_covariance(plugin, name, values)
        return values

    return check


def with_memory(name: str, check: Check) -> Check:
    """Return the check of a method that answers something and its memory; arrays of that are locked from here on."""

    def check_both(plugin: Any, answer: Any, *arguments: Any, **named: Any) -> tuple[Any, Memory]:
        first, memory = _pair(plugin, name, answer, "what was asked and the memory")
        _lock((memory,))
        return check(plugin, first, *arguments, **named), memory

    return check_both


def instance(name: str, expected: type | None = None, *, optional: bool = False, **parts: Check) -> Check:
    """Return the check of an answer of a class, by default the plugin's own, and of its attributes `parts`."""

    def check(plugin: Any, answer: Any, *arguments: Any, **named: Any) -> Any:
        if not (optional and answer is None):
            expect_instance(plugin, name, answer, expected or type(plugin))
            for attribute, part in parts.items():
                part(plugin, getattr(answer, attribute), *arguments, **named)
        return answer

    return check


def several(name: str, expected: type | None = None, least: int = 0) -> Check:
    """Return the check of an answer of at least so many of a class, by default the plugin's own."""

    def check(plugin: Any, answer: Any, *arguments: object, **named: object) -> tuple[Any, ...]:
        items = tuple(each_of(plugin, name, answer))
        for item in items:
            expect_instance(plugin, f"one of {name}", item, expected or type(plugin))
        if len(items) < least:
            raise plugin_error(plugin, f"{name} is empty, at least {least} was expected")
        return items

    return check


def names(plugin: Any, answer: Any, *arguments: object) -> tuple[str, ...]:
    """Check texts."""
    if not (isinstance(answer, tuple | list) and all(isinstance(name, str) for name in answer)):
        raise plugin_error(plugin, f"has {a_type(answer)} where a tuple of texts was expected")
    return tuple(answer)


def labels(plugin: Any, answer: Any) -> tuple[str, ...]:
    """Check texts that differ."""
    texts = names(plugin, answer)
    if len(set(texts)) != len(texts):
        raise plugin_error(plugin, f"its labels {', '.join(texts)} are not all different")
    return texts


def text(plugin: Any, answer: Any, *arguments: object) -> str:
    """Check a text."""
    if not isinstance(answer, str):
        raise plugin_error(plugin, f"has {a_type(answer)} where a text was expected")
    return answer


OF_STATES = "its {n} {states} ask for "
OF_EPOCHS = "its {n} states, {m} components and {N} epochs ask for "
_PRIOR = instance(
    "prior", Prior, x=array("prior x", "n", why=OF_STATES), P=array("prior P", "n n", why=OF_STATES, covariance=True)
)
_STEPS = instance(
    "transition",
    Transition,
    F=array("F", "n n", "N n n", why=OF_STATES),
    Q=array("Q", "n n", "N n n", why=OF_STATES, covariance=True),
    u=array("the drift u", "n", "N n", why=OF_STATES),
    C=array("C", "d n", "N d n", why=OF_STATES, optional=True),
)
_MEASUREMENT = instance(  # what is not used may be anything
    "the measurement",
    Measurement,
    z=array("z", "N m", why=OF_EPOCHS, finite=False),
    H=array("H", "m n", "N m n", why=OF_EPOCHS, finite=False),
    R=array("R", "m m", "N m m", why=OF_EPOCHS, finite=False),
    used=array("used", "N", "N m", why=OF_EPOCHS, kinds="b"),
)


def check_prior(model: BiasModel | MeasurementModel, prior: Prior, *arguments: object) -> Prior:
    """Raise PluginError where a prior is not a mean (n,) and a covariance (n, n), or not every state has a unit."""
    units = model.units("1") if isinstance(model, BiasModel) else model.units
    if len(units) != len(model.labels):
        raise plugin_error(model, f"has {len(units)} units for {len(model.labels)} labels")
    return _PRIOR(model, prior)  # type: ignore[no-any-return]


def check_transition(model: BiasModel, step: Transition, chunk: Chunk | int, memory: Memory = None) -> Transition:
    """Raise PluginError where N steps are not F, Q (n, n) or (N, n, n), u (n,) or (N, n) and C (d, n) or (N, d, n)."""
    _check_steps(model, step, chunk)
    if step.C is None and (n := len(model.labels)) != (d := len(model.axes)):
        raise plugin_error(model, f"has {n} labels for {d} axes and no C; a C ({d}, {n}) says how the bias follows")
    return step


def _check_steps(model: BiasModel | MeasurementModel, step: Transition, chunk: Chunk | int) -> None:
    if not _ordinary(step, len(model.labels), chunk if isinstance(chunk, int) else len(chunk)):
        _STEPS(model, step, chunk)


def _ordinary(step: Transition, n: int, N: int) -> bool:
    """Return True if steps are sound and as nearly all are, which is seen quickly: F and Q constant, Q diagonal."""
    if type(step) is not Transition or step.C is not None:
        return False
    F, Q, u = step.F, step.Q, step.u
    if not (type(F) is type(Q) is type(u) is np.ndarray and F.dtype is Q.dtype is u.dtype is FLOAT):
        return False
    if not (F.shape == Q.shape == (n, n) and u.shape in ((n,), (N, n))):
        return False
    F, Q, u = [a if a.flags.carray else a.copy() for a in (F, Q, u)]
    return bool(_sound(F, Q, u.reshape(-1)))


@compiled
def _sound(F: Array, Q: Array, u: Array) -> bool:
    """Return True if F (n, n), Q (n, n) and numbers u are finite, and Q is diagonal with no variance below zero."""
    n, ordinary = len(F), True
    for i in range(n):
        for j in range(n):
            ordinary &= np.isfinite(F[i, j]) and (Q[i, j] == 0 if i != j else 0 <= Q[i, j] < np.inf)
    for value in u:
        ordinary &= np.isfinite(value)
    return ordinary


def sensors(model: MeasurementModel, answer: Any) -> tuple[Sensor, ...]:
    """Check sensors, of a channel each, with a bias model and a noise of their axes."""
    given: tuple[Sensor, ...] = several("sensors", Sensor, least=1)(model, answer)
    for sensor in given:
        expect_instance(model, f"the bias of its sensor {sensor.channel}", sensor.bias, BiasModel)
        expect_array(model, f"the noise of its sensor {sensor.channel}", sensor.noise, ((len(sensor.axes),),))
    if len({sensor.channel for sensor in given}) < len(given):
        raise plugin_error(model, "two of its sensors are of one channel, each of its own was expected")
    return given


def components(model: MeasurementModel, answer: Any) -> list[tuple[str, str, str]]:
    """Check triples of channel, axis and unit."""
    items = list(each_of(model, "components", answer))
    for item in items:
        if len(names(model, item)) != 3:
            raise plugin_error(model, f"a component is {item}, channel, axis and unit were expected")
    return items


def equations(
    model: MeasurementModel, answer: Any, chunk: Chunk, steps: object, alignment: Alignment
) -> tuple[Transition, Measurement]:
    """Check the steps of all states and a measurement."""
    if built_in(model):  # held by its laws, and its bias blocks are checked; uneven epochs ask a few hundred at a time
        return answer  # type: ignore[no-any-return]
    step, measured = _pair(model, "equations", answer, "the steps and the measurement")
    _STEPS(model, step, chunk)
    _MEASUREMENT(model, measured, chunk)
    used, z, H, R = measured.used, measured.z, measured.H, measured.R
    if not used.all():  # what is not used is not looked at
        whole = used if used.ndim == 1 else used.all(axis=1)
        z, H, R = z[used], H if H.ndim == 2 else H[used], R if R.ndim == 2 else R[whole]
    expect_finite(model, "z", z)
    expect_finite(model, "H", H)
    expect_covariance(model, "R", R)
    if not np.min(R.diagonal(axis1=-2, axis2=-1), initial=np.inf) > 0:
        raise plugin_error(model, "R has a variance of zero; leave a component that is not measured out by used")
    return step, measured


def aligned(model: MeasurementModel, answer: Any, *arguments: object) -> Alignment:
    """Check an alignment, which has an input of each sensor."""
    expect_instance(model, "aligned", answer, Alignment)
    axes = {sensor.channel: len(sensor.axes) for sensor in model.sensors}
    missing = sorted(axes.keys() - answer.inputs.keys())
    if missing:
        raise plugin_error(model, f"the alignment has no input of {', '.join(missing)}")
    for name in ("inputs", "noise_ratio", "levels"):
        for channel, values in getattr(answer, name).items():
            d = axes.get(channel, np.size(values))
            expect_array(model, f"{name} of {channel} in the alignment", values, ((d,),))
    expect_array(model, "unsure in the alignment", answer.unsure, ((axes[model.tracked.channel],),))
    return answer  # type: ignore[no-any-return]


def length_of_input(model: MeasurementModel, answer: Any, *arguments: object) -> tuple[float, float] | None:
    """Check a length and its deviation, or None."""
    if answer is not None and not (np.shape(answer) == (2,) and np.all(np.isfinite(answer))):
        raise plugin_error(model, f"length_of_input is {answer!r}, a length and its deviation, or None, were expected")
    return answer  # type: ignore[no-any-return]


def still(model: MeasurementModel, answer: Any, *arguments: object) -> bool:
    """Check true or false."""
    if not isinstance(answer, bool | np.bool_):
        raise plugin_error(model, f"still answers {a_type(answer)}, true or false was expected")
    return bool(answer)


def simulated(model: MeasurementModel, answer: Any, N: int, *arguments: object) -> Mapping[str, Array]:
    """Check a channel of each sensor."""
    expect_instance(model, "simulated", answer, Mapping)
    for sensor in model.sensors:
        shapes = ((N, len(sensor.axes)),)
        expect_array(model, f"the simulated channel '{sensor.channel}'", answer.get(sensor.channel), shapes)
    return answer  # type: ignore[no-any-return]


def look(detector: Detector, answer: Any, chunk: Chunk, memory: Memory) -> tuple[Any, Any, Memory]:
    """Check what a detector shows of some epochs, and its memory."""
    if not (isinstance(answer, tuple) and len(answer) == 3):
        raise plugin_error(detector, f"look answers {a_type(answer)}, three were expected: still, standing out, memory")
    N, D = len(chunk), len(detector.axes)
    expect_array(detector, "still of its detector", answer[0], ((N,),), kinds="b")
    expect_array(detector, "what stands out of its detector", answer[1], ((N, D),), kinds="b")
    _lock(answer[2:])
    return answer


def curve(fitted: FittedMap, answer: Any, T: Array, *arguments: object) -> Array:
    """Check a value of each axis at each temperature."""
    expect_array(fitted, "its curve", answer, ((len(T), fitted.record.d),))
    return answer  # type: ignore[no-any-return]


def chunks(source: Any, answer: Any, size: int, faults: Faults) -> Iterator[Chunk]:
    """Check each chunk of a source as it comes: channels (N,) or (N, d), of one d each."""
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
                raise plugin_error(source, f"channel '{name}' has shape {shape}, (N,) or (N, d) was expected")
        yield chunk


def frames(framing: Any, answer: Any, data: bytes, memory: Memory) -> Frames:
    """Check the samples that a framing has cut out."""
    expect_instance(framing, "what it decodes", answer, Frames)
    for name, values in answer.channels.items():
        shape = np.shape(values)
        if len(shape) not in (1, 2) or shape[0] != answer.N:
            raise plugin_error(framing, f"channel '{name}' has shape {shape} in {answer.N} frames")
        expect_array(framing, f"channel '{name}'", values, (shape,), finite=False)
    if answer.count is not None:
        expect_array(framing, "count", answer.count, ((answer.N,),), kinds="iu")
    return answer  # type: ignore[no-any-return]


def effects(effect: Effect, answer: Any, *arguments: object) -> Iterator[Effect]:
    """Check each proposed effect as it comes."""
    for candidate in each_of(effect, "candidates", answer):
        expect_instance(effect, "what it proposes", candidate, type(effect))
        yield candidate


def loss(exporter: Any, answer: Any, *arguments: object) -> Loss:
    """Check the errors of an export, one an axis each."""
    expect_instance(exporter, "what it says is lost", answer, Loss)
    for lost in answer.sensors:
        for name, error in (("domain", lost.domain), ("warm-up", lost.warm_up), *lost.causes.items()):
            for values in (error.rms, error.largest):
                expect_array(exporter, f"the error over the {name}", values, ((len(lost.sensor.axes),),))
    return answer  # type: ignore[no-any-return]


def basis(settings: ThermalMap, answer: Any, domain: tuple[float, float]) -> Basis:
    """Check the curves where they are made; what they give afterwards, whenever they are evaluated."""
    expect_instance(settings, "basis", answer, Basis)
    q = np.shape(answer.penalty)[0] if np.ndim(answer.penalty) else 0
    expect_array(settings, "the basis' penalty", answer.penalty, ((q, q),))

    def values(T: Array) -> Array:
        curves = answer.values(T)
        expect_array(settings, "values of the basis", curves, ((len(T), q),))
        return np.asarray(curves)

    return Basis(values, answer.penalty)


def smoother(settings: ThermalMap, answer: Any, T: Array, bias: Array) -> Smoother:
    """Check that there is a function; what it gives, whenever it is evaluated."""
    if not callable(answer):
        raise plugin_error(settings, f"its smoother is {a_type(answer)}, a function was expected")

    def response(blocks: Blocks, grid: Array, axis: int) -> Array:
        H = answer(blocks, grid, axis)
        expect_array(settings, "its answer to noise", H, ((len(grid), len(blocks.T)),))
        return np.asarray(H)

    return response


def a_type(value: Any) -> str:
    """Return the type of a value, for a message."""
    return f"a {type(value).__name__}"


def expect_instance(plugin: Any, name: str, value: Any, expected: type) -> None:
    """Raise PluginError where a value is not of a class; `name` is what messages call it."""
    if not isinstance(value, expected):
        raise plugin_error(plugin, f"{name} is {a_type(value)}, a {expected.__name__} was expected")


def each_of(plugin: Any, name: str, answer: Any) -> Iterable[Any]:
    """Return an answer that can be gone through, else raise PluginError."""
    if not isinstance(answer, Iterable):
        raise plugin_error(plugin, f"{name} is {a_type(answer)}, an iterator was expected")
    return answer


def _pair(plugin: Any, name: str, answer: Any, what: str) -> tuple[Any, Any]:
    if not (isinstance(answer, tuple) and len(answer) == 2):
        raise plugin_error(plugin, f"{name} answers {a_type(answer)}, a pair of {what} was expected")
    return answer


def _lock(items: Iterable[Memory], depth: int = 8) -> None:
    """Lock the arrays among memories, and those in containers within one another up to a depth."""
    for item in items:
        if isinstance(item, np.ndarray):
            item.setflags(write=False)
        elif isinstance(item, (tuple, list, dict)) and item and depth:
            _lock(item.values() if isinstance(item, dict) else item, depth - 1)


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
        what = f"an array of {array.dtype}" if plain else a_type(array)
        raise plugin_error(plugin, f"{name} is {what}, an array of {KINDS[kinds]} was expected")
    if array.shape not in expected:
        raise plugin_error(plugin, f"{name} has shape {array.shape}, {why}{' or '.join(map(str, expected))}")
    if finite and "f" in kinds:
        expect_finite(plugin, name, array)


def expect_finite(plugin: Any, name: str, array: Array) -> None:
    """Raise PluginError where an array holds NaN or infinity."""
    if not all_finite(array):
        raise plugin_error(plugin, f"{name} is not finite")


def expect_covariance(model: Any, name: str, matrices: Array) -> None:
    """Raise where any of the matrices (n, n) or (N, n, n) is not symmetric with no negative eigenvalue."""
    expect_finite(model, name, matrices)
    diagonal = np.ascontiguousarray(matrices.diagonal(axis1=-2, axis2=-1))
    scale, lowest = diagonal.max(initial=0.0), diagonal.min(initial=0.0)
    if matrices.ndim == 3 and len(matrices) > MAX_MATRICES:
        matrices = matrices[np.linspace(0, len(matrices) - 1, MAX_MATRICES).astype(int)]
        diagonal = matrices.diagonal(axis1=-2, axis2=-1)
    if np.count_nonzero(matrices) > np.count_nonzero(diagonal):  # where it is diagonal, its eigenvalues are known
        uneven = np.max(np.abs(matrices - np.swapaxes(matrices, -1, -2)))
        lowest = min(lowest, -uneven)
        try:  # which succeeds, quickly, where no eigenvalue is further below zero than that
            np.linalg.cholesky(matrices + ROUNDING * scale * np.eye(matrices.shape[-1]))
        except np.linalg.LinAlgError:
            lowest = min(lowest, np.min(np.linalg.eigvalsh(matrices)))
    if lowest < -ROUNDING * scale or (scale == 0 and lowest < 0):
        raise plugin_error(model, f"{name} is not a covariance (symmetric, no eigenvalue below zero)")
