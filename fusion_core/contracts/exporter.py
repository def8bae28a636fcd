"""The contract of exporters: how a calibration leaves for another program or device, and how one is read back."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from fusion_core.chunk import Array
from fusion_core.contracts.calibrated import Export
from fusion_core.contracts.loss import Loss
from fusion_core.contracts.plugin import Plugin
from fusion_core.errors import ConfigError


@dataclass(frozen=True)
class ReadBack:
    """A sensor's calibration as a file of the target has it.

    Attributes
    ----------
    channel, unit : str
        Whose bias it is, and its SI unit.
    axes : tuple of str
        Names of the d axes.
    domain : (float, float)
        Temperatures that it is for, degC.
    bias : function of T (N,) -> (N, d)
        What the target subtracts within the domain.
    order : int
        The degree of polynomial that holds it.
    notes : tuple of str
        What one should know of it.
    """

    channel: str
    unit: str
    axes: tuple[str, ...]
    domain: tuple[float, float]
    bias: Callable[[Array], Array]
    order: int = 3
    notes: tuple[str, ...] = ()


class Exporter(Plugin):
    """A form in which a calibration leaves; its fields are what the user may choose."""

    suffix: ClassVar[str] = ""  # of the file; empty where it is a folder
    folder: ClassVar[bool] = False  # whether it writes several files, into a folder

    @abstractmethod
    def export(self, what: Export, path: Path) -> Loss:
        """Write what the target can hold to the file `path` (into it, where `folder`), and return what is lost.

        Raises
        ------
        ConfigError
            If the target would not use the file, or could not: nothing is to be written that is silently useless.
        """

    def read(self, path: Path) -> list[ReadBack]:
        """Return the calibrations that a file of the target has; by default ConfigError: it cannot be read back."""
        raise ConfigError(f"import {self.kind}: {path} cannot be read back; only some forms can, as px4 and ardupilot")
