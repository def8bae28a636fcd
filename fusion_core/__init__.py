"""The generic core: an augmented-state Kalman filter and the host of the plugins that describe its states.

Conventions, written here once and used everywhere:

- Time is always the leading axis. N samples, n states, m measured components, d axes.
- One step leads *to* sample k; with the known drift u, the noise w ~ N(0, Q) and r ~ N(0, R)::

      x_k = F_k x_{k-1} + u_k + w_k
      z_k = H_k x_k + r_k

- A leading N may be left out of F, Q, H, R: "the same for every sample". That is how the core knows
  that a model is time-invariant.
- y = z - H x is the innovation, S its covariance, K the gain, nis = y' S^-1 y.
- Everything is in SI units, temperatures in degC; `sigma_*` are standard deviations or densities.

The core knows arrays, chunks, blocks and plugins. It knows no gyro and no temperature.

What `__all__` names is the public API, and is loaded when it is first asked for: importing the package loads no
compiled code and no plugin.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fusion_core.chunk import Array, Chunk, concatenate
    from fusion_core.consistency import Whiteness, gate_of, nis_test, whiteness_p
    from fusion_core.contracts import (
        BiasModel,
        Effect,
        FittedMap,
        Framing,
        MeasurementModel,
        Memory,
        Plugin,
        Sensor,
        Source,
        ThermalBias,
        ThermalMap,
    )
    from fusion_core.discretize import van_loan
    from fusion_core.errors import FusionError
    from fusion_core.feedback import Segment, feed_back
    from fusion_core.hookspecs import hookimpl
    from fusion_core.host.registry import Installed, registry
    from fusion_core.kalman import estimate, expected
    from fusion_core.model import Estimates, Measurement, Prior, State, Transition, join
    from fusion_core.smoother import smooth
    from fusion_core.statespace import Block, StateSpace
    from fusion_core.units import Quantity, Unit

__all__ = [
    "Array",
    "BiasModel",
    "Block",
    "Chunk",
    "Effect",
    "Estimates",
    "FittedMap",
    "Framing",
    "FusionError",
    "Installed",
    "Measurement",
    "MeasurementModel",
    "Memory",
    "Plugin",
    "Prior",
    "Quantity",
    "Segment",
    "Sensor",
    "Source",
    "State",
    "StateSpace",
    "ThermalBias",
    "ThermalMap",
    "Transition",
    "Unit",
    "Whiteness",
    "concatenate",
    "estimate",
    "expected",
    "feed_back",
    "gate_of",
    "hookimpl",
    "join",
    "nis_test",
    "registry",
    "smooth",
    "van_loan",
    "whiteness_p",
]

_HOMES = {
    "chunk": ("Array", "Chunk", "concatenate"),
    "consistency": ("Whiteness", "gate_of", "nis_test", "whiteness_p"),
    "contracts": (
        "BiasModel",
        "Effect",
        "FittedMap",
        "Framing",
        "MeasurementModel",
        "Memory",
        "Plugin",
        "Sensor",
        "Source",
        "ThermalBias",
        "ThermalMap",
    ),
    "discretize": ("van_loan",),
    "errors": ("FusionError",),
    "feedback": ("Segment", "feed_back"),
    "hookspecs": ("hookimpl",),
    "host.registry": ("Installed", "registry"),
    "kalman": ("estimate", "expected"),
    "model": ("Estimates", "Measurement", "Prior", "State", "Transition", "join"),
    "smoother": ("smooth",),
    "statespace": ("Block", "StateSpace"),
    "units": ("Quantity", "Unit"),
}
_HOME = {name: module for module, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'fusion_core' has no attribute '{name}'")
    value = getattr(import_module(f"fusion_core.{_HOME[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
