"""How well recordings that were left out are predicted, by the declared model and by the one that was found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import LeftOutPart, error, parts
from driftlab.identification.records import Evidence
from driftlab.identification.state import Search, noises_of
from fusion_core.chunk import Array
from fusion_core.errors import EmptyRecording


@dataclass(frozen=True)
class LeftOut:
    """Errors of a part that was left out, its mean taken off, from the end of its alignment on.

    Attributes
    ----------
    name : str
        The recording.
    train : bool
        Whether it is for training.
    part : Part
        What was left out of it.
    t : (n,) array
        Times, s.
    before, after : (n, d) arrays
        Errors of the declared model and of the final one, SI.
    """

    name: str
    train: bool
    part: LeftOutPart
    t: Array
    before: Array
    after: Array


def check_length(evidence: Evidence) -> None:
    """Check that something can be left out and predicted; raises EmptyRecording."""
    if not parts(EffectRegressors(evidence, None)):
        longest = max(evidence.records, key=len)
        raise EmptyRecording(
            f"{longest.name}: is at rest for {longest.t[-1] - longest.t[0] + evidence.interval:.0f} s, of which "
            f"{evidence.align:.0f} s are for the alignment, and no recording given for fitting is longer: nothing is "
            "left to predict; record longer, or set a shorter filter.align"
        )


def left_out(found: Search) -> tuple[LeftOut, ...]:
    """Return what both models predict of each part; coefficients are those of the rest, hyper-parameters of all."""
    columns, evidence = found.columns, found.columns.evidence
    axes = range(len(columns.y))
    scale = columns.scale[columns.y]
    models = found.declared, found.model
    noises = [noises_of(found, model) for model in models]
    whole = []
    for part in found.left_out:
        record = evidence.records[part.record]
        first = evidence.slices[part.record].start
        errors = [
            np.stack([error(found.squares, model, axis, part, own[axis]) for axis in axes], axis=1) * scale
            for model, own in zip(models, noises, strict=True)
        ]
        t = record.t[part.window.stop - first : part.rows.stop - first]
        whole.append(LeftOut(record.name, record.train, part, t, *errors))
    return tuple(whole)


def rms(whole: Sequence[LeftOut]) -> tuple[Array, Array]:
    """Return the rms over all parts of each axis (d,), before and after, SI."""
    before, after = (np.concatenate([getattr(part, name) for part in whole]) for name in ("before", "after"))
    return np.sqrt(np.mean(before**2, axis=0)), np.sqrt(np.mean(after**2, axis=0))


def to_show(whole: Sequence[LeftOut]) -> dict[str, list[LeftOut]]:
    """Return the parts of each training recording, whole recordings where they were left out whole."""
    found: dict[str, list[LeftOut]] = {}
    for one in whole:
        if one.train:
            found.setdefault(one.name, []).append(one)
    for name, own in found.items():
        found[name] = [one for one in own if one.part.whole] or own
    return found
