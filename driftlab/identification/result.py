"""Result of an identification: the effects that the declared model lacks, and their errors on test recordings.

Predictions of a test recording, to which nothing was fitted, by the declared and the explained config.

`loop.json`: the verdict for programs.

The verdict in sentences for the test engineer.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab import __version__
from driftlab.identification.acceptance import CHANCE, GAIN
from driftlab.identification.diagnosis import MAX_NATS, Diagnosis, Finding, judge
from driftlab.identification.model import Joint, joint
from driftlab.identification.records import Evidence, Progress, missing_excitation
from driftlab.identification.search import search
from driftlab.identification.state import LeftOut, Search, Trial, check_length, left_out, name_of, rms
from driftlab.noise.local_level import falling
from driftlab.soak.blocks import means, runs
from driftlab.units import BiasUnit, with_uncertainty
from fusion_core.chunk import Array
from fusion_core.contracts import Effect, ThermalMap

if TYPE_CHECKING:
    from driftlab.evaluation.overview import ScoredRun


@dataclass(frozen=True)
class Identification:
    """The effects that the declared model lacks, and once it has been opened, their errors on the test recordings."""

    search: Search  # the identified model, and the trials
    verdict: Diagnosis  # on it
    left_out: tuple[LeftOut, ...]  # prediction errors of left-out parts without the effects and with them
    fit: Joint  # the model fitted to all rows
    lines: tuple[str, ...]  # the verdict in sentences
    outcomes: tuple[Outcome, ...] = ()  # each test recording through both configs
    change: ErrorChange | None = None  # of the prediction error over all of them
    content: dict[str, Any] = field(default_factory=dict)  # that of `loop.json`

    @property
    def anything(self) -> bool:
        """True if anything was added to the declared model."""
        return self.search.model != self.search.declared

    @property
    def refuted(self) -> bool:
        """True if the test recording is predicted worse beyond chance: then the declared config stays."""
        return self.verdict.word == "refuted"

    @property
    def worse(self) -> bool:
        """True if the test recording is predicted worse with the effects, by chance or beyond it."""
        return self.change is not None and self.change.after > self.change.before


def investigate(
    evidence: Evidence,
    settings: ThermalMap | None,
    declared: Sequence[Effect],
    progress: Progress,
    without: Collection[str] = (),
) -> Identification:
    """Find the effects that a model with this map (or none) and declared effects lacks on recordings.

    Effects of the kinds `without` are not tried. Raises EmptyRecording if the recordings are too short to leave
    anything out.
    """
    check_length(evidence)
    basis = None
    if settings is not None:
        T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
        basis = settings.basis((float(T.min()), float(T.max())))
    state = search(evidence, basis, progress, declared, without)
    parts = left_out(state)
    verdict = judge(state, rms(parts)[1], progress)
    fit = joint(state)
    lines = summary(state, verdict, fit)
    if verdict.word in ("ambiguous", "unexplained") or verdict.promising:
        lines += missing_excitation(evidence)
    return Identification(state, verdict, parts, fit, tuple(lines))


def closed(
    identified: Identification, outcomes: Sequence[Outcome], recordings: Mapping[str, Sequence[Mapping[str, Any]]]
) -> Identification:
    """Return the identification with its errors on test recordings; `recordings` are each role's identities."""
    change = change_of(outcomes)
    verdict = replace(identified.verdict, word="refuted") if change.worse else identified.verdict
    untested, nothing = _untested(outcomes), verdict.word == "nothing_missing"
    off = [f"{Path(o.name).name}: {line}" for o in outcomes for line in o.off if nothing]
    first = sentence(change, outcomes) if identified.anything else ""
    if off or (verdict.word == "explained" and (untested or first)):
        verdict = replace(verdict, word="unexplained")
    remarks = (f"{Path(o.name).name}: {remark}" for o in outcomes for remark in o.remarks)
    others = (remark for remark in remarks if remark not in off)
    noise = [_noise(outcomes)] if verdict.word == "nothing_missing" and not verdict.promising else []
    lines = (*untested, *off, *([first] if first else []), *identified.lines, *noise, *others)
    whole = replace(identified, verdict=verdict, outcomes=tuple(outcomes), change=change, lines=lines)
    return replace(whole, content={**as_json(whole, recordings), "holdout_change": asdict(change)})


