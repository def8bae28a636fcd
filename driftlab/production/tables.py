"""The files of a fleet as a whole: `units.parquet`, a row a unit and axis, the family, and the report.

`SI` stands for the SI unit of the bias, which the column `bias_unit` names. The family's part of each unit's rows is
made with the unit's curve for the report, and its `family_map.json`.

d axes, q coefficients, G temperatures.
"""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.evaluation.limits import VERDICTS, worst
from driftlab.family.file import save_family
from driftlab.family.mixed_model import Family
from driftlab.family.partitions import Partitions, Scratch, ScratchFolder, UnitOfLot, serial
from driftlab.family.posterior_map import UnitPosterior, informed_where_unknown, posterior_of
from driftlab.family.record import TERM_FIGURES, UnitRecord
from driftlab.family.shared_effect import OfUnit, SharedEffect, UnitDensities, of_effect, without_effects
from driftlab.identification.result import described
from driftlab.production.family import FamilyAnalysis
from driftlab.production.fleet_folder import FAMILY, REPORT, TABLE, FleetFolder, StoredUnits
from driftlab.production.summary import FleetProgress, Stage
from driftlab.production.unit_folders import COMMAND, FAMILY_MAP, UnitFolders
from driftlab.production.unit_map import file_content
from driftlab.production.units_pass import FleetStatus
from driftlab.reports.fleet import write_fleet_report
from driftlab.reports.fleet_charts import FleetOverview, SharedEffectRow
from driftlab.spc.yields import reasons
from driftlab.storage.ownership import seal_of
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.chunk import Array
from fusion_core.errors import UnreadableFile
from fusion_core.faults import DOUBT

if TYPE_CHECKING:
    import polars as pl

OF_TERMS = (*TERM_FIGURES, *(f"{name}_change" for name in TERM_FIGURES))
FIGURES = ("residual", "noise", "walk", "swing", "coast", "coast_1min", "coast_5min", "coast_end", *OF_TERMS)
ROWS = 20_000  # of a group, which is written at once
MOST_CURVES = 5000  # maps that the report draws
CURVE = 2  # temperatures of an interval of the knots
Row = dict[str, Any]


def write_fleet(
    folder: FleetFolder,
    status: FleetStatus,
    config: Config,
    analysis: FamilyAnalysis,
    beside: Mapping[str, Any],
    pages: Collection[str],
    progress: FleetProgress,
    units: Partitions[Sequence[UnitOfLot]],
    scratch: Scratch,
) -> None:
    """Write family, table and report, each whole or not at all.

    `beside` are fields of the page's overview, `pages` the units that have one, `units` all of the status; a worker
    writes the rows of its units to `scratch`.
    """
    if analysis.family is not None:
        _save_family(folder.hidden(FAMILY), analysis, analysis.family, config)
    more = list(dict.fromkeys(name for record in status.records for name in record.more))
    drawn = _drawn(status, analysis)
    table = _Table(folder.units, scratch, analysis.family, analysis.common.effects, tuple(more))
    progress(stage := Stage("tables and maps", total=len(status.records)))
    names, chosen = status.records.units, set(drawn)
    shown = np.array([name in chosen for name in names])
    of_units = (
        [of.get(name) for name in names] for of in (analysis.reasons, analysis.common.noise, analysis.common.of_units)
    )
    parts = [f"table-{k}" for k in range(len(units.parts))]
    of_part = [name for name, part in zip(parts, units.parts, strict=True) for _ in range(len(part))]
    curves: list[Array] = []
    for count, own in units.map(table.write, shown, *of_units, of_part):
        curves += own
        stage.done += count
        progress(stage)
    with scratch.files(parts) as paths:
        about = {"driftlab": __version__, "SI": status.bias_unit}
        join = partial(join_tables, folder.hidden(TABLE), more=more, metadata=about)
        engine = units.engine if isinstance(scratch, ScratchFolder) else serial  # a worker sees what is in the folder
        list(engine(join, [paths]))
    progress(Stage("report"))
    title = f"Fleet {(folder.out.name or folder.path.name).removeprefix('fleet').strip(' _-')}".strip()
    links = {name: f"{folder.units.root}/{name}/page/report.html" for name in pages}
    overview = _overview(title, status, tracked_unit(config.filter), analysis, links, curves, drawn)
    write_fleet_report(folder.hidden(REPORT), replace(overview, **beside))
    folder.publish([TABLE, REPORT] if analysis.family is None else [TABLE, FAMILY, REPORT])


