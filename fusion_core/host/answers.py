"""What a bias model answers, checked before the filter takes it, and what the filter answers after it.

N steps, n states, d axes. A defect of a plugin is reported by its name, and never becomes an estimate.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import BiasModel, Prior, Transition
from fusion_core.errors import BadValue, PluginError
from fusion_core.model import Estimates

ROUNDING = 1e-9  # relative to the largest variance: less below zero is rounding


def check_prior(model: BiasModel, prior: Prior) -> None:
    """Raise PluginError where a prior is not a mean (n,) and a covariance (n, n), or not every state has a unit."""
    n, units = len(model.labels), len(model.units("1"))
    if units != n:
        raise PluginError(f"{model.kind}: has {units} units for {n} labels; this is a defect of the plugin")
    _check_shape(model, "prior x", prior.x, ((n,),))
    _check_shape(model, "prior P", prior.P, ((n, n),))
    _check_finite(model, "prior x", prior.x)
    _check_covariance(model, "prior P", prior.P)


def check_transition(model: BiasModel, step: Transition, N: int) -> None:
    """Raise PluginError where N steps are not F, Q (n, n) or (N, n, n), u (n,) or (N, n) and C (d, n) or (N, d, n)."""
    n, d = len(model.labels), len(model.axes)
    for name, array in (("F", step.F), ("Q", step.Q)):
        _check_shape(model, name, array, ((n, n), (N, n, n)))
    _check_shape(model, "u", step.u, ((n,), (N, n)))
    _check_finite(model, "F", step.F)
    _check_finite(model, "the drift u", step.u)
    _check_covariance(model, "Q", step.Q)
    if step.C is not None:
        _check_shape(model, "C", step.C, ((d, n), (N, d, n)))
        _check_finite(model, "C", step.C)


def check_finite(found: Estimates, t: Array, when: Callable[[float], str]) -> None:
    """Raise BadValue where the estimates at t (N,) in s are not finite numbers; `when` words a time."""
    good = np.all(np.isfinite(found.x) & np.isfinite(found.sigma), axis=1)
    if not np.all(good):
        raise not_finite(t[int(np.argmin(good))], when)


def not_finite(t: float, when: Callable[[float], str]) -> BadValue:
    """Return the error of an estimate that is not a finite number at t, s."""
    return BadValue(
        f"filter: the estimate is not a finite number at {when(t)}; check noise, walk and sigma_0 in "
        "the config, and the samples there"
    )


def _check_shape(model: BiasModel, name: str, array: Array, expected: tuple[tuple[int, ...], ...]) -> None:
    shape = np.shape(array)
    if shape not in expected:
        raise PluginError(
            f"{model.kind}: {name} has shape {shape}, its {len(model.labels)} labels ask for "
            f"{' or '.join(map(str, expected))}; this is a defect of the plugin"
        )


def _check_finite(model: BiasModel, name: str, array: Array) -> None:
    if not np.all(np.isfinite(array)):
        raise PluginError(f"{model.kind}: {name} is not finite; this is a defect of the plugin")


def _check_covariance(model: BiasModel, name: str, matrices: Array) -> None:
    """Raise where any of the matrices (n, n) or (N, n, n) is not symmetric with no negative eigenvalue."""
    _check_finite(model, name, matrices)
    diagonal = np.diagonal(matrices, axis1=-2, axis2=-1)
    scale = np.max(diagonal, initial=0.0)
    lowest = np.min(diagonal, initial=0.0)
    n = matrices.shape[-1]
    if np.any(matrices[..., ~np.eye(n, dtype=bool)]):  # where it is diagonal, its eigenvalues are known
        uneven = np.max(np.abs(matrices - np.swapaxes(matrices, -1, -2)))
        lowest = min(lowest, -uneven, np.min(np.linalg.eigvalsh(matrices)))
    if lowest < -ROUNDING * scale or (scale == 0 and lowest < 0):
        raise PluginError(
            f"{model.kind}: {name} is not a covariance (symmetric, no eigenvalue below zero); "
            "this is a defect of the plugin"
        )
