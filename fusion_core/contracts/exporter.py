"""The contract of exporters: how a fitted map leaves for another program or device."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from fusion_core.chunk import Array
from fusion_core.contracts.fitted_map import FittedMap
from fusion_core.contracts.plugin import Plugin


@dataclass(frozen=True)
class Loss:
    """What a map loses on its way, measured as its reader evaluates it.

    Attributes
    ----------
    largest : (d,) array
        Largest error of the bias over the map's domain, in the map's own unit.
    left_out : tuple of str
        What the target cannot hold, in words.
    """

    largest: Array
    left_out: tuple[str, ...] = ()


class Exporter(Plugin):
    """A form that a fitted map can be given; its fields are what the user may choose."""

    suffix: ClassVar[str] = ""  # of the file

    @abstractmethod
    def export(self, fitted: FittedMap, path: Path) -> Loss:
        """Write the map to `path`, and return what is lost."""
