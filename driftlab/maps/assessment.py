"""How good a fitted map is, in numbers and in words.

The deviation that is said is that of the curve over its domain, all temperatures alike, a misfit included. Where up and
down differ by D(T), half of it is either branch's distance from the curve between them; p is how probable a memory is,
one that is seen and one that is not excluded alike::

    good^2 = mean over T of  sigma(T)^2 + p E[(D(T) / 2)^2]

The level is not in it: what the bias has in the mean over the fit is learnt anew at every alignment. d axes.

What a soak has seen of the temperatures: where there are few samples or none, and how long each way took.

What placements told, and what one more would tell, in words and in numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab.maps.hysteresis.memory import MemoryVerdict, memory_of
from driftlab.soak.blocks import CELLS, WAYS, SoakSummary
from driftlab.soak.placements import Placements
from driftlab.soak.rest import Used
from driftlab.units import BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap

GRID = 400


@dataclass(frozen=True, eq=False)
class MapVerdict:
    """What can be said of a map and of the soak it was fitted on.

    Attributes
    ----------
    fitted : FittedMap
    settings : ThermalMap
        It was fitted with.
    soak : Soak
    axes : tuple of str
    memory : Memory
        Whether the bias remembers which temperatures came before.
    placements : Placements or None
        What the placements of a unit told, where its input is known by its length alone.
    used : Used or None
        How much of the soak is used; None where that is not known.
    """

    fitted: FittedMap
    settings: ThermalMap
    soak: SoakSummary
    axes: tuple[str, ...]
    memory: MemoryVerdict
    placements: Placements | None = None
    used: Used | None = None

    @cached_property
    def map(self) -> FittedMap:
        """The map with what the soak said of memories in its record, for those who judge by its file."""
        record = self.fitted.record.model_copy(update={"memory": self.memory.as_json()})
        return replace(self.fitted, record=record)

    @cached_property
    def T(self) -> Array:
        """Temperatures (GRID,) at which the curve is looked at, degC."""
        return np.linspace(*self.fitted.domain, GRID)

    @property
    def seen(self) -> bool:
        """Whether the bias is seen to differ between up and down."""
        return self.memory.answer == "seen"

    @cached_property
    def sigma(self) -> Array | None:
        """Deviation (GRID, d) of the curve, half of what is or may be between up and down included."""
        if self.fitted.record.error is None:
            return None
        return np.sqrt(np.square(self.fitted.sigma(self.T)) + self.memory.variance(self.T))

    @cached_property
    def good(self) -> Array | None:
        """Its rms over the domain (d,)."""
        return None if self.sigma is None else np.sqrt(np.mean(self.sigma**2, axis=0))

    @cached_property
    def coverage(self) -> Coverage:
        """How the samples lie over the temperatures."""
        return coverage_of(self.soak, self.fitted, self.good)

    def sentences(self, unit: BiasUnit) -> list[str]:
        """Return the verdict in words, the decisive one first: that much of the soak is not used, where it is so."""
        unused = "" if self.used is None else self.used.sentence()
        bent, differ = self._misfits(unit), [memory_sentence(self.memory, self.axes, unit)]
        told = [] if self.placements is None else sentences(self.placements, self.axes, unit)
        good, *more = self._good(unit)
        return [*([unused] if unused else []), good, *differ, *more, *told, *bent, *self._coverage(unit)]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, in SI."""
        record = self.fitted.record
        found: dict[str, Any] = {"white_noise": self.soak.white.tolist(), "coverage": self.coverage.as_json()}
        if self.used is not None:
            found["unused"] = self.used.as_json()
        if self.placements is not None:
            found["placements"] = as_json(self.placements, self.axes)
        if self.good is not None and self.sigma is not None:
            k = np.argmax(self.sigma, axis=0)
            found["sigma"] = {"rms": self.good.tolist(), "worst": self.sigma.max(axis=0).tolist()}
            found["sigma"]["worst_at_degC"] = self.T[k].tolist()
        if record.error is not None:
            found["misfits"] = [dict(m.model_dump(), axis=self.axes[m.axis]) for m in record.error.misfits]
        return found | {"memory": self.memory.as_json()}

    def _good(self, unit: BiasUnit) -> list[str]:
        low, high = self.fitted.domain
        between = f"between {low:.3g} and {high:.3g} °C"
        if self.good is None or self.sigma is None:
            left = self.fitted.record.residual
            words = f"{self.settings.description} does not say how sure its curve is"
            if left is None:
                return [words]
            axis = int(np.argmax(left))
            white = text(self.soak.white[axis] * unit.factor)
            return [
                f"{words}; it leaves {self.axes[axis]} {text(left[axis] * unit.factor)} {unit.shown} rms of the "
                f"samples {between}, {white} of it is white noise"
            ]
        each = ", ".join(f"{name} {text(v * unit.factor)}" for name, v in zip(self.axes, self.good, strict=True))
        k, worst = np.unravel_index(int(np.argmax(self.sigma)), self.sigma.shape)
        good = (
            f"good to {text(float(np.max(self.good)) * unit.factor)} {unit.shown} {between} (1 sigma, rms over the "
            f"range: {each}; worst {self.axes[int(worst)]} {text(self.sigma[k, worst] * unit.factor)} at "
            f"{self.T[k]:.3g} °C)"
        )
        level = "another power-up may shift it, and every alignment learns it anew"
        if self.placements is not None:
            level = "another power-up may shift it"
        return [good, f"its level is not in that: {level}"]

    def _misfits(self, unit: BiasUnit) -> list[str]:
        error, advice = self.fitted.record.error, self.settings.advice
        found = sorted(() if error is None else error.misfits, key=lambda misfit: -misfit.left)
        if not found:
            return []
        each = [
            f"{self.axes[m.axis]} bends at {m.T:.3g} °C more than {self.settings.description} can "
            f"({text(m.left * unit.factor)} {unit.shown} left, {text(m.noise * unit.factor)} is noise)"
            for m in found[:1]
        ] + [
            f"{self.axes[m.axis]} at {m.T:.3g} °C ({text(m.left * unit.factor)} left, "
            f"{text(m.noise * unit.factor)} is noise)"
            for m in found[1:]
        ]
        when = "once it is known why up and down differ, " if self.seen else ""
        what = advice or "a kind that bends more"
        whether = "`driftlab fit-map --compare` tells whether it predicts better"
        return [f"{', '.join(each)}: {when}take {what}; {whether}"]

    def _coverage(self, unit: BiasUnit) -> list[str]:
        found = self.coverage
        lines = [
            f"no sample between {start:.4g} and {stop:.4g} °C{self._inside(start, stop, unit)}; "
            "record these temperatures too"
            for start, stop in found.holes
        ]
        lines += [
            f"few samples between {part.start:.4g} and {part.stop:.4g} °C: {part.found:.0f} a kelvin, where "
            f"{part.needed:.0f} would bring white noise alone down to the curve's deviation; stay longer there"
            for part in found.thin
        ]
        return lines

    def _inside(self, start: float, stop: float, unit: BiasUnit) -> str:
        if self.fitted.record.error is None:
            return ""
        sigma = np.max(self.fitted.sigma(np.linspace(start, stop, 50), start), axis=0) * unit.factor
        return f", the curve is known there only to {', '.join(text(v, 2) for v in sigma)} {unit.shown}"


