"""Discrimination of effects by a profile: a second criterion for the search among profiles.

Each effect is of one size for all profiles: one SI unit where the chamber goes up and down as fast as it can. So a
profile that provokes an effect more counts for more.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from driftlab.identification.state import Search, name_of
from driftlab.planning.chamber import Chamber, Profile, ramps
from driftlab.planning.detectability import families
from driftlab.planning.search import MIN_COVERAGE, SearchResult, possible
from driftlab.planning.simulated_search import Information, planned, swing_of
from driftlab.planning.unit_model import UnitModel

ROWS = 600  # of a recording that is only one of many
SIGMA_EXCESS = 0.1  # over the best, for the sake of discrimination


class DiscriminationCriterion:
    """The criterion for effects of some kinds, `names`."""

    def __init__(self, unit: UnitModel, chamber: Chamber, hours: float, kinds: Collection[str]) -> None:
        self.unit, self.lag = unit, chamber.lag
        sweeps = possible(*(ramps(chamber, hours, cycles) for cycles in (1, 2, 4, 8, 16)))
        assert sweeps, "hours in which the chamber comes up and down"
        search = self._search(unit, sweeps[-1])  # up and down as often as fits the hours
        self._own = {name: own for name, own in families(search).items() if own[0].kind in kinds}
        self._sizes = {repr(effect): swing_of(search, unit, effect) for own in self._own.values() for effect in own}
        self.names = tuple(self._own)

    def nats(self, profile: Profile) -> float:
        """Return the nats of the worst pair: of any of the effects, with another one in its place; or beside none."""
        search = self._search(self.unit, profile)
        effects = [effect for own in self._own.values() for effect in own]
        information = Information(search, self.unit, effects)
        places = {name: [k for k, e in enumerate(effects) if name_of(e) == name] for name in self.names}
        worst = np.inf
        for name, own in places.items():
            k = own[len(own) // 2]
            size = swing_of(search, self.unit, effects[k]) / self._sizes[repr(effects[k])]
            theta = size * information.direction(k)
            rivals = [j for other, at in places.items() if other != name for j in at]
            worst = min(worst, information.left(k, theta, rivals))
        return float(worst)

    def _search(self, unit: UnitModel, profile: Profile) -> Search:
        return planned(unit, lambda t: profile.body(t, self.lag), profile.duration, ROWS)


def preferred(result: SearchResult, criterion: DiscriminationCriterion) -> SearchResult:
    """Return the result with the most discriminating profile chosen, of those whose sigma is nearly the best."""
    limit = (1 + SIGMA_EXCESS) * result.chosen.score
    near = [item for item in result.judged if item.share >= MIN_COVERAGE and item.score <= limit]
    if not criterion.names or not near:
        return result
    best = max(near, key=lambda item: criterion.nats(item.profile))
    return replace(result, judged=(best, *(item for item in result.judged if item is not best)))