def _noise(outcomes: Sequence[Outcome]) -> str:
    """Return the sentence on what is left where nothing is missing, with its size where sigma is too small for it."""
    nis = max((outcome.runs[-1].overview.nis for outcome in outcomes), key=lambda test: test.mean)
    times = np.sqrt(nis.mean)
    larger = f", {times:.2g} times as large as declared: set the noise, sigma is as much too small"
    return f"what is left looks like noise{larger if times > LARGER and not nis.consistent else ''}"


def _untested(outcomes: Sequence[Outcome]) -> list[str]:
    """Return sentences on effects that no test recording tests: their channels are mostly beyond what they fitted."""
    runs = [outcome.runs[1] for outcome in outcomes]
    shares = [{own: n / run.overview.count for own, n in run.journal.beyond.items()} for run in runs]
    everywhere = [own for own in (shares[0] if shares else {}) if all(s.get(own, 0.0) > UNTESTED for s in shares)]
    return [
        f"{kind} of {channel} is not tested: at {min(share[kind, channel] for share in shares):.0%} of the updates of "
        "each test recording the channel is beyond what it was fitted on; correct its unit there, or test by a "
        "recording within"
        for kind, channel in everywhere
    ]


NO_PARAMETERS = ("kind", "channel", "channels")  # beside the fields that all effects have
LARGER = 1.2  # times the declared noise: as much too small a sigma is said
UNTESTED = 0.5  # of the updates beyond what an effect was fitted on: more test nothing of it
MAX_MEANS = 4096  # of a prediction that are compared
TINY = 1e-200  # of a variance: errors without noise leave no chance
SURE = 1.645  # deviations: one-sided, 95 %


@dataclass(frozen=True)
class Outcome:
    """One test recording through both configs, before and after: N times, d axes, SI."""

    name: str
    unit: BiasUnit
    t: Array
    temperature: Array | None
    reference: Array
    before: Array
    after: Array
    before_sigma: Array
    after_sigma: Array
    runs: tuple[ScoredRun, ScoredRun]
    remarks: tuple[str, ...] = ()  # on the second
    off: tuple[str, ...] = ()  # of these, on a prediction that is off by far more than its deviation


@dataclass(frozen=True)
class ErrorChange:
    """Change of the prediction error over all test recordings: its rms before and after, SI.

    `sigma` is by how many deviations of chance the sum of its squares grows; `power` by how many it would fall, if the
    effects are there as they were found, and grow, if they are not.
    """

    before: float
    after: float
    sigma: float
    power: float

    @property
    def worse(self) -> bool:
        """True if it grows beyond chance."""
        return self.after > self.before and self.sigma > SURE

    @property
    def confirms(self) -> bool:
        """True if it falls where effects that are there would hardly ever let it grow."""
        return self.after < self.before and self.power > SURE


def change_of(outcomes: Sequence[Outcome]) -> ErrorChange:
    """Return the change of the error.

    With e the error before and s the change of the prediction, the sum of squares grows by s's + 2 s'e. Its deviation
    is 2 sqrt(s' Omega s), Omega what the periodogram of e says, smooth and falling: slow noise that happens to run
    along a slow s counts as what it is, a few independent rows. Of effects that are there it falls by s's, but for
    the noise that is left then, and of effects that are not it grows by as much beside that of e: the one of e and
    e + s that is without the effects has the smaller Omega.
    """
    grown, moved, variances, total, rows = 0.0, 0.0, np.zeros(2), np.zeros(2), 0
    for outcome in outcomes:
        known = np.all(np.isfinite(outcome.reference), axis=1)
        e, after = (_means((side - outcome.reference)[known]) for side in (outcome.before, outcome.after))
        if not len(e):
            continue
        total += np.sum(e**2), np.sum(after**2)
        rows += e.size
        grown += float(np.sum(after**2) - np.sum(e**2))
        moved += float(np.sum((after - e) ** 2))
        for k, error in enumerate((e, after)):
            variances[k] += 4 * sum(_variance(own, change) for own, change in zip(error.T, (after - e).T, strict=True))
    before, after = np.sqrt(total / max(rows, 1))
    sigma, power = (x / float(np.sqrt(max(v, TINY))) for x, v in ((grown, variances[0]), (moved, variances.min())))
    return ErrorChange(float(before), float(after), sigma, power)