def judge(
    fitted: FittedMap,
    settings: ThermalMap,
    soak: SoakSummary,
    axes: tuple[str, ...],
    placements: Placements | None = None,
    used: Used | None = None,
) -> MapVerdict:
    """Return the verdict on a map that was fitted with settings on a soak, with its placements and what is used."""
    return MapVerdict(fitted, settings, soak, axes, memory_of(soak), placements, used)


def memory_sentence(memory: MemoryVerdict, axes: tuple[str, ...], unit: BiasUnit) -> str:
    """Return the answer to whether a bias remembers which temperatures came before, in words."""
    each = [text(float(v) * unit.factor, 2) for v in memory.none_larger_than]
    larger = f"{', '.join(f'{name} {v}' for name, v in zip(axes, each, strict=True))} {unit.shown}"
    if memory.answer == "none":
        return (
            f"no hysteresis or lag is seen between up and down; one larger than {larger}, of any kind, would have been "
            "seen with 95 % probability"
        )
    if memory.answer == "undecided":
        known = np.all(np.isfinite(memory.none_larger_than))
        return memory.why + (f"; one larger than {larger} would have been seen with 95 %" if known else "")
    sizes = [
        f"{name} by {text(abs(float(size)) * unit.factor)} ± {text(float(sigma) * unit.factor, 2)}"
        for name, size, sigma in zip(axes, memory.size, memory.sigma, strict=True)
    ]
    at = memory.where[int(np.argmax(np.abs(memory.size)))]
    return (
        f"hysteresis or lag: up and down differ in {', '.join(sizes)} {unit.shown} at most, near {at:.3g} °C; "
        f"the shape is that of {memory.called}; run `driftlab explain`"
    )


