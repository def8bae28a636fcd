"""A tumble in a chamber."""

from __future__ import annotations

from typing import Literal

from fusion_core.hookspecs import hookimpl
from fusion_plugins.stimuli.placements import PlacedStimulus


@hookimpl
class Tumble(PlacedStimulus):
    """Placements over temperature, of a chamber with a two-axis table or hands."""

    kind: Literal["tumble"] = "tumble"
