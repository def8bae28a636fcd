"""What the maps share: checked and binned samples of a soak, and the envelope of the file.

The mean of the n samples in a bin has the variance

::

    sigma_s^2 / n + sigma_b^2

sigma_s is the scatter within the bins. sigma_b is what averaging does not remove: a gyro's bias wanders over
hours, so ten thousand samples at one temperature are not ten thousand independent ones. Without it a long
stay at one temperature would outweigh all the others. N samples, m bins, d axes.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from fusion_core.chunk import Array
from fusion_core.contracts import MapRecord
from fusion_core.errors import BadValue, EmptyRecording, MapError, SwingTooSmall
from fusion_plugins.thermal_maps.uncertainty import Curve, Smoother, curve_error, resolution

LARGEST = 1e30  # number of a map file; what is beyond it becomes infinite in a curve
SLAB = 1 << 16  # samples handled at a time, so that millions need no memory of their own


class MapFile(BaseModel):
    """The part that every map file has; a kind adds its coefficients."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    driftlab_map: Literal[1] = 1  # version of the format
    record: MapRecord


Content = TypeVar("Content", bound=MapFile)


@dataclass(frozen=True, eq=False)
class Bins:
    """Samples averaged over narrow ranges of temperature: T (m,), bias and variance (m, d); the bin of each (N,)."""

    T: Array
    bias: Array
    variance: Array
    of_sample: NDArray[np.int64]


def check_samples(kind: str, T: Array, bias: Array) -> tuple[Array, Array]:
    """Return T (N,) and bias (N, d) as arrays of float64.

    Raises
    ------
    BadValue
        If the shapes do not match, or a value is not a finite number.
    EmptyRecording
        If there are no samples.
    """
    T, bias = np.asarray(T, dtype=np.float64), np.asarray(bias, dtype=np.float64)
    if T.ndim != 1 or bias.ndim != 2 or len(T) != len(bias) or bias.shape[1] == 0:
        raise BadValue(
            f"{kind}: has T {T.shape} and bias {bias.shape}, expected (N,) and (N, d); "
            f"give one row of bias a temperature"
        )
    if len(T) == 0:
        raise EmptyRecording(f"{kind}: has no sample to fit; check the recording and its START:STOP range")
    for name, values in (("T", T[:, None]), ("bias", bias)):
        good = np.isfinite(values).all(axis=1)
        if not good.all():
            k = int(np.argmin(good))
            raise BadValue(
                f"{kind}: {name} has {np.sum(~good)} samples that are not finite numbers, the first is "
                f"sample {k} of {len(T)}, expected none; leave those rows out before the fit"
            )
    return T, bias


def check_swing(kind: str, T: Array, min_swing: float, distinct: int, what: str, remedy: str) -> None:
    """Raise SwingTooSmall where T (N,) moves less than `min_swing` K or takes too few `distinct` values."""
    swing, values = float(np.ptp(T)), len(np.unique(T))
    if swing < min_swing:
        raise SwingTooSmall(
            f"{kind}: T moves by only {swing:.2f} K, {what} needs at least {min_swing:g} K; "
            f"fit it on a wider soak or lower min_swing"
        )
    if values < distinct:
        raise SwingTooSmall(
            f"{kind}: T takes only {values} distinct values, {what} needs at least {distinct}; "
            f"fit it on a wider soak or {remedy}"
        )


def bin_samples(T: Array, bias: Array, count: int) -> Bins:
    """Average T (N,) and bias (N, d) over at most `count` bins of equal width; empty ones are left out."""
    low = T.min()
    index = np.minimum(((T - low) * (count / np.ptp(T))).astype(np.intp), count - 1)
    n_all = np.bincount(index, minlength=count)
    n = n_all[n_all > 0]

    def mean(values: Array) -> Array:
        return np.bincount(index, values, minlength=count)[n_all > 0] / n

    centre, means = mean(T), np.stack([mean(column) for column in bias.T], axis=1)
    offset = bias.mean(axis=0)  # the squares below lose digits to a large constant
    squares = np.stack([mean((column - o) ** 2) for column, o in zip(bias.T, offset, strict=True)], axis=1)
    within = np.maximum(squares - (means - offset) ** 2, 0.0)
    scatter = n @ within / max(len(T) - len(n), 1)
    variance = scatter / n[:, None] + _between(centre, means, scatter / n[:, None])
    smallest = np.finfo(float).eps ** 2 * np.mean(bias**2, axis=0) + np.finfo(float).tiny  # samples without noise
    place = np.cumsum(n_all > 0) - 1
    return Bins(centre, means, np.maximum(variance, smallest), place[index].astype(np.int64))


