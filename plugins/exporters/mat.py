"""A .mat file (version 5) for MATLAB and Octave: a struct for each sensor, with its map as a table.

::

    load gyro.mat
    b = interp1(gyro.temperature, gyro.bias, T, 'spline');     % rad/s, one column an axis

Rows are a fixed step apart. The loss of straight lines between them is measured, and that of a spline. A file that is
read back is checked before scipy makes room for what it declares.
"""

from __future__ import annotations

import io
import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from fusion_core.budget import DEEPEST, FILE, inflated, read_whole
from fusion_core.chunk import Array
from fusion_core.contracts import Calibrated, Deviation, Export, Exporter, Loss, ReadBack, SensorLoss, beyond_a_map
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError, FusionError, UnreadableFile, quote
from fusion_core.escaping import is_plain, line, matlab_name
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit


class Mat(Exporter):
    """A .mat file with a struct for each sensor."""

    suffix: ClassVar[str] = ".mat"

    kind: Literal["mat"] = "mat"
    step: Annotated[float, Unit("delta_degC", positive=True, example="0.5 K")] = Quantity(0.5, "0.5 K")
    """Temperature from one row to the next."""
    method: Literal["linear", "spline"] = "linear"
    """Method of `interp1` between the rows, for which the loss is computed."""

    def export(self, what: Export, path: Path) -> Loss:
        """Write a struct for each sensor that has a map."""
        from scipy.io import savemat

        content: dict[str, Any] = {}
        lost: list[SensorLoss] = []
        notes: list[str] = []
        left_out = ["what is beyond the first and the last row"]
        for sensor in what.mapped:
            T = rows_of(sensor.fitted.domain, self.step)
            bias = sensor.fitted.bias(T)
            lost.append(SensorLoss.measured(sensor, between(T, bias, self.method)))
            left_out += beyond_a_map(replace(sensor, walk=None))[1]  # the struct has the walk
            notes.append(self._other(sensor, T, bias))
            name = matlab_name(sensor.channel)
            if not sensor.channel or not is_plain(sensor.channel) or sensor.channel != sensor.channel.strip():
                raise ConfigError(
                    f"export {self.kind}: '{quote(sensor.channel)}' is no name of a channel; name it otherwise"
                )
            if name.lower() in {"driftlab", *map(str.lower, content)}:
                raise ConfigError(
                    f"export {self.kind}: a variable called {name} is there already, as the channel "
                    f"'{quote(sensor.channel)}' would be; name the channel otherwise"
                )
            content[name] = _struct(sensor, T, bias, lost[-1])
        if any(one.effects for one in what.mapped):
            notes.append("of effects there are the coefficients, which interp1 leaves out")
        loss = Loss(tuple(lost), tuple(left_out), tuple(notes))
        about = {"serial": line(what.serial), "interpolation": self.method, "loss": "\n".join(loss.lines())}
        savemat(path, {**content, "driftlab": about}, long_field_names=True, oned_as="column", appendmat=False)
        _without_date(path)
        return loss

    def read(self, path: Path) -> list[ReadBack]:
        """Return the maps that a .mat file of this form has."""
        try:
            content = content_of(path)
        except FusionError:
            raise
        except Exception as error:  # of a damaged file scipy raises any of a dozen
            why = getattr(error, "strerror", None) or quote(error, 100)
            raise UnreadableFile(f"{path}: is no .mat file of version 5 ({why}); name one that was exported") from None
        structs = [
            item for item in content.values() if isinstance(item, dict) and "temperature" in item and "bias" in item
        ]
        if not structs:
            raise ConfigError(f"import {self.kind}: {path} has no struct with temperature and bias; name one that has")
        method = str(content.get("driftlab", {}).get("interpolation", "linear"))
        return [_read_back(item, method) for item in structs]

    def _other(self, sensor: Calibrated, T: Array, bias: Array) -> str:
        """Return the loss of the other method than that of the settings, in words."""
        other = "spline" if self.method == "linear" else "linear"
        at = np.linspace(*sensor.fitted.domain, TEMPERATURES)
        rms = Deviation.of(between(T, bias, other)(at) - sensor.fitted.bias(at)).rms * sensor.factor
        return f"{sensor.channel}: interp1 with '{other}' loses {'/'.join(f'{v:.3g}' for v in rms)} {sensor.shown} rms"


def rows_of(domain: tuple[float, float], step: float) -> Array:
    """Return temperatures from end to end of a domain, at most `step` apart."""
    low, high = domain
    return np.linspace(low, high, max(int(np.ceil((high - low) / step - 1e-9)), 1) + 1)


def between(T: Array, bias: Array, method: str) -> Any:
    """Return the function of temperature (N,) -> (N, d) that `interp1` is with rows T (n,), bias (n, d)."""
    if method == "spline" and len(T) > 3:
        from scipy.interpolate import CubicSpline

        return CubicSpline(T, bias, bc_type="not-a-knot", extrapolate=False)
    return lambda at: np.stack([np.interp(at, T, column) for column in bias.T], axis=1)


