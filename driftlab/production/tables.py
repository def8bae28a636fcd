"""`units.parquet`: a row a unit and axis; its columns with their types, units and meanings.

`SI` stands for the SI unit of the bias, which the column `bias_unit` names. The family's part of each unit's rows is
made with the unit's curve for the report, and its `family_map.json`.

d axes, q coefficients, G temperatures.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from driftlab.evaluation.limits import VERDICTS, worst
from driftlab.family.mixed_model import Family
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.posterior_map import informed_where_unknown, posterior_of
from driftlab.family.record import UnitRecord
from driftlab.family.shared_effects import SharedEffects
from driftlab.production.store import NEW, UNITS, UnitRef
from fusion_core.chunk import Array

if TYPE_CHECKING:
    import polars as pl

FIGURES = ("residual", "noise", "walk", "swing", "coast", "coast_1min", "coast_5min", "coast_end")
PIECE = 10_000  # rows that are made a frame at once
Row = dict[str, Any]


def rows_of(record: UnitRecord, family: OfTheFamily | None, odd: Sequence[str] | None) -> Iterator[Row]:
    """Yield the rows of a unit: `odd` are the reasons for which it stands out, None where they are not known."""
    row: Row = {name: getattr(record, name) for name in ("unit", "state", "seconds")}
    row |= {named(name): value for name, value in record.more.items()}
    texts = ("lot", "date", "error", "channel", "bias_unit", "driftlab", "key")
    row |= {name: getattr(record, name) or None for name in texts}
    row |= {"plugins": [_plugin(item) for item in record.plugins]}
    if record.state == "failed":
        yield row
        return
    low, high = record.domain or (None, None)
    row |= {"T_low": low, "T_high": high, "hours": record.hours, "samples": record.samples}
    row |= {"coast_of": record.coast_of or None, "coast_in_sample": record.coast_in_sample}
    row |= {"verdict": record.verdict, **_limits(record), **_loop(record)}
    if odd is not None:
        row |= {"odd": bool(odd), "odd_why": "; ".join(odd) or None}
    for k, axis in enumerate(record.axes):
        values: Row = {"axis": axis, "map_sigma": None if record.map_sigma is None else record.map_sigma[k]}
        for name in FIGURES:
            if (figure := record.figures.get(name)) is not None:
                values |= {name: figure.value[k], f"{name}_sigma": figure.sigma[k]}
        yield row | values | ({} if family is None else family.row(k))


def _plugin(item: Mapping[str, Any]) -> str:
    return " ".join(str(item.get(name, "")) for name in ("family", "kind", "distribution", "version")).strip()


def _limits(record: UnitRecord) -> Row:
    by = {word: [str(row.get("name")) for row in record.limits if row.get("verdict") == word] for word in VERDICTS}
    return {"limits": worst(record.limits), "limits_failed": by["fail"], "limits_undecided": by["undecided"]}


def _loop(record: UnitRecord) -> Row:
    if record.loop is None:
        return {}
    effects = record.loop.get("effects") or []
    added = [str(item.get("kind", item)) if isinstance(item, Mapping) else str(item) for item in effects]
    return {"loop": record.loop.get("verdict") or record.loop.get("why_not"), "effects": added}


def write_table(path: Path, rows: Iterable[Row], more: Iterable[str], metadata: Mapping[str, str]) -> None:
    """Write rows as a Parquet file, with units and meanings of its columns in its metadata beside `metadata`.

    `more` are the names of the manifest's own columns.
    """
    import polars as pl
    from polars import selectors

    columns, left = all_columns(more), iter(rows)
    types = schema(columns)
    pieces = [pl.DataFrame(schema=types)]
    while piece := list(islice(left, PIECE)):
        pieces.append(pl.DataFrame(piece, schema=types))
    described = {name: {"unit": c.unit, "meaning": c.meaning} for name, c in columns.items()}
    table = pl.concat(pieces).with_columns(selectors.float().fill_nan(None))
    table.write_parquet(path, metadata={**metadata, "columns": json.dumps(described)})


Type = Literal["text", "texts", "number", "numbers", "count", "flag"]


@dataclass(frozen=True)
class UnitColumn:
    """One column: its type, its unit (empty: it has none), and what it says."""

    type: Type
    unit: str
    meaning: str


def _with_sigma(name: str, unit: str, meaning: str) -> Iterator[tuple[str, UnitColumn]]:
    yield name, UnitColumn("number", unit, meaning)
    yield f"{name}_sigma", UnitColumn("number", unit, "its standard deviation")


COLUMNS: dict[str, UnitColumn] = dict([
    ("unit", UnitColumn("text", "", "name of the unit")),
    ("axis", UnitColumn("text", "", "axis of its sensor; null in the only row of a unit that failed")),
    ("lot", UnitColumn("text", "", "as the manifest has it")),
    ("date", UnitColumn("text", "", "as the manifest has it, ISO 8601")),
    ("state", UnitColumn("text", "", "`done` or `failed`")),
    ("error", UnitColumn("text", "", "why it failed")),
    ("channel", UnitColumn("text", "", "sensor whose bias it is about")),
    ("bias_unit", UnitColumn("text", "", "SI unit of its bias")),
    ("T_low", UnitColumn("number", "degC", "lowest temperature that was soaked")),
    ("T_high", UnitColumn("number", "degC", "highest temperature that was soaked")),
    ("hours", UnitColumn("number", "h", "of recordings at rest")),
    ("samples", UnitColumn("count", "1", "that the own map was fitted on")),
    ("knots", UnitColumn("numbers", "degC", "temperatures at which the splines of the family's basis peak")),
    ("coefficients", UnitColumn("numbers", "SI", "of the family's map on that basis: own data and the family")),
    ("coefficients_sigma", UnitColumn("numbers", "SI", "their standard deviations")),
    *_with_sigma("residual", "SI", "rms of 30 s averages about the own map"),
    *_with_sigma("noise", "SI/sqrt(Hz)", "density of the white noise"),
    *_with_sigma("walk", "SI/sqrt(s)", "density of the random walk of the bias"),
    *_with_sigma("swing", "SI", "largest less smallest bias of the own map"),
    *_with_sigma("coast", "SI", "rms of the error of 10 min without a measurement"),
    *_with_sigma("coast_1min", "SI", "the same of 1 min"),
    *_with_sigma("coast_5min", "SI", "the same of 5 min"),
    *_with_sigma("coast_end", "SI", "the same to the end of the recording"),
    ("coast_of", UnitColumn("text", "", "recording that was coasted")),
    ("coast_in_sample", UnitColumn("flag", "", "whether the own map was fitted on it")),
    ("map_sigma", UnitColumn("number", "SI", "rms of the standard deviation of the own map over its domain")),
    ("family_sigma", UnitColumn("number", "SI", "rms of that of the family's map over the family's domain")),
    ("shape_distance", UnitColumn("number", "1", "how far the coefficients are from the family's, in deviations")),
    ("odd", UnitColumn("flag", "", "whether the unit stands out, in any axis")),
    ("odd_why", UnitColumn("text", "", "why, in sentences")),
    ("verdict", UnitColumn("texts", "", "on the own map, in sentences")),
    ("limits", UnitColumn("text", "", "of the config: `pass`, `fail`, `undecided`, `not measured`; null: none")),
    ("limits_failed", UnitColumn("texts", "", "those that the unit does not keep")),
    ("limits_undecided", UnitColumn("texts", "", "those within whose guard the unit is")),
    ("effects", UnitColumn("texts", "", "that the loop added to the unit's model, with --explain")),
    ("loop", UnitColumn("text", "", "verdict of the loop, or why there is none")),
    *_with_sigma("common_effect", "SI", "size of the family's common effect in this unit"),
    ("driftlab", UnitColumn("text", "", "version that did the unit")),
    ("plugins", UnitColumn("texts", "", "that took part: family, kind, distribution, version")),
    ("seconds", UnitColumn("number", "s", "of one processor")),
    ("key", UnitColumn("text", "", "hash of recordings, config and versions")),
])  # fmt: skip
AFTER = "date"  # behind which the manifest's own columns stand


def named(name: str) -> str:
    """Return the name in the table of a column of the manifest: `manifest_NAME` where that is another's name."""
    return f"manifest_{name}" if name in COLUMNS else name


