"""Assessment of a fitted map, in numbers and in words.

Its deviation is that of the curve over its domain, all temperatures alike, a misfit included. Where up and
down differ by D(T), half of it is either branch's distance from the curve between them; p is how probable a memory is,
one that is seen and one that is not excluded alike::

    good^2 = mean over T of  sigma(T)^2 + p E[(D(T) / 2)^2]

The level is not in it: the mean of the bias over the fit is learnt anew at every alignment. d axes.

Coverage of the temperatures by a soak: where there are few samples or none, and how long each way took.

Placements of a unit: the levels and scale factors that they determine, and the placement that would determine more.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Any

import numpy as np

from driftlab.filtering.segment import runs
from driftlab.maps.fit import axes_of, unseen
from driftlab.maps.hysteresis.memory import MemoryVerdict, memory_of
from driftlab.soak.blocks import CELLS, WAYS, SoakSummary
from driftlab.soak.placements import Placements
from driftlab.soak.rest import Used
from driftlab.units import BiasUnit
from fusion_core.chunk import Array, Flags
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.faults import DOUBT, in_doubt

GRID = 400


@dataclass(frozen=True, eq=False)
class MapVerdict:
    """Quality of a map and of the soak it was fitted on."""

    fitted: FittedMap
    settings: ThermalMap  # with which it was fitted
    soak: SoakSummary
    placements: Placements | None = None  # of the unit, where its input is known by its length alone
    used: Used | None = None  # share of the soak that is used; None where that is not known
    doubts: Sequence[str] = ()  # why the soak may not be what its config says (`Faults.doubts`)
    known_memory: MemoryVerdict | None = None  # of the soak, where the curve is the mean of both its ways
    compared: bool = False  # whether the settings were chosen among all kinds (`driftlab.maps.kind_selection`)

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes."""
        return axes_of(self.fitted)

    @cached_property
    def memory(self) -> MemoryVerdict:
        """Verdict on whether the bias remembers which temperatures came before."""
        return memory_of(self.soak) if self.known_memory is None else self.known_memory

    @cached_property
    def map(self) -> FittedMap:
        """The map with the soak's evidence for memories and doubts in its record, for those who judge by its file."""
        provenance = {**self.fitted.record.provenance, **({DOUBT: self.doubts[0]} if self.doubts else {})}
        return self.fitted.noting(memory=self.memory.as_json(), provenance=provenance)

    @cached_property
    def T(self) -> Array:
        """Temperatures (GRID,) at which the curve is looked at, degC."""
        return np.linspace(*self.fitted.domain, GRID)

    @property
    def seen(self) -> bool:
        """True if the bias is seen to differ between up and down."""
        return self.memory.answer == "seen"

    @cached_property
    def sigma(self) -> Array | None:
        """Deviation (GRID, d) of the curve, half of what is or may be between up and down included."""
        if self.fitted.record.error is None:
            return None
        counted = None if self.known_memory is None else self.known_memory.apart  # with the curve of both ways
        return np.sqrt(np.square(self.fitted.sigma(self.T)) + self.memory.variance(self.T, counted))

    @cached_property
    def good(self) -> Array | None:
        """Its rms over the domain (d,)."""
        return None if self.sigma is None else np.sqrt(np.mean(self.sigma**2, axis=0))

    @cached_property
    def coverage(self) -> Coverage:
        """Distribution of the samples over the temperatures."""
        return coverage_of(self.soak, self.fitted, self.good)

    def sentences(self, unit: BiasUnit) -> list[str]:
        """Return the verdict in words, the decisive one first: doubts, or that much of the soak is not used."""
        unused = "" if self.used is None else self.used.sentence()
        placements = [] if self.placements is None else sentences(self.placements, self.axes, unit)
        good, *level = self._good(unit)
        lines = [*in_doubt(self.doubts), *([unused] if unused else [])]
        lines += [good, memory_sentence(self.memory, self.axes, unit), *level, *placements]
        return [*lines, *self._misfits(unit), *self._coverage(unit)]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, in SI."""
        numbers: dict[str, Any] = {"white_noise": self.soak.white.tolist(), "coverage": self.coverage.as_json()}
        if self.used is not None:
            numbers["unused"] = self.used.as_json()
        if self.placements is not None:
            numbers["placements"] = as_json(self.placements, self.axes)
        if self.good is not None and self.sigma is not None:
            worst = self.T[np.argmax(self.sigma, axis=0)].tolist()
            largest = self.sigma.max(axis=0).tolist()
            numbers["sigma"] = {"rms": self.good.tolist(), "worst": largest, "worst_at_degC": worst}
        if self.fitted.record.error is not None:
            misfits = self.fitted.record.error.misfits
            numbers["misfits"] = [dict(m.model_dump(), axis=self.axes[m.axis]) for m in misfits]
        return numbers | {"memory": self.memory.as_json()}

    def _good(self, unit: BiasUnit) -> list[str]:
        low, high = np.round(self.fitted.domain, 2) + 0.0  # no -0
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
            f"{round(self.T[k], 2) + 0.0:.3g} °C)"
        )
        level = "another power-up may shift it, and every alignment learns it anew"
        if self.placements is not None:
            level = "another power-up may shift it"
        return [good, f"its level is not in that: {level}"]

    def _misfits(self, unit: BiasUnit) -> list[str]:
        """Return the misfits, but for those within half of what is seen between up and down: means of both are off so.

        Where a temperature was passed more often one way than the other, that is.
        """
        error = self.fitted.record.error
        misfits = () if error is None else error.misfits
        if self.seen:
            half = np.sqrt(self.memory.variance(np.array([m.T for m in misfits])))
            misfits = tuple(m for m, beside in zip(misfits, half, strict=True) if m.left > beside[m.axis])
        each: list[str] = []
        for m in sorted(misfits, key=lambda misfit: -misfit.left):
            axis, left, noise = self.axes[m.axis], text(m.left * unit.factor), text(m.noise * unit.factor)
            if each:
                each.append(f"{axis} at {m.T:.3g} °C ({left} left, {noise} is noise)")
            else:
                bends = f"{axis} bends at {m.T:.3g} °C more than {self.settings.description} can"
                each.append(f"{bends} ({left} {unit.shown} left, {noise} is noise)")
        when = "once it is known why up and down differ, " if self.seen else ""
        what = f"take {self.settings.advice or 'a kind that bends more'}"
        whether = "`driftlab fit-map --compare` tells whether it predicts better"
        if self.compared:
            what, whether = "look at the samples there", "of the kinds that were compared none surely predicts better"
        return [f"{', '.join(each)}: {when}{what}; {whether}"] if each else []

    def _coverage(self, unit: BiasUnit) -> list[str]:
        lines = [unseen(self.fitted, *hole, unit) for hole in self.coverage.holes]
        lines += [
            f"few samples between {part.start:.4g} and {part.stop:.4g} °C: {part.found:.0f} a kelvin, where "
            f"{part.needed:.0f} would bring white noise alone down to the curve's deviation; stay longer there"
            for part in self.coverage.thin
        ]
        return lines


def memory_sentence(memory: MemoryVerdict, axes: tuple[str, ...], unit: BiasUnit) -> str:
    """Return the answer to whether a bias remembers which temperatures came before, in words."""
    named = zip(axes, memory.none_larger_than, strict=True)
    larger = f"{', '.join(f'{name} {text(float(v) * unit.factor, 2)}' for name, v in named)} {unit.shown}"
    if memory.answer == "none":
        return (
            f"no hysteresis or lag is seen between up and down; one larger than {larger}, of any kind that spans "
            f"{text(memory.over, 2)} K or more, would have been seen with 95 % probability"
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
    """Return a number in plain digits: 22.6, 0.0314, 1250."""
    if not np.isfinite(value) or (value and not 1e-4 <= abs(value) < 1e6):
        return f"{value:.{digits}g}"
    return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")


WIDTH = 1.0  # K, over which samples are counted
SPARSE = 0.2  # of the median: what is as dense as the rest is not few, however many there are
SHORT = 0.03  # of the range: fewer samples in less than that are not reported


@dataclass(frozen=True, eq=False)
class Thin:
    """A range of temperature with few samples."""

    start: float  # degC
    stop: float  # degC
    found: float  # fewest samples a kelvin there
    needed: float  # samples a kelvin with which white noise is no more than the curve's deviation


@dataclass(frozen=True, eq=False)
class Coverage:
    """Distribution of a soak's samples over its temperatures."""

    T: Array  # (CELLS,): middle of each cell, degC
    density: Array  # (CELLS,): samples a kelvin about it
    share: float  # of the range, that has samples
    holes: tuple[tuple[float, float], ...]  # ranges without a sample, degC
    thin: tuple[Thin, ...]
    hours: dict[str, float]  # warming, cooling, and neither

    def as_json(self) -> dict[str, Any]:
        """Return it for programs."""
        some = self.density[self.density > 0]
        return {
            "share": self.share,
            "holes_degC": [list(hole) for hole in self.holes],
            "samples_per_K": {"least": float(some.min()), "median": float(np.median(some))},
            "thin": [vars(part) for part in self.thin],
            "hours": self.hours,
        }


