"""The columns of `units.parquet`: what they are called, of which type and unit, and what they mean.

`SI` stands for the SI unit of the bias, which the column `bias_unit` names.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    import polars as pl

Type = Literal["text", "texts", "number", "numbers", "count", "flag"]


@dataclass(frozen=True)
class Column:
    """One column: its type, its unit (empty: it has none), and what it says."""

    type: Type
    unit: str
    meaning: str


def _with_sigma(name: str, unit: str, meaning: str) -> Iterator[tuple[str, Column]]:
    yield name, Column("number", unit, meaning)
    yield f"{name}_sigma", Column("number", unit, "its standard deviation")


COLUMNS: dict[str, Column] = dict([
    ("unit", Column("text", "", "name of the unit")),
    ("axis", Column("text", "", "axis of its sensor; null in the only row of a unit that failed")),
    ("lot", Column("text", "", "as the manifest has it")),
    ("date", Column("text", "", "as the manifest has it, ISO 8601")),
    ("state", Column("text", "", "`done` or `failed`")),
    ("error", Column("text", "", "why it failed")),
    ("channel", Column("text", "", "sensor whose bias it is about")),
    ("bias_unit", Column("text", "", "SI unit of its bias")),
    ("T_low", Column("number", "degC", "lowest temperature that was soaked")),
    ("T_high", Column("number", "degC", "highest temperature that was soaked")),
    ("hours", Column("number", "h", "of recordings at rest")),
    ("samples", Column("count", "1", "that the own map was fitted on")),
    ("knots", Column("numbers", "degC", "temperatures at which the splines of the family's basis peak")),
    ("coefficients", Column("numbers", "SI", "of the family's map on that basis: own data and the family")),
    ("coefficients_sigma", Column("numbers", "SI", "their standard deviations")),
    *_with_sigma("residual", "SI", "rms of 30 s averages about the own map"),
    *_with_sigma("noise", "SI/sqrt(Hz)", "density of the white noise"),
    *_with_sigma("walk", "SI/sqrt(s)", "density of the random walk of the bias"),
    *_with_sigma("swing", "SI", "largest less smallest bias of the own map"),
    *_with_sigma("coast", "SI", "rms of the error of 10 min without a measurement"),
    *_with_sigma("coast_1min", "SI", "the same of 1 min"),
    *_with_sigma("coast_5min", "SI", "the same of 5 min"),
    *_with_sigma("coast_end", "SI", "the same to the end of the recording"),
    ("coast_of", Column("text", "", "recording that was coasted")),
    ("coast_in_sample", Column("flag", "", "whether the own map was fitted on it")),
    ("map_sigma", Column("number", "SI", "rms of the standard deviation of the own map over its domain")),
    ("family_sigma", Column("number", "SI", "rms of that of the family's map over the family's domain")),
    ("shape_distance", Column("number", "1", "how far the coefficients are from the family's, in deviations")),
    ("odd", Column("flag", "", "whether the unit stands out, in any axis")),
    ("odd_why", Column("text", "", "why, in sentences")),
    ("verdict", Column("texts", "", "on the own map, in sentences")),
    ("limits", Column("text", "", "of the config: `pass`, `fail`, `undecided`, `not measured`; null: none")),
    ("limits_failed", Column("texts", "", "those that the unit does not keep")),
    ("limits_undecided", Column("texts", "", "those within whose guard the unit is")),
    ("effects", Column("texts", "", "that the loop added to the unit's model, with --explain")),
    ("loop", Column("text", "", "verdict of the loop, or why there is none")),
    *_with_sigma("common_effect", "SI", "size of the family's common effect in this unit"),
    ("driftlab", Column("text", "", "version that did the unit")),
    ("plugins", Column("texts", "", "that took part: family, kind, distribution, version")),
    ("seconds", Column("number", "s", "of one processor")),
    ("key", Column("text", "", "hash of recordings, config and versions")),
])  # fmt: skip
AFTER = "date"  # behind which the manifest's own columns stand


def named(more: Iterable[str]) -> dict[str, str]:
    """Return what the manifest's own columns are called in the table: `manifest_NAME` where that is another's name."""
    found: dict[str, str] = {}
    for name in more:
        found[name] = name if name not in COLUMNS else f"manifest_{name}"
    return found


def all_columns(more: Iterable[str]) -> dict[str, Column]:
    """Return the columns of a fleet whose manifest has `more` of them, in their order."""
    found: dict[str, Column] = {}
    for name, column in COLUMNS.items():
        found[name] = column
        if name == AFTER:
            found |= {n: Column("text", "", "of the manifest") for n in named(more).values()}
    return found


def schema(columns: dict[str, Column]) -> dict[str, pl.DataType]:
    """Return the types of columns as polars has them."""
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
