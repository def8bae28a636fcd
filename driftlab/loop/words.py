"""The verdict in sentences that one understands at the bench."""

from __future__ import annotations

import numpy as np

from driftlab.loop.explained import Joint
from driftlab.loop.gates import CHANCE
from driftlab.loop.record import parameters
from driftlab.loop.residue import BEYOND
from driftlab.loop.state import Search, Trial, name_of
from driftlab.loop.verdict import Finding, Verdict
from fusion_core.contracts import Effect


def summary(found: Search, verdict: Verdict, fit: Joint) -> list[str]:
    """Return the verdict in sentences."""
    lines = []
    for finding in verdict.findings:
        lines += _found(found, finding, fit)
    for structure in verdict.left:
        lines.append(f"unexplained: {structure.description}")
    for trial in verdict.promising:
        lines.append(
            f"{described(trial.term.effect)}: not added, it {predicts(found, trial)}, with "
            f"{nats(trial.evidence.chance)} at fast times ({trial.evidence.price + CHANCE:.0f} needed); "
            "another recording would tell"
        )
    for experiment in verdict.experiments:
        name, other = experiment.separates
        what = f"confirm or refute {name}" if other == "nothing" else f"tell {name} from {other}"
        lines.append(f"to {what}, record: {experiment.description} ({nats(experiment.gain)})")
    named = {name_of(finding.effect) for finding in verdict.findings}
    lines += [f"{name}: the same here as {other}" for name, other in found.same.items() if other not in named]
    lines += [f"{kind}: left out, it is broken ({reason})" for kind, reason in found.broken.items()]
    if verdict.word == "nothing_missing":
        lines.append(f"no effect of {found.tried} candidates has enough evidence, and what is left looks like noise")
    return lines


def _found(found: Search, finding: Finding, fit: Joint) -> list[str]:
    evidence, name = finding.trial.evidence, name_of(finding.effect)
    lines = [
        f"{described(finding.effect)}: {size(found, finding, fit)}; {predicts(found, finding.trial)}; "
        f"{nats(evidence.chance)} at fast times ({evidence.price + CHANCE:.0f} needed)"
    ]
    if not evidence.fast:
        lines.append(f"{name}: stands on what is predicted of left-out recordings alone; record another to be sure")
    if finding.alike:
        lines.append(f"{name}: here the same as {', '.join(finding.alike)}")
    if finding.names:
        lines.append(f"{name}: cannot be told from {', '.join(finding.names)} on these recordings")
    return lines


def size(found: Search, finding: Finding, fit: Joint) -> str:
    """Return half of what an effect moves the bias by on each axis, as `x ±12.1 (sigma 0.2) deg/h`."""
    evidence = found.columns.evidence
    own = (values[finding.place] * evidence.unit.factor for values in (fit.sizes, fit.sizes_sigma))
    axes = zip(evidence.axes, *own, strict=True)
    return ", ".join(f"{axis} ±{value:.3g} (sigma {sigma:.2g})" for axis, value, sigma in axes) + (
        f" {evidence.unit.shown}"
    )


def predicts(found: Search, trial: Trial) -> str:
    """Return how much better left-out parts are predicted, geometric mean over the axes."""
    ratio = float(np.sqrt(trial.evidence.ratio))
    unit = found.columns.evidence.unit
    after = left_out_error(found, trial) * unit.factor
    part = "recordings" if len(found.columns.evidence.records) > 1 else "parts"
    better = f"{100 * abs(1 - ratio):.0f} % {'better' if ratio < 1 else 'worse'}"
    return f"predicts left-out {part} {better} ({after / ratio:.3g} -> {after:.3g} {unit.shown})"


def nats(gain: float) -> str:
    """Return evidence in words; what is less likely than the least number of a computer is said to be so."""
    return f"{gain:.0f} nats" if gain < BEYOND else f"more than {BEYOND:.0f} nats"


def left_out_error(found: Search, trial: Trial) -> float:
    """Return the rms error of a candidate on left-out parts, geometric mean over the axes, SI."""
    rows = sum(part.rows.stop - part.window.stop for part in found.left_out)
    rms = np.sqrt(trial.blocks.sum(axis=1) / max(rows, 1)) * found.columns.scale[found.columns.y[found.axes]]
    return float(np.exp(np.mean(np.log(np.maximum(rms, 1e-300)))))


def described(effect: Effect) -> str:
    """Return an effect with its hyper-parameters: `relaxation of temperature, tau 40 min`."""
    about = effect.subject if effect.subject != "time" else ""
    known = {name: field.default for name, field in type(effect).model_fields.items()}
    plain = [name for name, value in effect if isinstance(value, float | str) and value != known[name]]
    given = [f"{name} {text}" for name, text in parameters(effect).items() if name in {*plain, *effect.continuous}]
    return ", ".join([f"{effect.kind} of {about}" if about else effect.kind, *given])