def text(value: float, digits: int = 3) -> str:
    """Return a number as one says it: 22.6, 0.0314, 1250."""
    if not np.isfinite(value) or (value and not 1e-4 <= abs(value) < 1e6):
        return f"{value:.{digits}g}"
    return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")


WIDTH = 1.0  # K, over which samples are counted
SPARSE = 0.2  # of the median: what is as dense as the rest is not few, however many there are
SHORT = 0.03  # of the range: fewer samples in less than that are not spoken of


@dataclass(frozen=True, eq=False)
class Thin:
    """A range of temperature with few samples.

    Attributes
    ----------
    start, stop : float
        degC.
    found, needed : float
        Samples a kelvin: the fewest there, and with how many white noise is no more than the curve's deviation.
    """

    start: float
    stop: float
    found: float
    needed: float


@dataclass(frozen=True, eq=False)
class Coverage:
    """How a soak's samples lie over its temperatures.

    Attributes
    ----------
    T, density : (CELLS,) arrays
        Middle of each cell, degC, and samples a kelvin about it.
    share : float
        Of the range, that has samples.
    holes : tuple of pairs
        Ranges without a sample, degC.
    thin : tuple of Thin
    hours : dict of str to float
        Warming, cooling, and neither.
    """

    T: Array
    density: Array
    share: float
    holes: tuple[tuple[float, float], ...]
    thin: tuple[Thin, ...]
    hours: dict[str, float]

    def as_json(self) -> dict[str, Any]:
        """Return it for programs."""
        seen = self.density[self.density > 0]
        return {
            "share": self.share,
            "holes_degC": [list(hole) for hole in self.holes],
            "samples_per_K": {"least": float(seen.min()), "median": float(np.median(seen))},
            "thin": [vars(part) for part in self.thin],
            "hours": self.hours,
        }


def coverage_of(soak: SoakSummary, fitted: FittedMap, good: Array | None) -> Coverage:
    """Return the coverage; `good` (d,) is what the curve is known to, where it is known."""
    count, edges = soak.count.sum(axis=0), soak.edges
    width = float(edges[1] - edges[0]) or 1.0
    reach = np.ones(max(1, 2 * round(WIDTH / width / 2) + 1))
    near = np.convolve(count, reach, "same") / (np.convolve(np.ones(CELLS), reach, "same") * width)
    error = fitted.record.error
    holes = error.holes if error is not None else tuple(_ranges(count == 0, edges, 0.05))
    hours = {name: soak.hours(way) for name, way in WAYS.items()} | {"neither": soak.hours(0)}
    thin = () if good is None else _thin(soak, near, count, good)
    return Coverage((edges[1:] + edges[:-1]) / 2, near, float(np.mean(count > 0)), holes, thin, hours)


def _thin(soak: SoakSummary, near: Array, count: Array, good: Array) -> tuple[Thin, ...]:
    known = good > 0
    if not np.any(known):
        return ()
    needed = float(np.max((soak.white[known] / good[known]) ** 2))
    edges, found = soak.edges, []
    few = min(needed, SPARSE * float(np.median(near[count > 0])))
    for start, stop in _ranges((near < few) & (count > 0), edges, SHORT):
        inside = (edges[:-1] >= start) & (edges[1:] <= stop)
        found.append(Thin(start, stop, float(np.min(near[inside])), needed))
    return tuple(found)


