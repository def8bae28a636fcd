"""What the search amounts to: effects with their evidence, explanations that cannot be told apart, and the verdict.

What is left when nothing is added any more, and whether it is noise.

The errors of predicting each row from those before (`driftlab.noise.local_level`) are white with unit variance, once
divided by their deviation, where the fast part of what is left says all of it. Over windows of W rows their sums, over
the square root of W, are then independent with unit variance again, at every time scale; and none stands out. What is
significant is told only where it matters to one who coasts: where what is left is slow.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from driftlab.identification.acceptance import CHANCE, GAIN
from driftlab.identification.candidates import Family, Probe, candidates_of, probes, span, with_residual
from driftlab.identification.experiment_design import Experiment, Question, propose
from driftlab.identification.least_squares import Model, Term
from driftlab.identification.records import Progress
from driftlab.identification.state import Search, Trial, name_of, noises_of
from driftlab.identification.trials import as_good, contains, tried
from driftlab.noise.local_level import one_step
from fusion_core.chunk import Array
from fusion_core.contracts import Effect

Word = Literal["explained", "nothing_missing", "unexplained", "ambiguous", "refuted"]

SHORT = 200.0  # s: a memory of temperature that is shorter is its rate, whatever it is called
ALIKE = 0.99  # correlation of what two effects show, from which on they are one
DROPPED = "was added, and what was added after it takes its part"
PROMISING = 0.8  # left-out ratio of a candidate that another recording may well confirm


@dataclass(frozen=True)
class Finding:
    """An effect of the model: how it was found, its place in it, as it is in the end, and what cannot be told from it.

    `rivals` are of other physics, the best of each name, `alike` are other names of the same.
    """

    trial: Trial
    place: int
    effect: Effect
    rivals: tuple[Trial, ...]
    alike: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """What the rivals are called."""
        return tuple(name_of(trial.term.effect) for trial in self.rivals)


@dataclass(frozen=True)
class Diagnosis:
    """All that was found.

    Attributes
    ----------
    word : str
        In one word.
    findings : tuple of Finding
        What was added.
    rejected : tuple of Trial
        The best of each effect that was not.
    left : tuple of Structure
        What is significantly left.
    promising : tuple of Trial
        Of the rejected, those that another recording may confirm.
    experiments : tuple of Experiment
        What would tell apart what could not be, and confirm what stands on slow evidence.
    """

    word: Word
    findings: tuple[Finding, ...]
    rejected: tuple[Trial, ...]
    left: tuple[Structure, ...]
    promising: tuple[Trial, ...]
    experiments: tuple[Experiment, ...]


def judge(found: Search, error: Array, progress: Progress) -> Diagnosis:
    """Look at the model that was found from all sides; `error` (d,) is its own on left-out parts, SI."""
    findings = _findings(found)
    rejected = _rejected(found)
    progress("looking at what is left")
    unnamed = _unnamed(found)
    beside = replace(found, model=(*found.model, *(trial.term for trial in unnamed)))
    beside.noises = noises_of(beside, beside.model)
    left = (*map(_structure, unnamed), *structures(beside, error))
    word: Word
    if any(finding.rivals for finding in findings):
        word = "ambiguous"
    elif left:
        word = "unexplained"
    else:
        word = "explained" if findings else "nothing_missing"
    promising = () if findings else tuple(t for t in rejected if _promising(t))[:1]
    experiments = propose(found, _questions(findings, promising))
    return Diagnosis(word, findings, rejected, left, promising, experiments)


def _findings(found: Search) -> tuple[Finding, ...]:
    """Return each addition that stayed, in the order of the model."""
    added = list(found.added)
    findings = []
    for place, term in enumerate(found.model):
        named = [pair for pair in added if name_of(pair[0].term.effect) == name_of(term.effect)]
        if term in found.declared or not named:
            continue
        trial, rivals = named[0]
        added.remove(named[0])
        trial, rivals = _beside_all(found, place, trial, rivals)
        others = [rival for rival in rivals if not _more_than(found, rival, trial)]
        alike = [rival for rival in others if _same_physics(found, rival, trial)]
        others = [rival for rival in others if rival not in alike]
        names = [name_of(one.term.effect) for one in _best_of_each(alike)]
        names += [name for name, other in found.same.items() if other == name_of(term.effect)]
        findings.append(Finding(trial, place, term.effect, _best_of_each(others), tuple(names)))
    return tuple(findings)


def _beside_all(found: Search, place: int, trial: Trial, rivals: tuple[Trial, ...]) -> tuple[Trial, tuple[Trial, ...]]:
    """Return a trial and its rivals, those alone that are it still beside what was added later."""
    others = tuple(term for k, term in enumerate(found.model) if k != place)
    if not rivals or others == trial.model[:-1]:
        return trial, rivals
    names = {name_of(one.term.effect) for one in (trial, *rivals)}
    view = replace(found, model=others)
    trials = tried(view, others, {key: terms for key, terms in candidates_of(view).items() if key[0] in names})
    own = [one for one in trials if name_of(one.term.effect) == name_of(trial.term.effect)]
    if not own:
        return trial, rivals
    best = min(own, key=lambda one: one.evidence.ratio)
    return best, tuple(one for one in trials if one not in own and one.passes and as_good(one, best))


def _more_than(found: Search, rival: Trial, trial: Trial) -> bool:
    """Return whether the rival is the effect and more: then it is no other explanation."""
    wide, own = rival.term, trial.term
    return contains(found.columns, wide, own) and not contains(found.columns, own, wide)


def _same_physics(found: Search, rival: Trial, trial: Trial) -> bool:
    """Return whether two candidates are one: both a short memory of temperature, or its rate, and of one shape."""
    if not all(_short(one.term.effect) for one in (rival, trial)):
        return False
    shapes = [_shape(found, one.model) for one in (rival, trial)]
    base = _shape(found, tuple(term for term in trial.model if term is not trial.term))
    a, b = (shape - base for shape in shapes)
    return float(np.sum(a * b)) > ALIKE * float(np.sqrt(np.sum(a**2) * np.sum(b**2)))


def _short(effect: Effect) -> bool:
    span = effect.memory_span
    return effect.subject == "temperature" and span is not None and span < SHORT


def _shape(found: Search, model: Model) -> Array:
    """Return what a model says of the bias (n, d), in the columns' scale."""
    squares = found.squares
    fits = [squares.fit(model, axis, found.everything) for axis in range(len(found.columns.y))]
    return np.stack([-squares.residual(axis, fit) for axis, fit in enumerate(fits)], axis=1)


