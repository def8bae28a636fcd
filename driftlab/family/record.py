"""Records as JSON: arrays in them, and that of a unit: `unit.json` in its folder, of which `units.parquet` is made.

d axes; all values in SI, temperatures in degC.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import isqrt
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, PlainSerializer, PlainValidator

from fusion_core.chunk import Array
from fusion_core.thermal.curve_error import Numbers, numbers

LOT_DIGITS = 9  # significant ones of a lot's covariance, of which there are many


def _square(values: Any) -> Array:
    """Return the symmetric matrices (..., q, q) of lists of upper triangles, row by row; arrays as they are."""
    triangles = numbers(values)
    n = triangles.shape[-1] if triangles.ndim else 0
    q = (isqrt(8 * n + 1) - 1) // 2
    if isinstance(values, np.ndarray) or q * (q + 1) // 2 != n:
        return triangles
    matrices = np.zeros((*triangles.shape[:-1], q, q))
    rows, columns = np.triu_indices(q)
    matrices[..., rows, columns] = matrices[..., columns, rows] = triangles
    return matrices


def _triangles(matrices: Array) -> Any:
    return matrices[..., *np.triu_indices(matrices.shape[-1])].tolist()


def _rounded_triangles(matrices: Array) -> Any:
    return [[float(f"{value:.{LOT_DIGITS}g}") for value in row] for row in _triangles(matrices)]


Covariances = Annotated[Array, PlainValidator(_square), PlainSerializer(_triangles)]
RoundedCovariances = Annotated[Array, PlainValidator(_square), PlainSerializer(_rounded_triangles)]

FIGURES = ("residual", "noise", "walk", "swing", "coast")
"""Figures of each axis on the charts of a line: rms of 30 s averages about the own map, densities of white noise and of
the walk, largest less smallest bias of the map, rms of the error of 10 min without a measurement."""
TERM_FIGURES = ("scale_factor", "misalignment_x", "misalignment_y", "misalignment_z")
"""Terms of M of each axis in the middle of the temperatures of a stimulus: the error of its scale factor, and the parts
of the input along x, y and z that it reads. The figures `scale_factor_change`, ... are their changes over these."""
PER = {"noise": "/sqrt(Hz)", "walk": "/sqrt(s)"}  # of the unit of a figure, beside that of the bias


def figure_name(figure: str) -> str:
    """Return the name of a figure for people, where files have another."""
    if figure in TERM_FIGURES[1:]:
        return f"misalignment to {figure[-1]}"
    return {"coast": "prediction", "scale_factor": "error of the scale factor"}.get(figure, figure)


class Figure(BaseModel):
    """One quantity of a unit, a value an axis.

    Attributes
    ----------
    value, sigma : (d,) floats
        None where it is not known.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    value: tuple[float | None, ...]
    sigma: tuple[float | None, ...]

    @classmethod
    def of(cls, values: Array, sigma: Array) -> Figure:
        """Return the figure of values and their deviations (d,), None where they are not finite."""
        both = ([float(v) if np.isfinite(v) else None for v in part] for part in (values, sigma))
        return cls(value=tuple(next(both)), sigma=tuple(next(both)))


class Figures(BaseModel):
    """Figures by name."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    figures: dict[str, Figure] = {}

    def table(self, names: Sequence[str], d: int) -> Array:
        """Return values and deviations (2, figures, d) of figures by their names, NaN where they are not known."""
        return table_of([self.figures.get(name) for name in names], d)


def table_of(figures: Iterable[Figure | None], d: int) -> Array:
    """Return values and deviations (2, figures, d) of figures, NaN where they are not known."""
    rows = [(one.value, one.sigma) if one and len(one.value) == d else 2 * ((None,) * d,) for one in figures]
    both = np.array(rows, dtype=np.float64).reshape(len(rows), 2, d).swapaxes(0, 1).copy()
    return np.where(np.isfinite(both), both, np.nan)


class RepeatedSoak(Figures):
    """One of the soaks of a unit by itself: the figures of its own map, and its `level`.

    `name` is that of its recording, `place` its number among the unit's soaks from 0 on: names change where files move.
    """

    name: str
    place: int


class TermParabolas(BaseModel):
    """The nine terms of M of a unit as parabolas over the temperatures T of its stimulus, degC.

    Attributes
    ----------
    c, covariance : (9, 3) and (9, 3, 3) arrays
        Chebyshev coefficients.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    T: tuple[float, float]
    c: Numbers
    covariance: RoundedCovariances


class UnitRecord(Figures):
    """Record of one unit.

    Attributes
    ----------
    key : str
        Hash of the contents of its recordings, the config and the versions: what was done with the same is not done
        again.
    unit, lot, date : str
        As the manifest has them; empty where it has not. The date is ISO 8601.
    more : dict of str to str
        The other columns of the manifest.
    state : str
        `done` or `failed`.
    error : str
        Why it failed; empty where it did not.
    recordings : dict of str to list
        By role: name, length and hash of each.
    channel, bias_unit : str
        Whose bias, and its SI unit.
    axes : tuple of str
    domain : (low, high)
        Temperatures that were soaked, degC.
    hours : float
        Of recordings at rest.
    samples : int
    figures : dict of str to Figure
        FIGURES by name; `coast_1min`, `coast_5min`, `coast_end` too, and of a unit with a stimulus TERM_FIGURES and
        their changes, None where the stimulus does not tell them.
    parabolas : TermParabolas or None
        Terms of M as its family takes them; None without a stimulus over temperature.
    coast_of : str
        Which recording was predicted.
    coast_in_sample : bool
        Whether that is one that the map was fitted on.
    repeats : list of RepeatedSoak
        Where the unit was soaked twice or more over the same range: what each soak says by itself.
    map_sigma : (d,) floats
        Rms of the deviation of the own map over its domain.
    map_file : str
        Its name in the unit's folder; empty where there is none.
    verdict : list of str
        On the map, in sentences.
    limits : list of dict
        The config's limits, held against the unit.
    loop : dict or None
        With --explain: `verdict`, and `effects` as in loop.json; or `why_not`.
    notes : list of str
        What one should know of its recordings.
    doubts : list of str
        Why these may not be what the config says: it is not accepted.
    seconds : float
        Of one processor that it took.
    driftlab : str
        Version.
    plugins : list of dict
    written : dict of str to str
        SHA-256 of each file of the unit's folder, by its name.
    """

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    key: str
    unit: str
    lot: str = ""
    date: str = ""
    more: dict[str, str] = {}
    state: Literal["done", "failed"]
    error: str = ""
    recordings: dict[str, list[dict[str, Any]]] = {}
    channel: str = ""
    bias_unit: str = ""
    axes: tuple[str, ...] = ()
    domain: tuple[float, float] | None = None
    hours: float = 0.0
    samples: int = 0
    parabolas: TermParabolas | None = None
    coast_of: str = ""
    coast_in_sample: bool = False
    repeats: list[RepeatedSoak] = []
    map_sigma: tuple[float, ...] | None = None
    map_file: str = ""
    verdict: list[str] = []
    limits: list[dict[str, Any]] = []
    loop: dict[str, Any] | None = None
    notes: list[str] = []
    doubts: list[str] = []
    seconds: float = 0.0
    driftlab: str = ""
    plugins: list[dict[str, Any]] = []
    written: dict[str, str] = {}