def _ranges(where: NDArray[np.bool_], edges: Array, least: float) -> list[tuple[float, float]]:
    """Return the ranges in which cells are true, as far as they are wider than `least` of all."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], where, [False]]).astype(int)))
    pairs = zip(edges[change[::2]].tolist(), edges[change[1::2]].tolist(), strict=True)
    return [(a, b) for a, b in pairs if b - a > least * (edges[-1] - edges[0])]


SEES = 0.3  # of the input, on an axis: with less its scale factor hardly shows
CLEAR = 3.0  # deviations


def sentences(found: Placements, axes: Sequence[str], unit: BiasUnit) -> list[str]:
    """Return what P placements told of level and scale factor of each axis, and what they did not."""
    return [*_levels(found, axes, unit), *_scales(found, axes), *_changes(found, axes), *_lengths(found, unit)]


def as_json(found: Placements, axes: Sequence[str]) -> dict[str, Any]:
    """Return the numbers, in SI."""
    levels = found.levels
    each = [
        {
            "axis": axis,
            "level": levels.bias[k],
            "level_sigma": levels.sigma[k],
            "level_told": levels.level(k),
            "scale": levels.scale[k] if levels.scale_told[k] else None,
            "scale_sigma": levels.scale_sigma[k],
            "scale_change": found.changes[k].value if found.changes[k].told else None,
            "scale_change_sigma": found.changes[k].sigma if found.changes[k].told else None,
        }
        for k, axis in enumerate(axes)
    ]
    return {"up": found.up.tolist(), "axes": each}


def _levels(found: Placements, axes: Sequence[str], unit: BiasUnit) -> list[str]:
    levels, P = found.levels, len(found.up)
    count = "one placement" if P == 1 else f"{P} placements"
    lines = []
    for kind in ("told", "scale", "tilt"):
        own = [k for k in range(len(axes)) if levels.level(k) == kind]
        if not own:
            continue
        names = ", ".join(axes[k] for k in own)
        sigma = levels.sigma if kind == "told" else levels.given_scale
        each = ", ".join(
            f"{axes[k]} {_number(levels.bias[k] * unit.factor)} ± {sigma[k] * unit.factor:.2g}" for k in own
        )
        if kind == "told":
            lines.append(f"{count}: level {each} {unit.shown}")
        elif kind == "scale":
            more = " and ".join(f"{axes[k]} {_way(found, k)}" for k in own)
            lines.append(
                f"{count}: level {each} {unit.shown} if the scale factor is true, which may be part of it; one more "
                f"placement{' each' if len(own) > 1 else ''} with {more} tells them apart"
            )
        else:
            lines.append(
                f"{count}: the level of {names} is one with the tilt of the unit, and is left at zero; placements with "
                f"{names} upright tell it"
            )
    return lines


def _way(found: Placements, axis: int) -> str:
    """Return which way an axis has not been."""
    return "down" if np.sum(found.up[:, axis]) > 0 else "up"


def _scales(found: Placements, axes: Sequence[str]) -> list[str]:
    levels = found.levels
    each = [
        f"{axis} {100 * levels.scale[k]:+.2g} ± {100 * levels.scale_sigma[k]:.1g} %"
        for k, axis in enumerate(axes)
        if levels.scale_told[k] and abs(levels.scale[k]) > CLEAR * levels.scale_sigma[k]
    ]
    return [f"scale factor off by {', '.join(each)}: the map is of the bias alone, and leaves that"] if each else []


def _changes(found: Placements, axes: Sequence[str]) -> list[str]:
    """Return what is known of the scale factors over temperature."""
    lines = []
    told = [k for k in range(len(axes)) if found.changes[k].told]
    moving = [k for k in told if abs(found.changes[k].value) > CLEAR * found.changes[k].sigma]
    if moving:
        each = ", ".join(f"{axes[k]} by {_percent(found, k)}" for k in moving)
        lines.append(f"the scale factor changes from the coldest to the warmest sample, {each}: the map is without it")
    if still := [k for k in told if k not in moving]:
        known = max(found.changes[k].sigma for k in still)
        names = ", ".join(axes[k] for k in still)
        lines.append(
            f"no change of the scale factor of {names} with temperature is seen (known to {100 * known:.1g} %)"
        )
    for k, axis in enumerate(axes):
        if not found.changes[k].told and np.max(np.abs(found.up[:, k])) > SEES:
            lines.append(
                f"{axis}: the change with temperature may be of its scale factor; one more placement with {axis} "
                f"{_way(found, k)}, warmed up too, tells them apart"
            )
    return lines


def _percent(found: Placements, axis: int) -> str:
    change = found.changes[axis]
    return f"{100 * change.value:+.2g} ± {100 * change.sigma:.1g} %"


def _lengths(found: Placements, unit: BiasUnit) -> list[str]:
    levels = found.levels
    worst = int(np.argmax(np.abs(levels.lengths) / levels.expected))
    if abs(levels.lengths[worst]) <= CLEAR * levels.expected[worst]:
        return []
    off = f"{levels.lengths[worst] * unit.factor:+.2g} {unit.shown}"
    return [
        f"the force is {off} off its length in placement {worst + 1}, more than bias and scale explain; look for "
        "axes that are not square, or motion"
    ]


def _number(value: float) -> str:
    return f"{value:.4g}"
