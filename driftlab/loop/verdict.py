"""What the search amounts to: effects with their evidence, explanations that cannot be told apart, and the verdict."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from driftlab.loop.experiment import Experiment, propose
from driftlab.loop.probe import Probe
from driftlab.loop.regression import Fit, Regression
from driftlab.loop.residue import Structure, structures
from driftlab.loop.scan import Score
from driftlab.loop.search import (
    AS_GOOD,
    Addition,
    Progress,
    Search,
    closer,
    evidence_for,
    name_of,
    near,
    without,
)
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

Word = Literal["explained", "nothing_missing", "unexplained", "ambiguous"]

HIDDEN = 0.05  # share of an effect's weight that map and noise leave; with less it is as good as not seen


@dataclass(frozen=True)
class Finding:
    """An effect of the model: its evidence, the fits with each rival in its place that does as well, and their names.

    What the map hides on these recordings is a rival too where the effect is about time or temperature.
    """

    addition: Addition
    rivals: tuple[Fit, ...]
    names: tuple[str, ...]


@dataclass(frozen=True)
class Trial:
    """The best candidate of an effect that was not kept: gain and threshold in nats, and why."""

    effect: Effect
    gain: float
    threshold: float
    reason: str


@dataclass(frozen=True)
class Verdict:
    """All that was found.

    Attributes
    ----------
    word : str
        In one word.
    findings, rejected : tuples
        What is in the model, and what is not.
    left : tuple of Structure
        What is significantly left.
    hidden : dict of str to float
        Effects that these recordings do not show apart from the map, and the share of their weight that is left.
    experiments : tuple of Experiment
        What would tell apart what could not be.
    names, collinearity : tuple of str, (k, k) array
        Of the best candidate of each effect: correlation of their innovations, the map taken out.
    """

    word: Word
    findings: tuple[Finding, ...]
    rejected: tuple[Trial, ...]
    left: tuple[Structure, ...]
    hidden: dict[str, float]
    experiments: tuple[Experiment, ...]
    names: tuple[str, ...]
    collinearity: Array


def judge(found: Search, progress: Progress) -> Verdict:
    """Look at the model that was found from all sides."""
    regression, fit = found.regression, found.fit
    findings = []
    named = tuple(effect for effect in fit.effects if not isinstance(effect, Probe))
    for k, effect in enumerate(named):
        progress(f"looking for rivals of {name_of(effect)} ({k + 1} of {len(named)})")
        rivals = _rivals(found, effect)
        findings.append(Finding(evidence_for(found, effect), rivals, tuple(name_of(f.effects[-1]) for f in rivals)))
    progress("looking at what is left")
    rejected = _rejected(found, found.scores(fit))
    left = (*_unnamed(found), *structures(regression, fit))
    best = [*named, *(trial.effect for trial in rejected)]
    signals = [_signal(regression, fit, effect) for effect in best]
    share, matrix = _collinearity(regression, fit, signals)
    about_map = {e.kind: s for e, s in zip(best, share, strict=True) if _no_channel(e)}
    hidden = {kind: s for kind, s in about_map.items() if s < HIDDEN and kind not in {e.kind for e in fit.effects}}
    findings = [
        replace(f, names=(*f.names, *hidden)) if _no_channel(f.addition.effect) and len(hidden) > 0 else f
        for f in findings
    ]
    rivalry = [(finding.addition.effect, rival) for finding in findings for rival in finding.rivals]
    word: Word
    if rivalry or (hidden and all(_no_channel(finding.addition.effect) for finding in findings)):
        word = "ambiguous"
    elif left:
        word = "unexplained"
    else:
        word = "explained" if findings else "nothing_missing"
    unseen = [e for e in best if e.kind in hidden]
    experiments = propose(regression, fit, rivalry, unseen) if word == "ambiguous" else ()
    names = tuple(name_of(e) for e in best)
    return Verdict(word, tuple(findings), rejected, left, hidden, experiments, names, matrix)


def _no_channel(effect: Effect) -> bool:
    """Return whether an effect is about time or temperature alone, and is not the map itself."""
    return set(effect.requires) <= {"temperature", "temperature_rate"} and effect.kind != "map_misfit"


def _unnamed(found: Search) -> list[Structure]:
    """Return what is in the model without a name."""
    probes = [effect for effect in found.fit.effects if isinstance(effect, Probe)]
    additions = [(probe, evidence_for(found, probe)) for probe in probes]
    return [
        Structure(p.channel, p.tau if p.form == "late" else 0.0, p.description, a.gain, a.threshold)
        for p, a in additions
    ]


def _rivals(found: Search, effect: Effect) -> tuple[Fit, ...]:
    """Return the fits with another effect in the place of this one that are about as good, prices paid."""
    base = found.regression.fit(without(found.fit.effects, effect), found.fit)
    present = found.fit.log_likelihood - found.threshold(effect)
    scores = [score for score in found.scores(base, effect) if not isinstance(score.effect, Probe)]
    fits = closer(found, base, near(found, base, scores, present), count=6)
    good = (fit for fit in fits if fit.log_likelihood - found.threshold(fit.effects[-1]) > present - AS_GOOD)
    return tuple(fit for fit in good if not _more_than(found.regression, fit.effects[-1], effect))


def _more_than(regression: Regression, rival: Effect, effect: Effect) -> bool:
    """Return whether the rival is the effect and more: then it is no other explanation."""
    return _contains(regression, rival, effect) and not _contains(regression, effect, rival)


def _contains(regression: Regression, rival: Effect, effect: Effect) -> bool:
    """Return whether the rival has the effect's own regressors among its own."""
    wide, own = (np.concatenate(list(np.swapaxes(regression.signature(e), 0, 1))) for e in (rival, effect))
    if not own.size or not wide.size:
        return False
    scale = np.linalg.norm(wide, axis=0)
    unit = wide / np.where(scale > 0, scale, 1.0)
    rest = own - unit @ np.linalg.lstsq(unit, own, rcond=1e-10)[0]
    return bool(np.linalg.norm(rest) < 1e-6 * np.linalg.norm(own))


