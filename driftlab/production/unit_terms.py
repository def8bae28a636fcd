"""Scale factor and misalignment of a unit as figures, and over the units of a fleet.

A unit with recordings of the role `stimulus` has them fitted as `fit-map --terms scale,misalignment` does, beside the
bias of its own soak (`driftlab.production.unit_map`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.evaluation.limits import OF_M
from driftlab.family.record import TERM_FIGURES, Figure, UnitRecord
from driftlab.family.unit_records import figure_of, figures_in
from driftlab.storage.json import plain
from driftlab.triad.model import AXES, NARROW
from driftlab.units import number

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from driftlab.triad.estimate import TriadFit
    from fusion_core.chunk import Array


def figures_of_terms(fit: TriadFit) -> dict[str, Figure]:
    """Return TERM_FIGURES of a fit in the middle of its temperatures, and their changes from the lowest to the highest.

    NaN, None in a figure, stands for a term that is not observable.
    """
    low, high = fit.domain
    middle = np.array([(low + high) / 2])
    moved = fit.observable & ~fit.unobservable_changes & (high - low >= NARROW)
    at_middle = _by_axis(fit.terms.at(middle)[0], fit.sigma(middle)[0], fit.observable)
    change = _by_axis(*fit.change(), moved)
    return at_middle | {f"{name}_change": figure for name, figure in change.items()}


def _by_axis(values: Array, sigma: Array, known: NDArray[np.bool_]) -> dict[str, Figure]:
    """Return TERM_FIGURES of all terms (q,) and their deviations, of those that are known."""
    M, S = (np.where(known, part, np.nan)[3:12].reshape(3, 3) for part in (values, sigma))
    diagonal, off = np.diag(M), np.where(np.eye(3, dtype=bool), np.nan, M)
    columns = [(diagonal, np.diag(S)), *((off[:, j], np.where(np.isnan(off[:, j]), np.nan, S[:, j])) for j in range(3))]
    return {name: Figure.of(value, own) for name, (value, own) in zip(TERM_FIGURES, columns, strict=True)}


def terms_of_units(records: Sequence[UnitRecord]) -> dict[str, Any] | None:
    """Return median and spread of each term over units, by its name, and how many units have one; None where none has.

    The spread is 1.48 times the median deviation, which odd units hardly widen; null of a single unit.
    """
    if not figures_in(records).intersection(TERM_FIGURES):
        return None
    M = np.stack([figure_of(records, name, len(AXES))[0] for name in TERM_FIGURES], axis=1)
    M = M[np.any(np.isfinite(M), axis=(1, 2))]
    if not len(M):
        return None
    found: dict[str, Any] = {"units": len(M)}
    for j, figure in enumerate(TERM_FIGURES):
        for i, axis in enumerate(AXES):
            own = M[np.isfinite(M[:, j, i]), j, i]
            if len(own):
                middle = np.median(own)
                spread = 1.4826 * np.median(np.abs(own - middle)) if len(own) > 1 else np.nan
                name = f"scale {axis}" if j == 0 else f"misalignment {axis}{figure[-1]}"
                found[name] = {"median": middle, "spread": spread, "units": len(own)}
    return dict(plain(found))


def sentence_of(terms: dict[str, Any]) -> str:
    """Return the spread of the terms over units, of the axis where it is largest, in a sentence."""
    parts = []
    for group, unit in OF_M.items():
        spreads = [row["spread"] for name, row in terms.items() if name.startswith(group) and row["spread"] is not None]
        if spreads:
            parts.append(f"{group} by {number(max(spreads) * unit.factor)} {unit.shown}")
    count = f"{terms['units']:,} unit{'s' * (terms['units'] > 1)}"
    spread = f": they spread in {' and '.join(parts)} (the axis that does most)" if parts else ""
    return f"scale factor and misalignment of {count} by a stimulus{spread}"
