"""A search in progress: the model so far with its noise, and the trials beside it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from driftlab.identification.acceptance import CandidateEvidence
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import LeftOutPart
from driftlab.identification.least_squares import AxisFit, LeastSquares, Model, Term, slow_density
from driftlab.identification.records import Evidence, Progress
from driftlab.noise.local_level import LocalLevel, fit_local_level
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

SMOOTHING = np.logspace(-8, 2, 11)  # of the map, relative to its curves' own weight


@dataclass(frozen=True)
class Trial:
    """One family's best candidate beside a base.

    Attributes
    ----------
    model : tuple of Term
        The base, its memories as they were chosen with the candidate, and the candidate last.
    evidence : CandidateEvidence
        Its figures.
    blocks : (d, blocks) array
        Sums of squares of the left-out errors, in the columns' scale.
    likelihood : float
        Gain in log-likelihood, each side at its best noise and parameters paid for, in nats.
    passes : bool
        Whether the evidence is enough.
    reason : str
        The figure that is not enough.
    """

    model: Model
    evidence: CandidateEvidence
    blocks: Array
    likelihood: float
    passes: bool
    reason: str

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
    """A search: the model so far, the fits that it stands on, and the trials.

    Attributes
    ----------
    squares : LeastSquares
        Fits, on all columns.
    model : tuple of Term
        The model.
    noises : list of LocalLevel, one an axis
        Of the model's residuals.
    added : list of (Trial, tuple of Trial)
        Each addition with its rivals, in the order of the model's terms after those that were declared.
    trials : list of Trial
        The last that were tried, and not added.
    tried : int
        Candidates at once, at most.
    without : frozenset of str
        Kinds of effects that are not to be tried.
    broken : dict of str to str
        Kinds that were left out because they do not keep their contract, and how.
    same : dict of str to str
        Names whose regressors are exactly another's, and that one's name: they are not tried.
    """

    squares: LeastSquares
    progress: Progress
    declared: Model
    model: Model
    left_out: tuple[LeftOutPart, ...]
    noises: list[LocalLevel] = field(default_factory=list)
    added: list[tuple[Trial, tuple[Trial, ...]]] = field(default_factory=list)
    trials: list[Trial] = field(default_factory=list)
    tried: int = 0
    without: frozenset[str] = frozenset()
    broken: dict[str, str] = field(default_factory=dict)
    same: dict[str, str] = field(default_factory=dict)

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
