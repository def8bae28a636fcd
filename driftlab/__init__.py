"""driftlab: inertial units at rest, their thermal bias, and the filters that track it.

    import driftlab

    result = driftlab.run("unit.yaml", {"time": (t, "s"), "gyro": (omega, "deg/s"), "temperature": (T, "degC")})
    result.bias, result.bias_sigma  # (N, 3), rad/s

The functions are the commands of the same names, on files or on arrays in memory: `driftlab.api`. What they raise is
in `driftlab.errors`.

The application is the only place where angular rate omega, specific force f and temperature T have a meaning
together. Conventions: SI, temperatures in degC; body axes x, y, z as in the recording, right-handed where a heading
is used; the local level frame is east, north, up.
"""
# ruff: noqa: F403, F405

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from driftlab import errors
    from driftlab.api import *

    __version__: str

__all__ = [
    "allan", "check", "compare", "errors", "explain", "export",
    "fit_map", "fleet", "import_map", "init", "plan", "run", "simulate", "vehicle",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what is asked for: `import driftlab` alone loads no library."""
    if name == "__version__":
        from importlib.metadata import version

        globals()[name] = version("driftlab")
        return globals()[name]
    if name not in __all__:
        raise AttributeError(f"module 'driftlab' has no attribute '{name}'")
    return import_module("driftlab.errors") if name == "errors" else getattr(import_module("driftlab.api"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
