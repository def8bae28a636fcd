"""Diagnosis of a search: effects with their evidence, explanations that cannot be distinguished, and the verdict.

The errors of predicting each row from those before (`driftlab.noise.local_level`) are white with unit variance, once
divided by their deviation, where the fast part of the residual says all of it. Over windows of W rows their sums, over
the square root of W, are then independent with unit variance again, at every time scale; and none stands out. What is
significant is reported only where it matters to one who drives off: where the residual is slow, or is no noise.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from driftlab.identification.acceptance import CHANCE, GAIN, nats_of
from driftlab.identification.candidates import Family, Probe, candidates_of, probes, with_residual
from driftlab.identification.experiments import Experiment, Question, propose
from driftlab.identification.least_squares import Term, without_term
from driftlab.identification.records import Evidence, Progress
from driftlab.identification.state import Search, Trial, name_of
from driftlab.identification.trials import as_good, contains, is_copy, tried, with_uncertain_map
from driftlab.noise.local_level import LocalLevel, one_step, whitened
from driftlab.units import duration
from fusion_core.chunk import Array
from fusion_core.contracts import Effect
from fusion_core.thermal.sweeps import one_way

Word = Literal["explained", "nothing_missing", "unexplained", "ambiguous", "refuted"]

SHORT = 200.0  # s: a memory of temperature that is shorter is its rate, whatever its name
ALIKE = 0.99  # correlation of what two effects add, from which on they are one
DROPPED = "was added, and what was added after it takes its part"
PROMISING = 0.8  # left-out ratio of a candidate that another recording may well confirm


@dataclass(frozen=True)
class Finding:
    """An effect of the model: its trial, its place in the model, its final form, and its rivals.

    `rivals` are of other physics, the best of each name, `alike` are other names of the same.
    """

    trial: Trial
    place: int
    effect: Effect
    rivals: tuple[Trial, ...]
    alike: tuple[str, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the rivals."""
        return tuple(trial.name for trial in self.rivals)


@dataclass(frozen=True)
class Diagnosis:
    """The verdict on a search."""

    word: Word  # in one word
    findings: tuple[Finding, ...]  # effects that were added
    rejected: tuple[Trial, ...]  # the best of each effect that was not
    left: tuple[Structure, ...]  # significant structure of the residual
    promising: tuple[Trial, ...]  # of the rejected, those that another recording may confirm
    # recordings that would tell rivals apart, and confirm what stands on slow evidence
    experiments: tuple[Experiment, ...]


def judge(search: Search, error: Array, progress: Progress) -> Diagnosis:
    """Look at the final model from all sides; `error` (d,) is its own on left-out parts, SI."""
    findings = _findings(search)
    rejected = _rejected(search)
    progress("looking at what is left")
    unnamed = _unnamed(search)
    beside = replace(search, model=(*search.model, *(trial.term for trial in unnamed)))
    beside.noises = beside.noises_of(beside.model)
    left = (*map(_structure, unnamed), *structures(beside, error))
    promising = () if findings else tuple(filter(_promising, _surely(search, rejected)))[:1]
    word: Word
    if any(finding.rivals for finding in findings):
        word = "ambiguous"
    elif left or any(map(_likely, promising)):
        word = "unexplained"
    else:
        word = "explained" if findings else "nothing_missing"
    experiments = propose(search, _questions(findings, promising))
    return Diagnosis(word, findings, rejected, left, promising, experiments)