def _between(T: Array, means: Array, variance: Array) -> Array:
    """Estimate sigma_b^2 (d,): scatter of bin means about their neighbours that `variance` does not explain.

    The median makes it blind to a step in the curve. Source: pseudo-residuals of Gasser, Sroka and
    Jennen-Steinmetz, Residual variance and residual pattern in nonlinear regression, Biometrika 73 (1986).
    """
    if len(T) < 5:
        return np.zeros(means.shape[1])
    right = ((T[1:-1] - T[:-2]) / (T[2:] - T[:-2]))[:, None]
    left = 1 - right
    expected = left**2 * variance[:-2] + right**2 * variance[2:] + variance[1:-1]
    gain = left**2 + right**2 + 1
    found = (left * means[:-2] + right * means[2:] - means[1:-1]) ** 2
    median_of_chi2 = 0.4549  # one degree of freedom
    excess: Array = np.median(found / gain, axis=0) / median_of_chi2 - np.median(expected / gain, axis=0)
    return np.maximum(excess, 0.0)


def record_fit(
    kind: str, T: Array, bias: Array, provenance: Mapping[str, str], predict: Curve, smoother: Smoother
) -> MapRecord:
    """Return the record of a fit to T (N,) and bias (N, d): the rms over all samples of what is left, and the error.

    Raises
    ------
    SingularFit
        If the temperatures have a hole that the curve cannot bridge.
    """
    from threadpoolctl import threadpool_limits  # type: ignore[import-untyped]

    total = np.zeros(bias.shape[1])
    for start in range(0, len(T), SLAB):
        part = slice(start, start + SLAB)
        total += np.sum((bias[part] - predict(T[part])) ** 2, axis=0)
    residual = tuple(np.sqrt(total / len(T)).tolist())
    domain = (float(T.min()), float(T.max()))
    with threadpool_limits(1):  # a few hundred blocks: threads would wait for one another
        error = curve_error(kind, T, bias, predict, smoother)
    return MapRecord(
        kind=kind, domain=domain, residual=residual, samples=len(T), provenance=provenance,
        resolution=resolution(T), error=error,
    )  # fmt: skip


def write_file(kind: str, path: Path, data: bytes) -> None:
    """Write a map's file under a temporary name and rename it when it is whole."""
    part = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with part.open("xb") as file:  # never in the place of another file
            try:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            except OSError:
                part.unlink()
                raise
        os.replace(part, path)
    except OSError as error:
        raise MapError(
            f"{kind}: map file {path} cannot be written ({error.strerror}); "
            f"name a file in a folder that exists and can be written"
        ) from None


def read_file(kind: str, path: Path) -> bytes:
    """Read a map's file; raises MapError where it cannot be read."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise MapError(
            f"{kind}: map file {path} cannot be read ({error.strerror}); name a file that `driftlab fit-map` wrote"
        ) from None


def parse(kind: str, path: Path, text: bytes | str, model: type[Content]) -> Content:
    """Check the JSON text of a map file.

    Raises
    ------
    MapError
        If it is not JSON, not a map, of another version or kind, or not whole.
    """
    try:
        data = json.loads(text, parse_constant=_refuse_constant, parse_float=_number)
    except (ValueError, RecursionError) as error:
        raise _wrong(kind, path, f"is damaged or not JSON ({error})", "a JSON map", "refit it") from None
    if not isinstance(data, dict) or "driftlab_map" not in data:
        raise _wrong(kind, path, "has no key 'driftlab_map'", "a map", "name a file that `driftlab fit-map` wrote")
    if data["driftlab_map"] != 1:
        found = f"is of version {data['driftlab_map']!r}"
        raise _wrong(kind, path, found, "version 1", "refit it, or use the driftlab that wrote it")
    record = data.get("record")
    found_kind = record.get("kind") if isinstance(record, dict) else None
    if found_kind is not None and found_kind != kind:
        raise _wrong(
            kind,
            path,
            f"holds a map of kind '{found_kind}'",
            f"'{kind}'",
            f"set kind: {found_kind}, or refit it",
        )
    try:
        content = model.model_validate(data)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, first["loc"])) or "content"
        raise _wrong(kind, path, f"is damaged at {where} ({first['msg']})", "a whole map", "refit it") from None
    low, high = content.record.domain
    if not (-LARGEST <= low < high <= LARGEST and content.record.residual):
        found = f"has the domain ({low}, {high}) and {len(content.record.residual)} axes"
        raise _wrong(kind, path, found, "a range and at least one axis", "refit it")
    if not all(0 <= value <= LARGEST for value in content.record.residual):
        raise _wrong(kind, path, f"has the residual {content.record.residual}", "a deviation an axis", "refit it")
    return content


def expect_shape(name: str, values: Any, shape: tuple[int, ...]) -> None:
    """Raise ValueError where nested sequences do not have the shape; for the validators of map files."""
    if np.shape(values) != shape:  # a ragged one raises ValueError of its own
        raise ValueError(f"{name} has the shape {np.shape(values)}, not {shape}")


def _wrong(kind: str, path: Path, found: str, expected: str, remedy: str) -> MapError:
    return MapError(f"{kind}: map file {path} {found}, expected {expected}; {remedy}")


def _number(text: str) -> float:
    value = float(text)
    if not abs(value) <= LARGEST:
        raise ValueError(f"the number {text[:20]} is beyond {LARGEST:g}")
    return value


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is not a number")
