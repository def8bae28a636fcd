"""The six hooks of a plugin module: each returns the classes of one family that the module brings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import pluggy

if TYPE_CHECKING:
    from fusion_core.contracts import BiasModel, Effect, MeasurementModel, Source, ThermalMap
    from fusion_core.contracts.framing import Framing

PROJECT = "fusion_core"  # also the name of the entry-point group

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


@hookspec
def bias_models() -> list[type[BiasModel]]:  # type: ignore[empty-body]
    """Return bias models: how a sensor bias moves from sample to sample."""


@hookspec
def thermal_maps() -> list[type[ThermalMap]]:  # type: ignore[empty-body]
    """Return thermal maps: a bias as a function of temperature."""


@hookspec
def sources() -> list[type[Source]]:  # type: ignore[empty-body]
    """Return sources: where recordings come from."""


@hookspec
def framings() -> list[type[Framing]]:  # type: ignore[empty-body]
    """Return framings: how samples are cut out of a stream of bytes."""


@hookspec
def effects() -> list[type[Effect]]:  # type: ignore[empty-body]
    """Return effects: what a residual can be traced to."""


@hookspec
def measurement_models() -> list[type[MeasurementModel]]:  # type: ignore[empty-body]
    """Return measurement models: what the filter knows of the sensors, and what it measures."""
