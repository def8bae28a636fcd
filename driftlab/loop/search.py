"""Forward selection of effects: one at a time, each of which must pay for itself.

An effect pays for its coefficients and refined hyper-parameters as in the Bayesian information criterion, and for the
luck of having been chosen among M candidates::

    threshold = (p + h) / 2 log N + log M

Where the noise is not that of the model (`driftlab.loop.residue.dispersion`), gains count for less. An effect must also
make blocks of the training recordings that it was not fitted on more likely, by more than log M. Probes
(`driftlab.loop.probe`) take part, so that what has no name is not given one that fits half. After each addition
the hyper-parameters of all effects are refined, those that no longer pay are dropped, and each is exchanged where
another one does better in its place. G. Schwarz, Annals of Statistics 6 (1978) 461; J. Chen and Z. Chen, Biometrika 95
(2008) 759, for the price of the choice.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from driftlab.loop.probe import Probe, probes
from driftlab.loop.regression import Fit, Regression, solution
from driftlab.loop.residue import dispersion
from driftlab.loop.scan import Score, columns_seen, scan
from driftlab.loop.signals import Indices, Model
from fusion_core.chunk import Chunk
from fusion_core.contracts import Effect
from fusion_core.registry import registry

AS_GOOD = 3.0  # nats: one that is this much worse, prices paid, is 20 times less likely (Jeffreys: strong evidence)
CLOSER = 4  # best candidates of a scan whose noise and hyper-parameters are fitted before one is chosen
WORTH = 0.5  # of its threshold that a candidate must gain in a scan to be looked at more closely
NEAR = 0.7  # of the gain of the effect whose place it would take
MOST = 12  # effects that are added at the very most
FOLDS = 5

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Addition:
    """An effect with its evidence: gains in log-likelihood (nats) and what it had to reach."""

    effect: Effect
    gain: float
    threshold: float
    heldout: float


@dataclass
class Search:
    """A search in progress: the present model and what was tried."""

    regression: Regression
    progress: Progress
    null: Fit
    fit: Fit
    tried: int = 0  # candidates at once, at most
    seen: dict[tuple[str, int], int] = field(default_factory=dict)  # coefficients that can be told apart
    refused: dict[str, str] = field(default_factory=dict)  # why effects that were looked at closely were not added
    scored: dict[tuple[Any, ...], list[Score]] = field(default_factory=dict)  # some bases are looked at twice

    def worth(self, base: Fit, fit: Fit, effect: Effect) -> float:
        """Return what the effect gains beyond its price, from the fit without it to that with it."""
        return (fit.log_likelihood - base.log_likelihood) / dispersion(self.regression, fit) - self.threshold(effect)

    def scores(self, base: Fit, but: Effect | None = None) -> list[Score]:
        """Return a score for each of the proposals beside the base, but not for those of one name."""
        key = (repr(base.effects), tuple(axis.log_ratio for axis in base.axes), but and name_of(but))
        if key not in self.scored:
            offered = [e for e in proposals(self, base) if but is None or name_of(e) != name_of(but)]
            have = f" beside {', '.join(name_of(e) for e in base.effects)}" if base.effects else ""
            if but is None:
                self.progress(f"trying {len(offered)} candidates{have}")
            self.scored[key] = scan(self.regression, base, offered)
        return self.scored[key]

    def threshold(self, effect: Effect) -> float:
        """Return what the effect has to gain, in nats."""
        key = (name_of(effect), len(effect.labels))
        if key not in self.seen:
            self.seen[key] = columns_seen(self.regression, effect)
        p = self.seen[key] + len(effect.continuous)
        return 0.5 * p * float(np.log(len(self.regression.evidence))) + float(np.log(max(self.tried, 1)))


def search(regression: Regression, progress: Progress, declared: Model = ()) -> Search:
    """Find the effects that the model lacks; those that are declared already are fitted with the others."""
    progress("fitting the declared model")
    null = regression.fit(declared)
    found = Search(regression, progress, null, null)
    found.null = found.fit = refined(found, null)
    while len(found.fit.effects) < MOST and _add(found):
        if len(found.fit.effects) > 1:
            found.fit = refined(found, found.fit)
            _prune(found)
            _exchange(found)
    return found


def evidence_for(found: Search, effect: Effect) -> Addition:
    """Return an effect of the present model with its evidence: what its removal loses."""
    base = found.regression.fit(without(found.fit.effects, effect))
    gain = found.fit.log_likelihood - base.log_likelihood
    return Addition(effect, gain, found.threshold(effect), heldout_gain(found.regression, base, found.fit))


def closer(found: Search, base: Fit, scores: list[Score], count: int = CLOSER) -> list[Fit]:
    """Return full fits of the base with each of the best candidates, one of each kind and subject."""
    fits, seen = [], set()
    for score in sorted(scores, key=lambda s: s.gain - found.threshold(s.effect), reverse=True):
        key = name_of(score.effect)
        if key in seen:
            continue
        seen.add(key)
        fits.append(refined(found, found.regression.fit((*base.effects, score.effect), base), only=score.effect))
        if len(fits) == count:
            break
    return fits


def near(found: Search, base: Fit, scores: list[Score], present: float) -> list[Score]:
    """Return the scores that may come near the present model's log-likelihood, its effect's price paid."""
    bar = present - base.log_likelihood
    return [s for s in scores if s.gain - found.threshold(s.effect) > NEAR * bar - WORTH * found.threshold(s.effect)]


def name_of(effect: Effect) -> str:
    """Return what tells an effect from others in messages: its kind, and what it is about."""
    subject = effect.subject
    return effect.kind if subject in ("time", "temperature") else f"{effect.kind} of {subject}"


def proposals(found: Search, base: Fit) -> list[Effect]:
    """Return what every installed effect offers on these recordings, as far as the base has not got it already."""
    chunks = with_residual(found.regression, base)
    have = {name_of(effect) for effect in base.effects if effect.kind != "periodic"}
    offered: list[Effect] = []
    for cls in registry().classes(Effect).values():
        blank = cls(axes=found.regression.evidence.axes)  # type: ignore[call-arg]
        for effect in blank.proposals(chunks):  # type: ignore[attr-defined]
            if set(effect.requires) <= set(chunks[0].channels) and name_of(effect) not in have:
                offered.append(effect)
    offered += [e for e in probes(chunks, found.regression.evidence.axes) if name_of(e) not in have]
    found.tried = max(found.tried, len(offered))
    return offered


def with_residual(regression: Regression, fit: Fit) -> list[Chunk]:
    """Return the recordings with what the model leaves as channel `residual`."""
    evidence = regression.evidence
    residual = np.stack([regression.innovations(fit, axis)[0] for axis in range(len(evidence.axes))], axis=1)
    parts = evidence.split(residual)
    return [chunk.having(residual=part) for chunk, part in zip(evidence.chunks, parts, strict=True)]


def refined(found: Search, fit: Fit, only: Effect | None = None) -> Fit:
    """Refine the continuous hyper-parameters one after the other, at the fit's noise; then fit the noise again."""
    from scipy.optimize import minimize_scalar

    effects = list(fit.effects)
    changed = False
    for k, effect in enumerate(effects):
        if only is not None and effect is not only:
            continue
        for name, factor in type(effect).continuous.items():
            value, best = float(getattr(effect, name)), effects[k]

            def cost(
                log_factor: float, k: int = k, name: str = name, value: float = value, best: Effect = best
            ) -> float:
                effects[k] = best.model_copy(update={name: value * float(np.exp(log_factor))})
                return -found.regression.at_noise_of(fit, tuple(effects)).log_likelihood

            width = float(np.log(factor))
            result = minimize_scalar(cost, bounds=(-width, width), method="bounded", options={"xatol": width / 100})
            effects[k] = best.model_copy(update={name: value * float(np.exp(result.x))})
            changed = True
    return found.regression.fit(tuple(effects), fit) if changed else fit


