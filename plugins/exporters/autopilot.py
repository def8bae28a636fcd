"""The common part of exporters to autopilots: a polynomial of low order, its loss, and files of parameters.

::

    b(T) ~ sum_i c_i (T - T_ref)^i,    i = 0 .. order
    c = argmin sum_k w_k |b(T_k) - sum_i c_i (T_k - T_ref)^i|^2

T_k are dense and even over the map's domain; w_k is 1 where it flies and `OUTSIDE` elsewhere, so that what it flies
through decides, and the rest stays bounded. The fit is solved in Chebyshev polynomials of the domain, which is well
conditioned, and only then written in powers of T - T_ref. Cutting a better map down to its first terms would keep the
error of what was cut. N samples, n = order + 1 coefficients, d axes.

Parameter files hold numbers by name, one a line. All lines that ground stations write are read:
`1<TAB>1<TAB>NAME<TAB>VALUE<TAB>TYPE` (QGroundControl), `NAME,VALUE` (Mission Planner, `ulog_params`), `NAME VALUE`
(MAVProxy) and `NAME=VALUE` (ArduPilot's own); `#` begins a comment.
"""

from __future__ import annotations

import math
import re
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, ClassVar, NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fusion_core import contracts
from fusion_core.budget import read_whole
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Calibrated, Loss, ReadBack, SensorLoss, TriadMatrix
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError, UnreadableFile, quote
from fusion_core.escaping import comment
from fusion_core.units import Unit, same_dimension

Single = NDArray[np.float32]
TRIAD = ("x", "y", "z")
SCALES = (0.7, 1.4)  # of a triad
OUTSIDE = 1e-3  # weight where it does not fly: an error there may be some 30 times that where it does


@dataclass(frozen=True)
class FirmwareSensor:
    """A kind of sensor that a firmware corrects for temperature.

    `short` stands in the parameters' names; the firmware's unit is `size` of the SI unit. `scaled`: readings less their
    bias are multiplied by a constant scale, axis by axis.
    """

    short: str
    channel: str
    unit: str
    order: int = 3
    axes: tuple[str, ...] = TRIAD
    scaled: bool = False
    size: float = 1.0


class Firmware:
    """One sensor's thermal parameters as a firmware holds them, and its arithmetic; limits of temperature in degC."""

    T_min: np.float32
    T_max: np.float32

    def bias(self, temperature: ArrayLike) -> Single:
        """Return the correction (N, d) at temperatures (N,) in degC."""
        raise NotImplementedError


Held = TypeVar("Held", bound=Firmware)
Kind = TypeVar("Kind", bound=FirmwareSensor)


class Parameter(NamedTuple):
    """A line of a parameter file."""

    name: str
    value: float
    whole: bool = False


class Corrections(NamedTuple):
    """The parameters of one sensor, their loss, and texts about what they leave out and what the user has to do."""

    parameters: list[Parameter]
    loss: SensorLoss
    left_out: tuple[str, ...]
    notes: list[str]


