"""Prediction errors of recordings that were left out, by the declared model and by the identified one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import LeftOutPart, error, parts
from driftlab.identification.least_squares import Model
from driftlab.identification.records import Evidence
from driftlab.identification.state import Search
from driftlab.noise.local_level import LocalLevel
from fusion_core.chunk import Array
from fusion_core.errors import EmptyRecording

Errors = list[list[Array]]  # of each part, of each axis


@dataclass(frozen=True)
class LeftOut:
    """Errors of a part that was left out, its mean taken off, from the end of its alignment on.

    Attributes
    ----------
    name : str
        The recording.
    train : bool
        Whether it is for training.
    part : LeftOutPart
        The rows that were left out of it.
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


def left_out_errors(search: Search, models: Sequence[Model], noises: Sequence[LocalLevel]) -> Errors:
    """Return the errors of the predictions of all parts, by a model for each of them."""
    return [
        [error(search.squares, model, axis, part, noises[axis]) for axis in search.all_axes]
        for model, part in zip(models, search.left_out, strict=True)
    ]


def left_out(search: Search) -> tuple[LeftOut, ...]:
    """Return the errors of both models on each part; coefficients are those of the rest, hyper-parameters of all."""
    evidence, scale = search.evidence, search.columns.scale[search.columns.y]
    both = [
        left_out_errors(search, [model] * len(search.left_out), search.noises_of(model))
        for model in (search.declared, search.model)
    ]
    whole = []
    for part, *errors in zip(search.left_out, *both, strict=True):
        record, first = evidence.records[part.record], evidence.slices[part.record].start
        t = record.t[part.window.stop - first : part.rows.stop - first]
        before, after = (np.stack(each, axis=1) * scale for each in errors)
        whole.append(LeftOut(record.name, record.train, part, t, before, after))
    return tuple(whole)


def rms(whole: Sequence[LeftOut]) -> tuple[Array, Array]:
    """Return the rms over all parts of each axis (d,), before and after, SI."""
    before, after = (np.concatenate([getattr(part, name) for part in whole]) for name in ("before", "after"))
    return np.sqrt(np.mean(before**2, axis=0)), np.sqrt(np.mean(after**2, axis=0))


def to_show(whole: Sequence[LeftOut]) -> dict[str, list[LeftOut]]:
    """Return the parts of each training recording, whole recordings where they were left out whole."""
    shown: dict[str, list[LeftOut]] = {}
    for one in whole:
        if one.train:
            shown.setdefault(one.name, []).append(one)
    return {name: [one for one in parts if one.part.whole] or parts for name, parts in shown.items()}
