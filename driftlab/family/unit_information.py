"""Information of a soak on a unit's map: in the family's basis, with the unit's own noise.

The bias of an axis over R rows, means of some seconds at rest, is::

    y = B(T) c + walk + white,    c the coefficients of the family's basis (`driftlab.family.basis`)

The likelihood of c under the noise of the rows has J = B' S^-1 B and h = B' S^-1 y: -2 log L = c'Jc - 2 c'h + y'S^-1y
+ log det S. Coefficients at temperatures that were never seen have no information, and that is all it takes for units
that saw half of the range. The rows stay beside it: the signature of an effect in them may be asked for later.
q coefficients, d axes.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.family.basis import SplineBasis
from driftlab.noise.local_level import log_determinant, whitened
from fusion_core.budget import opened
from fusion_core.chunk import Array

UNKNOWN = 1e8  # times the noise and the walk of a whole recording: variance of a level of which nothing is known


def unknown_level(noise: Array, steps: Array) -> float:
    """Return the variance of an unknown level, beside variances (R,) of white noise and of the steps of the walk."""
    return UNKNOWN * float(np.max(noise) + np.sum(steps))


@dataclass(frozen=True, eq=False)
class SoakRows:
    """Means of one recording at rest, in the order of time.

    Attributes
    ----------
    t : (R,) array
        Their middles, s.
    T : (R,) array
        Temperature as measured, degC.
    bias : (R, d) array
        Of the tracked sensor, SI.
    span : (R,) array
        How long each was measured, s.
    channels : mapping of str to (R,) or (R, k) array
        What else was recorded, for effects.
    """

    t: Array
    T: Array
    bias: Array
    span: Array
    channels: Mapping[str, Array]

    def part(self, where: NDArray[np.bool_]) -> SoakRows:
        """Return the rows of which `where` (R,) is true."""
        channels = {name: values[where] for name, values in self.channels.items()}
        return SoakRows(self.t[where], self.T[where], self.bias[where], self.span[where], channels)

    def within(self, low: float, high: float) -> NDArray[np.bool_]:
        """Return True where a row (R,) is at a temperature from low to high, degC."""
        temperature = self.T
        return (temperature >= low) & (temperature <= high)

    def variances(self, white: float, walk: float, *, free: bool) -> tuple[Array, Array]:
        """Return variances (R,) of the white noise of the rows and of the walk that leads to each.

        `white` and `walk` are densities, SI/sqrt(Hz) and SI/sqrt(s). The level is that of the curve at the first row,
        or `free`: nothing is known of it, as of a further recording of the same unit.
        """
        steps = walk**2 * np.diff(self.t, prepend=self.t[0])
        noise = np.maximum(white**2 / self.span, np.finfo(float).tiny)
        if free:
            steps[0] = unknown_level(noise, steps)
        return noise, steps

    def whitened(self, columns: Array, white: float, walk: float, *, free: bool) -> tuple[Array, float]:
        """Return columns (R, m) over the rows as normalised innovations, and log det of the covariance of the rows.

        The noise is that of `variances`.
        """
        noise, steps = self.variances(white, walk, free=free)
        return whitened(columns, noise, steps), log_determinant(noise, steps)


@dataclass(frozen=True, eq=False)
class UnitInformation:
    """Information of the soaks of one unit.

    Attributes
    ----------
    unit : str
        Its name.
    axes : tuple of str
    knots : Knots
        Over the temperatures that the unit saw.
    J, h : (d, q, q) and (d, q) arrays
        Information on the coefficients, and information times their values.
    squares, log_det : (d,) arrays
        y' S^-1 y, and log det S: what a likelihood needs beside J and h.
    count : int
        Rows in all.
    white, walk : (d,) arrays
        Densities of the noise that J and h stand on, SI/sqrt(Hz) and SI/sqrt(s).
    recordings : tuple of Rows
        The first one's level is the map's, each further one has a level of its own.
    """

    unit: str
    axes: tuple[str, ...]
    knots: SplineBasis
    J: Array
    h: Array
    squares: Array
    log_det: Array
    count: int
    white: Array
    walk: Array
    recordings: tuple[SoakRows, ...]

    @classmethod
    def of(
        cls, unit: str, axes: tuple[str, ...], recordings: Sequence[SoakRows], white: Array, walk: Array, step: float,
        used: Sequence[NDArray[np.bool_]] | None = None,
    ) -> UnitInformation:  # fmt: skip
        """Return the information of rows with noise of the densities `white` and `walk` (d,), knots `step` K apart.

        Where not all rows are `used` (R,), the walk goes on in those between.
        """
        used = [np.ones(len(rows.t), bool) for rows in recordings] if used is None else used
        T = np.concatenate([rows.T[where] for rows, where in zip(recordings, used, strict=True)])
        knots = SplineBasis.over(T, step)
        d, q = len(axes), knots.q
        J, h, squares, log_det = np.zeros((d, q, q)), np.zeros((d, q)), np.zeros(d), np.zeros(d)
        parts = []
        for k, (rows, where) in enumerate(zip(recordings, used, strict=True)):
            if not np.any(where):
                continue
            parts.append(rows.part(where))
            B = knots.values(rows.T[where])
            for axis in range(d):
                noise, steps = rows.variances(white[axis], walk[axis], free=k > 0)
                noise, steps = noise[where], np.diff(np.cumsum(steps)[where], prepend=0.0)
                X = whitened(np.column_stack([B, rows.bias[where, axis]]), noise, steps)
                N = X.T @ X
                J[axis] += N[:q, :q]
                h[axis] += N[:q, q]
                squares[axis] += N[q, q]
                log_det[axis] += log_determinant(noise, steps)
        return cls(unit, axes, knots, J, h, squares, log_det, len(T), white, walk, tuple(parts))

    def between(self, low: float, high: float) -> UnitInformation | None:
        """Return the information of the rows at temperatures from low to high, degC.

        The level stays that of the first row, wherever that is. None where fewer than two rows are left.
        """
        used = [rows.within(low, high) for rows in self.recordings]
        if sum(int(np.sum(where)) for where in used) < 2:
            return None
        return self.of(self.unit, self.axes, self.recordings, self.white, self.walk, self.knots.step, used)

    def on(self, wider: SplineBasis) -> tuple[Array, Array]:
        """Return J (d, q, q) and h (d, q) on the knots of a wider domain; zero where the unit saw nothing."""
        part, d = self.knots.within(wider), len(self.axes)
        J, h = np.zeros((d, wider.q, wider.q)), np.zeros((d, wider.q))
        J[:, part, part], h[:, part] = self.J, self.h
        return J, h

    def to_bytes(self) -> bytes:
        """Return it as the content of an .npz file (`unit.npz`)."""
        arrays: dict[str, Array] = {
            "unit": np.array(self.unit),
            "axes": np.array(self.axes),
            "knots": np.array([self.knots.first, self.knots.intervals, self.knots.step]),
            "count": np.array(self.count),
        }
        arrays |= {name: getattr(self, name) for name in ("J", "h", "squares", "log_det", "white", "walk")}
        for k, rows in enumerate(self.recordings):
            arrays |= {f"{k}/{name}": getattr(rows, name) for name in ("t", "T", "bias", "span")}
            arrays |= {f"{k}/channel/{name}": values for name, values in rows.channels.items()}
        file = io.BytesIO()
        np.savez(file, **arrays)  # type: ignore[arg-type]
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> UnitInformation:
        """Return the information that `to_bytes` wrote."""
        with opened(content) as file:
            first, intervals, step = file["knots"]
            names = [name.split("/", 1) for name in file.files if "/" in name]
            recordings = []
            for k in sorted({int(number) for number, _ in names}):
                own = {name: file[f"{k}/{name}"] for number, name in names if int(number) == k}
                channels = {name[8:]: values for name, values in own.items() if name.startswith("channel/")}
                recordings.append(SoakRows(own["t"], own["T"], own["bias"], own["span"], channels))
            return cls(
                str(file["unit"]), tuple(file["axes"].tolist()), SplineBasis(int(first), int(intervals), float(step)),
                file["J"], file["h"], file["squares"], file["log_det"], int(file["count"]), file["white"],
                file["walk"], tuple(recordings),
            )  # fmt: skip