def _findings(search: Search) -> tuple[Finding, ...]:
    """Return each addition that stayed, in the order of the model."""
    added = list(search.added)
    findings = []
    for place, term in enumerate(search.model):
        named = [pair for pair in added if pair[0].name == name_of(term.effect)]
        if term in search.declared or not named:
            continue
        trial, rivals = named[0]
        added.remove(named[0])
        trial, rivals = _beside_all(search, place, trial, rivals)
        rivals = (*rivals, *_copies(search, place, trial))
        others = [rival for rival in rivals if not _more_than(search, rival, trial)]
        alike = [rival for rival in others if _same_physics(search, rival, trial)]
        others = [rival for rival in others if rival not in alike]
        names = [one.name for one in _best_of_each(alike)]
        names += [name for name, other in search.same.items() if other == name_of(term.effect)]
        findings.append(Finding(trial, place, term.effect, _best_of_each(others), tuple(names)))
    return tuple(findings)


def _beside_all(search: Search, place: int, trial: Trial, rivals: tuple[Trial, ...]) -> tuple[Trial, tuple[Trial, ...]]:
    """Return a trial and its rivals, those alone that are it still beside what was added later."""
    others = without_term(search.model, place)
    if not rivals or others == trial.base:
        return trial, rivals
    names = {one.name for one in (trial, *rivals)}
    view = replace(search, model=others)
    trials = tried(view, others, {key: terms for key, terms in candidates_of(view).items() if key[0] in names})
    return _as_good(trials, trial) or (trial, rivals)


def _as_good(trials: Sequence[Trial], trial: Trial) -> tuple[Trial, tuple[Trial, ...]] | None:
    """Return the best of trials that has a trial's name, and those of others that are as good; None where none has."""
    same = [one for one in trials if one.name == trial.name]
    if not same:
        return None
    best = min(same, key=lambda one: one.evidence.ratio)
    return best, tuple(one for one in trials if one not in same and one.passes and as_good(one, best))


def _copies(search: Search, place: int, trial: Trial) -> tuple[Trial, ...]:
    """Return the same effect of channels that move with its own, where it is as good at the same hyper-parameters.

    Each on a grid of its own, the two differ by what lies between the points.
    """
    others, effect = without_term(search.model, place), search.model[place].effect
    names = {one.name for one in search.trials if is_copy(search, effect, one.term.effect)}
    if not names:
        return ()
    view, families = replace(search, model=others), {}
    for key, (term, *_) in candidates_of(view).items():
        if key[0] in {trial.name, *names}:
            families[key] = [replace(term, effect=term.effect.model_copy(update=effect.hyper_parameters))]
    return (_as_good(tried(view, others, families), trial) or (trial, ()))[1]


def _more_than(search: Search, rival: Trial, trial: Trial) -> bool:
    """Return True if the rival is the effect and more: then it is no other explanation."""
    wide, own = rival.term, trial.term
    return contains(search.columns, wide, own) and not contains(search.columns, own, wide)


def _same_physics(search: Search, rival: Trial, trial: Trial) -> bool:
    """Return True if two candidates are one: both a short memory of temperature, or its rate, and of one shape."""
    for effect in (rival.term.effect, trial.term.effect):
        if effect.subject != "temperature" or effect.memory_span is None or effect.memory_span >= SHORT:
            return False
    base, a, b = (np.stack(search.residuals(model), axis=1) for model in (trial.base, rival.model, trial.model))
    a, b = base - a, base - b  # what each adds to the bias (n, d), in the columns' scale
    return float(np.sum(a * b)) > ALIKE * float(np.sqrt(np.sum(a**2) * np.sum(b**2)))


def _rejected(search: Search) -> tuple[Trial, ...]:
    """Return the best of each effect that is not in the model, best first."""
    have = {name_of(term.effect) for term in search.model}
    dropped = [replace(trial, passes=False, reason=DROPPED) for trial, _ in search.added]
    return _best_of_each([trial for trial in (*dropped, *search.trials) if trial.name not in have])


def _best_of_each(trials: Sequence[Trial], of: Callable[[Trial], str] = lambda trial: trial.name) -> tuple[Trial, ...]:
    """Return the best trial of each name, or what `of` returns, best first."""
    best: dict[str, Trial] = {}
    for trial in sorted(trials, key=lambda t: (not t.passes, t.evidence.ratio)):
        best.setdefault(of(trial), trial)
    return tuple(best.values())


