"""The identified model as files that `driftlab run` takes: the map, and the config with the effects in it.

All rows of all recordings are fitted at once. The map is then that of the declared kind, fitted to what effects and
starts leave of the rows. n rows, R recordings, d axes; everything is in SI here.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.config import Config
from driftlab.identification.config_edit import the_map, with_host
from driftlab.identification.cross_validation import level_prior
from driftlab.identification.least_squares import AxisFit
from driftlab.identification.records import Evidence, map_inputs
from driftlab.identification.state import Search
from driftlab.maps.fit import provenance
from driftlab.soak.temperature import of_thermometer
from driftlab.units import BiasUnit
from fusion_core.chunk import Array
from fusion_core.contracts import Effect, FittedMap, ThermalMap
from fusion_core.contracts.effect import Domain

ENDS = 0.02  # of the swing, by which means may draw in the ends of a temperature


@dataclass(frozen=True)
class Joint:
    """A model fitted to all rows; all in SI."""

    effects: tuple[Effect, ...]  # with coefficients, standard deviations, domain, and how large an unknown start is
    sizes: Array  # (effects, d) half of what each effect moves the bias by over all rows
    sizes_sigma: Array  # (effects, d) its standard deviation
    curve: Array  # (n, d) the map's
    left: Array  # (n, d) residual
    levels: Array  # (R, d) of the recordings: rate less map, effects and starts
    common: Array  # (d,) level of the calibration, which is that of the map
    walk: Array  # (d,) density of the bias's walk, SI/sqrt(s)
    repeatability: Array | None  # (d,) deviation of the level of one more recording; None for a single one
    starts: bool  # whether an effect begins at an unknown start


def joint(search: Search) -> Joint:
    """Fit the model of a search to all rows."""
    columns, evidence, model = search.columns, search.evidence, search.model
    n, d, scale = len(evidence), len(columns.y), columns.scale[columns.y]
    curve, left, levels = np.zeros((n, d)), np.zeros((n, d)), np.zeros((len(evidence.slices), d))
    # coefficients of each effect: of several axes their mean, weighted by the variances
    weights = [np.zeros((2, columns.of(term.effect).p)) for term in model]  # sums of 1 / variance and value / variance
    initial, sizes = np.zeros((len(model), d)), np.zeros((2, len(model), d))
    q, R = len(columns.of_map([term.effect for term in model])), len(columns.levels)
    for axis, y in enumerate(scale):
        fit = search.fit(model, axis)
        beta = fit.beta * y / columns.scale[fit.cols]
        covariance = _covariance(search, axis, fit)
        variance = np.diag(covariance) * (y / columns.scale[fit.cols]) ** 2
        of_map, others = np.arange(q), np.r_[np.arange(q), np.arange(q + R, len(fit.cols))]
        curve[:, axis] = columns.raw(fit.cols[of_map]) @ beta[of_map]
        rest = evidence.rate[:, axis] - columns.raw(fit.cols[others]) @ beta[others]
        for r, rows in enumerate(evidence.slices):
            levels[r, axis] = rest[rows].mean()
            left[rows, axis] = rest[rows] - levels[r, axis]
        at = q + R
        for k, term in enumerate(model):
            places = columns.of(term.effect).places[axis]
            part = slice(at, at + len(places))
            at += len(places)
            weights[k][:, places] += [1 / variance[part], beta[part] / variance[part]]
            initial[k, axis] = fit.sd[k] * y
            sizes[:, k, axis] = _size(search, k, axis, part, covariance)
    effects = tuple(
        _with_coefficients(term.effect, evidence, weights[k], initial[k] if term.free else np.zeros(d))
        for k, term in enumerate(model)
    )
    walk = np.array([np.sqrt(noise.walk / evidence.interval) for noise in search.noises]) * scale
    starts = any(any(effect.initial or ()) for effect in effects)
    common = levels[[record.calibration for record in evidence.records]].mean(axis=0)
    return Joint(effects, sizes[0], sizes[1], curve, left, levels, common, walk, _repeatability(levels, left), starts)


def _with_coefficients(effect: Effect, evidence: Evidence, weights: Array, initial: Array) -> Effect:
    """Return an effect with its coefficients and the domain that they hold on.

    `weights` (2, p) are sums of 1 / variance and value / variance, `initial` (d,) the deviation of an unknown start.
    """
    known = weights[0] > 0
    weight = np.where(known, weights[0], 1.0)
    update: dict[str, Any] = {
        "coefficients": tuple(map(float, weights[1] / weight)),
        "sigma": tuple(map(float, np.where(known, 1 / np.sqrt(weight), 0.0))),
        "initial": tuple(map(float, initial)) if np.any(initial) else None,
        "domain": _domain(effect, evidence) or None,
        "regressors": _regressors(effect, evidence) if effect.requires else None,
    }
    return effect.model_copy(update=update)


def _domain(effect: Effect, evidence: Evidence) -> Domain:
    """Return the range of each channel that an effect reads: a pair, or of several columns a pair each."""
    domain = Domain()
    for name in effect.requires:
        pairs = tuple((float(low), float(high)) for low, high in evidence.ends(name))
        domain[name] = pairs[0] if len(pairs) == 1 else pairs
    return domain


def _regressors(effect: Effect, evidence: Evidence) -> tuple[tuple[float, float], ...] | None:
    """Return the range of each regressor of an effect with a memory, on the axes on which it acts; else None."""
    signatures = [effect.signature(chunk, None) for chunk in evidence.chunks]
    if signatures[0][1] is None:
        return None
    values = np.concatenate([signature for signature, _ in signatures])
    there = np.any(values != 0, axis=0)
    low = np.min(np.where(there, values.min(axis=0), np.inf), axis=0)
    high = np.max(np.where(there, values.max(axis=0), -np.inf), axis=0)
    return tuple((float(a), float(b)) if a <= b else (0.0, 0.0) for a, b in zip(low, high, strict=True))


def _covariance(search: Search, axis: int, fit: AxisFit) -> Array:
    """Return the covariance (k, k) of a fit's coefficients, in the columns' scale, by white noise and walk.

    With the normal equations A, and r and q the residual's variances of a row and of the walk's step from row to row::

        A^-1 (r X'X + q sum_m c_m c_m') A^-1,    c_m = sum of the rows x_k, k >= m, of a recording
    """
    noise, X = search.noises[axis], search.columns.W[:, fit.cols]
    middle = noise.white * X.T @ X
    for rows in search.evidence.slices:
        ahead = np.cumsum(X[rows][::-1], axis=0)
        middle += noise.walk * ahead.T @ ahead
    return fit.equations.solve(fit.equations.solve(middle).T)


def _size(search: Search, k: int, axis: int, own: slice, covariance: Array) -> tuple[float, float]:
    """Return half of what the k-th effect moves the bias of an axis by, and its deviation, SI.

    `own` are its columns of the fit, whose coefficients have the `covariance`. One that acts on the map's input moves
    the map's curve. The deviation is the larger of that of the noise and of how the size varies where one part after
    the other is left out (jackknife: B. Efron, C. Stein, Ann. Stat. 9 (1981) 586): the model's misfit is in it.
    """
    squares, columns, model = search.squares, search.columns, search.model
    fit, effects = search.fit(model, axis), [term.effect for term in model]
    of_map = columns.of_map(effects)
    regressors = np.zeros((len(search.evidence), len(fit.cols)))
    regressors[:, own] = columns.raw(fit.cols[own])
    if effects[k].acts_on_input:
        without = columns.of_map([effect for effect in effects if effect is not effects[k]])
        regressors[:, : len(of_map)] = columns.raw(of_map) - columns.raw(without)
    regressors *= columns.scale[columns.y[axis]] / columns.scale[fit.cols]
    moved = regressors @ fit.beta
    between = regressors[int(np.argmax(moved))] - regressors[int(np.argmin(moved))]
    p, g = len(squares.fixed(model, axis)), len(search.everything)
    others = [between[:p] @ squares.fit(model, axis, columns.all_but(part)).beta[:p] for part in search.everything]
    variance = max((g - 1) * float(np.var(others)), float(between @ covariance @ between), 0.0)
    return float(np.ptp(moved)) / 2, float(np.sqrt(variance)) / 2


def _repeatability(levels: Array, left: Array) -> Array | None:
    if len(levels) < 2:
        return None
    rms = np.sqrt(np.mean(left**2, axis=0))
    return np.array([level_prior(own, own, float(more))[1] for own, more in zip(levels.T, rms, strict=True)])


def explained_map(search: Search, fit: Joint, declared: FittedMap, settings: ThermalMap, names: list[str]) -> FittedMap:
    """Return the map of the declared kind, fitted as the declared one was, to what the effects leave.

    So it is the declared one where there are no effects: recordings of the calibration keep their levels, as they did
    then. Those of the training alone are shifted to the level of the calibration.
    """
    evidence = search.evidence
    T = evidence.rows(map_inputs(evidence.chunks, fit.effects))
    bias = fit.curve + fit.left
    for record, rows, level in zip(evidence.records, evidence.slices, fit.levels, strict=True):
        bias[rows] += level if record.calibration else fit.common
    T, bias = _to_the_ends(T, bias, declared.domain)
    fitted = settings.fit(T, bias, provenance(settings, names))
    update = {"channel": declared.record.channel, "unit": declared.record.unit}
    fitted = replace(fitted, record=fitted.record.model_copy(update=update))
    return of_thermometer(fitted, declared.record.steps)  # of single readings, and not of means


def _to_the_ends(T: Array, bias: Array, domain: tuple[float, float]) -> tuple[Array, Array]:
    """Return rows T (n,) and bias (n, d) with one more at each end that means have drawn in, as the row next to it.

    Else the new map would refuse by hundredths of a kelvin what the declared one was fitted to.
    """
    near = ENDS * float(np.ptp(T))
    for end, k in ((domain[0], int(np.argmin(T))), (domain[1], int(np.argmax(T)))):
        if 0 < abs(end - T[k]) <= near and not T.min() <= end <= T.max():
            T, bias = np.append(T, end), np.concatenate([bias, bias[k : k + 1]])
    return T, bias


def explained_config(config: Config, unit: BiasUnit, fit: Joint, map_path: Path | None, *, estimate: bool) -> Config:
    """Return the config with the map of the joint fit, the effects, and the walk that is left with them.

    Where an effect begins at an unknown start, also the level of earlier switch-ons: the start is estimated as a
    unit is aligned, and is separable from the bias by that alone.
    """
    values: dict[str, Any] = {
        "effects": tuple(effect.model_copy(update={"estimate": estimate}) for effect in fit.effects),
        "walk": tuple(unit.text(value, "/sqrt(s)") for value in fit.walk),
    }
    if fit.starts and fit.repeatability is not None:
        offset = fit.levels.mean(axis=0) - (0.0 if the_map(config) is None else fit.common)
        values["turn_on_bias"] = tuple(map(unit.text, offset))
        values["repeatability"] = tuple(map(unit.text, fit.repeatability))
    return with_host(config, unit, map_path, **values)