def all_columns(more: Iterable[str]) -> dict[str, UnitColumn]:
    """Return the columns of a fleet whose manifest has `more` of them, in their order."""
    columns: dict[str, UnitColumn] = {}
    for name, column in COLUMNS.items():
        columns[name] = column
        if name == AFTER:
            columns |= {named(n): UnitColumn("text", "", "of the manifest") for n in more}
    return columns


def schema(columns: Mapping[str, UnitColumn]) -> dict[str, pl.DataType]:
    """Return the types of columns, of polars."""
    import polars as pl

    types: dict[Type, pl.DataType] = {
        "text": pl.String(),
        "texts": pl.List(pl.String()),
        "number": pl.Float64(),
        "numbers": pl.List(pl.Float64()),
        "count": pl.Int64(),
        "flag": pl.Boolean(),
    }
    return {name: types[column.type] for name, column in columns.items()}


MAP = "family_map.json"
AT_ONCE = 25  # units that a process is given at once, with the family


@dataclass(frozen=True, eq=False)
class OfTheFamily:
    """The family's part of a unit's rows, and its curve.

    Attributes
    ----------
    knots : (q,) array
        Where the splines peak, degC.
    c, sigma : (d, q) arrays
        Coefficients of the unit's map with the family, and their deviations.
    curve : (d, G) array
        That map over `temperatures`, in single precision.
    map_sigma : (d,) array
        Rms of its deviation over the family's domain.
    distance : (d,) array
        Of its coefficients from the mean of its lot, in deviations: 1 is usual.
    common, common_sigma : (d,) arrays or None
        First coefficient of the first common effect in this unit.
    """

    knots: Array
    c: Array
    sigma: Array
    curve: Array
    map_sigma: Array
    distance: Array
    common: Array | None = None
    common_sigma: Array | None = None

    def row(self, k: int) -> Row:
        """Return the part of the row of the k-th axis."""
        numbers = {
            "family_sigma": self.map_sigma, "shape_distance": self.distance, "common_effect": self.common,
            "common_effect_sigma": self.common_sigma,
        }  # fmt: skip
        return {
            "knots": self.knots.tolist(),
            "coefficients": self.c[k].tolist(),
            "coefficients_sigma": self.sigma[k].tolist(),
            **{name: None if values is None else float(values[k]) for name, values in numbers.items()},
        }


