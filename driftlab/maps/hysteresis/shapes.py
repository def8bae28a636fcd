"""Shapes of memories of temperature on a soak: regressors of the installed effects that read it alone.

Each installed effect proposes its hyper-parameters for the soak's temperatures, as it does for `explain`; its shape is
that of a coefficient of 1 in the bias. What is a function of temperature alone, run forwards or backwards, is no
memory and is left to the curve. An effect that acts on the map's input (a lag) shows the temperature that the curve
sees; what it adds is the curve there less the curve here. So may what is behind temperature by some kelvin (a play).

A material has not one width or time but many: beside each shape of a grid stands the mean of all up to it, as loops
that are lenses (a Prandtl-Ishlinskii operator, many plays side by side) and creep over decades of time need. Beside the
narrowest of what knows no time (a play) stand narrower ones, down to a step where the temperature turns.
The opening of a memory is the greatest difference between a sweep up and a sweep down at the same temperature.
S slots, J shapes, W sweeps, G temperatures, d axes.

Source: M. Brokate and J. Sprekels, Hysteresis and Phase Transitions, Springer (1996), section 2.4.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.soak.blocks import SoakSummary
from fusion_core.chunk import Array, Chunk, Integers
from fusion_core.contracts import Effect
from fusion_core.errors import FusionError
from fusion_core.host.registry import registry

SUBJECT = "temperature"
NARROWER = (4.0, 2.0)  # than the narrowest of a grid
MINUTE = 60.0  # s
BEHIND = "bias/K"  # unit of the coefficient of what is behind temperature, in kelvin
SAME = 1e-6  # of a signature: a difference that is rounding


@dataclass(frozen=True, eq=False)
class MemoryShapes:
    """Shapes of the bias of the slots that memories may add, in order of their kinds."""

    kinds: tuple[str, ...]  # of each shape (J,); first those that add, then those that act on the curve's input
    added: Array  # (S, A): what a coefficient of 1 adds, of the first A
    inputs: Array  # (S, J - A): temperature that the curve sees, of the others, degC: of lags, and of every other play
    # (J,): which act on the curve's input for less than a minute: as a thermometer does that is read a moment before or
    # after the sensor, or stands beside it
    brief: NDArray[np.bool_]
    settling: NDArray[np.bool_]  # (J,): which run with the time alone, as what settles after it was switched on
    broken: tuple[str, ...] = ()  # effects that could not be tried, and why


def shapes_of(soak: SoakSummary) -> MemoryShapes:
    """Return the shapes of all installed effects that read temperature alone and remember it."""
    forward, backward = _recordings(soak), _recordings(soak, backward=True)
    added: list[tuple[str, Array]] = []
    inputs: list[tuple[str, Array]] = []
    spans: list[float] = []
    settling, broken = [], []
    for kind, cls in registry().classes(Effect).items():
        assert issubclass(cls, Effect)
        try:
            columns, acting, own = _offered(cls, forward, backward, soak.way.astype(np.float64))
        except FusionError as error:
            broken.append(f"{kind}: {error}")
            continue
        except ValueError as error:  # of a validation: settings without a default
            broken.append(f"{kind}: {str(error).splitlines()[0]}")
            continue
        if cls(axes=("x",)).walks:  # type: ignore[call-arg]
            settling.append(kind)
        if acting:
            inputs.extend((kind, column) for column in columns)
            spans += own
        elif len(columns):
            many = np.cumsum(columns, axis=0)[2::2] / np.arange(3, len(columns) + 1, 2)[:, None]
            added.extend((kind, column) for column in (*columns, *many))
            if cls.unit == BEHIND and np.isinf(own[0]):
                inputs.extend((kind, soak.T + column) for column in columns[-len(own) :: 2])
                spans += own[::2]
    S, kinds = len(soak.T), tuple(kind for kind, _ in (*added, *inputs))
    return MemoryShapes(
        kinds,
        np.array([column for _, column in added]).reshape(-1, S).T,
        np.array([column for _, column in inputs]).reshape(-1, S).T,
        np.concatenate([np.zeros(len(added), dtype=bool), np.array(spans) < MINUTE]),
        np.isin(kinds, settling),
        tuple(broken),
    )


def _offered(
    cls: type[Effect], forward: Sequence[Chunk], backward: Sequence[Chunk], way: Array
) -> tuple[list[Array], bool, list[float]]:
    """Return the proposals of a class on the slots, whether they act on the curve's input, and their spans in s."""
    grid = [e for e in cls(axes=("x",)).proposals(forward) if _may_open(e)]  # type: ignore[call-arg]
    if not grid:
        return [], False, []
    acting, settles = grid[0].acts_on_input, grid[0].walks
    grid = grid[::2] if settles else grid  # one exponential is much like the next
    timeless = not settles and grid[0].memory_span is None and len(cls.continuous) == 1
    if not remembers(_shown(grid[0], forward), _shown(grid[0], backward)):
        return [], acting, []  # whatever its hyper-parameters
    if timeless and not acting:
        ((name, value),) = grid[0].hyper_parameters.items()
        grid = [*(grid[0].model_copy(update={name: value / by}) for by in NARROWER), *grid]
    columns = [column for effect in grid for column in np.vstack(_shown(effect, forward)).T]
    spans = [np.inf if effect.memory_span is None else effect.memory_span for effect in grid]
    return [way, np.sign(columns[0]), *columns] if timeless and not acting else columns, acting, spans


