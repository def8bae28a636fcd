"""From a fitted model to files that `driftlab run` takes: the map, and the config with the effects in it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from driftlab.config import Config
from driftlab.fit import provenance
from driftlab.loop.declared import the_map, with_gyro
from driftlab.loop.probe import Probe
from driftlab.loop.regression import Fit, Regression
from driftlab.loop.signals import Model
from driftlab.summary import DEG_H
from fusion_core.chunk import Array
from fusion_core.contracts import BiasModel, FittedMap, ThermalMap
from fusion_core.registry import registry
from fusion_core.units import Quantity, along_axes

CURVE = 4000  # temperatures at which a fitted curve is handed to the declared kind of map


def explained_map(regression: Regression, fit: Fit, settings: ThermalMap, names: list[str]) -> FittedMap:
    """Return the map of the joint fit as one of the declared kind, its mean that of the calibration."""
    evidence = regression.evidence
    T = np.concatenate([chunk["temperature"] for chunk in evidence.chunks])
    c = np.stack([axis.c for axis in fit.axes], axis=1)
    left = evidence.rate - regression.curves(fit.effects) @ c - _contribution(regression, fit)
    first = ~evidence.train if not np.all(evidence.train) else evidence.train
    offset = left[first].mean(axis=0)
    for record, part in zip(evidence.records, evidence.split(left), strict=True):
        part -= offset if not record.train else part.mean(axis=0)
    grid = np.linspace(float(T.min()), float(T.max()), CURVE)
    fitted = settings.fit(grid, regression.basis.values(grid) @ c + offset, provenance(settings, names))
    residual = tuple(float(v) for v in np.sqrt(np.mean(left**2, axis=0)))
    # how sure such a curve is: as one of its kind that is fitted to the recordings, the effects taken out
    alike = settings.fit(T, regression.basis.values(np.clip(T, grid[0], grid[-1])) @ c + offset + left, {}).record
    update = {"residual": residual, "samples": len(T), "error": alike.error, "resolution": alike.resolution}
    return replace(fitted, record=fitted.record.model_copy(update=update))


def _contribution(regression: Regression, fit: Fit) -> Array:
    """Return what the effects add to the bias (N, d), with their own zero."""
    total = np.zeros_like(regression.evidence.rate)
    for effect in with_coefficients(regression, fit):
        parts = [
            effect.signature(chunk, None)[0] @ np.asarray(effect.coefficients) for chunk in regression.evidence.chunks
        ]
        total += np.concatenate(parts)
    return total


def with_coefficients(regression: Regression, fit: Fit) -> Model:
    """Return the effects with their coefficients and standard deviations (one that acts on two axes: their mean)."""
    sizes = [regression.number(effect) for effect in fit.effects]
    total = sum(sizes)
    weight, weighted, variance = np.zeros(total), np.zeros(total), np.zeros(total)
    for axis, own in enumerate(fit.axes):
        _, place = regression.columns(fit.effects, axis)
        spread = np.diag(own.covariance)
        seen = spread > 0
        weight[place[seen]] += 1 / spread[seen]
        weighted[place[seen]] += own.theta[seen] / spread[seen]
    known = weight > 0
    variance[known] = 1 / weight[known]
    theta = weighted * variance
    found, start = [], 0
    for effect, size in zip(fit.effects, sizes, strict=True):
        part = slice(start, start + size)
        values = {"coefficients": tuple(map(float, theta[part])), "sigma": tuple(map(float, np.sqrt(variance[part])))}
        if not isinstance(effect, Probe):  # those have no name
            found.append(effect.model_copy(update=values))
        start += size
    return tuple(found)


def explained_config(config: Config, regression: Regression, fit: Fit, map_path: Path, *, estimate: bool) -> Config:
    """Return the config with the map of the joint fit, the effects, and the walk that is left with them."""
    assert config.filter is not None
    gyro = config.filter.gyro
    bias: BiasModel = gyro.bias
    settings = the_map(config).model_copy(update={"path": map_path})
    effects = tuple(e.model_copy(update={"estimate": estimate}) for e in with_coefficients(regression, fit))
    update = {"map": settings, "effects": effects, "walk": _walk(bias, fit)}
    if gyro.calibration is not None or not hasattr(bias, "effects"):
        model = registry().classes(BiasModel)["thermal_derivative"]
        kept = {name: getattr(bias, name) for name in ("axes", "sigma_0")}
        bias = model.model_construct(None, **kept, **update)  # type: ignore[assignment, arg-type]
    else:
        bias = bias.model_copy(update=update)
    return with_gyro(config, gyro.model_copy(update={"calibration": None, "bias": bias}))


def _walk(bias: BiasModel, fit: Fit) -> tuple[Quantity, ...]:
    declared = along_axes(getattr(bias, "walk"), len(fit.axes))  # noqa: B009
    values = [w * np.exp(axis.log_ratio / 2) * axis.scale for w, axis in zip(declared, fit.axes, strict=True)]
    return tuple(Quantity(float(v), f"{v * DEG_H:.4g} deg/h/sqrt(s)") for v in values)
