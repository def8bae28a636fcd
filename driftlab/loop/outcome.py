"""What the declared and the explained config predict of a holdout recording, which nothing was fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.loop.noise import falling
from driftlab.units import BiasUnit
from fusion_core.chunk import Array

ROWS = 4096  # means of a prediction that are compared, at most
SURE = 1.645  # deviations: one-sided, 95 %


@dataclass(frozen=True)
class Outcome:
    """One holdout recording through both configs: N times, d axes, SI.

    `summaries` are those of the two runs, `remarks` what a user should know of the second.
    """

    name: str
    unit: BiasUnit
    t: Array
    temperature: Array | None
    reference: Array
    before: Array
    after: Array
    before_sigma: Array
    after_sigma: Array
    summaries: tuple[dict[str, Any], dict[str, Any]]
    remarks: tuple[str, ...]


@dataclass(frozen=True)
class Change:
    """How the error of the prediction changes over all holdout recordings: its rms before and after, SI.

    `sigma` is by how many deviations of chance the sum of its squares grows.
    """

    before: float
    after: float
    sigma: float

    @property
    def worse(self) -> bool:
        """Whether it grows beyond chance."""
        return self.after > self.before and self.sigma > SURE


def change_of(outcomes: Sequence[Outcome]) -> Change:
    """Return how the error changes.

    With e the error before and s the change of the prediction, the sum of squares grows by s's + 2 s'e. Its deviation
    is 2 sqrt(s' Omega s), Omega what the periodogram of e says, smooth and falling: slow noise that happens to run
    along a slow s counts as what it is, a few independent rows.
    """
    grown, variance, total, rows = 0.0, 0.0, np.zeros(2), 0
    for outcome in outcomes:
        known = np.all(np.isfinite(outcome.reference), axis=1)
        e, after = (_means((side - outcome.reference)[known]) for side in (outcome.before, outcome.after))
        if not len(e):
            continue
        total += np.sum(e**2), np.sum(after**2)
        rows += len(e)
        grown += float(np.sum(after**2) - np.sum(e**2))
        variance += 4 * sum(_variance(own, change) for own, change in zip(e.T, (after - e).T, strict=True))
    before, after = np.sqrt(total / max(rows, 1))
    return Change(float(before), float(after), grown / float(np.sqrt(variance)) if variance > 0 else 0.0)


def sentence(change: Change, outcomes: Sequence[Outcome]) -> str:
    """Return what is to be said first of a prediction that gets worse; nothing where it does not by half a percent."""
    if not change.after > 1.005 * change.before:
        return ""
    unit, names = outcomes[0].unit, ", ".join(Path(outcome.name).name for outcome in outcomes)
    figures = f"{change.before * unit.factor:.3g} -> {change.after * unit.factor:.3g} {unit.shown}"
    if not change.worse:
        return f"{names}: predicted worse with what was found ({figures}), though by no more than chance may do"
    return (
        f"{names}: predicted worse with what was found than without ({figures}; {change.sigma:.1f} sigma): "
        "explained.yaml is the declared config, and candidate.yaml has what was found"
    )


def _means(values: Array) -> Array:
    """Return values (N, d) as at most `ROWS` means."""
    length = max(1, -(-len(values) // ROWS))
    starts = np.arange(0, len(values), length)
    sizes = np.diff(np.append(starts, len(values)))
    return np.asarray(np.add.reduceat(values, starts, axis=0) / sizes[:, None]) if len(values) else values


def _variance(e: Array, s: Array) -> float:
    """Return s' Omega s of signals (n,), Omega as the periodogram of e, its mean among it, says."""
    n = len(e)
    counted = np.full(n // 2 + 1, 2.0)
    counted[0] = 1.0
    omega = falling(np.abs(np.fft.rfft(e)) ** 2 / n)
    return float(np.sum(counted * omega * np.abs(np.fft.rfft(s)) ** 2) / n)
