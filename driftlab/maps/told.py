"""What placements told, and what one more would tell, in words and in numbers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from driftlab.maps.placements import Placements
from driftlab.units import BiasUnit

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
