"""`loop.json`: the verdict for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.loop.explained import with_coefficients
from driftlab.loop.search import Search
from driftlab.loop.verdict import Verdict
from fusion_core.contracts import Effect


def as_json(
    found: Search,
    verdict: Verdict,
    recordings: Mapping[str, Sequence[Mapping[str, Any]]],
    summaries: Sequence[tuple[dict[str, Any], dict[str, Any]]],
) -> dict[str, Any]:
    """Return the content of `loop.json`."""
    effects = with_coefficients(found.regression, found.fit)
    return {
        "schema": 1,
        "driftlab": __version__,
        "verdict": verdict.word,
        "recordings": recordings,
        "effects": [_effect(effect, finding) for effect, finding in zip(effects, verdict.findings, strict=True)],
        "rejected": [
            {"kind": trial.effect.kind, "channel": trial.effect.subject, "reason": trial.reason,
             "log_likelihood_gain": trial.gain, "threshold": trial.threshold}
            for trial in verdict.rejected
        ],
        "unexplained": [
            {"channel": s.channel, "time_scale_s": s.time_scale, "description": s.description,
             "log_likelihood_gain": s.gain, "threshold": s.threshold}
            for s in verdict.left
        ],
        "hidden": verdict.hidden,
        "experiments": [
            {"description": e.description, "separates": list(e.separates), "expected_gain_nats": e.gain}
            for e in verdict.experiments
        ],
        "candidates_tried": found.tried,
        "before": _errors([before for before, _ in summaries]),
        "after": _errors([after for _, after in summaries]),
    }  # fmt: skip


def parameters(effect: Effect) -> dict[str, str]:
    """Return the hyper-parameters of an effect, as one writes them."""
    content = effect.model_dump(mode="json", exclude_none=True)
    skip = {"kind", "axes", "coefficients", "sigma", "estimate", "channel", "channels"}
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


def _effect(effect: Effect, finding: Any) -> dict[str, Any]:
    labels = effect.labels
    values, sigma = effect.coefficients or (), effect.sigma or ()
    if len(labels) != len(values):
        labels = tuple(f"c{k}" for k in range(len(values)))
    return {
        "kind": effect.kind,
        "channel": effect.subject,
        "parameters": parameters(effect),
        "coefficients": dict(zip(labels, values, strict=True)),
        "unit": effect.unit,
        "sigma": dict(zip(labels, sigma, strict=True)),
        "log_likelihood_gain": finding.addition.gain,
        "threshold": finding.addition.threshold,
        "heldout_gain": finding.addition.heldout,
        "indistinguishable_from": list(finding.names),
        "explanation": effect.explanation,
    }


def _errors(summaries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the errors over all holdout recordings: rms of the rms, mean of the nis, least of the p values."""

    def rms(values: list[Any]) -> Any:
        return np.sqrt(np.mean(np.square(np.array(values, dtype=float)), axis=0))

    d = len(summaries[0]["axes"]["gyro"])
    return {
        "coast_rmse_rad_s": rms([s["coast_rmse_rad_s"]["to the end"] for s in summaries]),
        "coast_sigma_rad_s": rms([s["coast_sigma_rad_s"]["to the end"] for s in summaries]),
        "filter_rmse_rad_s": rms([s["filter_rmse_rad_s"]["whole"] for s in summaries]),
        "nis": float(np.mean([s["nis"]["mean_per_component"] for s in summaries])),
        "whiteness_p": float(min(np.min(np.asarray(s["whiteness_p"])[-d:]) for s in summaries)),
    }
