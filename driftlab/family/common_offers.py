"""What a family may have in common: all that the installed effects propose for some of its units."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from pydantic import ValidationError

from driftlab.family.contrasts import chunks_of, of_each_axis, own_curve
from driftlab.family.soaked import Soaked
from driftlab.loop.offers import installed
from driftlab.loop.state import name_of
from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.errors import FusionError, MissingChannel
from fusion_core.host.classes import kind_of

MOST = 3  # coefficients an axis: with more, an effect is a map, or one's guess


@dataclass(frozen=True, eq=False)
class Offer:
    """An effect with hyper-parameters, and how many coefficients an axis it has here; a lag's one is 1."""

    effect: Effect
    size: int

    @property
    def family(self) -> tuple[str, str]:
        """What it has in common with those that differ by hyper-parameters alone."""
        return name_of(self.effect), self.effect.variant

    @property
    def parameters(self) -> tuple[int, int]:
        """How simple it is: coefficients; and hyper-parameters, with one for a memory of what came before."""
        return self.size, len(self.effect.continuous) + int(self.effect.fades)


def offered(sample: Sequence[Soaked], without: Collection[str]) -> tuple[list[Offer], dict[str, str]]:
    """Return what is offered, and why kinds of effects are not.

    Lines are not: their phase is the chamber's at the time, and no unit's.
    """
    channels = Counter(frozenset(soaked.recordings[0].channels) for soaked in sample)
    alike = [s for s in sample if frozenset(s.recordings[0].channels) == channels.most_common(1)[0][0]]
    chunks = [chunk for soaked in alike for chunk in _with_residual(soaked)]
    found: list[Offer] = []
    refused: dict[str, str] = {}
    for cls in installed():
        kind = kind_of(cls)
        if kind in without:
            refused[kind] = "not wanted"
        elif cls.course == "line":
            refused[kind] = "its phase is no property of a unit"
        else:
            try:
                found += _of(cls, sample[0].axes, chunks)
            except MissingChannel:
                continue
            except FusionError as error:
                refused[kind] = f"broken: {error}"
    return found, refused


def _of(cls: type[Effect], axes: tuple[str, ...], chunks: Sequence[Chunk]) -> list[Offer]:
    try:
        blank = cls(axes=axes)  # type: ignore[call-arg]
    except ValidationError:
        return []
    found = []
    for proposed in blank.proposals(chunks):
        effect = proposed.beside_map(None) if set(proposed.requires) <= set(chunks[0].channels) else None
        if effect is None:
            continue
        size = 1 if effect.acts_on_input else _coefficients(effect, chunks[0])
        if 0 < size <= MOST:
            found.append(Offer(effect, size))
    return found


def _coefficients(effect: Effect, chunk: Chunk) -> int:
    """Return how many coefficients an axis an effect has; 0 where those of one axis show on another."""
    shown = effect.signature(chunk.part(0, min(len(chunk), 500)), None)[0]
    d, p = shown.shape[1:]
    if p % d:
        return 0
    own = of_each_axis(shown)
    return p // d if np.isclose(np.sum(own**2), np.sum(shown**2)) else 0


def _with_residual(soaked: Soaked) -> list[Chunk]:
    curve = own_curve(soaked)
    parts = [rows.bias - soaked.knots.values(rows.T) @ curve.T for rows in soaked.recordings]
    spread = np.maximum(np.std(np.concatenate(parts), axis=0), 1e-300)
    return [chunk.having(residual=part / spread) for chunk, part in zip(chunks_of(soaked), parts, strict=True)]