def _save_family(path: Path, analysis: FamilyAnalysis, family: Family, config: Config) -> None:
    kind = next((settings.kind for settings in config.tracked_maps()), "")
    common = analysis.common.model_dump(mode="json") if analysis.common.effects else None
    lots = [lot.sentence for lot in analysis.lots]
    save_family(path, family, map_kind=kind, config=config.as_yaml(), common_effects=common, odd_lots=lots)


def _drawn(status: FleetStatus, analysis: FamilyAnalysis) -> list[str]:
    """Return the units whose curves the report draws: all, or an even sample and the first of an odd shape."""
    if analysis.family is None:
        return []
    names, done = list(analysis.odd), status.sound.units
    bent = {name for name in names if any(one.T is not None for one in analysis.odd[name])}
    even = set(done[:: max(1, -(-len(done) // MOST_CURVES))])
    first = set([name for name in done if name in bent][:MOST_CURVES])
    return [name for name in done if name in even or name in first]


@dataclass(frozen=True)
class _Table:
    """Writer of a partition's rows, and of its units' maps with the family."""

    folders: UnitFolders
    scratch: Scratch
    family: Family | None
    effects: Sequence[SharedEffect]
    more: tuple[str, ...]  # names of the manifest's own columns

    def write(
        self,
        units: StoredUnits,
        shown: NDArray[np.bool_],
        odd: Sequence[Sequence[str] | None],
        noise: Sequence[UnitDensities | None],
        sizes: Sequence[Sequence[OfUnit] | None],
        parts: Sequence[str],
    ) -> tuple[int, list[Array]]:
        """Write rows and maps; return the number of the units, and the curves (d, G) of those that are `shown`."""
        rows, curves = list[Row](), list[Array]()
        for k, name in enumerate(units.names):
            record = self.folders.record(name)
            if record is None:
                raise UnreadableFile(
                    f"{self.folders.address}/{name}: has no record any more; give the same command again"
                )
            if self.family is None or record.state != "done":
                rows += rows_of(record, odd=odd[k])
                continue
            soaked, lot = units[k]
            if self.effects:
                soaked = without_effects(soaked, lot, self.effects, noise[k])
            else:
                soaked = informed_where_unknown(soaked, self.family, record)
            part, curve = _posterior_rows(self.folders, posterior_of(self.family, soaked, lot), sizes[k], record.doubts)
            rows += rows_of(record, part, odd[k] or ())
            curves += [curve] * bool(shown[k])
        table = io.BytesIO()
        frame_of(rows, self.more).write_parquet(table)
        self.scratch.write(parts[0], table.getvalue())
        return len(units), curves


def _posterior_rows(
    folders: UnitFolders, of_unit: UnitPosterior, size: Sequence[OfUnit] | None, doubts: Sequence[str]
) -> tuple[list[Row], Array]:
    """Write the map of a unit with the family; return the family's part of its rows, and that map's curve (d, G).

    `shape_distance` is that of its coefficients from the mean of its lot, in deviations: 1 is usual.
    """
    family, name, lot, posterior = of_unit.family, of_unit.soaked.unit, of_unit.lot, of_unit.posterior
    doubt = {DOUBT: doubts[0]} if doubts else {}
    fitted = of_unit.map({"written": seal_of(COMMAND), "unit": name, "lot": lot, **doubt})
    folders.write(name, FAMILY_MAP, file_content(fitted, FAMILY_MAP))
    (T, B), before = family.knots.grid(CURVE), family.marginal(lot)
    off = [np.linalg.solve(C, c) @ c for C, c in zip(before.covariance, posterior.c - before.c, strict=True)]
    columns = {
        "coefficients": posterior.c,
        "coefficients_sigma": np.sqrt(np.diagonal(posterior.covariance, axis1=1, axis2=2)),
        "family_sigma": np.sqrt(np.mean(of_unit.sigma_at(T) ** 2, axis=0)),
        "shape_distance": np.sqrt(np.array(off) / family.knots.q),
    }
    for first in (size or ())[:1]:
        columns |= {"common_effect": first.c[:, 0], "common_effect_sigma": first.sigma[:, 0]}
    knots = family.knots.peaks.tolist()
    rows = [{"knots": knots, **{name: values[k].tolist() for name, values in columns.items()}} for k in range(len(off))]
    return rows, (B @ posterior.c.T).T.astype(np.float32)


def rows_of(record: UnitRecord, family: Sequence[Row] = (), odd: Sequence[str] | None = None) -> Iterator[Row]:
    """Yield the rows of a unit.

    `family` are the family's parts of them, `odd` the reasons for which it stands out, None where they are not known.
    """
    row: Row = {name: getattr(record, name) for name in ("unit", "state", "seconds")}
    row |= {named(name): value for name, value in record.more.items()}
    texts = ("lot", "date", "error", "channel", "bias_unit", "driftlab", "key")
    row |= {name: getattr(record, name) or None for name in texts}
    row |= {"plugins": [_plugin(item) for item in record.plugins], "reasons": reasons(record)}
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
        yield row | values | (family[k] if family else {})


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


def frame_of(rows: Iterable[Row], more: Iterable[str]) -> pl.DataFrame:
    """Return rows as a frame; `more` are the names of the manifest's own columns."""
    import polars as pl
    from polars import selectors

    types = {
        "text": pl.String(), "texts": pl.List(pl.String()), "number": pl.Float64(), "numbers": pl.List(pl.Float64()),
        "count": pl.Int64(), "flag": pl.Boolean(),
    }  # fmt: skip
    schema = {name: types[column.type] for name, column in all_columns(more).items()}
    return pl.DataFrame(list(rows), schema=schema).with_columns(selectors.float().fill_nan(None))


def join_tables(path: Path, parts: Iterable[Path], more: Iterable[str], metadata: Mapping[str, str]) -> None:
    """Write tables one behind the other as a Parquet file, in so many rows at a time.

    Units and meanings of its columns are in its metadata, beside `metadata`.
    """
    import polars as pl

    described = {name: {"unit": c.unit, "meaning": c.meaning} for name, c in all_columns(more).items()}
    pl.scan_parquet(list(parts)).sink_parquet(
        path, metadata={**metadata, "columns": json.dumps(described)}, row_group_size=ROWS
    )


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
    *_with_sigma("scale_factor", "1", "error of the scale factor, in the middle of the stimulus' temperatures"),
    *_with_sigma("misalignment_x", "1", "part of the input along x that the axis reads, there"),
    *_with_sigma("misalignment_y", "1", "the same along y"),
    *_with_sigma("misalignment_z", "1", "the same along z"),
    *_with_sigma("scale_factor_change", "1", "change of it over the stimulus' temperatures"),
    *_with_sigma("misalignment_x_change", "1", "the same of `misalignment_x`"),
    *_with_sigma("misalignment_y_change", "1", "the same of `misalignment_y`"),
    *_with_sigma("misalignment_z_change", "1", "the same of `misalignment_z`"),
    ("coast_of", UnitColumn("text", "", "recording that was predicted")),
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
    ("reasons", UnitColumn("texts", "", "for which the unit is not accepted; none where it is")),
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


def _overview(
    title: str,
    status: FleetStatus,
    unit: BiasUnit,
    analysis: FamilyAnalysis,
    links: Mapping[str, str],
    curves: Sequence[Array],
    drawn: Sequence[str],
) -> FleetOverview:
    family, axes = analysis.family, analysis.line.axes
    T, B = (np.zeros(0), np.zeros(0)) if family is None else family.knots.grid(CURVE)
    return FleetOverview(
        title=title,
        records=status.records,
        unit=unit,
        line=analysis.line,
        T=T,
        curves=np.stack(curves) if curves else np.zeros((0, len(axes), len(T)), dtype=np.float32),
        drawn=drawn,
        mean=None if family is None else (B @ family.mu.T).T,
        odd=analysis.odd,
        effects=[_effect_row(effect, unit, axes) for effect in analysis.common.effects],
        links=dict(links),
        remarks=analysis.lines,
        judged=analysis.judged,
    )


def _effect_row(shared: SharedEffect, unit: BiasUnit, axes: Sequence[str]) -> SharedEffectRow:
    """Return an effect as the report shows it, with its mean first coefficient in each lot."""
    per = shared.unit.removeprefix(unit.si)
    lots = [
        (lot.lot, lot.units, axis, float(mean[0]) * unit.factor, float(sigma[0]) * unit.factor)
        for lot in shared.lots
        for axis, mean, sigma in zip(axes, lot.mean, lot.sigma, strict=True)
    ]
    sentence = " ".join([*of_effect(shared, unit, axes), shared.effect.explanation])
    return SharedEffectRow(described(shared.effect), sentence, f"{unit.shown}{per}", tuple(lots))
