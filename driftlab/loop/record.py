"""`loop.json`: the verdict for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.loop.evidence import Evidence
from driftlab.loop.explained import Joint
from driftlab.loop.gates import CHANCE, GAIN
from driftlab.loop.predicted import LeftOut, rms
from driftlab.loop.residue import BEYOND
from driftlab.loop.state import Search, Trial
from driftlab.loop.verdict import Finding, Verdict
from driftlab.units import RATE, BiasUnit
from fusion_core.contracts import Effect


def as_json(
    found: Search,
    verdict: Verdict,
    fit: Joint,
    left_out: Sequence[LeftOut],
    recordings: Mapping[str, Sequence[Mapping[str, Any]]],
    summaries: Sequence[tuple[dict[str, Any], dict[str, Any]]],
) -> dict[str, Any]:
    """Return the content of `loop.json`."""
    before, after = rms(left_out)
    unit = found.columns.evidence.unit.si
    return {
        "schema": 1,
        "driftlab": __version__,
        "verdict": verdict.word,
        "unit": unit,
        "recordings": recordings,
        "effects": [_effect(fit, finding, found.columns.evidence) for finding in verdict.findings],
        "rejected": [
            {"kind": trial.term.effect.kind, "channel": trial.term.effect.subject, "reason": trial.reason,
             "parameters": parameters(trial.term.effect), **_evidence(trial)}
            for trial in verdict.rejected
        ],
        "same": [{"name": name, "same_as": other} for name, other in found.same.items()],
        "left_out_plugins": _left_out(found),
        "unexplained": [
            {"channel": s.channel, "time_scale_s": s.time_scale, "description": s.description,
             "log_likelihood_gain": s.gain, "threshold": s.threshold}
            for s in verdict.left
        ],
        "hidden": {},
        "experiments": [
            {"description": e.description, "separates": list(e.separates), "expected_gain_nats": e.gain}
            for e in verdict.experiments
        ],
        "candidates_tried": found.tried,
        "left_out": {"before": before, "after": after},
        "before": _errors([before for before, _ in summaries], unit),
        "after": _errors([after for _, after in summaries], unit),
    }  # fmt: skip


def _left_out(found: Search) -> list[dict[str, str]]:
    """Return which kinds of effects were not tried, and why."""
    broken = [{"kind": kind, "reason": f"broken: {reason}"} for kind, reason in found.broken.items()]
    return [*broken, *({"kind": kind, "reason": "not wanted"} for kind in sorted(found.without))]


def _evidence(trial: Trial) -> dict[str, float]:
    """Return a candidate's figures; gains are in nats before the price of the choice, which is in the thresholds."""
    e = trial.evidence
    return {
        "left_out_ratio": e.ratio,
        "heldout_gain": e.left_out,
        "log_likelihood_gain": e.gain + e.price,
        "threshold": GAIN + e.price,
        "fast_gain": min(e.chance, BEYOND),
        "fast_threshold": CHANCE + e.price,
    }


def parameters(effect: Effect) -> dict[str, str]:
    """Return the hyper-parameters of an effect, as one writes them."""
    content = effect.model_dump(mode="json", exclude_none=True)
    skip = {
        "kind",
        "axes",
        "coefficients",
        "sigma",
        "estimate",
        "channel",
        "channels",
        "initial",
        "domain",
        "regressors",
    }
    return {name: _short(value) for name, value in content.items() if name not in skip}


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
    """Return what is known of an effect; its size is half of what it moves the bias by on each axis, SI."""
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
        "domain": effect.domain or {},
        "regressors": None if effect.regressors is None else dict(zip(labels, effect.regressors, strict=True)),
        **_evidence(finding.trial),
        "indistinguishable_from": list(finding.names),
        "same_as": list(finding.alike),
        "explanation": effect.explanation,
    }


def _errors(summaries: Sequence[dict[str, Any]], unit: str) -> dict[str, Any]:
    """Return the errors over all holdout recordings: rms of the rms, mean of the nis, least of the p values.

    Where the bias is no rate, the names of its errors say no unit: `unit` beside them does.
    """
    key = BiasUnit(unit, unit).key

    def rms(values: list[Any]) -> Any:
        return np.sqrt(np.mean(np.square(np.array(values, dtype=float)), axis=0))

    d = len(figures(summaries[0], "filter_rmse")["whole"])
    return {
        key("coast_rmse"): rms([figures(s, "coast_rmse")["to the end"] for s in summaries]),
        key("coast_sigma"): rms([figures(s, "coast_sigma")["to the end"] for s in summaries]),
        key("filter_rmse"): rms([figures(s, "filter_rmse")["whole"] for s in summaries]),
        "nis": float(np.mean([s["nis"]["mean_per_component"] for s in summaries])),
        "whiteness_p": float(min(np.min(np.asarray(s["whiteness_p"])[-d:]) for s in summaries)),
    }


def figures(summary: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return errors of a run's summary, SI; those of a rate have its unit in their name."""
    found: dict[str, Any] = summary.get(RATE.key(name)) or summary[name]
    return found