def _rejected(found: Search) -> tuple[Trial, ...]:
    """Return the best of each effect that is not in the model, best first."""
    have = {name_of(term.effect) for term in found.model}
    dropped = [replace(trial, passes=False, reason=DROPPED) for trial, _ in found.added]
    trials = [trial for trial in (*dropped, *found.trials) if name_of(trial.term.effect) not in have]
    return _best_of_each(trials)


def _best_of_each(trials: Sequence[Trial]) -> tuple[Trial, ...]:
    """Return the best trial of each name, best first."""
    best: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda t: (not t.passes, t.evidence.ratio)):
        best.setdefault(name_of(trial.term.effect), trial)
    return tuple(best.values())


def _promising(trial: Trial) -> bool:
    """Return whether left-out parts or fast times speak for a candidate, though not enough of them."""
    evidence = trial.evidence
    slow = evidence.steady < -1 and evidence.left_out > 0 and evidence.ratio < PROMISING
    likely = evidence.chance > evidence.price + CHANCE and evidence.gain > GAIN and evidence.ratio < 1
    return not trial.passes and (slow or likely)


def _unnamed(found: Search) -> list[Trial]:
    """Return the best probe of each channel that finds something beside the final model: it is not named, nor added."""
    families: dict[Family, list[Term]] = {}
    axes = found.columns.evidence.axes
    for probe in probes(with_residual(found), axes):
        family = probe.channel, probe.form, found.columns.of(probe).p, False
        families.setdefault(family, []).append(Term(probe))
    passing = [trial for trial in tried(found, found.model, families) if trial.passes] if families else []
    best: dict[str, Trial] = {}
    for trial in sorted(passing, key=lambda t: t.evidence.ratio):
        best.setdefault(trial.term.effect.subject, trial)
    return list(best.values())


def _structure(trial: Trial) -> Structure:
    probe, evidence = trial.term.effect, trial.evidence
    assert isinstance(probe, Probe)
    scale = probe.tau if probe.form == "late" else 0.0
    return Structure(probe.channel, scale, probe.description, min(evidence.chance, BEYOND), evidence.price + CHANCE)


def _questions(findings: tuple[Finding, ...], promising: tuple[Trial, ...]) -> list[Question]:
    asked = []
    for finding in findings:
        name = name_of(finding.effect)
        for trial, other in zip(finding.rivals, finding.names, strict=True):
            asked.append(Question(finding.trial.model, trial.model, (name, other)))
        if not finding.rivals and not finding.trial.evidence.fast:
            asked.append(Question(finding.trial.model, _without(finding.trial), (name, "nothing")))
    for trial in promising:
        asked.append(Question(trial.model, _without(trial), (name_of(trial.term.effect), "nothing")))
    return asked


