"""The corrections that an autopilot applied to its inertial units before it logged them, undone row by row.

::

    v -= p(clip(T) - 35) - p(clip(T_cal) - 35)     where INS_TCALn_ENABLE is 1
    v -= offset                                    INS_GYROFFS, INS_ACCOFFS
    v *= scale                                     INS_ACCSCAL, accelerometers
    v  = R v                                       AHRS_ORIENTATION, the board in the vehicle

with p(t) = (c_1 + (c_2 + c_3 t) t) t 1e-6 and T clipped to TMIN ... TMAX, in the frame of the board; ENABLE of 2
means that the polynomial is being learned, and is not applied. How a sensor is turned on its board is known to its
driver only. Before Copter 3.3 (logs with TimeMS) R came first, and an accelerometer's offset after its scale.

Source: ArduPilot, AP_InertialSensor_Backend.cpp (_rotate_and_correct_gyro, _rotate_and_correct_accel),
AP_InertialSensor_tempcal.cpp (correct_sensor), rotations.h.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from fusion_core.chunk import Array, Integers
from fusion_plugins.ardupilot_names import ParameterNames, of_axes

Sensor = Literal["Gyr", "Acc"]

REFERENCE = 35.0  # degC, of the polynomial
UNITS = ("INS", "AHRS", "CUST")  # what parameters of inertial units are called
NEVER = -300.0  # degC, a calibration temperature that was never set
LIMITS = {"TMIN": 0.0, "TMAX": 70.0}  # degC, of the polynomial, where the log has none

EULER = (
    "0 0 0,0 0 45,0 0 90,0 0 135,0 0 180,0 0 225,0 0 270,0 0 315,180 0 0,180 0 45,180 0 90,180 0 135,0 180 0,"
    "180 0 225,180 0 270,180 0 315,90 0 0,90 0 45,90 0 90,90 0 135,270 0 0,270 0 45,270 0 90,270 0 135,0 90 0,"
    "0 270 0,0 180 90,0 180 270,90 90 0,180 90 0,270 90 0,90 180 0,270 180 0,90 270 0,180 270 0,270 270 0,"
    "90 180 90,90 0 270,90 68.8 293.3,0 315 0,90 315 0,0 7 0,45 0 0,315 0 0"
)
ORIENTATIONS = dict(enumerate(tuple(float(a) for a in angles.split()) for angles in EULER.split(",")))
"""Roll, pitch and yaw in degrees by the number of AHRS_ORIENTATION."""

CUSTOM = {
    100: ("AHRS_CUSTOM_ROLL", "AHRS_CUSTOM_PIT", "AHRS_CUSTOM_YAW"),
    101: ("CUST_ROT1_ROLL", "CUST_ROT1_PITCH", "CUST_ROT1_YAW"),
    102: ("CUST_ROT2_ROLL", "CUST_ROT2_PITCH", "CUST_ROT2_YAW"),
}


class Parameters:
    """The parameters of a log by name: each holds from the place in the file where it stands, the first from the start.

    A value that is not finite is damage, and is left out.

    Parameters
    ----------
    names : list of str
    at : (P,) array of int
        Where in the file.
    values : (P,) array
    """

    def __init__(self, names: list[str], at: Integers, values: Array) -> None:
        self._rows: dict[str, tuple[list[int], list[float]]] = {}
        for name, place, value in zip(names, at.tolist(), values.tolist(), strict=True):
            places, known = self._rows.setdefault(name, ([], []))
            if np.isfinite(value) and (not known or known[-1] != value):
                places.append(place)
                known.append(value)

    def __bool__(self) -> bool:
        return bool(self._rows)

    def value(self, name: str, place: int, default: float) -> float:
        """Return the value in force at a place, `default` where the log does not have the parameter."""
        places, known = self._rows.get(name, ((), ()))
        return known[max(bisect_right(places, place) - 1, 0)] if known else default

    def vector(self, name: str, place: int, default: float) -> Array:
        """Return the parameters `name` with _X, _Y and _Z."""
        return np.array([self.value(one, place, default) for one in of_axes(name)])

    def changes(self, names: list[str]) -> list[int]:
        """Return the places at which one of these parameters took another value."""
        return sorted({at for name in names for at in self._rows.get(name, ([], []))[0][1:]})

    @property
    def last(self) -> dict[str, float]:
        """The values in force at the end."""
        return {name: known[-1] for name, (_, known) in self._rows.items() if known}

    @property
    def steps(self) -> int:
        """Number of changes of the inertial units' parameters."""
        return sum(len(places) - 1 for name, (places, _) in self._rows.items() if name.startswith(UNITS) and places)


