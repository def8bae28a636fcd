"""A polynomial of low order fitted to a map with weights where it flies, for firmware that holds nothing else.

::

    b(T) ~ sum_i c_i (T - T_ref)^i,    i = 0 .. order
    c = argmin sum_k w_k |b(T_k) - sum_i c_i (T_k - T_ref)^i|^2

T_k are dense and even over the map's domain; w_k is 1 where it flies and `OUTSIDE` elsewhere, so that what it flies
through decides, and the rest stays bounded. The fit is solved in Chebyshev polynomials of the domain, which is well
conditioned, and only then written in powers of T - T_ref. Cutting a better map down to its first terms would keep the
error of what was cut. N samples, n = order + 1 coefficients, d axes.

Parameter files of autopilots: numbers by name, one a line.

Read are the lines that ground stations write: `1<TAB>1<TAB>NAME<TAB>VALUE<TAB>TYPE` (QGroundControl), `NAME,VALUE`
(Mission Planner, `ulog_params`), `NAME VALUE` (MAVProxy) and `NAME=VALUE` (ArduPilot's own); `#` begins a comment.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.polynomial import Polynomial, chebyshev

from fusion_core.budget import check_regular
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Exporter, FittedMap, SensorLoss, beyond_a_map, causes, warm_up
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError, UnreadableFile, shown
from fusion_core.units import Unit

TRIAD = ("x", "y", "z")
OUTSIDE = 1e-3  # weight where it does not fly: an error there may be some 30 times that where it does


class Cubic(Exporter):
    """An exporter to firmware that holds a polynomial of temperature: its settings say where the vehicle flies."""

    flies_from: Annotated[float, Unit("degC", example="10 degC")] | None = None
    """Lowest temperature of the sensor in use; below it the fit counts little. The map's own lowest by default."""
    flies_to: Annotated[float, Unit("degC", example="50 degC")] | None = None
    """Highest temperature of the sensor in use. The map's own highest by default."""

    def flown(self, domain: tuple[float, float]) -> tuple[float, float] | None:
        """Return where it flies within the map's domain; None where nothing is said of it.

        Raises
        ------
        ConfigError
            If nothing of the domain is left.
        """
        if self.flies_from is None and self.flies_to is None:
            return None
        low = domain[0] if self.flies_from is None else max(float(self.flies_from), domain[0])
        high = domain[1] if self.flies_to is None else min(float(self.flies_to), domain[1])
        if not low < high:
            raise ConfigError(
                f"flies_from, flies_to: {low:.6g} to {high:.6g} °C is nothing of the map's domain ({domain[0]:.6g}, "
                f"{domain[1]:.6g}); give temperatures within it"
            )
        return low, high


def places(kind: str, sensor: Calibrated) -> list[int]:
    """Return which of a firmware's axes x, y, z the map's axes are.

    Raises
    ------
    ConfigError
        If one of them is none of those.
    """
    if not set(sensor.axes) <= set(TRIAD):
        raise ConfigError(
            f"export {kind}: {sensor.channel} has the axes {', '.join(sensor.axes)}, expected some of x, y, z, those "
            "of the sensor; name the axes so"
        )
    return [TRIAD.index(axis) for axis in sensor.axes]


def uncorrected(sensor: Calibrated) -> tuple[str, ...]:
    """Return in words what becomes of axes that the map does not have."""
    missing = [axis for axis in TRIAD if axis not in sensor.axes]
    return (f"{sensor.channel}: the map has no {', '.join(missing)}, which stay uncorrected",) if missing else ()


def polynomial(fitted: FittedMap, order: int, T_ref: float, flown: tuple[float, float] | None) -> Array:
    """Return coefficients (n, d) of powers of T - `T_ref` that follow the map best where it flies."""
    low, high = fitted.domain
    T = np.linspace(low, high, TEMPERATURES)
    bias = fitted.bias(T)
    x = (2 * T - (low + high)) / (high - low)
    first, last = flown or (low, high)
    root = np.sqrt(np.where((first <= T) & (last >= T), 1.0, OUTSIDE))[:, None]
    c = np.linalg.lstsq(root * chebyshev.chebvander(x, order), root * bias, rcond=None)[0]
    scale = 2 / (high - low)  # x = scale (T - T_ref) + offset
    inner = Polynomial([scale * T_ref - (low + high) / (high - low), scale])
    columns = [chebyshev.Chebyshev(column).convert(kind=Polynomial)(inner) for column in c.T]
    return np.stack([np.pad(p.coef, (0, order + 1 - len(p.coef))) for p in columns], axis=1)