def _without(trial: Trial) -> Model:
    return trial.model[:-1]


SIGNIFICANT = 1e-5  # probability that noise alone shows so much at any of the time scales
SLOW = 120.0  # s: what is left over means of that length spoils a coast
MATTERS = 0.5  # of the error on left-out parts
BEYOND = 700.0  # nats: exp of minus that is nearly the least number of a computer
SETTLE = 3  # rows of a recording whose average is not yet of many


@dataclass(frozen=True)
class Structure:
    """Something significant that is left: on which channel, at which time scale (s), and how sure (nats)."""

    channel: str
    time_scale: float
    description: str
    gain: float
    threshold: float


def structures(found: Search, error: Array) -> list[Structure]:
    """Return whether what is left varies beyond its noise, and the time scale at which some of it stands out.

    `error` (d,) is that of the model on left-out parts, SI.
    """
    from scipy.stats import chi2, norm

    columns, slices = found.columns, found.columns.evidence.slices
    interval, d = columns.evidence.interval, len(columns.y)
    fits = [found.squares.fit(found.model, axis, found.everything) for axis in range(d)]
    left = np.stack([found.squares.residual(axis, fit) for axis, fit in enumerate(fits)], axis=1)
    parts = [left[rows] * columns.scale[columns.y] for rows in slices]
    if not _slow(interval, parts, error):
        return []
    scales = list(_sums(_white(found, [left[rows] for rows in slices])))
    limit = -float(np.log(SIGNIFICANT / len(scales)))
    unit = columns.evidence.unit
    size, stays = float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) * unit.factor, _stays(interval, parts)
    wanders = f"what is left, {size:.3g} {unit.shown} rms, stays for about {span(stays)}, and not as noise does"
    varying, outlying = [], []
    for W, z in scales:
        p = float(chi2.logsf(float(np.sum(z**2)), z.size))
        varying.append(Structure("time", stays, wanders, min(-p, BEYOND), limit))
        largest = float(np.max(np.abs(z)))
        p = float(norm.logsf(largest)) + float(np.log(2 * z.size))
        text = f"what is left jumps within {span(W * interval)}, at most by {largest:.1f} deviations of its noise"
        outlying.append(Structure("time", W * interval, text, min(-p, BEYOND), limit))
    worst = [max(seen, key=lambda s: s.gain) for seen in (varying, outlying)]
    return [s for s in worst if s.gain > s.threshold]


def _white(found: Search, parts: list[Array]) -> list[Array]:
    """Return the one-step errors (n', d) of what is left (n, d) of each recording, in their deviation."""
    axes = [
        [e[SETTLE:] / np.sqrt(noise.variance) for e in one_step([part[:, axis] for part in parts], noise.gain)]
        for axis, noise in enumerate(found.noises)
    ]
    return [np.stack(errors, axis=1) for errors in zip(*axes, strict=True)]


def _slow(interval: float, parts: list[Array], error: Array) -> bool:
    """Return whether means of what is left (n, d) are a good part of the error (d,), on any axis."""
    W = max(1, round(SLOW / interval))
    means = np.concatenate([_windows(part, W).mean(axis=1) for part in parts])
    return bool(len(means) and np.any(np.sqrt(np.mean(means**2, axis=0)) > MATTERS * error))


def _stays(interval: float, parts: list[Array]) -> float:
    """Return the time (s) after which what is left (n, d) is half forgotten, white noise apart."""
    lags = np.unique(np.geomspace(1, max(max(map(len, parts)) // 2, 1), 60).astype(int))
    forgotten = lags[-1]
    covariance = [
        np.sum([np.sum(part[k:] * part[: len(part) - k]) for part in parts if len(part) > k])
        / sum(len(part) - k for part in parts if len(part) > k)
        for k in lags
    ]
    for k, value in zip(lags, covariance, strict=True):
        if value < covariance[0] / 2:
            forgotten = k
            break
    return float(interval * forgotten)


def _windows(part: Array, W: int) -> Array:
    return part[: len(part) // W * W].reshape(-1, W, part.shape[1])


def _sums(parts: list[Array]) -> Iterator[tuple[int, Array]]:
    """Yield W and the normalised sums (k, d) of white parts (n, d) over windows of W rows, for W = 1, 2, 4, ..."""
    longest = max(map(len, parts))
    W = 1
    while W == 1 or longest >= W * 8:
        yield W, np.concatenate([_windows(part, W).sum(axis=1) / np.sqrt(W) for part in parts])
        W *= 2