def coverage_of(soak: SoakSummary, fitted: FittedMap, good: Array | None) -> Coverage:
    """Return the coverage; `good` (d,) is the curve's deviation, where it is known."""
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
    edges, thin = soak.edges, []
    few = min(needed, SPARSE * float(np.median(near[count > 0])))
    for start, stop in _ranges((near < few) & (count > 0), edges, SHORT):
        inside = (edges[:-1] >= start) & (edges[1:] <= stop)
        thin.append(Thin(start, stop, float(np.min(near[inside])), needed))
    return tuple(thin)


def _ranges(where: Flags, edges: Array, least: float) -> list[tuple[float, float]]:
    """Return the ranges in which cells are true, as far as they are wider than `least` of all."""
    pairs = [(float(edges[start]), float(edges[stop])) for start, stop in runs(where)]
    return [(a, b) for a, b in pairs if b - a > least * (edges[-1] - edges[0])]


VISIBLE = 0.3  # of the input, on an axis: with less its scale factor hardly shows
CLEAR = 3.0  # deviations


def sentences(placements: Placements, axes: Sequence[str], unit: BiasUnit) -> list[str]:
    """Return sentences on level and scale factor of each axis, as far as P placements determine them."""
    each = _levels(placements, axes, unit), _scales(placements, axes), _changes(placements, axes)
    return [*chain(*each), *_lengths(placements, unit)]


