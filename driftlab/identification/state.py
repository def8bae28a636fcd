"""A search in progress: the model so far with its noise, and what was tried beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from driftlab.identification.acceptance import CandidateEvidence
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.cross_validation import LeftOutPart
from driftlab.identification.least_squares import LeastSquares, Model, Term, slow_density
from driftlab.noise.local_level import LocalLevel, fitted
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

SMOOTHING = np.logspace(-8, 2, 11)  # of the map, relative to its curves' own weight

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Trial:
    """One family's best candidate beside a base.

    Attributes
    ----------
    model : tuple of Term
        The base, its memories as they were chosen with the candidate, and the candidate last.
    evidence : Evidence
        Its figures.
    blocks : (d, blocks) array
        Sums of squares of the left-out errors, in the columns' scale.
    likelihood : float
        What it gains in likelihood, each side at its best noise and parameters paid for, in nats.
    passes : bool
        Whether it is enough.
    reason : str
        What it is that is not.
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
    def size(self) -> int:
        """Coefficients an axis, hyper-parameters, and one more for an unknown start."""
        effect = self.term.effect
        return len(effect.terms) + len(effect.continuous) + int(self.term.free)


@dataclass
class Search:
    """A search: the model so far, what it stands on, and what was tried.

    Attributes
    ----------
    squares : LeastSquares
        Fits, on all columns.
    model : tuple of Term
        The model.
    noises : list of Noise, one an axis
        Of what the model leaves.
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
        Names that show exactly what another shows, and that one's name: they are not tried.
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
    def everything(self) -> tuple[int, ...]:
        """All segments."""
        return self.columns.everything

    @property
    def axes(self) -> list[int]:
        """The axes on which anything was measured: one that shows a constant says nothing of any model."""
        columns = self.columns
        return [axis for axis, y in enumerate(columns.y) if np.any(columns.W[:, y])] or [0]

    def fresh(self) -> None:
        """Work out smoothing and noise for the present model."""
        self.squares.forget()
        slices = self.columns.evidence.slices
        self.noises = []
        for axis in range(len(self.columns.y)):
            self.squares.smoothing[axis] = smoothing_of(self, axis)
            fit = self.squares.fit(self.model, axis, self.everything)
            residual = self.squares.residual(axis, fit)
            split = [residual[rows] for rows in slices]
            self.squares.colour[axis] = slow_density(split) / max(float(np.mean(residual**2)), 1e-300)
        self.squares.forget()
        self.noises = noises_of(self, self.model)


def noises_of(found: Search, model: Model) -> list[LocalLevel]:
    """Return the noise of what a model leaves on each axis."""
    squares, slices = found.squares, found.columns.evidence.slices
    found_noises = []
    for axis in range(len(found.columns.y)):
        residual = squares.residual(axis, squares.fit(model, axis, found.everything))
        found_noises.append(fitted([residual[rows] for rows in slices]))
    return found_noises


def smoothing_of(found: Search, axis: int) -> float:
    """Return the weight of the map's penalty that predicts left-out segments best, the map fitted without them."""
    squares, columns = found.squares, found.columns
    if not np.any(columns.penalty):
        return 0.0
    costs = []
    for weight in SMOOTHING:
        squares.smoothing[axis] = weight
        squares.forget()
        total = 0.0
        for k, segment in enumerate(columns.segments):
            rest = tuple(j for j in found.everything if j != k)
            fit = squares.fit(found.model, axis, rest)
            e = columns.W[segment.rows, columns.y[axis]] - columns.W[segment.rows][:, fit.cols] @ fit.beta
            total += float(np.sum((e - e.mean()) ** 2))
        costs.append(total)
    squares.forget()
    return float(SMOOTHING[int(np.argmin(costs))])


def name_of(effect: Effect) -> str:
    """Return what tells an effect from others in messages: its kind, and what it is about."""
    subject = effect.subject
    return effect.kind if subject in ("time", "temperature") else f"{effect.kind} of {subject}"