class Autopilot(contracts.Exporter):
    """An exporter to firmware that holds a polynomial of temperature: its settings say where the vehicle flies."""

    title: ClassVar[str]  # of the autopilot
    heading: ClassVar[tuple[str, ...]] = ()  # comments above the parameters

    flies_from: Annotated[float, Unit("degC", example="10 degC")] | None = None
    """Lowest temperature of the sensor in use; below it the fit counts little. The map's own lowest by default."""
    flies_to: Annotated[float, Unit("degC", example="50 degC")] | None = None
    """Highest temperature of the sensor in use. The map's own highest by default."""

    @abstractmethod
    def corrections(self, sensor: Calibrated, sensors: tuple[Calibrated, ...]) -> Corrections:
        """Return the parameters of one of the sensors; raises ConfigError where the firmware could not use them."""

    @abstractmethod
    def written(self, parameter: Parameter) -> str:
        """Return the line of a parameter."""

    def shared(self, sensors: tuple[Calibrated, ...]) -> tuple[list[Parameter], list[str]]:
        """Return the parameters and notes of all sensors together; none by default."""
        return [], []

    def export(self, what: contracts.Export, path: Path) -> Loss:
        """Write the parameters of each sensor that has a map."""
        sensors = what.mapped
        parameters, notes = self.shared(sensors)
        each = [self.corrections(sensor, sensors) for sensor in sensors]
        loss = Loss(
            tuple(one.loss for one in each),
            tuple(text for one in each for text in one.left_out),
            (*notes, *(note for one in each for note in one.notes)),
        )
        head = [f"Thermal calibration of {self.title}, by driftlab", *loss.lines(), *self.heading]
        parameters = _without_repeats([*parameters, *(parameter for one in each for parameter in one.parameters)])
        lines = [*map(comment, head), *map(self.written, parameters)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return loss

    def flown(self, domain: tuple[float, float]) -> tuple[float, float] | None:
        """Return the temperatures within the map's domain at which it flies; None where they are not set.

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

    def scale(self, sensor: Calibrated, kind: FirmwareSensor) -> Single | None:
        """Return the constant scale (3,), by the firmware's axes, that is closest to 1 / (1 + M_ii) where it flies.

        None where map or firmware has none.
        """
        matrix = sensor.matrix
        if matrix is None or not kind.scaled:
            return None
        T = np.linspace(*(self.flown(sensor.fitted.domain) or sensor.fitted.domain), TEMPERATURES)
        ratio = 1 + np.diagonal(matrix.at(T), axis1=1, axis2=2)
        scale = np.ones(len(kind.axes), dtype=np.float32)
        scale[places(self.kind, sensor)] = np.sum(ratio, axis=0) / np.sum(ratio**2, axis=0)
        return scale

    def fit(
        self,
        sensor: Calibrated,
        kind: FirmwareSensor,
        T_ref: float,
        hold: Callable[[Array], Held],
        limits: tuple[np.float32, np.float32] | None = None,
        in_use: Callable[[Chunk], Array] | None = None,
    ) -> tuple[Held, SensorLoss, tuple[str, ...]]:
        """Fit the polynomial; return the firmware's parameters, the loss, and texts about everything that is left out.

        Parameters
        ----------
        kind : FirmwareSensor
            Its order and axes.
        T_ref : float
            Reference of the powers, degC.
        hold : function of coefficients (n, d) of all axes of the firmware, in its unit
            Makes the parameters.
        limits : pair of float32, optional
            The firmware's limits of temperature, degC, where they are within the map's domain.
        in_use : function of a recording -> (N,), optional
            The temperatures whose correction is in use; each its own by default.
        """
        at = [0] if len(kind.axes) == 1 else places(self.kind, sensor)
        flown = self.flown(sensor.fitted.domain)
        c = polynomial(sensor.fitted, kind.order, T_ref, flown)
        of_all = np.zeros((len(c), len(kind.axes)))
        of_all[:, at] = c / kind.size
        held = hold(of_all)

        def target(T: ArrayLike) -> Array:
            return held.bias(T)[:, at].astype(np.float64) * kind.size

        def renewed(recording: Chunk) -> Array:
            return target(recording["temperature"] if in_use is None else in_use(recording))

        modelled, left_out = contracts.beyond_a_map(sensor)
        recording = contracts.warm_up(sensor.fitted.domain)
        T = recording["temperature"]
        steps = {
            "truth": modelled.bias(recording),
            "effects beyond a map": sensor.fitted.bias(T),
            "the polynomial in place of the map": powers(T, T_ref, c),
            "the limits of temperature": powers(T if limits is None else np.clip(T, *limits), T_ref, c),
            "single precision": target(T),
            "its renewal in stairs": renewed(recording),
        }
        scale = self.scale(sensor, kind)
        gain = None if scale is None else partial(_constant, scale[at].astype(np.float64))
        loss = SensorLoss.measured(modelled, target, renewed, contracts.causes(steps), flown, gain)
        return held, loss, (*left_out, *(uncorrected(sensor) if len(kind.axes) > 1 else ()))


def _constant(scale: Array, T: Array) -> Array:
    """Return the matrices (N, 3, 3) of a constant scale (3,) at T (N,)."""
    return np.broadcast_to(np.diag(scale), (len(T), len(scale), len(scale)))


def _matrix(scale: Array, domain: tuple[float, float]) -> TriadMatrix:
    """Return the matrix of a target that multiplies by `scale` (3,) at all temperatures of a domain, degC."""
    M = np.diag(1 / np.asarray(scale, dtype=np.float64) - 1)
    return TriadMatrix(
        T=domain, values=(tuple(M.ravel().tolist()),) * 2, slopes=((0.0,) * 9,) * 2, frame="given",
        told=tuple(np.eye(3, dtype=bool).ravel().tolist()), kinds=("constant",) * 9,
    )  # fmt: skip


def _without_repeats(parameters: Sequence[Parameter]) -> list[Parameter]:
    """Return each parameter once; raises ConfigError where two sensors give one another value."""
    once: dict[str, Parameter] = {}
    for parameter in parameters:
        if once.setdefault(parameter.name, parameter) != parameter:
            raise ConfigError(
                f"{parameter.name}: two of the sensors set it, to {single(once[parameter.name].value)} and "
                f"{single(parameter.value)}; export them one by one"
            )
    return list(once.values())


def kind_of(kinds: Sequence[Kind], sensor: Calibrated, exporter: str, corrected: str) -> Kind:
    """Return the firmware's kind of a sensor, by its unit; raises ConfigError with `corrected`, the kinds in words."""
    kind = next((kind for kind in kinds if same_dimension(sensor.unit, kind.unit)), None)
    if kind is None:
        raise ConfigError(
            f"export {exporter}: the map of the {sensor.channel} is in {sensor.unit or 1}, {corrected}; give the map "
            "of one of those"
        )
    if len(kind.axes) == 1 and len(sensor.axes) != 1:
        raise ConfigError(
            f"export {exporter}: {sensor.channel} has {len(sensor.axes)} axes, a barometer has one; give the map of "
            "one barometer"
        )
    return kind


def read_back(
    kind: FirmwareSensor,
    held: Firmware,
    whose: str,
    notes: Sequence[str],
    about: Mapping[str, str],
    besides: Array | None = None,
    scale: Array | None = None,
) -> ReadBack:
    """Return the calibration that a firmware holds.

    `besides` (d,) is what it takes off at all temperatures, `scale` (3,) what it multiplies readings by then.
    """
    low, high = held.T_min, held.T_max

    def bias(T: Array) -> Array:
        taken_off = held.bias(T).astype(np.float64)
        return (taken_off if besides is None else taken_off + besides) * kind.size

    domain = float(low), float(high)
    scaled = scale is not None and np.any(scale) and np.any(scale != 1)  # all are zero where none was determined
    if scale is not None and scaled and not (SCALES[0] < np.min(scale) and np.max(scale) < SCALES[1]):
        raise ConfigError(
            f"{kind.channel}: its scale is {'/'.join(f'{v:.3g}' for v in scale)}, near 1 was expected; calibrate that "
            "vehicle before its parameters are read"
        )
    first = f"{kind.channel}: {whose}, clamped below {low:g} and above {high:g} °C"
    axes = kind.axes if len(kind.axes) > 1 else ("x",)
    matrix = None if scale is None or not scaled else _matrix(scale, domain)
    return ReadBack(kind.channel, kind.unit, axes, domain, bias, kind.order, (first, *notes), matrix, about)


def places(kind: str, sensor: Calibrated) -> list[int]:
    """Return the places of the map's axes among a firmware's axes x, y, z.

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


def polynomial(fitted: contracts.FittedMap, order: int, T_ref: float, flown: tuple[float, float] | None) -> Array:
    """Return coefficients (n, d) of powers of T - `T_ref` that follow the map best where it flies."""
    from numpy.polynomial import Polynomial, chebyshev

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


FIELDS = re.compile(r"[\s,=]+")
NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]*\Z")


def read_parameters(path: Path) -> dict[str, float]:
    """Return a file's parameters by name.

    Raises
    ------
    UnreadableFile
        If it is not there, holds a line that is no parameter, or says two things of one.
    """
    parameters: dict[str, float] = {}
    for number, line in enumerate(_text(path).splitlines(), 1):
        fields = FIELDS.split(line.split("#")[0].strip())
        if fields == [""]:
            continue
        name, text = fields[2:4] if len(fields) == 5 and fields[0].isdigit() else [*fields, ""][:2]
        value = _number(text)
        if not NAME.match(name) or value is None or len(fields) not in (2, 5):
            raise UnreadableFile(
                f"{path}, line {number}: '{quote(line.strip())}' is no parameter, expected NAME VALUE, NAME,VALUE or "
                "QGroundControl's five columns; name a parameter file that a ground station saved"
            )
        if parameters.setdefault(name, value) != value:
            raise UnreadableFile(
                f"{path}, line {number}: {name} is {value:.9g}, and {parameters[name]:.9g} further up; keep one of "
                "the two"
            )
    return parameters


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
        return read_whole(path).decode("utf-8-sig")
    except OSError as error:
        raise UnreadableFile(f"{path}: cannot be read ({error.strerror}); name a parameter file") from None
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
