r"""A .mat file (version 5) for MATLAB and Octave: a struct for each sensor, with its map as a table.

::

    load gyro.mat
    b = interp1(gyro.temperature, gyro.bias, T, 'spline');     % rad/s, one column an axis
    M = reshape(interp1(gyro.temperature, gyro.matrix, T), 3, 3)';   % of a triad, at one temperature
    u = (eye(3) + M) \ (reading - b)';

Rows are a fixed step apart. The loss of straight lines between them is measured, and that of a spline. A file that is
read back is read element by element, and no further than the budget of a reader.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import ValidationError

from fusion_core.budget import FILE, check_regular, check_size
from fusion_core.chunk import Array
from fusion_core.contracts import (
    Calibrated,
    Deviation,
    Export,
    Exporter,
    Loss,
    ReadBack,
    SensorLoss,
    TriadMatrix,
    beyond_a_map,
)
from fusion_core.contracts.calibration import TEMPERATURES
from fusion_core.errors import ConfigError, FusionError, UnreadableFile, quote
from fusion_core.escaping import is_plain, line, matlab_name
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.mat_elements import Elements, Variable


@hookimpl
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
            lost.append(SensorLoss.measured(sensor, between(T, bias, self.method), gain=self._gain(sensor, T)))
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
        with path.open("r+b") as file:  # no date, no machine: the same calibration gives the same bytes
            file.write(b"MATLAB 5.0 MAT-file, written by driftlab".ljust(116))
        return loss

    def _gain(self, sensor: Calibrated, T: Array) -> Any:
        """Return the function of temperature (N,) -> (N, 3, 3) that the rows T (n,) of M are."""
        if sensor.matrix is None:
            return None
        terms = between(T, sensor.matrix.terms(T), self.method)
        return lambda at: np.linalg.inv(np.eye(3) + terms(at).reshape(-1, 3, 3))

    def read(self, path: Path) -> list[ReadBack]:
        """Return the maps that a .mat file of this form has."""
        try:
            structs = structs_of(path)
        except FusionError:
            raise
        except Exception as error:  # of a damaged file scipy raises any of a dozen
            why = getattr(error, "strerror", None) or quote(error, 100)
            raise UnreadableFile(f"{path}: is no .mat file of version 5 ({why}); name one that was exported") from None
        maps = [fields for fields in structs.values() if "temperature" in fields and "bias" in fields]
        if not maps:
            raise ConfigError(f"import {self.kind}: {path} has no struct with temperature and bias; name one that has")
        interpolation = structs.get("driftlab", {}).get("interpolation")
        method = "linear" if interpolation is None else interpolation.text
        return [_read_back(fields, method) for fields in maps]

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
    if (matrix := sensor.matrix) is not None:
        content |= {"matrix": matrix.terms(T), "matrix_sigma": matrix.sigma(T), "frame": matrix.frame,
                    "told": np.array(matrix.told, dtype=float)[None, :]}  # fmt: skip
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


def _texts_of(variable: Variable) -> tuple[str, ...]:
    """Return the texts of a cell array, or the rows of a matrix of characters, which is kept column by column."""
    if variable.cells or not variable.text:
        return tuple(cell.text for cell in variable.cells)
    rows = variable.shape[0]
    return tuple(variable.text[k::rows].rstrip() for k in range(rows))


def _read_back(fields: Mapping[str, Variable], method: str) -> ReadBack:
    T, bias = (np.asarray(fields[name].array, dtype=np.float64) for name in ("temperature", "bias"))
    T, bias = T.ravel(), bias.reshape(T.size, -1)
    axes = _texts_of(fields["axes"])
    unit = (fields["units"].fields or {})["bias"].text
    domain = (float(T[0]), float(T[-1]))
    matrix = _matrix(T, fields) if "matrix" in fields else None
    return ReadBack(fields["channel"].text, unit, axes, domain, between(T, bias, method), order=7, matrix=matrix)


def _matrix(T: Array, fields: Mapping[str, Variable]) -> TriadMatrix:
    """Return the cubic spline of the rows of M; its error is not known."""
    from scipy.interpolate import CubicSpline

    terms = np.asarray(fields["matrix"].array, dtype=np.float64).reshape(T.size, -1)
    slopes = CubicSpline(T, terms)(T, 1)
    told = np.asarray(fields["told"].array).ravel() > 0
    frame: Any = fields["frame"].text
    try:
        return TriadMatrix(
            T=tuple(T.tolist()), values=tuple(map(tuple, terms.tolist())), slopes=tuple(map(tuple, slopes.tolist())),
            frame=frame, kinds=("table",) * len(told), told=tuple(told.tolist()),
        )  # fmt: skip
    except ValidationError as error:
        raise ConfigError(f"import mat: its matrix is none ({quote(error.errors()[0]['msg'], 120)}); mend it") from None


def structs_of(path: Path) -> dict[str, Mapping[str, Variable]]:
    """Return the structs of a file of version 5 to 7; raises what reading it raises."""
    check_regular(path)
    with path.open("rb") as file:
        size = os.fstat(file.fileno()).st_size
        if not file.read(10) == b"MATLAB 5.0":
            raise ValueError("it does not begin as a MAT file of version 5 to 7 does")
        check_size(path, "all of it", size, FILE)
        elements = Elements(path, file, size)
        variables = [elements.load(at) for _, at in elements.variables()]
    return {variable.name: variable.fields for variable in variables if variable and variable.fields}