def _surely(search: Search, trials: Sequence[Trial]) -> Iterator[Trial]:
    """Yield trials, likely ones as they are beside an uncertain map, where temperatures go both ways to show it."""
    T = [chunk["temperature"] for chunk in search.evidence.chunks if "temperature" in chunk.channels]
    apart = not (T and one_way(T))
    yield from (with_uncertain_map(search, trial) if apart and _likely(trial) else trial for trial in trials)


def _promising(trial: Trial) -> bool:
    """Return True if left-out parts or fast times speak for a candidate, though not enough of them."""
    evidence = trial.evidence
    slow = evidence.steady < -1 and evidence.left_out > 0 and evidence.ratio < PROMISING
    return not trial.passes and (slow or _likely(trial))


def _likely(trial: Trial) -> bool:
    """Return True if a candidate is significant at fast times, and predicts no worse."""
    evidence = trial.evidence
    return evidence.chance > evidence.price + CHANCE and evidence.gain > GAIN and evidence.ratio < 1


def _unnamed(search: Search) -> tuple[Trial, ...]:
    """Return the best passing probe of each channel beside the final model: it is not named, nor added."""
    families: dict[Family, list[Term]] = {}
    for probe in probes(with_residual(search), search.evidence.axes):
        family = probe.channel, probe.form, search.columns.of(probe).p, False
        families.setdefault(family, []).append(Term(probe))
    passing = [trial for trial in tried(search, search.model, families) if trial.passes] if families else []
    return _best_of_each(passing, lambda trial: trial.term.effect.subject)


def _structure(trial: Trial) -> Structure:
    probe, evidence = trial.term.effect, trial.evidence
    assert isinstance(probe, Probe)
    scale = probe.tau if probe.form == "late" else 0.0
    return Structure(probe.channel, scale, probe.description, min(evidence.chance, MAX_NATS), evidence.price + CHANCE)


def _questions(findings: tuple[Finding, ...], promising: tuple[Trial, ...]) -> list[Question]:
    questions = []
    for finding in findings:
        name = name_of(finding.effect)
        for trial in finding.rivals:
            questions.append(Question(finding.trial.model, trial.model, (name, trial.name)))
        if not finding.rivals and not finding.trial.evidence.fast:
            questions.append(Question(finding.trial.model, finding.trial.base, (name, "nothing")))
    for trial in promising:
        questions.append(Question(trial.model, trial.base, (trial.name, "nothing")))
    return questions


SIGNIFICANT = 1e-5  # probability that noise alone shows so much at any of the time scales
SLOW = 120.0  # s: a residual over means of that length spoils a coast
MATTERS = 0.5  # of the error on left-out parts
BEYOND = 2.0  # of the declared mean square: from there on most of what is left is neither declared noise nor walk
PREDICTABLE = 0.5  # of what is left: where more than that follows from what was before, it is no noise
MIN_POWERS = 50  # frequencies of a spectrum: of fewer, the mean of logarithms is not Gaussian
MAX_NATS = 700.0  # exp of minus that is nearly the least number of a computer


@dataclass(frozen=True)
class Structure:
    """Something significant that is left, as `loop.json` has it: on which channel, at which time scale, how sure."""

    channel: str
    time_scale_s: float
    description: str
    log_likelihood_gain: float
    threshold: float


def structures(search: Search, error: Array) -> list[Structure]:
    """Return the structures of a residual that varies beyond its noise, or stands out at some time scale.

    `error` (d,) is that of the model on left-out parts, SI.
    """
    columns, evidence = search.columns, search.evidence
    left = evidence.split(np.stack(search.residuals(search.model), axis=1))
    parts = [part * columns.scale[columns.y] for part in left]
    found = _lasting(search, left, parts) if _slow(evidence.interval, parts, error) else []
    return found or quick(_predicted(search, left), evidence.interval, evidence.axes)