def _may_open(effect: Effect) -> bool:
    """Return True if what an effect shows may differ between up and down: of temperature, or what settles with time.

    A steady drift is one of the laws of the slow noise.
    """
    return tuple(effect.requires) == (SUBJECT,) or (effect.walks and bool(effect.continuous))


def remembers(forward: Sequence[Array], backward: Sequence[Array]) -> bool:
    """Return True if what was shown of recordings differs from what is shown of them run backwards."""
    return any(
        bool(np.max(np.abs(one - other[::-1])) > SAME * max(float(np.ptp(one)), 1e-300))
        for one, other in zip(forward, backward, strict=True)
    )


def _recordings(soak: SoakSummary, *, backward: bool = False) -> list[Chunk]:
    step = -1 if backward else 1
    chunks = []
    for number in np.unique(soak.recording):
        own = soak.recording == number
        t, T = soak.t[own], soak.T[own][::step]
        chunks.append(Chunk(t, {SUBJECT: T, "residual": np.zeros((len(T), 1))}))
    return chunks


def _shown(effect: Effect, recordings: Sequence[Chunk]) -> list[Array]:
    """Return the input (N, 1) that an effect makes of each recording, or its signature (N, p)."""
    if effect.acts_on_input:
        return [effect.input(chunk, None)[0][:, None] for chunk in recordings]
    return [effect.signature(chunk, None)[0][:, 0] for chunk in recordings]


Mask = NDArray[np.bool_]

GRID = 121
OTHER = 0.5  # of an opening: almost as far