def _struct(sensor: Calibrated, T: Array, bias: Array, lost: SensorLoss) -> dict[str, Any]:
    fitted = sensor.fitted
    residual = lost.residual
    content = {
        "channel": sensor.channel,
        "kind": line(fitted.record.kind),
        "axes": _texts(sensor.axes),
        "domain": np.array(fitted.domain),
        "temperature": T[:, None],
        "bias": bias,
        "sigma": fitted.sigma(T),
        "slope": fitted.slope(T),
        "units": {"temperature": "degC", "bias": sensor.unit, "sigma": sensor.unit, "slope": f"{sensor.unit}/K"},
        "residual": np.full(len(sensor.axes), np.nan) if residual is None else residual,
        "effects": [_effect(effect) for effect in sensor.effects] or np.empty((0, 0)),
    }
    densities = {"noise": sensor.noise, "walk": sensor.walk}
    return {**content, **{name: values for name, values in densities.items() if values is not None}}


def _texts(texts: Sequence[str]) -> Any:
    """Return texts as a cell array of MATLAB."""
    return np.array([line(text) for text in texts], dtype=object)


def _effect(effect: Any) -> dict[str, Any]:
    given = effect.coefficients
    return {
        "kind": line(effect.kind),
        "labels": _texts(effect.labels),
        "units": _texts(effect.units),
        "coefficients": np.empty((0, 0)) if given is None else np.asarray(given),
        "requires": _texts(effect.requires),
        **{name: float(value) for name, value in effect.hyper_parameters.items()},
    }


def _without_date(path: Path) -> None:
    """Write a head without the date and the machine: the same calibration gives the same bytes."""
    with path.open("r+b") as file:
        file.write(b"MATLAB 5.0 MAT-file, written by driftlab".ljust(116))


def _read_back(item: dict[str, Any], method: str) -> ReadBack:
    T, bias = np.atleast_1d(item["temperature"]), np.asarray(item["bias"], dtype=np.float64)
    bias = bias.reshape(len(T), -1)
    axes = tuple(str(axis) for axis in np.atleast_1d(item["axes"]))
    unit = str(item["units"]["bias"])
    domain = (float(T[0]), float(T[-1]))
    return ReadBack(str(item["channel"]), unit, axes, domain, between(T, bias, method), order=7)


MATRIX, COMPRESSED = 14, 15
CELL, STRUCT = 1, 2
READ = (CELL, STRUCT, 4, *range(6, 16))  # cells, structs, text and numbers


def content_of(path: Path) -> dict[str, Any]:
    """Return the variables of a file of version 5 to 7, structs as dictionaries.

    Raises
    ------
    OSError
        If it cannot be read.
    ValueError
        If it is damaged, of another version, or declares more than it holds.
    """
    from scipy.io import loadmat

    data = read_whole(path)
    if not data.startswith(b"MATLAB 5.0"):
        raise ValueError("it does not begin as a MAT file of version 5 to 7 does")
    order = ">" if data[126:128] == b"MI" else "<"
    at, total = 128, 0
    while at + 8 <= len(data):
        kind, size, _ = _tag(data, at, order)
        element = data[at : at + 8 + size]
        if kind == COMPRESSED:
            element = inflated(path, "a variable", zlib.decompressobj(), element[8:], FILE)
        total += len(element)
        if total > 4 * FILE:
            raise UnreadableFile(f"{path}: its variables take more than {4 * FILE >> 20} MB, which is the limit")
        _check(element, 0, len(element), order, 0)
        at += 8 + size
    content: dict[str, Any] = loadmat(io.BytesIO(data), simplify_cells=True)  # type: ignore[arg-type]
    return content


def _tag(data: bytes, at: int, order: str) -> tuple[int, int, int]:
    """Return type and size of the element at a place, and where its content begins."""
    first, second = np.frombuffer(data[at : at + 8], f"{order}u4").tolist()
    return (first & 0xFFFF, first >> 16, at + 4) if first >> 16 else (first, second, at + 8)


def _check(data: bytes, at: int, end: int, order: str, depth: int) -> None:
    """Raise ValueError where a variable declares more values than it has bytes, or goes too deep."""
    kind, size, begin = _tag(data, at, order)
    if kind != MATRIX or begin + size > end or depth > DEEPEST:
        raise ValueError(f"a variable is damaged, or more than {DEEPEST} deep")
    if size == 0:
        return
    stop, at = begin + size, begin + 16
    cls = int(np.frombuffer(data[begin + 8 : begin + 12], f"{order}u4")[0]) & 0xFF
    _, size, begin = _tag(data, at, order)
    count = math.prod(np.frombuffer(data[begin : begin + size], f"{order}i4").tolist())
    at = _end_of(data, at, order)
    at = _end_of(data, at, order)  # its name
    fields = 1
    if cls == STRUCT:
        width = int(np.frombuffer(data[_tag(data, at, order)[2] :][:4], f"{order}i4")[0])
        at = _end_of(data, at, order)
        fields, at = _tag(data, at, order)[1] // max(width, 1), _end_of(data, at, order)
    if cls not in READ or not 0 <= count * fields * (8 if cls in (CELL, STRUCT) else 1) <= stop - at:
        raise ValueError(f"a variable of class {cls} declares {count} values in {stop - at} bytes")
    while cls in (CELL, STRUCT) and at + 8 <= stop:
        _check(data, at, stop, order, depth + 1)
        at = _end_of(data, at, order)


def _end_of(data: bytes, at: int, order: str) -> int:
    """Return the place of the next element."""
    _, size, begin = _tag(data, at, order)
    return at + 8 if begin == at + 4 else begin + size + -size % 8


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [Mat]