def _lasting(search: Search, left: list[Array], parts: list[Array]) -> list[Structure]:
    """Return the structures of a slow residual, of each recording (n, d) in the columns' scale and in SI."""
    from scipy.special import log_ndtr

    evidence, scales = search.evidence, list(_sums(_white(search, left)))
    limit = -float(np.log(SIGNIFICANT / len(scales)))
    unit, stays = evidence.unit, _stays(evidence.interval, parts)
    size = float(np.sqrt(np.mean(np.concatenate(parts) ** 2))) * unit.factor
    wanders = f"what is left, {size:.3g} {unit.shown} rms, stays for about {duration(stays)}, and not as noise does"
    varying, outlying = [], []
    for W, z in scales:
        nats = nats_of(float(np.sum(z**2)), z.size)
        varying.append(Structure("time", stays, wanders, min(nats, MAX_NATS), limit))
        largest, length = float(np.max(np.abs(z))), W * evidence.interval
        p = float(log_ndtr(-largest)) + float(np.log(2 * z.size))
        text = f"what is left jumps within {duration(length)}, at most by {largest:.1f} deviations of its noise"
        outlying.append(Structure("time", length, text, min(-p, MAX_NATS), limit))
    worst = [max(each, key=lambda s: s.log_likelihood_gain) for each in (varying, outlying)]
    return [s for s in worst if s.log_likelihood_gain > s.threshold] + beyond_declared(evidence, parts)[:1]


def quick(white: Sequence[Array], interval: float, axes: Sequence[str]) -> list[Structure]:
    """Return the structure of prediction errors (n, d), `interval` s apart, of which most follows from those before.

    The share that does is 1 - exp(mean log S) / mean S, S the spectrum (Kolmogorov), of whose logarithm that of a
    periodogram is less by Euler's constant in the mean. Noise has none, but for a deviation of the logarithm of
    sqrt((pi^2 / 6 - 1) / K) over K frequencies; what repeats, as a tone or a vibration, has.
    """
    from scipy.special import log_ndtr

    powers = [np.abs(np.fft.rfft(part - part.mean(axis=0), axis=0)[1:-1]) ** 2 / len(part) for part in white]
    power = np.concatenate([part for part in powers if len(part)])
    if len(power) < MIN_POWERS or not np.all(np.mean(power, axis=0) > 0):
        return []
    logs = np.mean(np.log(power), axis=0) + np.euler_gamma - np.log(np.mean(power, axis=0))
    flatness, k = np.exp(logs), int(np.argmin(logs))
    nats = -float(log_ndtr(logs[k] / np.sqrt((np.pi**2 / 6 - 1) / len(power))))
    limit = -float(np.log(SIGNIFICANT / len(axes)))
    if nats <= limit or flatness[k] > 1 - PREDICTABLE:
        return []
    longest = max(powers, key=len)[:, k]
    period = 2 * (len(longest) + 1) * interval / (1 + int(np.argmax(longest)))
    share = f"{1 - float(flatness[k]):.0%} of it follow from what was before"
    text = f"on {axes[k]} what is left is no noise, {share}, most of all with a period of {duration(period)}"
    return [Structure("time", period, text, min(nats, MAX_NATS), limit)]


