"""Acceptance of an effect: the evidence that it needs, at short time scales, or at long ones and large.

Three figures of a candidate beside a base, M candidates having been tried:

left-out ratio    mean square of the error on left-out parts, with over without, geometric mean over the axes
left-out gain     sum over axes of n_eff / 4 log(1 / ratio) - log M, in nats; n_eff counts the independent rows of the
                  error for the shape that the effect adds, every row is left out twice
matched filter    the effect's coefficients in the residual, both whitened (`driftlab.noise.local_level`), with a
                  variance that does not trust the noise model (H. White, Econometrica 48 (1980) 817): its
                  chance, in nats; and what it gains in likelihood beyond the Bayesian information criterion and log M

Fast evidence: chance below exp(-5) / M, a gain beyond 3 nats, ratio below 0.9 (beside other
effects 0.85), a left-out gain at all. Slow evidence
counts what stands on few independent rows: a left-out gain beyond 5 nats and a ratio below 0.5.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc, gammaln, stdtrit

from driftlab.identification.columns import NormalEquations
from driftlab.identification.least_squares import LeastSquares, Model, Term
from driftlab.noise.local_level import LocalLevel, one_step
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

CHANCE = 5.0  # nats beyond the price of the choice
GAIN = 3.0  # nats beyond the Bayesian information criterion
FAST, BESIDE, SLOW = 0.9, 0.85, 0.5  # ratios: of a first effect, of one beside others, of slow evidence
ONE_SIGMA, SURELY = 0.8413, 0.95  # that the parts do not show it by accident
WORSE = 1.05  # ratio of a whole recording: where an effect does not act it may not harm
DRIFTING, SECOND = 0.8, 0.7  # ratios of what a walk imitates, and of a further term of a channel that is named already


@dataclass(frozen=True)
class CandidateEvidence:
    """A candidate's figures, as above; gains, chance and price in nats."""

    ratio: float  # mean square of the left-out error, with over without
    steady: float  # mean of the logarithms of the ratios part by part, over the deviation of that mean
    parts: int  # their number
    poorest: float  # the largest of the ratios of whole recordings
    beside: bool  # whether there are other effects in the model
    left_out: float  # left-out gain
    chance: float  # of the matched filter's answer
    gain: float  # of the matched filter, beyond the criterion
    price: float  # log M

    @property
    def needed(self) -> float:
        """Upper limit of the ratio; lower beside other effects, since their misfit looks like one more."""
        return BESIDE if self.beside else FAST

    def better(self, probability: float = ONE_SIGMA) -> bool:
        """Return True if left-out parts are predicted better: in all, and part by part with a probability."""
        quantile = -float(stdtrit(max(self.parts - 1, 1), probability))
        return self.ratio < self.needed and self.steady < quantile and self.poorest < WORSE and self.left_out > 0

    @property
    def fast(self) -> bool:
        """True if evidence at short times is enough."""
        strong = self.chance > self.price + CHANCE and self.gain > GAIN
        return strong and self.better()

    @property
    def slow(self) -> bool:
        """True if what is predicted of left-out parts is enough by itself."""
        return self.better(SURELY) and self.left_out > CHANCE and self.ratio < SLOW

    def reason(self) -> str:
        """Return in words what is not enough."""
        change, poorest = (100 * (float(np.sqrt(ratio)) - 1) for ratio in (self.ratio, self.poorest))
        if self.left_out <= 0 or self.ratio >= self.needed:
            return f"predicts left-out parts {change:+.0f} %: not better by more than chance"
        if self.poorest >= WORSE:
            return f"predicts a left-out recording {poorest:+.0f} %, that is, worse than without it"
        if not self.better():
            return "predicts one left-out part better, and the others not"
        if self.gain <= GAIN or self.chance <= self.price + CHANCE:
            return (
                f"is seen at slow times alone (log-likelihood {self.chance:.0f} at fast ones, "
                f"{self.price + CHANCE:.0f} needed), and predicts left-out parts {change:+.0f} % (-29 % needed)"
            )
        return "passes"


def accept(effect: Effect, evidence: CandidateEvidence, named: Collection[str]) -> tuple[bool, str]:
    """Judge the evidence for a candidate beside channels that are named already; return the reason where it fails.

    An effect that is easily imitated needs more: what runs with time alone, by any walk; a further term of a channel,
    by the first one's misfit.
    """
    own = set(effect.requires) - {"temperature", "temperature_rate"}
    if own & set(named):
        accepted = evidence.fast and evidence.left_out > CHANCE and evidence.ratio < SECOND
    elif effect.walks:
        needed = SECOND if evidence.beside else DRIFTING
        accepted = evidence.better(SURELY) and evidence.left_out > CHANCE and evidence.ratio < needed
        return accepted, "a walk imitates it, and left-out parts are not predicted better by as much as that needs"
    else:
        accepted = evidence.fast or evidence.slow
    return accepted, "" if accepted else evidence.reason()


