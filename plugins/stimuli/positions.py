"""Placements by hand or by faces."""

from __future__ import annotations

from typing import Literal

from fusion_core.hookspecs import hookimpl
from fusion_plugins.stimuli.placements import PlacedStimulus


@hookimpl
class Positions(PlacedStimulus):
    """Placements by hand, or on six faces and between them."""

    kind: Literal["positions"] = "positions"
