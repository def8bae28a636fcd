"""How good a fitted map is, in numbers and in words.

The deviation that is said is that of the curve over its domain, all temperatures alike, a misfit included; where up and
down are seen to differ by D(T), half of it is either branch's distance from the curve between them::

    good^2 = mean over T of  sigma(T)^2 + (D(T) / 2)^2

The level is not in it: what the bias has in the mean over the fit is learnt anew at every alignment. d axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from driftlab.maps.branches import Difference, differences
from driftlab.maps.coverage import Coverage, coverage_of
from driftlab.maps.hysteresis.memory import Memory
from driftlab.maps.placements import Placements
from driftlab.maps.soak import Soak
from driftlab.maps.told import as_json as told_numbers
from driftlab.maps.told import sentences as told_sentences
from driftlab.units import BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap

GRID = 400
APART = {
    "warms": "only ever warms: hysteresis cannot be seen; come back down by the same steps",
    "cools": "only ever cools: hysteresis cannot be seen; come back up by the same steps",
    "no way": "the temperature goes neither up nor down in the order of the samples: hysteresis cannot be seen",
    "apart": "warming and cooling share too few temperatures: hysteresis cannot be seen; come back by the same steps",
    "levels": "each recording or placement goes one way and has a level of its own: a hysteresis that is alike at "
    "all temperatures cannot be seen, no other is seen; warm and cool within one",
    "short": "too short on its way up or down: hysteresis cannot be told from noise; go slower, or up and down again",
}


@dataclass(frozen=True, eq=False)
class Verdict:
    """What can be said of a map and of the soak it was fitted on.

    Attributes
    ----------
    fitted : FittedMap
    settings : ThermalMap
        It was fitted with.
    soak : Soak
    axes : tuple of str
    difference : tuple of Difference, one an axis, or str
        Warming less cooling; a key of APART where it cannot be seen.
    placements : Placements or None
        What the placements of a unit told, where its input is known by its length alone.
    """

    fitted: FittedMap
    settings: ThermalMap
    soak: Soak
    axes: tuple[str, ...]
    difference: tuple[Difference, ...] | str
    placements: Placements | None = None

    @cached_property
    def memory(self) -> Memory:
        """Whether the bias remembers which temperatures came before."""
        d = len(self.axes)
        if isinstance(self.difference, str):
            return Memory.unknown(d, APART[self.difference])
        size = np.array([found.value[found.peak] for found in self.difference])
        sigma = np.array([found.sigma[found.peak] for found in self.difference])
        where = np.array([found.T[found.peak] for found in self.difference])
        kinds = ("hysteresis",) if self.seen else ()
        return Memory("seen" if self.seen else "none", kinds, size, sigma, np.abs(size) + 2 * sigma, where, "")

    @cached_property
    def map(self) -> FittedMap:
        """The map with what the soak said of memories in its record, for those who judge by its file."""
        record = self.fitted.record.model_copy(update={"memory": self.memory.as_json()})
        return replace(self.fitted, record=record)

    @cached_property
    def T(self) -> Array:
        """Temperatures (GRID,) at which the curve is looked at, degC."""
        return np.linspace(*self.fitted.domain, GRID)

    @cached_property
    def seen(self) -> dict[int, Difference]:
        """The axes whose bias is seen to differ between up and down."""
        found = () if isinstance(self.difference, str) else self.difference
        return {axis: difference for axis, difference in enumerate(found) if difference.seen}

    @cached_property
    def sigma(self) -> Array | None:
        """Deviation (GRID, d) of the curve, half of the difference between up and down included."""
        if self.fitted.record.error is None:
            return None
        variance = np.square(self.fitted.sigma(self.T))
        for axis, found in self.seen.items():
            half = np.maximum(found.value**2 - found.sigma**2, 0.0) / 4
            variance[:, axis] += np.interp(self.T, found.T, half)
        return np.sqrt(variance)

    @cached_property
    def good(self) -> Array | None:
        """Its rms over the domain (d,)."""
        return None if self.sigma is None else np.sqrt(np.mean(self.sigma**2, axis=0))

    @cached_property
    def coverage(self) -> Coverage:
        """How the samples lie over the temperatures."""
        return coverage_of(self.soak, self.fitted, self.good)

    def sentences(self, unit: BiasUnit) -> list[str]:
        """Return the verdict in words, the decisive one first."""
        bent, differ = self._misfits(unit), self._differences(unit)
        # where up and down differ, a curve between them may look bent
        found = [*differ, *bent] if self.seen else [*bent, *differ]
        told = [] if self.placements is None else told_sentences(self.placements, self.axes, unit)
        return [*self._good(unit), *told, *found, *self._coverage(unit)]

    def as_json(self) -> dict[str, Any]:
        """Return the numbers, in SI."""
        record = self.fitted.record
        found: dict[str, Any] = {"white_noise": self.soak.white.tolist(), "coverage": self.coverage.as_json()}
        if self.placements is not None:
            found["placements"] = told_numbers(self.placements, self.axes)
        if self.good is not None and self.sigma is not None:
            k = np.argmax(self.sigma, axis=0)
            found["sigma"] = {"rms": self.good.tolist(), "worst": self.sigma.max(axis=0).tolist()}
            found["sigma"]["worst_at_degC"] = self.T[k].tolist()
        if record.error is not None:
            found["misfits"] = [dict(m.model_dump(), axis=self.axes[m.axis]) for m in record.error.misfits]
        found["memory"] = self.memory.as_json()
        if isinstance(self.difference, str):
            return found | {"warming_less_cooling": None, "why_not": APART[self.difference]}
        return found | {"warming_less_cooling": [self._as_json(axis) for axis in range(len(self.axes))]}

    def _as_json(self, axis: int) -> dict[str, Any]:
        assert not isinstance(self.difference, str)
        found = self.difference[axis]
        peak = {"at_degC": found.T[found.peak], "value": found.value[found.peak], "sigma": found.sigma[found.peak]}
        numbers = {name: float(value) for name, value in peak.items()} | {"rms": found.rms, "chance": found.chance}
        return {"axis": self.axes[axis], "seen": found.seen, **numbers}

    def _good(self, unit: BiasUnit) -> list[str]:
        low, high = self.fitted.domain
        between = f"between {low:.3g} and {high:.3g} degC"
        if self.good is None or self.sigma is None:
            left = self.fitted.record.residual
            words = f"{self.settings.called} does not say how sure its curve is"
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
            f"{self.T[k]:.3g} degC)"
        )
        level = "another power-up may shift it, and every alignment learns it anew"
        if self.placements is not None:
            level = "another power-up may shift it"
        return [good, f"its level is not in that: {level}"]

    def _misfits(self, unit: BiasUnit) -> list[str]:
        error, advice = self.fitted.record.error, self.settings.looser
        found = sorted(() if error is None else error.misfits, key=lambda misfit: -misfit.left)
        if not found:
            return []
        each = [
            f"{self.axes[m.axis]} bends at {m.T:.3g} degC more than {self.settings.called} can "
            f"({text(m.left * unit.factor)} {unit.shown} left, {text(m.noise * unit.factor)} is noise)"
            for m in found[:1]
        ] + [
            f"{self.axes[m.axis]} at {m.T:.3g} degC ({text(m.left * unit.factor)} left, "
            f"{text(m.noise * unit.factor)} is noise)"
            for m in found[1:]
        ]
        when = "once it is known why up and down differ, " if self.seen else ""
        what = advice or "a kind that bends more"
        whether = "`driftlab fit-map --compare` tells whether it predicts better"
        return [f"{', '.join(each)}: {when}take {what}; {whether}"]

    def _differences(self, unit: BiasUnit) -> list[str]:
        if isinstance(self.difference, str):
            return [APART[self.difference]]
        if not self.seen:
            known = max(float(np.sqrt(np.mean(found.sigma**2))) for found in self.difference)
            return [
                "no hysteresis is seen: up and down differ by no more than chance (their difference is known to "
                f"{text(known * unit.factor, 2)} {unit.shown}, 1 sigma)"
            ]
        each = []
        for axis, found in self.seen.items():
            k = found.peak
            value, sigma = abs(found.value[k]) * unit.factor, text(found.sigma[k] * unit.factor, 2)
            each.append(
                f"{self.axes[axis]} by {text(value)} ± {sigma} {unit.shown} at {found.T[k]:.3g} degC "
                f"(rms {text(found.rms * unit.factor)})"
            )
        return [f"hysteresis or lag: up and down differ in {'; '.join(each)}; run `driftlab explain`"]

    def _coverage(self, unit: BiasUnit) -> list[str]:
        found = self.coverage
        lines = [
            f"no sample between {start:.4g} and {stop:.4g} degC{self._inside(start, stop, unit)}; "
            "record these temperatures too"
            for start, stop in found.holes
        ]
        lines += [
            f"few samples between {part.start:.4g} and {part.stop:.4g} degC: {part.found:.0f} a kelvin, where "
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
    fitted: FittedMap, settings: ThermalMap, soak: Soak, axes: tuple[str, ...], placements: Placements | None = None
) -> Verdict:
    """Return the verdict on a map that was fitted with settings on a soak, and what its placements told."""
    residual = soak.bias - fitted.bias(np.clip(soak.T, *fitted.domain))
    return Verdict(fitted, settings, soak, axes, differences(soak, residual), placements)


def text(value: float, digits: int = 3) -> str:
    """Return a number as one says it: 22.6, 0.0314, 1250."""
    if not np.isfinite(value) or (value and not 1e-4 <= abs(value) < 1e6):
        return f"{value:.{digits}g}"
    return np.format_float_positional(value, precision=digits, unique=False, fractional=False, trim="-")