def _add(found: Search) -> bool:
    """Add the effect that gains most beyond its price; return whether there is one."""
    base = found.fit
    fits = closer(found, base, [s for s in found.scores(base) if s.gain > WORTH * found.threshold(s.effect)])

    def rank(pair: tuple[float, Fit]) -> float:
        return pair[0] if isinstance(pair[1].effects[-1], Probe) else pair[0] + AS_GOOD

    worth = [(found.worth(base, fit, fit.effects[-1]), fit) for fit in fits]
    for value, fit in sorted(worth, key=rank, reverse=True):
        effect, gain = fit.effects[-1], fit.log_likelihood - base.log_likelihood
        if value <= 0:
            needed = found.threshold(effect)
            if gain > needed:
                found.refused[name_of(effect)] = (
                    f"gains {gain:.1f} nats, which count for {value + needed:.1f} since what is left beside it is not "
                    f"the declared noise ({needed:.1f} needed)"
                )
            continue
        heldout = heldout_gain(found.regression, base, fit)
        if heldout > np.log(found.tried):
            found.fit = fit
            return True
        found.refused[name_of(effect)] = (
            f"gains {gain:.1f} nats, but only {heldout:.1f} on held-out blocks ({np.log(found.tried):.1f} needed)"
        )
    return False


def _prune(found: Search) -> None:
    """Drop effects that no longer pay, the poorest first."""
    while len(found.fit.effects) > 1:
        fits = [found.regression.fit(without(found.fit.effects, e), found.fit) for e in found.fit.effects]
        nets = [found.worth(fit, found.fit, effect) for effect, fit in zip(found.fit.effects, fits, strict=True)]
        poorest = int(np.argmin(nets))
        if nets[poorest] > 0:
            return
        dropped = found.fit.effects[poorest]
        found.refused[name_of(dropped)] = "was added first, and no longer paid beside what was found after it"
        found.fit = fits[poorest]