def as_json(placements: Placements, axes: Sequence[str]) -> dict[str, Any]:
    """Return the numbers, in SI."""
    levels = placements.levels
    each = [
        {
            "axis": axis,
            "level": levels.bias[k],
            "level_sigma": levels.sigma[k],
            "level_told": levels.level(k),
            "scale": levels.scale[k] if levels.scale_determined[k] else None,
            "scale_sigma": levels.scale_sigma[k],
            "scale_change": change.value if change.determined else None,
            "scale_change_sigma": change.sigma if change.determined else None,
        }
        for k, (axis, change) in enumerate(zip(axes, placements.changes, strict=True))
    ]
    return {"up": placements.up.tolist(), "axes": each}


def _levels(placements: Placements, axes: Sequence[str], unit: BiasUnit) -> list[str]:
    levels, P = placements.levels, len(placements.up)
    count = "one placement" if P == 1 else f"{P} placements"
    lines = []
    for kind in ("told", "scale", "tilt"):
        own = [k for k in range(len(axes)) if levels.level(k) == kind]
        if not own:
            continue
        names = ", ".join(axes[k] for k in own)
        sigma = levels.sigma if kind == "told" else levels.given_scale
        each = ", ".join(f"{axes[k]} {levels.bias[k] * unit.factor:.4g} ± {sigma[k] * unit.factor:.2g}" for k in own)
        if kind == "told":
            lines.append(f"{count}: level {each} {unit.shown}")
        elif kind == "scale":
            more = " and ".join(f"{axes[k]} {_way(placements, k)}" for k in own)
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


def _way(placements: Placements, axis: int) -> str:
    """Return the way in which an axis has not been."""
    return "down" if np.sum(placements.up[:, axis]) > 0 else "up"


def _scales(placements: Placements, axes: Sequence[str]) -> list[str]:
    levels = placements.levels
    each = [
        f"{axis} {100 * levels.scale[k]:+.2g} ± {100 * levels.scale_sigma[k]:.1g} %"
        for k, axis in enumerate(axes)
        if levels.scale_determined[k] and abs(levels.scale[k]) > CLEAR * levels.scale_sigma[k]
    ]
    return [f"scale factor off by {', '.join(each)}: the map is of the bias alone, and leaves that"] if each else []


def _changes(placements: Placements, axes: Sequence[str]) -> list[str]:
    """Return sentences on the scale factors over temperature."""
    lines = []
    determined = [k for k in range(len(axes)) if placements.changes[k].determined]
    moving = [k for k in determined if abs(placements.changes[k].value) > CLEAR * placements.changes[k].sigma]
    if moving:
        sizes = [
            f"{100 * placements.changes[k].value:+.2g} ± {100 * placements.changes[k].sigma:.1g} %" for k in moving
        ]
        each = ", ".join(f"{axes[k]} by {size}" for k, size in zip(moving, sizes, strict=True))
        lines.append(f"the scale factor changes from the coldest to the warmest sample, {each}: the map is without it")
    if still := [k for k in determined if k not in moving]:
        known = max(placements.changes[k].sigma for k in still)
        names = ", ".join(axes[k] for k in still)
        lines.append(
            f"no change of the scale factor of {names} with temperature is seen (known to {100 * known:.1g} %)"
        )
    for k, axis in enumerate(axes):
        if not placements.changes[k].determined and np.max(np.abs(placements.up[:, k])) > VISIBLE:
            lines.append(
                f"{axis}: the change with temperature may be of its scale factor; one more placement with {axis} "
                f"{_way(placements, k)}, warmed up too, tells them apart"
            )
    return lines


def _lengths(placements: Placements, unit: BiasUnit) -> list[str]:
    levels = placements.levels
    worst = int(np.argmax(np.abs(levels.lengths) / levels.expected))
    if abs(levels.lengths[worst]) <= CLEAR * levels.expected[worst]:
        return []
    off = f"{levels.lengths[worst] * unit.factor:+.2g} {unit.shown}"
    return [
        f"the force is {off} off its length in placement {worst + 1}, more than bias and scale explain; look for "
        "axes that are not square, or motion"
    ]
