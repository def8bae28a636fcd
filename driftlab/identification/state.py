"""A search in progress: the model so far with its noise, the trials beside it, and errors of left-out predictions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from driftlab.identification.acceptance import CandidateEvidence
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import LeftOutPart, error, parts
from driftlab.identification.least_squares import AxisFit, LeastSquares, Model, Term, slow_density
from driftlab.identification.records import Evidence, Progress
from driftlab.noise.local_level import LocalLevel, fit_local_level
from fusion_core.chunk import Array
from fusion_core.contracts import Basis, Effect
from fusion_core.errors import EmptyRecording

Errors = list[list[Array]]  # of each part, of each axis
SMOOTHING = np.logspace(-8, 2, 11)  # of the map, relative to its curves' own weight


@dataclass(frozen=True)
class Trial:
    """One family's best candidate beside a base."""

    model: Model  # the base, its memories as they were chosen with the candidate, and the candidate last
    evidence: CandidateEvidence  # figures of the candidate
    blocks: Array  # (d, blocks) sums of squares of the left-out errors, in the columns' scale
    likelihood: float  # gain in log-likelihood, each side at its best noise and parameters paid for, nats
    passes: bool  # whether the evidence is enough
    reason: str  # the figure that is not enough

    @property
    def term(self) -> Term:
        """The candidate."""
        return self.model[-1]

    @property
    def name(self) -> str:
        """Name of the candidate in messages."""
        return name_of(self.term.effect)

    @property
    def base(self) -> Model:
        """The model without the candidate."""
        return self.model[:-1]

    @property
    def size(self) -> int:
        """Coefficients an axis, hyper-parameters, and one more for an unknown start."""
        effect = self.term.effect
        return len(effect.terms) + len(effect.continuous) + int(self.term.free)


