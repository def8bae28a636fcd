"""A unit's recording through the filter with its own map, and what it predicts without a measurement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.config import with_recording
from driftlab.fleets.figures import coasts_of, unknown
from driftlab.jobs.estimates import plain
from driftlab.jobs.run import RunResult, run
from driftlab.judging.measured import of_alignment

if TYPE_CHECKING:
    from driftlab.family.record import Figure
    from driftlab.fleets.own_map import Own
    from fusion_core.chunk import Array


@dataclass(frozen=True, eq=False)
class Coasted:
    """A run, and its coast.

    Attributes
    ----------
    name : str
        Of the recording.
    in_sample : bool
        Whether the map was fitted on it.
    figures : mapping of str to Figure
        The coasts.
    limits : list of dict
        The config's, held against run and map.
    notes : list of str
    result : RunResult or None
        None where the config has no filter.
    """

    name: str
    in_sample: bool
    figures: dict[str, Figure]
    limits: list[dict[str, Any]]
    notes: list[str]
    result: RunResult | None


def coasted(own: Own, tests: Sequence[str], soaks: Sequence[str], walk: Array) -> Coasted:
    """Run the filter with a unit's own map on its tests, or else on its first soak; of several tests the worst counts.

    `walk` (d,) is the density of its bias, SI/sqrt(s).

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used.
    """
    if own.config.filter is None:
        return Coasted("", in_sample=False, figures=dict(unknown(len(own.axes))), limits=[], notes=[], result=None)
    config = own.lenient if tests else own.config
    name, result = max(((name, run(with_recording(config, name))) for name in tests or soaks[:1]), key=_badness)
    alignment = result.journal.alignments[0]
    noise = of_alignment(result.model.tracked, alignment, result.model.align)
    overview = result.overview
    found = coasts_of(overview.yardsticks, overview.end - alignment.t, noise.values, walk)
    limits = plain([row.as_json(own.unit) for row in result.judged])
    return Coasted(name, not tests, found, limits, result.lines(), result)


def _badness(one: tuple[str, RunResult]) -> float:
    """Return the largest coast over ten minutes, or over what there is of it."""
    scores = (one[1].overview.yardsticks.coast[horizon] for horizon in ("10 min", "5 min", "1 min"))
    known = next((values for values in scores if np.any(np.isfinite(values))), np.zeros(1))
    return float(np.nanmax(known))
