"""ArduPilot's names for the parameters of its inertial units.

The first three have one group of names, `INS_TCAL<n>_*` since firmware 4.1; the fourth and fifth have a group of their
own, `INS4_*`. Source: ArduPilot, AP_InertialSensor.cpp, AP_InertialSensor_Params.cpp, AP_InertialSensor_tempcal.cpp.
"""

from __future__ import annotations

from dataclasses import dataclass


def thermal_group(n: int) -> str:
    """Return the beginning of the names of the n-th unit's thermal parameters, from 1."""
    return f"INS_TCAL{n}" if n <= 3 else f"INS{n}_TCAL"


def of_axes(name: str) -> list[str]:
    """Return the names of a parameter's three axes."""
    return [f"{name}_{axis}" for axis in "XYZ"]


@dataclass(frozen=True)
class ParameterNames:
    """Names of the parameters of one sensor of a unit; those of vectors lack their axes.

    Attributes
    ----------
    part : str
        The sensor: GYR or ACC.
    n : int
        Number of the unit, from 1.
    """

    part: str
    n: int

    @property
    def group(self) -> str:
        """The beginning of the names of the unit's thermal parameters."""
        return thermal_group(self.n)

    @property
    def coefficients(self) -> list[str]:
        """Vectors: coefficients of the thermal polynomial, by their powers from 1 to 3."""
        return [f"{self.group}_{self.part}{power}" for power in (1, 2, 3)]

    @property
    def offset(self) -> str:
        """Vector: the constant offset."""
        return f"{self._sensor}OFFS"

    @property
    def scale(self) -> str:
        """Vector: the scale, of accelerometers alone."""
        return f"{self._sensor}SCAL"

    @property
    def caltemp(self) -> str:
        """The temperature at which the offset was taken."""
        return f"INS_{self.part}{self.n}_CALTEMP" if self.n <= 3 else f"INS{self.n}_{self.part}_CALTEMP"

    @property
    def _sensor(self) -> str:
        return f"INS_{self.part}{self.n if self.n > 1 else ''}" if self.n <= 3 else f"INS{self.n}_{self.part}"
