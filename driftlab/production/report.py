"""The files of a fleet as a whole: a row a unit and axis, the family, and the report."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path

import numpy as np

from driftlab import __version__
from driftlab.config import Config
from driftlab.family.file import save_family
from driftlab.family.parallel import ParallelMap, serial
from driftlab.family.shared_effect import SharedEffect, of_effect
from driftlab.identification.result import described
from driftlab.production.family import FamilyAnalysis
from driftlab.production.store import FAMILY, NEW, REPORT, TABLE, UNITS, FleetFolder
from driftlab.production.summary import FleetProgress, Stage
from driftlab.production.tables import Row, posteriors, rows_of, temperatures, write_table
from driftlab.production.units_pass import FleetStatus
from driftlab.reports.fleet import FleetOverview, SharedEffectRow, write_fleet_report
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.chunk import Array


def is_written(folder: Path, *, family: bool) -> bool:
    """Return True if all files of a fleet as a whole are there."""
    return all((folder / name).is_file() for name in (TABLE, REPORT, *([FAMILY] if family else ())))


def write_fleet(
    folder: FleetFolder,
    status: FleetStatus,
    config: Config,
    analysis: FamilyAnalysis,
    pages: Collection[str],
    progress: FleetProgress,
    each: ParallelMap = serial,
) -> None:
    """Write family, table and report, each whole or not at all; `pages` are the units that have one."""
    path = folder.path
    if analysis.family is not None:
        kind = next((settings.kind for settings in config.tracked_maps()), "")
        common = analysis.common.model_dump(mode="json") if analysis.common.effects else None
        save_family(
            path / FAMILY, analysis.family, map_kind=kind, config=config.as_yaml(), common_effects=common,
            odd_lots=[lot.sentence for lot in analysis.lots],
        )  # fmt: skip
    else:
        (path / FAMILY).unlink(missing_ok=True)  # of other units
    curves: list[Array] = []
    new = path / f".{TABLE}{NEW}"
    more = list(dict.fromkeys(name for record in status.records for name in record.more))
    write_table(
        new, _rows(folder, status, analysis, curves, progress, each), more,
        {"driftlab": __version__, "SI": status.bias_unit},
    )  # fmt: skip
    os.replace(new, path / TABLE)
    progress(Stage("report"))
    new = path / f".{REPORT}{NEW}"
    title = f"Fleet {folder.out.name or path.name}"
    write_fleet_report(new, _overview(title, status, tracked_unit(config.filter), analysis, pages, curves))
    os.replace(new, path / REPORT)


def _rows(
    folder: FleetFolder,
    status: FleetStatus,
    analysis: FamilyAnalysis,
    curves: list[Array],
    progress: FleetProgress,
    each: ParallelMap,
) -> Iterator[Row]:
    """Yield the rows of the table, and add each unit's curve to `curves`."""
    stage = Stage("tables and maps", total=len(status.records))
    progress(stage)
    family, reasons = analysis.family, analysis.reasons
    of_units = iter(()) if family is None else posteriors(folder.path, status.done, family, analysis.common, each)
    for record in status.records:
        posterior = next(of_units, None) if record.state == "done" else None
        if posterior is not None:
            curves.append(posterior.curve)
        yield from rows_of(record, posterior, None if posterior is None else reasons.get(record.unit, ()))
        stage.done += 1
        progress(stage)


def _overview(
    title: str,
    status: FleetStatus,
    unit: BiasUnit,
    analysis: FamilyAnalysis,
    pages: Collection[str],
    curves: Sequence[Array],
) -> FleetOverview:
    family, axes = analysis.family, analysis.line.axes
    T = np.zeros(0) if family is None else temperatures(family)
    return FleetOverview(
        title=title,
        records=status.records,
        unit=unit,
        line=analysis.line,
        T=T,
        curves=np.stack(curves) if curves else np.zeros((0, len(axes), len(T)), dtype=np.float32),
        drawn=[record.unit for record in status.done] if curves else [],
        mean=None if family is None else (family.knots.values(T) @ family.mu.T).T,
        odd=analysis.odd,
        effects=[_effect_row(effect, unit, axes) for effect in analysis.common.effects],
        links={name: f"{UNITS}/{name}/page/report.html" for name in pages},
        remarks=analysis.lines,
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
