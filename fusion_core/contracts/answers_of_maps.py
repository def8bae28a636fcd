"""What thermal maps answer, checked as in `answers`. N samples, K blocks, G points of a grid, d axes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts.answers import each_of, expect_array, expect_finite, expect_instance, said_of
from fusion_core.contracts.curve_uncertainty import Smoother
from fusion_core.contracts.family import Check
from fusion_core.contracts.fitted_map import FittedMap
from fusion_core.contracts.plugin import broken
from fusion_core.contracts.soak_noise import Blocks
from fusion_core.contracts.thermal_map import Basis, ThermalMap


def _fitted(settings: ThermalMap, answer: Any, *arguments: object) -> FittedMap:
    expect_instance(settings, "the fitted map", answer, FittedMap)
    fitted: FittedMap = answer
    return fitted


def _basis(settings: ThermalMap, answer: Any, domain: tuple[float, float]) -> Basis:
    """Check the curves where they are made; what they give afterwards, whenever they are evaluated."""
    expect_instance(settings, "basis", answer, Basis)
    q = np.shape(answer.penalty)[0] if np.ndim(answer.penalty) else 0
    expect_array(settings, "the basis' penalty", answer.penalty, ((q, q),))
    expect_finite(settings, "the basis' penalty", answer.penalty)

    def values(T: Array) -> Array:
        found = answer.values(T)
        expect_array(settings, "values of the basis", found, ((len(T), q),))
        expect_finite(settings, "values of the basis", found)
        return np.asarray(found)

    return Basis(values, answer.penalty)


def _smoother(settings: ThermalMap, answer: Any, T: Array, bias: Array) -> Smoother:
    if not callable(answer):
        raise broken(settings, f"its smoother is {said_of(answer)}, a function was expected")

    def smoother(blocks: Blocks, grid: Array, axis: int) -> Array:
        expect_array(
            settings, "its answer to noise", found := answer(blocks, grid, axis), ((len(grid), len(blocks.T)),)
        )
        expect_finite(settings, "its answer to noise", found)
        return np.asarray(found)

    return smoother


def _variants(settings: ThermalMap, answer: Any) -> tuple[ThermalMap, ...]:
    found = tuple(each_of(settings, "variants", answer))
    if not found:
        raise broken(settings, "variants is empty, at least the settings themselves were expected")
    for variant in found:
        expect_instance(settings, "a variant", variant, type(settings))
    return found


def _curve(fitted: FittedMap, answer: Any, T: Array, *arguments: object) -> Array:
    expect_array(fitted, "its curve", answer, ((len(T), fitted.record.d),))
    expect_finite(fitted, "its curve", answer)
    return np.asarray(answer)


OF_THERMAL_MAPS: Mapping[str, Check] = {
    "fit": _fitted,
    "read": _fitted,
    "load": _fitted,
    "basis": _basis,
    "smoother": _smoother,
    "variants": _variants,
}
OF_FITTED_MAPS: Mapping[str, Check] = {"_bias": _curve, "_slope": _curve, "sigma": _curve}