class Sweeps:
    """Shapes over the W sweeps of a soak, of which `up` (W,) go up, at the temperatures T (G,) in degC.

    `shown` (W, G, J, d) is what a coefficient of 1 adds there; NaN where the sweep is not.
    """

    def __init__(self, soak: SoakSummary, *values: Array) -> None:
        """Take what shapes show on the slots, parts of (S, J, d) or, where all axes are alike, (S, J, 1)."""
        self.T = np.linspace(*soak.domain, GRID)
        key = soak.recording * 3 + soak.way
        cuts = np.flatnonzero(np.diff(key, prepend=key[0] - 1))
        up, shown, d = [], [], max(part.shape[2] for part in values)
        for start, stop in zip(cuts, [*cuts[1:], len(key)], strict=True):
            if soak.way[start] and stop - start > 1:
                up.append(soak.way[start] > 0)
                each = (_over(self.T, soak.T[start:stop], part[start:stop]) for part in values)
                shown.append(np.concatenate([np.broadcast_to(x, (*x.shape[:2], d)) for x in each], axis=1))
        self.up = np.array(up, dtype=bool)
        self.shown = np.array(shown).reshape(len(up), GRID, sum(part.shape[1] for part in values), d)

    def openings(self) -> tuple[Array, Array]:
        """Return the opening of each shape (J, d), warming less cooling, and at which temperature it is (J, d)."""
        most, least = _extremes(self.shown, self.up)
        wide = np.where(np.abs(most) >= np.abs(least), most, least)
        known = np.isfinite(wide)
        at = np.argmax(np.where(known, np.abs(wide), 0.0), axis=0)
        return np.take_along_axis(np.where(known, wide, 0.0), at[None], axis=0)[0], self.T[at]

    def both_ways(self) -> NDArray[np.bool_]:
        """Return the shapes (J, d) that open almost as far the other way: a curve that bends has no sign."""
        most, least = (np.where(np.isfinite(one), one, 0.0) for one in _extremes(self.shown, self.up))
        sides = np.stack([np.max(most, axis=0), -np.min(least, axis=0)])
        return np.asarray(np.min(sides, axis=0) > OTHER * np.max(sides, axis=0))

    def opening_of(self, which: Integers, coefficients: Array, axis: int) -> tuple[float, Array]:
        """Return the opening of some shapes (q,) together on an axis, and what each coefficient (q,) adds to it."""
        shown = self.shown[:, :, which, axis]
        above, below, g = self.widest(shown @ coefficients)
        gradient = shown[above, g] - shown[below, g]
        return float(gradient @ coefficients), gradient

    def widest(self, together: Array) -> tuple[Integers, Integers, Integers]:
        """Return between which sweeps, up and down, and where on T each thing shown (W, G, ...) opens most."""
        most, least = (np.where(np.isfinite(one), one, 0.0) for one in _extremes(together, self.up))
        most_of_all = np.max(most, axis=0) >= -np.min(least, axis=0)
        g = np.where(most_of_all, np.argmax(most, axis=0), np.argmin(least, axis=0))
        there = np.take_along_axis(together, g[None, None], axis=1)[:, 0]
        signed, up = np.where(most_of_all, there, -there), self.up.reshape(-1, *[1] * (there.ndim - 1))
        above = np.argmax(np.where(up & ~np.isnan(there), signed, -np.inf), axis=0)
        return above, np.argmin(np.where(up | np.isnan(there), np.inf, signed), axis=0), g

    def mean_differences(self) -> Array:
        """Return warming less cooling in the mean over the sweeps (G, J, d); NaN where one of the two is missing."""
        up, down = (_mean(self.shown[self.up == way]) for way in (True, False))
        return up - down


def _over(grid: Array, T: Array, values: Array) -> Array:
    order = np.argsort(T, kind="stable")
    T, flat = T[order], values.reshape(len(T), -1)
    place = np.clip(np.searchsorted(T, grid) - 1, 0, len(T) - 2)
    width = T[place + 1] - T[place]
    share = np.clip(np.divide(grid - T[place], width, out=np.zeros_like(grid), where=width > 0), 0.0, 1.0)[:, None]
    values_there = flat[order[place]] * (1 - share) + flat[order[place + 1]] * share
    values_there[(grid < T[0]) | (grid > T[-1])] = np.nan
    return np.asarray(values_there.reshape(len(grid), *values.shape[1:]))


def _extremes(shown: Array, up: Mask) -> tuple[Array, Array]:
    """Return the greatest and the least of a sweep up less a sweep down; infinite where one of the two is missing."""
    low, high = np.where(np.isnan(shown), np.inf, shown), np.where(np.isnan(shown), -np.inf, shown)
    with np.errstate(invalid="ignore"):
        return high[up].max(axis=0) - low[~up].min(axis=0), low[up].min(axis=0) - high[~up].max(axis=0)


def _mean(shown: Array) -> Array:
    some = ~np.isnan(shown)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.where(some, shown, 0.0).sum(axis=0) / some.sum(axis=0))