def sentence(change: ErrorChange, outcomes: Sequence[Outcome]) -> str:
    """Return the first sentence about a prediction that does not confirm the effects; nothing where it does."""
    if change.confirms or not outcomes:
        return ""
    unit, names = outcomes[0].unit, ", ".join(Path(outcome.name).name for outcome in outcomes)
    if not any(np.any(np.isfinite(outcome.reference)) for outcome in outcomes):
        return f"{names}: is nowhere at rest after its alignment, so nothing tests the effects; test by one that is"
    figures = f"{change.before * unit.factor:.3g} -> {change.after * unit.factor:.3g} {unit.shown}"
    if change.worse:
        return (
            f"{names}: predicted worse with the identified effects than without ({figures}; {change.sigma:.1f} "
            "sigma): explained.yaml is the declared config, and candidate.yaml has the effects"
        )
    if change.power <= SURE:
        return (
            f"{names}: hardly tests the identified effects ({figures}): what they move the prediction by there is "
            "within chance; test by a recording in which what they depend on moves further"
        )
    return (
        f"{names}: predicted no better with the identified effects ({figures}), where effects as large as those that "
        "were found would be seen; worse, if it is, by no more than chance: test by another recording"
    )


def _means(values: Array) -> Array:
    """Return values (N, d) as at most `MAX_MEANS` means."""
    return means(values, runs([0], len(values), -(-len(values) // MAX_MEANS))) if len(values) else values


def _variance(e: Array, s: Array) -> float:
    """Return s' Omega s of signals (n,), Omega by the periodogram of e, its mean among it."""
    n = len(e)
    counted = np.full(n // 2 + 1, 2.0)
    counted[0] = 1.0
    omega = falling(np.abs(np.fft.rfft(e)) ** 2 / n)
    return float(np.sum(counted * omega * np.abs(np.fft.rfft(s)) ** 2) / n)


def as_json(whole: Identification, recordings: Mapping[str, Sequence[Mapping[str, Any]]]) -> dict[str, Any]:
    """Return the content of `loop.json`."""
    state, verdict = whole.search, whole.verdict
    before, after = rms(whole.left_out)
    unit = state.evidence.unit
    return {
        "schema": 1,
        "driftlab": __version__,
        "verdict": verdict.word,
        "unit": unit.si,
        "recordings": recordings,
        "effects": [_effect(whole.fit, finding, state.evidence) for finding in verdict.findings],
        "rejected": [
            {"kind": trial.term.effect.kind, "channel": trial.term.effect.subject, "reason": trial.reason,
             "parameters": parameters(trial.term.effect), **_evidence(trial)}
            for trial in verdict.rejected
        ],
        "same": [{"name": name, "same_as": other} for name, other in state.same.items()],
        "left_out_plugins": [
            *({"kind": kind, "reason": f"broken: {reason}"} for kind, reason in state.broken.items()),
            *({"kind": kind, "reason": "not wanted"} for kind in sorted(state.without)),
        ],
        "unexplained": list(map(asdict, verdict.left)),
        "hidden": {},
        "experiments": list(map(asdict, verdict.experiments)),
        "candidates_tried": state.tried,
        "left_out": {"before": before, "after": after},
        **{
            name: _errors([outcome.runs[k] for outcome in whole.outcomes], unit)
            for k, name in enumerate(("before", "after"))
        },
    }  # fmt: skip


def _evidence(trial: Trial) -> dict[str, float]:
    """Return a candidate's figures; gains are in nats before the price of the choice, which is in the thresholds."""
    e = trial.evidence
    return {
        "left_out_ratio": e.ratio,
        "heldout_gain": e.left_out,
        "log_likelihood_gain": e.gain + e.price,
        "threshold": GAIN + e.price,
        "fast_gain": min(e.chance, MAX_NATS),
        "fast_threshold": CHANCE + e.price,
    }


def parameters(effect: Effect) -> dict[str, str]:
    """Return the hyper-parameters of an effect, as one writes them."""
    content = effect.model_dump(mode="json", exclude_none=True, exclude={*Effect.model_fields, *NO_PARAMETERS})
    return {name: _short(value) for name, value in content.items()}


def _short(value: Any) -> str:
    """Return a value with four digits, its unit after it where it has one."""
    if isinstance(value, list | tuple):
        return ", ".join(_short(item) for item in value)
    number, _, unit = str(value).partition(" ")
    try:
        return f"{float(number):.4g} {unit.replace('delta_degC', 'K')}".strip()
    except ValueError:
        return str(value)


def _effect(fit: Joint, finding: Finding, evidence: Evidence) -> dict[str, Any]:
    """Return an effect for programs; its size is half of what it moves the bias by on each axis, SI."""
    effect, bias = fit.effects[finding.place], evidence.unit.si
    sizes = {"size": fit.sizes[finding.place], "size_sigma": fit.sizes_sigma[finding.place]}
    labels = effect.labels
    values, sigma = effect.coefficients or (), effect.sigma or ()
    if len(labels) != len(values):
        labels = tuple(f"c{k}" for k in range(len(values)))
    return {
        "kind": effect.kind,
        "channel": effect.subject,
        "parameters": parameters(effect),
        "coefficients": dict(zip(labels, values, strict=True)),
        "unit": ", ".join(dict.fromkeys(effect.units_of(bias))) or bias,
        "sigma": dict(zip(labels, sigma, strict=True)),
        **{name: dict(zip(evidence.axes, map(float, values), strict=True)) for name, values in sizes.items()},
        "size_text": size(fit, finding, evidence),
        "domain": effect.domain or {},
        "regressors": None if effect.regressors is None else dict(zip(labels, effect.regressors, strict=True)),
        **_evidence(finding.trial),
        "indistinguishable_from": list(finding.names),
        "same_as": list(finding.alike),
        "explanation": effect.explanation,
    }


def _errors(runs: Sequence[ScoredRun], unit: BiasUnit) -> dict[str, Any]:
    """Return the errors over all test recordings: rms of the rms, mean of the nis, least of the p values.

    Where the bias is no rate, the names of its errors say no unit: `unit` beside them does.
    """
    scores = [run.yardsticks for run in runs]
    rms = {
        "coast_rmse": [one.coast["to the end"] for one in scores],
        "coast_sigma": [one.coast_sigma["to the end"] for one in scores],
        "filter_rmse": [one.filter_whole for one in scores],
    }
    return {
        **{unit.key(name): np.sqrt(np.mean(np.square(values), axis=0)) for name, values in rms.items()},
        "nis": float(np.mean([run.overview.nis.mean for run in runs])),
        "whiteness_p": float(min(np.min(run.overview.whiteness_p[-len(run.sensor.axes) :]) for run in runs)),
    }


def summary(search: Search, verdict: Diagnosis, fit: Joint) -> list[str]:
    """Return the verdict in sentences."""
    lines = []
    for finding in verdict.findings:
        lines += _of_finding(search, finding, fit)
    for structure in verdict.left:
        lines.append(f"unexplained: {structure.description}")
    for trial in verdict.promising:
        lines.append(
            f"{described(trial.term.effect)}: not added, it {predicts(search, trial)}, with "
            f"{log_likelihood(trial.evidence.chance)} at fast times ({trial.evidence.price + CHANCE:.0f} needed); "
            "another recording would tell"
        )
    for experiment in verdict.experiments:
        name, other = experiment.separates
        what = f"confirm or refute {name}" if other == "nothing" else f"tell {name} from {other}"
        gain = log_likelihood(experiment.expected_gain_nats)
        lines.append(f"to {what}, record: {experiment.description} (expected {gain})")
    named = {name_of(finding.effect) for finding in verdict.findings}
    lines += [f"{name}: the same here as {other}" for name, other in search.same.items() if other not in named]
    lines += [f"{kind}: left out, it is broken ({reason})" for kind, reason in search.broken.items()]
    if verdict.word == "nothing_missing":
        perhaps = ", and it may be what is named above" * bool(verdict.promising)
        lines.append(f"no effect of {search.tried} candidates has enough evidence{perhaps}")
    return lines


def _of_finding(search: Search, finding: Finding, fit: Joint) -> list[str]:
    evidence, name = finding.trial.evidence, name_of(finding.effect)
    lines = [
        f"{described(finding.effect)}: {size(fit, finding, search.evidence)}; {predicts(search, finding.trial)}; "
        f"{log_likelihood(evidence.chance)} at fast times ({evidence.price + CHANCE:.0f} needed)"
    ]
    if not evidence.fast:
        lines.append(f"{name}: stands on the prediction of left-out recordings alone; record another to be sure")
    if finding.alike:
        lines.append(f"{name}: here the same as {', '.join(finding.alike)}")
    if finding.names:
        lines.append(f"{name}: cannot be distinguished from {', '.join(finding.names)} on these recordings")
    return lines


def size(fit: Joint, finding: Finding, evidence: Evidence) -> str:
    """Return the size of an effect: `x 3.06 ± 0.04 deg/h/K, moves the bias by x ±12.1 deg/h`.

    The second is half of what it moves the bias by. Where an axis has several coefficients that alone, with its sigma.
    """
    effect, axes, unit = fit.effects[finding.place], evidence.axes, evidence.unit
    own = [values[finding.place] * unit.factor for values in (fit.sizes, fit.sizes_sigma)]
    units = set(effect.units_of(unit.shown))
    if {len(effect.coefficients or ()), len(effect.sigma or ())} != {len(axes)} or len(units) != 1:
        each = (f"{axis} ±{value:.3g} (sigma {sigma:.2g})" for axis, value, sigma in zip(axes, *own, strict=True))
        return f"moves the bias by {', '.join(each)} {unit.shown}"
    pairs = zip(axes, *np.array([effect.coefficients, effect.sigma], dtype=np.float64) * unit.factor, strict=True)
    coefficients = ", ".join(f"{axis} {with_uncertainty(value, sigma)}" for axis, value, sigma in pairs)
    moved = ", ".join(f"{axis} ±{value:.3g}" for axis, value in zip(axes, own[0], strict=True))
    return f"{coefficients} {units.pop()}, moves the bias by {moved} {unit.shown}"


def predicts(search: Search, trial: Trial) -> str:
    """Return the gain in the prediction of left-out parts, geometric mean over the axes."""
    ratio, unit, columns = float(np.sqrt(trial.evidence.ratio)), search.evidence.unit, search.columns
    rows = sum(part.rows.stop - part.window.stop for part in search.left_out)
    rms = np.sqrt(trial.blocks.sum(axis=1) / max(rows, 1)) * columns.scale[columns.y[search.axes]]
    after = float(np.exp(np.mean(np.log(np.maximum(rms, 1e-300))))) * unit.factor
    part = "recordings" if len(search.evidence.records) > 1 else "parts"
    better = f"{100 * abs(1 - ratio):.0f} % {'better' if ratio < 1 else 'worse'}"
    return f"predicts left-out {part} {better} ({after / ratio:.3g} -> {after:.3g} {unit.shown})"


def log_likelihood(gain: float) -> str:
    """Return evidence in words, up to the largest that a computer's numbers can tell."""
    return f"log-likelihood {gain:.0f}" if gain < MAX_NATS else f"log-likelihood over {MAX_NATS:.0f}"


def described(effect: Effect) -> str:
    """Return an effect with its hyper-parameters: `relaxation of temperature, tau 40 min`."""
    about = effect.subject if effect.subject != "time" else ""
    known = {name: field.default for name, field in type(effect).model_fields.items()}
    plain = [name for name, value in effect if isinstance(value, float | str) and value != known[name]]
    given = [f"{name} {text}" for name, text in parameters(effect).items() if name in {*plain, *effect.continuous}]
    return ", ".join([f"{effect.kind} of {about}" if about else effect.kind, *given])