@dataclass
class Search:
    """A search: the model so far, the fits that it stands on, and the trials."""

    squares: LeastSquares  # fits, on all columns
    progress: Progress
    declared: Model  # terms that the config has already
    model: Model  # so far
    left_out: tuple[LeftOutPart, ...]  # parts that are left out in turn
    noises: list[LocalLevel] = field(default_factory=list)  # of the model's residuals, one an axis
    # each addition with its rivals, in the order of the model's terms after the declared ones
    added: list[tuple[Trial, tuple[Trial, ...]]] = field(default_factory=list)
    trials: list[Trial] = field(default_factory=list)  # the last that were tried, and not added
    tried: int = 0  # candidates at once, at most
    without: frozenset[str] = frozenset()  # kinds of effects that are not to be tried
    # kinds that were left out because they do not keep their contract, and how
    broken: dict[str, str] = field(default_factory=dict)
    # names whose regressors are exactly another's, and that one's name: they are not tried
    same: dict[str, str] = field(default_factory=dict)

    @classmethod
    def begun(
        cls, evidence: Evidence, basis: Basis | None, progress: Progress, declared: Model, without: Collection[str] = ()
    ) -> Search:
        """Return a search of nothing but the declared terms, with their smoothing and noise."""
        columns, d = EffectRegressors(evidence, basis), len(evidence.axes)
        squares = LeastSquares(columns, np.full(d, 1e-4), np.ones(d))
        search = cls(squares, progress, declared, declared, parts(columns), without=frozenset(without))
        search.fresh()
        return search

    @property
    def columns(self) -> EffectRegressors:
        """All that may be in a model."""
        return self.squares.columns

    @property
    def evidence(self) -> Evidence:
        """The recordings."""
        return self.columns.evidence

    @property
    def everything(self) -> tuple[int, ...]:
        """All segments."""
        return self.columns.everything

    @property
    def all_axes(self) -> range:
        """The axes of the sensor."""
        return range(len(self.columns.y))

    @property
    def axes(self) -> list[int]:
        """The axes on which anything was measured: a constant is no evidence for any model."""
        columns = self.columns
        return [axis for axis, y in enumerate(columns.y) if np.any(columns.W[:, y])] or [0]

    @property
    def named(self) -> set[str]:
        """The channels that the effects of the model read."""
        return {name for term in self.model for name in term.effect.requires}

    def fit(self, model: Model, axis: int) -> AxisFit:
        """Fit a model on one axis over all recordings."""
        return self.squares.fit(model, axis, self.everything)

    def residuals(self, model: Model) -> list[Array]:
        """Return the residual (n,) of a model on each axis, in the columns' scale."""
        return [self.squares.residual(axis, self.fit(model, axis)) for axis in self.all_axes]

    def fresh(self) -> None:
        """Work out smoothing and noise for the present model."""
        for axis in self.all_axes:
            self.squares.smoothing[axis] = self._smoothing(axis)
        self.squares.forget()
        for axis, residual in enumerate(self.residuals(self.model)):
            slow = slow_density(self.evidence.split(residual))
            self.squares.colour[axis] = slow / max(float(np.mean(residual**2)), 1e-300)
        self.squares.forget()
        self.noises = self.noises_of(self.model)

    def noises_of(self, model: Model) -> list[LocalLevel]:
        """Return the noise of a model's residual on each axis."""
        return [fit_local_level(self.evidence.split(residual)) for residual in self.residuals(model)]

    def left_out_errors(self, models: Sequence[Model], noises: Sequence[LocalLevel]) -> Errors:
        """Return the errors of the predictions of all parts, by a model for each of them."""
        return [
            [error(self.squares, model, axis, part, noises[axis]) for axis in self.all_axes]
            for model, part in zip(models, self.left_out, strict=True)
        ]

    def errors_of(self, model: Model) -> Errors:
        """Return the errors of one model's predictions of all parts, under its own noise."""
        return self.left_out_errors([model] * len(self.left_out), self.noises_of(model))

    def _smoothing(self, axis: int) -> float:
        """Return the weight of the map's penalty that predicts left-out segments best, the map fitted without them."""
        squares, columns = self.squares, self.columns
        if not np.any(columns.penalty):
            return 0.0
        costs = []
        for weight in SMOOTHING:
            squares.smoothing[axis] = weight
            squares.forget()
            total = 0.0
            for k, segment in enumerate(columns.segments):
                fit = squares.fit(self.model, axis, columns.all_but(k))
                e = columns.W[segment.rows, columns.y[axis]] - columns.W[segment.rows][:, fit.cols] @ fit.beta
                total += float(np.sum((e - e.mean()) ** 2))
            costs.append(total)
        return float(SMOOTHING[int(np.argmin(costs))])


def name_of(effect: Effect) -> str:
    """Return the name of an effect in messages: its kind, and its channel."""
    subject = effect.subject
    return effect.kind if subject in ("time", "temperature") else f"{effect.kind} of {subject}"


@dataclass(frozen=True)
class LeftOut:
    """Errors of a part that was left out, its mean taken off, from the end of its alignment on."""

    name: str  # of the recording
    train: bool  # whether it is for training
    part: LeftOutPart  # rows that were left out of it
    t: Array  # (n,) times, s
    before: Array  # (n, d) errors of the declared model, SI
    after: Array  # (n, d) errors of the final one, SI


def check_length(evidence: Evidence) -> None:
    """Check that something can be left out and predicted; raises EmptyRecording."""
    if not parts(EffectRegressors(evidence, None)):
        longest = max(evidence.records, key=len)
        raise EmptyRecording(
            f"{longest.name}: is at rest for {longest.t[-1] - longest.t[0] + evidence.interval:.0f} s, of which "
            f"{evidence.align:.0f} s are for the alignment, and no recording given for fitting is longer: nothing is "
            "left to predict; record longer, or set a shorter filter.align"
        )


def left_out(search: Search) -> tuple[LeftOut, ...]:
    """Return the errors of both models on each part; coefficients are those of the rest, hyper-parameters of all."""
    evidence, scale = search.evidence, search.columns.scale[search.columns.y]
    both = search.errors_of(search.declared), search.errors_of(search.model)
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