def whitened(
    squares: LeastSquares, base: Model, term: Term, axis: int, noise: LocalLevel, *, generalised: bool = False
) -> tuple[Array, Array] | None:
    """Return residual (n,) of the base and the candidate's columns (n, p), the base taken out of both, as white.

    `generalised` takes the base out of what is white already, so that it is as uncertain as noise and walk make it.
    """
    columns, everything = squares.columns, squares.columns.everything
    fit, W = squares.fit(base, axis, everything), columns.W
    B, k = np.concatenate([fit.cols, squares.starts(term, everything)]), len(fit.cols)
    equations = columns.equations(everything, B, columns.y[axis : axis + 1])
    equations = equations.raised(fit.equations.A - equations.A[:k, :k])
    Z = W[:, columns.of(term.effect).columns[axis]]
    if term.effect.acts_on_input:
        other = squares.fit((*base, term), axis, everything)
        Z = np.column_stack([Z, W[:, fit.cols] @ fit.beta - W[:, other.cols] @ other.beta])
    if not Z.shape[1]:
        return None
    both = np.column_stack([W[:, columns.y[axis]], Z])
    left = both - W[:, B] @ equations.solve(W[:, B].T @ both)
    white = np.concatenate(one_step(columns.evidence.split(left), noise.gain))
    if generalised:
        X = np.concatenate(one_step(columns.evidence.split(W[:, B]), noise.gain))
        white = white - X @ NormalEquations(X.T @ X, np.zeros(len(B)), 0.0).solve(X.T @ white)
    return white[:, 0], white[:, 1:]


def fast_evidence(
    squares: LeastSquares, base: Model, term: Term, noises: list[LocalLevel], *, generalised: bool = False
) -> tuple[float, float]:
    """Return the chance of the matched filter's answer, and the gain beyond the information criterion, in nats."""
    pairs = (whitened(squares, base, term, axis, noise, generalised=generalised) for axis, noise in enumerate(noises))
    return matched_on_axes(filter(None, pairs), len(term.effect.continuous) + int(term.free))


def matched_on_axes(axes: Iterable[tuple[Array, Array]], parameters: int) -> tuple[float, float]:
    """Return the same of e (n,) and Z (n, p) of each axis, both white; `parameters` is beside the coefficients."""
    wald, gain, dof, rows = 0.0, 0.0, 0, 0
    for e, Z in axes:
        one = matched(e, Z)
        wald, gain, dof, rows = wald + one[0], gain + one[1], dof + one[2], max(rows, len(e))
    if dof == 0:
        return 0.0, -np.inf
    return nats_of(wald, dof), gain - 0.5 * (dof + parameters) * float(np.log(rows))


def matched(e: Array, Z: Array) -> tuple[float, float, int]:
    """Return Wald's figure of the columns Z (n, p) in e (n,), both white, the likelihood gained, and how many count.

    In nats the gain, before any parameter is paid for. Columns that show nothing do not count.
    """
    A = Z.T @ Z
    some = np.diag(A) > 1e-8 * len(e)
    Z, A = Z[:, some], A[np.ix_(some, some)]
    if not Z.shape[1]:
        return 0.0, 0.0, 0
    inverse = np.linalg.pinv(A, rcond=1e-9, hermitian=True)
    theta = inverse @ (Z.T @ e)
    left = e - Z @ theta
    ZR = Z * left[:, None]
    V = inverse @ (ZR.T @ ZR) @ inverse
    wald = float(theta @ np.linalg.pinv(V, rcond=1e-9, hermitian=True) @ theta)
    gain = 0.5 * len(e) * float(np.log(max(float(e @ e), 1e-300) / max(float(left @ left), 1e-300)))
    return wald, gain, Z.shape[1]


def nats_of(wald: float, dof: int) -> float:
    """Return minus the log of the chance that a chi-square is this large, also where that underflows."""
    with np.errstate(divide="ignore"):
        nats, half = -float(np.log(chdtrc(dof, wald))), 0.5 * dof
    return nats if np.isfinite(nats) else 0.5 * wald - (half - 1) * float(np.log(0.5 * wald)) + float(gammaln(half))