def temperatures(family: Family) -> Array:
    """Return temperatures (G,) over the family's domain, degC."""
    return np.linspace(*family.knots.domain, 2 * family.knots.intervals + 1)


def posteriors(
    folder: Path, records: Iterable[UnitRecord], family: Family, common: SharedEffects, each: ParallelMap = serial
) -> Iterator[OfTheFamily]:
    """Yield the family's part of each unit that was done, in their order, and write the units' maps.

    Raises
    ------
    DataError
        If a unit's file is damaged, or belongs to another family.
    """
    units = ((UnitRef(folder, one.unit, one.lot), one, common.of_unit(one.unit)) for one in records)
    return each(partial(_of_unit, family), units, at_once=AT_ONCE)


def _of_unit(family: Family, unit: tuple[UnitRef, UnitRecord, SharedEffects]) -> OfTheFamily:
    place, record, common = unit
    soaked, lot = place.read()
    soaked = common.apart(soaked, lot)
    if not common.effects:
        soaked = informed_where_unknown(soaked, family, record)
    unit_posterior, T = posterior_of(family, soaked, lot), temperatures(family)
    posterior = unit_posterior.posterior
    path = place.folder / UNITS / place.unit / MAP
    new = path.with_name(f".{MAP}{NEW}")
    unit_posterior.map({"unit": place.unit, "lot": lot}).save(new)
    os.replace(new, path)
    before = family.marginal(lot)
    off = [np.linalg.solve(C, c) @ c for C, c in zip(before.covariance, posterior.c - before.c, strict=True)]
    sizes = common.of_units.get(place.unit, ())
    return OfTheFamily(
        family.knots.peaks, posterior.c, np.sqrt(np.diagonal(posterior.covariance, axis1=1, axis2=2)),
        (family.knots.values(T) @ posterior.c.T).T.astype(np.float32),
        np.sqrt(np.mean(unit_posterior.sigma_at(T) ** 2, axis=0)),
        np.sqrt(np.array(off) / family.knots.q),
        sizes[0].c[:, 0] if sizes else None, sizes[0].sigma[:, 0] if sizes else None,
    )  # fmt: skip
