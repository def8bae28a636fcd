"""Information of a soak on a unit's map: in the family's basis, with the unit's own noise.

The bias of an axis over R rows, means of some seconds at rest, is::

    y = B(T) c + walk + white,    c the coefficients of the family's basis (`driftlab.family.basis`)

The likelihood of c under the noise of the rows has J = B' S^-1 B and h = B' S^-1 y: -2 log L = c'Jc - 2 c'h and what
knows no c. Coefficients at temperatures that were never seen have no information, and that is all it takes for units
that saw half of the range. The rows stay beside it: the signature of an effect in them may be asked for later.
q coefficients, d axes.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.family.basis import SplineBasis
from driftlab.soak.blocks import SoakRows
from fusion_core.budget import arrays_in
from fusion_core.chunk import Array


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
    seen : (low, high)
        These, degC.
    J, h : (d, q, q) and (d, q) arrays
        Information on the coefficients, and information times their values.
    count : int
        Rows in all.
    white, walk : (d,) arrays
        Densities of the noise that J and h stand on, SI/sqrt(Hz) and SI/sqrt(s).
    recordings : tuple of SoakRows
        The first one's level is the map's, each further one has a level of its own.
    """

    unit: str
    axes: tuple[str, ...]
    knots: SplineBasis
    seen: tuple[float, float]
    J: Array
    h: Array
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
        J, h = np.zeros((d, q, q)), np.zeros((d, q))
        parts = []
        for k, (rows, where) in enumerate(zip(recordings, used, strict=True)):
            if not np.any(where):
                continue
            parts.append(rows.part(where))
            columns = np.column_stack([knots.values(parts[-1].T), parts[-1].t])
            for axis in range(d):
                columns[:, q] = parts[-1].bias[:, axis]
                X = parts[-1].whitened(columns, white[axis], walk[axis], free=k > 0, start=rows.t[0])
                N = X.T @ X
                J[axis] += N[:q, :q]
                h[axis] += N[:q, q]
        return cls(unit, axes, knots, (float(T.min()), float(T.max())), J, h, len(T), white, walk, tuple(parts))

    def between(self, low: float, high: float) -> UnitInformation | None:
        """Return the information of the rows at temperatures from low to high, degC.

        The level stays that of the first row, wherever that is. None where fewer than two rows are left.
        """
        used = [rows.within(low, high) for rows in self.recordings]
        if sum(int(np.sum(where)) for where in used) < 2:
            return None
        return self.of(self.unit, self.axes, self.recordings, self.white, self.walk, self.knots.step, used)

    def with_noise(self, white: Array, walk: Array) -> UnitInformation:
        """Return the information of the rows with noise of other densities (d,)."""
        return self.of(self.unit, self.axes, self.recordings, white, walk, self.knots.step)

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
            "seen": np.array(self.seen),
            "count": np.array(self.count),
        }
        arrays |= {name: getattr(self, name) for name in ("J", "h", "white", "walk")}
        for k, rows in enumerate(self.recordings):
            arrays |= {f"{k}/{name}": getattr(rows, name) for name in ("t", "T", "bias", "span")}
            arrays |= {f"{k}/channel/{name}": values for name, values in rows.channels.items()}
        file = io.BytesIO()
        np.savez(file, **arrays)  # type: ignore[arg-type]
        return file.getvalue()

    @classmethod
    def from_bytes(cls, content: bytes) -> UnitInformation:
        """Return the information that `to_bytes` wrote."""
        file = arrays_in(content)
        first, intervals, step = file["knots"]
        names = [name.split("/", 1) for name in file if "/" in name]
        recordings = []
        for k in sorted({int(number) for number, _ in names}):
            own = {name: file[f"{k}/{name}"] for number, name in names if int(number) == k}
            channels = {name[8:]: values for name, values in own.items() if name.startswith("channel/")}
            recordings.append(SoakRows(own["t"], own["T"], own["bias"], own["span"], channels))
        knots = SplineBasis(int(first), int(intervals), float(step))
        return cls(
            str(file["unit"]), tuple(file["axes"].tolist()), knots, tuple(file["seen"].tolist()), file["J"], file["h"],
            int(file["count"]), file["white"], file["walk"], tuple(recordings),
        )  # fmt: skip
