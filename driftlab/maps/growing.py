"""The map of a soak that still goes on: how sure it is by now, over which temperatures, and what is missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from driftlab.maps.division import TURN
from driftlab.maps.hysteresis.memory import Memory
from driftlab.maps.verdict import memory_sentence
from driftlab.samples.turning import sweeps_of
from driftlab.units import RATE, BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap
from fusion_core.contracts.curve_uncertainty import HOLE

Range = tuple[float, float]

END = 0.01  # of the range: so near is as good as reached
GRID = 121  # temperatures of the curve


@dataclass(frozen=True, eq=False)
class MapStatus:
    """What is known of a map while its soak goes on.

    Attributes
    ----------
    kind : str
        Of the map.
    samples : int
        Epochs at rest so far.
    seen : pair of float
        Smallest and largest temperature so far, degC.
    asked : pair of float or None
        The range over which the map is wanted; None: what was seen.
    coverage : float
        Share of that range in which there are samples.
    missing : tuple of pairs
        Its parts that have none, degC.
    sweeps : int
        How often the temperature went up or down.
    T : (G,) array
        Temperatures of the curve, within the range and what was seen, degC; empty until there is one.
    bias, sigma : (G, d) arrays
        The curve and its standard deviation, in SI.
    wanted : float or None
        The sigma to be reached, in SI.
    reached : bool
        Whether the whole range is covered and sigma is nowhere larger than wanted.
    why : str
        Why there is no curve yet; empty where there is one.
    memory : Memory or None
        Whether the bias remembers which temperatures came before; None until there is a curve.
    unused, unused_share
        How much of the soak is not used and why, in words where it is much, and the share.
    axes, unit
        What the axes are called, and in which unit a bias is shown.
    """

    kind: str
    samples: int = 0
    seen: Range = (np.nan, np.nan)
    asked: Range | None = None
    coverage: float = 0.0
    missing: tuple[Range, ...] = ()
    sweeps: int = 1
    T: Array = field(default_factory=lambda: np.empty(0))
    bias: Array = field(default_factory=lambda: np.empty((0, 0)))
    sigma: Array = field(default_factory=lambda: np.empty((0, 0)))
    wanted: float | None = None
    reached: bool = False
    why: str = "no sample at rest so far"
    memory: Memory | None = None
    unused: str = ""
    unused_share: float = 0.0
    axes: tuple[str, ...] = ()
    unit: BiasUnit = RATE

    @property
    def range(self) -> Range:
        """The temperatures over which sigma is looked at, degC."""
        return self.seen if self.asked is None else self.asked

    @property
    def rms(self) -> Array:
        """Rms of sigma (d,) over the range so far, in SI."""
        return np.asarray(np.sqrt(np.mean(self.sigma**2, axis=0)), dtype=np.float64)

    @property
    def worst(self) -> tuple[float, float, str]:
        """Largest sigma in SI, at which temperature, and of which axis; NaN where there is no curve."""
        if not self.sigma.size:
            return np.nan, np.nan, ""
        k, axis = np.unravel_index(int(np.argmax(self.sigma)), self.sigma.shape)
        return float(self.sigma[k, axis]), float(self.T[k]), self.axes[int(axis)]

    def lines(self) -> list[str]:
        """Return what one should know of the map at the moment, a sentence each."""
        first = [self.unused] if self.unused else []
        if not self.samples:
            return [*first, self.why]
        low, high = self.range
        spans = [f"{start:.4g} to {stop:.4g}" for start, stop in self.missing]
        seen = f"{self.samples:,} epochs at rest, {self.seen[0]:.2f} to {self.seen[1]:.2f} °C"
        found = [*first, seen if self.asked is None else f"{seen}; {self.coverage:.0%} of {low:g} to {high:g} °C"]
        if spans:
            found.append(f"not yet seen: {', '.join(spans)} °C")
        if self.why:
            return [*found, self.why]
        sigma, at, axis = self.worst
        rms = ", ".join(self._said(value) for value in self.rms)
        where = f"at {at:.1f} °C" + (f" ({axis})" if len(self.axes) > 1 else "")
        found.append(f"sigma {rms} {self.unit.shown} rms, {self._said(sigma)} {where}")
        if self.memory is not None:
            found.append(memory_sentence(self.memory, self.axes, self.unit))
        if self.reached:
            found.append(self.sentence())
        return found

    def sentence(self) -> str:
        """Return that sigma is reached."""
        low, high = self.range
        end = "the chamber may stop" if self.asked is not None else "all that was seen so far"
        once = "; passed once: what differs on the way back is not in it" if self.sweeps < 2 else ""
        said = f"{self._said(self.worst[0])} {self.unit.shown} between {low:.4g} and {high:.4g} °C"
        return f"reached: {said}, {end}{once}"

    def as_json(self) -> dict[str, Any]:
        """Return it for programs; biases in SI, temperatures in degC."""
        sigma, at, axis = self.worst
        key, found = self.unit.key, bool(self.sigma.size)
        curve: Mapping[str, Any] = {"temperature_degC": self.T, key("bias"): self.bias, key("sigma"): self.sigma}
        return {
            "kind": self.kind,
            "samples": self.samples,
            "unused": self.unused_share,
            "seen_degC": self.seen if self.samples else None,
            "range_degC": self.asked,
            "coverage": self.coverage,
            "missing_degC": self.missing,
            "sweeps": self.sweeps,
            key("sigma_rms"): self.rms if found else None,
            key("sigma_worst"): sigma if found else None,
            "worst_at_degC": at if found else None,
            "worst_axis": axis or None,
            key("sigma_wanted"): self.wanted,
            "reached": self.reached,
            "why": self.why,
            "memory": None if self.memory is None else self.memory.as_json(),
            "curve": curve if found else None,
        }

    def _said(self, value: float) -> str:
        return f"{value * self.unit.factor:.2g}"


def covered(status: MapStatus, T: Array, seen: Range, samples: int) -> MapStatus:
    """Return the status with what was seen so far: T (K,) of blocks, the whole range, and how many samples."""
    low, high = seen if status.asked is None else status.asked
    width = high - low
    ends, slack = np.unique(T[(low <= T) & (high >= T)]), END * width
    missing: list[Range] = []
    if not len(ends):
        missing = [(low, high)] if width else []
    else:
        gaps = np.flatnonzero(np.diff(ends) > HOLE * width)
        missing += [(low, float(ends[0]))] if ends[0] > low + slack else []
        missing += [(float(ends[k]), float(ends[k + 1])) for k in gaps]
        missing += [(float(ends[-1]), high)] if ends[-1] < high - slack else []
    share = 1 - sum(stop - start for start, stop in missing) / width if width else float(samples > 0)
    sweeps = int(sweeps_of(T, TURN * float(np.ptp(T)))[-1]) + 1
    return replace(status, samples=samples, seen=seen, coverage=share, missing=tuple(missing), sweeps=sweeps)


def looked_at(status: MapStatus, fitted: FittedMap) -> MapStatus:
    """Return the status with the curve of a map, over what was seen of the range, and whether sigma is reached."""
    low, high = max(status.range[0], status.seen[0]), min(status.range[1], status.seen[1])
    if low > high:
        empty = np.empty((0, fitted.record.d))
        return replace(status, T=np.empty(0), bias=empty, sigma=empty, reached=False)
    T = np.linspace(low, high, GRID)
    sigma = fitted.sigma(T)
    enough = status.wanted is not None and not status.missing and bool(np.max(sigma) <= status.wanted)
    return replace(status, T=T, bias=fitted.bias(T), sigma=sigma, reached=enough)