def _rejected(found: Search, scores: list[Score]) -> tuple[Trial, ...]:
    """Return the best candidate of each effect that is not in the model."""
    trials: dict[str, Trial] = {}
    for score in sorted(scores, key=lambda s: s.gain - found.threshold(s.effect), reverse=True):
        if isinstance(score.effect, Probe):
            continue
        name, threshold = name_of(score.effect), found.threshold(score.effect)
        reason = found.refused.get(name, f"gains {score.gain:.1f} nats where {threshold:.1f} are needed")
        if name not in found.refused and score.gain > threshold:
            reason = f"gains {score.gain:.1f} nats at first sight, and others gain more: it was not looked at closer"
        trials.setdefault(name, Trial(score.effect, score.gain, threshold, reason))
    return tuple(trials.values())


def _signal(regression: Regression, fit: Fit, effect: Effect) -> list[Array]:
    """Return what an effect shows on each axis (N, p'); one that acts on the map's input, by its first order."""
    found = []
    for axis, own in enumerate(fit.axes):
        Z, _ = regression.columns((effect,), axis)
        if effect.acts_on_input:
            moved = regression.curves((effect,)) @ own.c - regression.curves(()) @ own.c
            Z = np.hstack([Z, moved[:, None]])
        found.append(Z)
    return found


def _collinearity(regression: Regression, fit: Fit, signals: list[list[Array]]) -> tuple[list[float], Array]:
    """Return what share of each signal (k,) the map leaves, and their largest canonical correlations (k, k)."""
    k = len(signals)
    shares, total = np.full((len(fit.axes), k), 1.0), np.zeros((k, k))
    for axis, own in enumerate(fit.axes):
        of_map = regression.white_map((), axis, own.log_ratio)
        X, inverse = of_map.X, np.linalg.pinv(of_map.XX + regression.prior(1e-6))
        bases = []
        for j, signal in enumerate(signals):
            white = regression.whitening(axis, own.log_ratio)(signal[axis])
            left = white - X @ (inverse @ (X.T @ white))
            weight = np.sum(white**2, axis=0)
            if not np.any(weight > 0):
                bases.append(np.zeros((len(X), 1)))
                continue
            shares[axis, j] = float(np.max(np.sum(left**2, axis=0)[weight > 0] / weight[weight > 0]))
            U, s, _ = np.linalg.svd(left / np.sqrt(np.where(weight > 0, weight, 1.0)), full_matrices=False)
            bases.append(U[:, s > 1e-4])
        for i in range(k):
            for j in range(k):
                if bases[i].size and bases[j].size:
                    total[i, j] += np.linalg.norm(bases[i].T @ bases[j], 2) / len(fit.axes)
    np.fill_diagonal(total, 1.0)  # of what the map takes altogether too, where nothing is left to correlate
    return [float(v) for v in np.min(shares, axis=0)], np.clip(total, 0.0, 1.0)


def summary(found: Search, verdict: Verdict) -> list[str]:
    """Return the verdict in sentences."""
    lines = []
    for finding in verdict.findings:
        a = finding.addition
        lines.append(
            f"{name_of(a.effect)}: gains {a.gain:.0f} nats ({a.threshold:.0f} needed), "
            f"{a.heldout:.0f} on held-out blocks of train"
        )
        if finding.names:
            lines.append(f"{name_of(a.effect)}: cannot be told from {', '.join(finding.names)} on these recordings")
    for structure in verdict.left:
        lines.append(f"unexplained on {structure.channel}: {structure.description}")
    if verdict.hidden:
        lines.append(
            "not seen apart from the map on these recordings: "
            + ", ".join(f"{kind} ({100 * share:.1f} % left)" for kind, share in verdict.hidden.items())
        )
    for experiment in verdict.experiments:
        lines.append(
            f"to tell {' from '.join(experiment.separates)}: {experiment.description} ({experiment.gain:.0f} nats)"
        )
    if verdict.word == "nothing_missing":
        lines.append(f"no effect of {found.tried} candidates pays for itself, and what is left looks like noise")
    return lines