def _exchange(found: Search) -> None:
    """Put another effect in the place of one of the model's where that does better."""
    for effect in found.fit.effects:
        base = found.regression.fit(without(found.fit.effects, effect), found.fit)
        present = found.fit.log_likelihood - found.threshold(effect)
        for fit in closer(found, base, near(found, base, found.scores(base, effect), present), count=2):
            other = fit.effects[-1]
            margin = AS_GOOD if isinstance(other, Probe) else 0.0
            better = found.worth(base, fit, other) - margin > found.worth(base, found.fit, effect)
            if better and heldout_gain(found.regression, base, fit) > np.log(found.tried):
                found.refused[name_of(effect)] = f"was added first; {name_of(other)} does better in its place"
                found.fit = fit
                return


def without(effects: Model, effect: Effect) -> Model:
    """Return the effects but one."""
    return tuple(e for e in effects if e is not effect)


def heldout_gain(regression: Regression, before: Fit, after: Fit) -> float:
    """Return how much more likely (nats) held-out blocks of the training recordings are with the second model.

    Coefficients of map and effects are those of the other blocks and the calibration; the noise is each fit's own.
    """
    folds = _folds(regression)
    return sum(_predictive(regression, after, axis, folds) - _predictive(regression, before, axis, folds)
               for axis in range(len(regression.evidence.axes)))  # fmt: skip


def _folds(regression: Regression) -> list[Indices]:
    return list(np.array_split(np.flatnonzero(regression.evidence.train), FOLDS))


def _predictive(regression: Regression, fit: Fit, axis: int, folds: list[Indices]) -> float:
    """Return the log-likelihood of the folds on one axis, each predicted from all other rows."""
    own = fit.axes[axis]
    X = regression.curves(fit.effects)
    Z, _ = regression.columns(fit.effects, axis)
    signals = np.hstack([X, Z, regression.evidence.rate[:, axis : axis + 1]])
    whitening = regression.whitening(axis, own.log_ratio)
    white, log_det = whitening(signals), whitening.log_S
    G = white.T @ white
    K = np.zeros_like(G[:-1, :-1])
    K[: X.shape[1], : X.shape[1]] = regression.prior(own.smoothing)
    total = 0.0
    for rows in folds:
        part = white[rows]
        rest = G - part.T @ part
        error = part[:, -1] - part[:, :-1] @ solution(rest[:-1, :-1] + K, rest[:-1, -1])
        total += -0.5 * float(np.sum(log_det[rows]) + np.sum((error / own.scale) ** 2)) - len(rows) * np.log(own.scale)
    return float(total)
