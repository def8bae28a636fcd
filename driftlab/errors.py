"""The errors that driftlab raises for what a user can cause; `FusionError` is the base of them all.

Messages and what to do are listed in docs/reference/errors.md.
"""
# ruff: noqa: F403, F405

from fusion_core.errors import *
from fusion_core.errors import FusionError

__all__ = [
    "BadValue",
    "ConfigError",
    "DataError",
    "EmptyRecording",
    "FusionError",
    "MapError",
    "MissingChannel",
    "NotAtRest",
    "OutsideDomain",
    "PluginError",
    "SingularFit",
    "SwingTooSmall",
    "TimeBackwards",
    "UnitConflict",
    "UnitError",
    "UnreadableFile",
    "Unwritable",
    "WorkersError",
]


class WorkersError(FusionError):
    """Those who should do the work cannot be had: not installed, not reachable, of other versions, none left."""