def powers(T: Array, T_ref: float, c: Array) -> Array:
    """Return the polynomial (N, d) of coefficients c (n, d) at T (N,), in double precision."""
    return np.asarray(np.polynomial.polynomial.polyval(T - T_ref, c).T)


def measured(
    sensor: Calibrated,
    exact: Callable[[Array], Array],
    clipped: Callable[[Array], Array],
    target: Callable[[Array], Array],
    renewed: Callable[[Chunk], Array],
    flown: tuple[float, float] | None,
) -> tuple[SensorLoss, tuple[str, ...]]:
    """Measure what a polynomial in firmware loses, and from what; and return in words what it leaves out.

    Parameters
    ----------
    exact, clipped, target : functions of T (N,) -> (N, d)
        The polynomial in double precision, the same within the firmware's limits, and what the firmware makes of it.
    renewed : function of a Chunk -> (N, d)
        What is in use over a recording, where the firmware does not renew it at once.
    flown : (float, float) or None
        Where it flies.
    """
    seen, left_out = beyond_a_map(sensor)
    recording = warm_up(sensor.fitted.domain)
    T = recording["temperature"]
    steps = {
        "truth": seen.bias(recording),
        "effects beyond a map": sensor.fitted.bias(T),
        "the polynomial in place of the map": exact(T),
        "the limits of temperature": clipped(T),
        "single precision": target(T),
        "its renewal in stairs": renewed(recording),
    }
    return SensorLoss.measured(seen, target, renewed, causes(steps), flown), left_out


FIELDS = re.compile(r"[\s,=]+")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")
LARGEST = 10_000_000  # bytes; a vehicle has some 1,500 parameters
LOGS = {  # how a log begins, what it is, and what writes its parameters
    b"ULog": ("a PX4 log", "`ulog_params -i LOG FILE` of pyulog"),
    b"\xa3\x95": ("a DataFlash log", "`mavparms.py LOG > FILE` of pymavlink"),
}


def read_parameters(path: Path) -> dict[str, float]:
    """Return a file's parameters by name.

    Raises
    ------
    UnreadableFile
        If it is not there, is a log, holds a line that is no parameter, or says two things of one.
    """
    found: dict[str, float] = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        fields = FIELDS.split(line.split("#")[0].strip())
        if fields == [""]:
            continue
        name, text = fields[2:4] if len(fields) == 5 and fields[0].isdigit() else [*fields, ""][:2]
        value = _number(text)
        if not NAME.match(name) or value is None or len(fields) not in (2, 5):
            raise UnreadableFile(
                f"{path}, line {number}: '{shown(line.strip())}' is no parameter, expected NAME VALUE, NAME,VALUE or "
                "QGroundControl's five columns; name a parameter file that a ground station saved"
            )
        if found.setdefault(name, value) != value:
            raise UnreadableFile(
                f"{path}, line {number}: {name} is {value:.9g}, and {found[name]:.9g} further up; keep one of the two"
            )
    return found


def single(value: float) -> str:
    """Return the shortest text that single precision reads as the nearest number to `value`."""
    return str(np.float32(value)).removesuffix(".0")


def integer(values: Mapping[str, float], name: str) -> int:
    """Return a parameter that is a whole number; 0 where it is not given."""
    return int(values.get(name, 0))


def missing(values: Mapping[str, float], names: Sequence[str]) -> tuple[str, ...]:
    """Return in words which of the parameters are not given, and taken as 0."""
    gone = [name for name in names if name not in values]
    return (f"{', '.join(gone)}: missing, taken as 0, which they are by default",) if gone else ()


def _text(path: Path) -> str:
    try:
        check_regular(path)
        with path.open("rb") as file:
            data = file.read(LARGEST + 1)
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name a parameter file") from None
    for begins, (what, tool) in LOGS.items():
        if data.startswith(begins):
            raise UnreadableFile(
                f"{path}: is {what}, expected a parameter file; save the vehicle's parameters with the ground station, "
                f"or take those of the log: {tool}"
            )
    try:
        if len(data) > LARGEST:
            raise ValueError
        return data.decode("utf-8-sig")
    except ValueError:
        raise UnreadableFile(
            f"{path}: is no text, expected a parameter file; name one that a ground station saved"
        ) from None


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
