"""What the units of a fleet have in common: their family, and what the line did."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from driftlab.config import Config
from driftlab.family.law import Family
from driftlab.family.model import fit_family
from driftlab.fleet.doing import Count
from driftlab.fleet.kept import Kept
from driftlab.fleet.progress import Progress, Stage
from driftlab.fleet.words import units as counted
from driftlab.units import tracked_unit
from fusion_core.chunk import Array


@dataclass(frozen=True, eq=False)
class Learned:
    """What was learned.

    Attributes
    ----------
    family : Family or None
        None where there are too few units.
    odd : mapping of str to sequence of str
        Why, by unit, of those that stand out.
    lines : list of str
        What one should know of the family, a sentence each.
    """

    family: Family | None = None
    odd: Mapping[str, Sequence[str]] = field(default_factory=dict)
    lines: list[str] = field(default_factory=list)


def learn(kept: Kept, found: Count, config: Config, progress: Progress) -> Learned:
    """Learn from the units that are done."""
    progress(Stage("family"))
    try:
        family = fit_family(kept, channel=found.channel, bias_unit=found.bias_unit)
    except ValueError as error:
        return Learned(lines=[f"no family: {error}"])
    return Learned(family, lines=[_known(family, config)])


def _known(family: Family, config: Config) -> str:
    """Return what the family knows, in a sentence."""
    unit = tracked_unit(config.filter)
    low, high = family.knots.domain
    B = family.knots.values(np.linspace(low, high, 4 * family.knots.intervals + 1))
    mean, about, between = (_rms(B, C) for C in (family.mu_covariance, family.Sigma, family.Lambda))
    spread = [np.sqrt(a**2 + b**2) for a, b in zip(about, between, strict=True)]

    def said(values: Sequence[float]) -> str:
        return ", ".join(f"{axis} {v * unit.factor:.3g}" for axis, v in zip(family.axes, values, strict=True))

    return (
        f"the family of {counted(family.units)}, {low:g} to {high:g} degC: they spread by {said(spread)} {unit.shown} "
        f"about a mean map that is known to {said(mean)} {unit.shown} (1 sigma, rms over the range)"
    )


def _rms(B: Array, covariance: Array) -> list[float]:
    """Return the rms over a range (G, q) of the deviations of each axis, of covariances (d, q, q)."""
    return [float(np.sqrt(np.mean(np.einsum("gi,ij,gj->g", B, C, B)))) for C in covariance]
