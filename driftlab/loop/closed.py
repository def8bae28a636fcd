"""What a loop amounts to: an explanation found in recordings, and how it does on a holdout."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.loop.evidence import Evidence, Progress
from driftlab.loop.explained import Joint, joint
from driftlab.loop.outcome import Outcome, change_of, sentence
from driftlab.loop.predicted import LeftOut, check_length, left_out, rms
from driftlab.loop.record import as_json
from driftlab.loop.recorded import lacking
from driftlab.loop.search import search
from driftlab.loop.state import Search
from driftlab.loop.verdict import Verdict, judge
from driftlab.loop.words import summary
from fusion_core.contracts import Effect, ThermalMap


@dataclass(frozen=True)
class Explanation:
    """What recordings say that the declared model lacks.

    Attributes
    ----------
    search : Search
        The model that was found, and what was tried.
    verdict : Verdict
    left_out : tuple of LeftOut
        How parts that were left out are predicted without it and with it.
    fit : Joint
        The model fitted to all rows.
    lines : tuple of str
        The verdict in sentences.
    """

    search: Search
    verdict: Verdict
    left_out: tuple[LeftOut, ...]
    fit: Joint
    lines: tuple[str, ...]

    @property
    def anything(self) -> bool:
        """Whether anything was added to the declared model."""
        return self.search.model != self.search.declared


@dataclass(frozen=True)
class Closed:
    """An explanation and how it does on the holdout; `content` is that of `loop.json`, `lines` say all in sentences."""

    search: Search
    verdict: Verdict
    left_out: tuple[LeftOut, ...]
    fit: Joint
    outcomes: tuple[Outcome, ...]
    lines: tuple[str, ...]
    content: dict[str, Any]

    @property
    def refuted(self) -> bool:
        """Whether it is predicted worse beyond chance: then the declared config stays."""
        return self.verdict.word == "refuted"

    @property
    def worse(self) -> bool:
        """Whether the holdout is predicted worse with what was found, by chance or beyond it."""
        return bool(self.content["holdout_change"]["after"] > self.content["holdout_change"]["before"])


def investigate(
    evidence: Evidence,
    settings: ThermalMap | None,
    declared: Sequence[Effect],
    progress: Progress,
    without: Collection[str] = (),
) -> Explanation:
    """Find what recordings say that a model with this map (or none) and these effects lacks.

    Effects of the kinds `without` are not tried.

    Raises
    ------
    EmptyRecording
        If the recordings are too short to leave anything out.
    """
    check_length(evidence)
    basis = None
    if settings is not None:
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        basis = settings.basis((float(T.min()), float(T.max())))
    found = search(evidence, basis, progress, declared, without)
    parts = left_out(found)
    verdict = judge(found, rms(parts)[1], progress)
    fit = joint(found)
    lines = summary(found, verdict, fit)
    if verdict.word in ("ambiguous", "unexplained") or verdict.promising:
        lines += lacking(evidence)
    return Explanation(found, verdict, parts, fit, tuple(lines))


def closed(
    found: Explanation, outcomes: Sequence[Outcome], recordings: Mapping[str, Sequence[Mapping[str, Any]]]
) -> Closed:
    """Return the explanation with how it does on the holdout; `recordings` are what each role's are called."""
    change = change_of(outcomes)
    verdict = replace(found.verdict, word="refuted") if change.worse else found.verdict
    first = sentence(change, outcomes)
    lines = (
        *([first] if first else []),
        *found.lines,
        *(f"{Path(o.name).name}: {remark}" for o in outcomes for remark in o.remarks),
    )
    summaries = [outcome.summaries for outcome in outcomes]
    content = as_json(found.search, verdict, found.fit, found.left_out, recordings, summaries)
    content["holdout_change"] = {"before": change.before, "after": change.after, "sigma": change.sigma}
    return Closed(found.search, verdict, found.left_out, found.fit, tuple(outcomes), lines, content)