def beyond_declared(evidence: Evidence, parts: Sequence[Array]) -> list[Structure]:
    """Return the axes and slow time scales at which residuals (n, d), SI, wander beyond declared noise and walk.

    The farthest first. The noise of the search is the residual's own, to which whatever wanders is a walk.
    """
    if evidence.noise is None or evidence.walk is None:
        return []
    h, axes = evidence.interval, evidence.axes
    noises = [LocalLevel.of(w**2 / h, q**2 * h) for w, q in zip(evidence.noise, evidence.walk, strict=True)]
    white = []
    for part, record in zip(parts, evidence.records, strict=True):
        steps = np.diff(record.t, prepend=record.t[0] - h) / h
        white.append(np.stack([innovations(e, noise, steps) for e, noise in zip(part.T, noises, strict=True)], axis=1))
    scales = [(W * h, z) for W, z in _sums(white) if W * h >= SLOW]
    limit = -float(np.log(SIGNIFICANT / max(len(scales) * len(axes), 1)))
    found = []
    for length, z in scales:
        for axis, square in zip(axes, np.mean(z**2, axis=0), strict=True):
            nats = nats_of(len(z) * float(square) / BEYOND, len(z))
            times = f"{float(np.sqrt(square)):.2g} times as far in {duration(length)}"
            text = f"on {axis} what is left wanders {times} as declared noise and walk"
            if nats > limit:
                found.append((float(square), Structure("time", length, text, min(nats, MAX_NATS), limit)))
    return [structure for _, structure in sorted(found, key=lambda pair: -pair[0])]


def _predicted(search: Search, parts: list[Array]) -> list[Array]:
    """Return the errors (n - 1, d) of predicting the residual (n, d) of each recording from its past, by its noise."""
    pairs = [
        [(np.ascontiguousarray(e), noise.gain) for e, noise in zip(x.T, search.noises, strict=True)] for x in parts
    ]
    return [np.column_stack([one_step([e], gain)[0] for e, gain in own]) for own in pairs]


def _white(search: Search, parts: list[Array]) -> list[Array]:
    """Return the normalised innovations (n - 1, d) of the residual (n, d) of each recording, by its noise."""
    return [
        np.stack([innovations(part[:, axis], noise) for axis, noise in enumerate(search.noises)], axis=1)
        for part in parts
    ]


def innovations(e: Array, noise: LocalLevel, steps: Array | float = 1.0) -> Array:
    """Return the normalised innovations (n - 1,) of a residual e (n,) whose level at the start is not known.

    An average of the first few rows is off by their noise, and a sum over those that follow would show it as a jump.
    `steps` (n,) is the time from the row before to each, in rows.
    """
    walk = np.full(len(e), noise.walk) * steps
    walk[0] = np.inf
    return np.asarray(whitened(e[:, None], np.full(len(e), noise.white), walk)[0][1:, 0])


def _slow(interval: float, parts: list[Array], error: Array) -> bool:
    """Return True if means of the residual (n, d) are a good part of the error (d,), on any axis."""
    W = max(1, round(SLOW / interval))
    means = np.concatenate([_windows(part, W).mean(axis=1) for part in parts])
    return bool(len(means) and np.any(np.sqrt(np.mean(means**2, axis=0)) > MATTERS * error))


def _stays(interval: float, parts: list[Array]) -> float:
    """Return the time (s) after which the residual (n, d) is half forgotten, white noise apart."""
    lags = np.unique(np.geomspace(1, max(max(map(len, parts)) // 2, 1), 60).astype(int))
    covariance = np.array([
        np.sum([np.sum(part[k:] * part[: len(part) - k]) for part in parts if len(part) > k])
        / sum(len(part) - k for part in parts if len(part) > k)
        for k in lags
    ])  # fmt: skip
    forgotten = lags[covariance < covariance[0] / 2]
    return float(interval * (forgotten[0] if len(forgotten) else lags[-1]))


def _windows(part: Array, W: int) -> Array:
    return part[: len(part) // W * W].reshape(-1, W, part.shape[1])


def _sums(parts: list[Array]) -> Iterator[tuple[int, Array]]:
    """Yield W and the normalised sums (k, d) of white parts (n, d) over windows of W rows, for W = 1, 2, 4, ..."""
    longest = max(map(len, parts))
    W = 1
    while W == 1 or longest >= W * 8:
        yield W, np.concatenate([_windows(part, W).sum(axis=1) / np.sqrt(W) for part in parts])
        W *= 2
