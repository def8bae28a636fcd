"""How well a profile tells effects apart: a second criterion for the search among profiles.

Each effect is of one size for all profiles: what shows as one SI unit where the chamber goes up and down as fast as it
can. So a profile that provokes an effect more counts for more.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace

import numpy as np

from driftlab.identification.state import name_of
from driftlab.planning.chamber import Chamber, Profile, ramps
from driftlab.planning.detectability import families
from driftlab.planning.information import Information
from driftlab.planning.search import ENOUGH, SearchResult
from driftlab.planning.simulated_search import Body, UnrecordedUnit, planned, swing_of

ROWS = 600  # of a recording that is only one of many
SHARE = 0.1  # by which sigma may be above the best for the sake of telling effects apart


class DiscriminationCriterion:
    """The criterion for effects of some kinds.

    Attributes
    ----------
    names : tuple of str
        The effects.
    """

    def __init__(self, unit: UnrecordedUnit, chamber: Chamber, hours: float, kinds: Collection[str]) -> None:
        self.unit, self.lag = unit, chamber.lag
        reference = ramps(chamber, hours, 1)
        fast = _fastest(chamber, hours) or reference
        assert fast is not None, "hours in which the chamber comes up and down"
        found = planned(unit, self._body(fast), fast.duration, ROWS)
        self._own = {name: own for name, own in families(found).items() if own[0].kind in kinds}
        self._sizes = {repr(effect): swing_of(found, unit, effect) for own in self._own.values() for effect in own}
        self.names = tuple(self._own)

    def nats(self, profile: Profile) -> float:
        """Return the nats of the worst pair: of any of the effects, with another one in its place; or beside none."""
        found = planned(self.unit, self._body(profile), profile.duration, ROWS)
        effects = [effect for own in self._own.values() for effect in own]
        information = Information(found, self.unit, effects)
        places = {name: [k for k, e in enumerate(effects) if name_of(e) == name] for name in self.names}
        worst = np.inf
        for name, own in places.items():
            k = own[len(own) // 2]
            size = swing_of(found, self.unit, effects[k]) / self._sizes[repr(effects[k])]
            theta = size * information.direction(k)
            rivals = [j for other, at in places.items() if other != name for j in at]
            worst = min(worst, information.left(k, theta, rivals))
        return float(worst)

    def _body(self, profile: Profile) -> Body:
        return lambda t: profile.body(t, self.lag)


def _fastest(chamber: Chamber, hours: float) -> Profile | None:
    """Return ramps up and down, as many as fit the hours."""
    found = None
    for cycles in (1, 2, 4, 8, 16):
        found = ramps(chamber, hours, cycles) or found
    return found


def preferred(found: SearchResult, telling: DiscriminationCriterion) -> SearchResult:
    """Return what a search found with the profile chosen that tells most, of those whose sigma is nearly the best."""
    least = found.chosen.score
    near = [item for item in found.judged if item.share >= ENOUGH and item.score <= (1 + SHARE) * least]
    if not telling.names or not near:
        return found
    best = max(near, key=lambda item: telling.nats(item.profile))
    return replace(found, judged=(best, *(item for item in found.judged if item is not best)))