@dataclass(frozen=True)
class ImuCorrections:
    """The corrections of one sensor over a log.

    Attributes
    ----------
    parameters : Parameters
    sensor : "Gyr" or "Acc"
    k : int
        Of which inertial unit, from 0.
    older : bool
        Whether the order is that of logs with TimeMS.
    """

    parameters: Parameters
    sensor: Sensor
    k: int
    older: bool

    @cached_property
    def names(self) -> ParameterNames:
        """Names of the sensor's parameters."""
        return ParameterNames(self.sensor.upper(), self.k + 1)

    def undo(self, v: Array, T: Array, at: Integers) -> Array:
        """Return samples v (N, 3), logged at T (N,) in degC and at places `at` (N,), as the sensor gave them."""
        raw = np.empty_like(v)
        for rows, place in self._spans(at):
            raw[rows] = self._undone(v[rows], T[rows], place)
        return raw

    def polynomial(self, at: Integers) -> bool:
        """Return True if a learned polynomial was applied to one of the rows."""
        return any(self._compensated(place) for _, place in self._spans(at))

    def unknown(self, at: Integers) -> int | None:
        """Return an AHRS_ORIENTATION of the rows that is none that is known; None where there is none such."""
        places = [place for _, place in self._spans(at) if self._rotation(place) is None]
        return int(self._value("AHRS_ORIENTATION", places[0])) if places else None

    def applied(self, at: Integers) -> list[str]:
        """Return the names of what was applied to one of the rows."""
        n, others, offsets = self.names, dict[str, None](), list[Array]()
        for _, place in self._spans(at):
            orientation, offset = self._value("AHRS_ORIENTATION", place), self._offset(place)
            others |= {f"{n.group} (polynomial)": None} if self._compensated(place) else {}
            others |= {n.scale: None} if np.any(self._scale(place) != 1) else {}
            others |= {f"AHRS_ORIENTATION {orientation:g}": None} if orientation else {}
            if not offsets or np.any(offsets[-1] != offset):
                offsets.append(offset)
        changed = f" (changed {len(offsets) - 1} times)" if len(offsets) > 1 else ""
        return [*([n.offset + changed] if np.any(offsets) else []), *others]

    def _spans(self, at: Integers) -> Iterator[tuple[slice, int]]:
        """Yield stretches of rows over which no parameter changed, and the place of their first one."""
        changes = np.array(self.parameters.changes(self._relevant()), at.dtype)  # of another type, all `at` is copied
        edges = np.searchsorted(at, changes).tolist()
        for begin, end in pairwise(sorted({0, *edges, len(at)})):
            yield slice(begin, end), int(at[begin])

    def _relevant(self) -> list[str]:
        n = self.names
        turned = ["AHRS_ORIENTATION", *(name for angles in CUSTOM.values() for name in angles)]
        single = [n.caltemp, *(f"{n.group}_{end}" for end in ("ENABLE", "TMIN", "TMAX"))]
        vectors = (n.offset, n.scale, *n.coefficients)
        return [*turned, *single, *(name for vector in vectors for name in of_axes(vector))]

    def _undone(self, v: Array, T: Array, place: int) -> Array:
        """Return samples over which no parameter changed as the sensor gave them."""
        offset, scale, R = self._offset(place), self._scale(place), self._rotation(place)
        assert R is not None, "the orientation was checked"
        if self.older:
            return np.asarray(((v + offset) / scale) @ R)
        raw: Array = (v @ R) / scale + offset
        if not self._compensated(place):
            return raw
        c = [self.parameters.vector(vector, place, 0.0) for vector in self.names.coefficients]
        T_min, T_max = (self._value(f"{self.names.group}_{end}", place, usual) for end, usual in LIMITS.items())

        def p(T: Array) -> Array:
            t = np.clip(T, T_min, T_max)[:, None] - REFERENCE
            return np.asarray((c[0] + (c[1] + c[2] * t) * t) * t * 1e-6)

        return raw + p(T) - p(np.array([self._value(self.names.caltemp, place, NEVER)]))

    def _value(self, name: str, place: int, default: float = 0.0) -> float:
        return self.parameters.value(name, place, default)

    def _compensated(self, place: int) -> bool:
        return self._value(f"{self.names.group}_ENABLE", place) == 1

    def _offset(self, place: int) -> Array:
        return self.parameters.vector(self.names.offset, place, 0.0)

    def _scale(self, place: int) -> Array:
        scale = self.parameters.vector(self.names.scale, place, 1.0) if self.sensor == "Acc" else np.ones(3)
        return np.where(scale == 0, 1.0, scale)  # multiplied by nothing, a value cannot be brought back

    def _rotation(self, place: int) -> Array | None:
        number = int(self._value("AHRS_ORIENTATION", place))
        angles = ORIENTATIONS.get(number)
        if number in CUSTOM:
            roll, pitch, yaw = (self._value(name, place) for name in CUSTOM[number])
            angles = (roll, pitch, yaw)
        return None if angles is None else rotation(*angles)


def rotation(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation (3, 3) by roll, then pitch, then yaw, in degrees."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", [roll, pitch, yaw], degrees=True).as_matrix()
