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
from driftlab.family.record import UnitRecord
from driftlab.family.shared_effect import SharedEffect
from driftlab.family.shared_effects import of_effect
from driftlab.identification.result import described
from driftlab.production.family import FamilyAnalysis
from driftlab.production.manifest import Manifest
from driftlab.production.store import NEW, UNITS, FleetFolder, record_of
from driftlab.production.summary import FleetProgress, Stage
from driftlab.production.tables import OfTheFamily, UnitTable, posteriors, temperatures
from driftlab.production.units_pass import FleetStatus
from driftlab.reports.fleet import FleetOverview, write_fleet_report
from driftlab.reports.fleet import SharedEffectRow as Shown
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.chunk import Array

TABLE, FAMILY, REPORT = "units.parquet", "family.json", "report.html"


def written(folder: Path, *, family: bool) -> bool:
    """Whether all that is written of a fleet as a whole is there."""
    return all((folder / name).is_file() for name in (TABLE, REPORT, *([FAMILY] if family else ())))


class FleetReport:
    """What is written of a fleet as a whole, when it is known."""

    def __init__(self, manifest: Manifest, folder: FleetFolder, found: FleetStatus, config: Config) -> None:
        self.manifest, self.folder, self.found, self.config = manifest, folder, found, config
        self.curves: list[Array] = []

    def write(
        self, learned: FamilyAnalysis, pages: Collection[str], progress: FleetProgress, each: ParallelMap = serial
    ) -> None:
        """Write all files, of which each is there whole or not at all; `each` goes through the units."""
        path = self.folder.path
        if learned.family is not None:
            kind = next((settings.kind for settings in self.config.tracked_maps()), "")
            common = learned.common.as_json() if learned.common.effects else None
            save_family(
                path / FAMILY, learned.family, map_kind=kind, config=self.config.as_yaml(), common_effects=common,
                odd_lots=[lot.sentence for lot in learned.lots],
            )  # fmt: skip
        else:
            (path / FAMILY).unlink(missing_ok=True)  # of other units
        self._table(learned, progress, each)
        progress(Stage("report"))
        new = path / f".{REPORT}{NEW}"
        write_fleet_report(new, self._overview(learned, pages))
        os.replace(new, path / REPORT)

    def records(self) -> Iterator[UnitRecord]:
        """Yield the record of every unit, also of those that failed."""
        for entry in self.manifest.units:
            record = record_of(self.folder.unit(entry.unit))
            if record is None:
                raise RuntimeError(f"unit {entry.unit} has no record any more")
            yield record

    def _table(self, learned: FamilyAnalysis, progress: FleetProgress, each: ParallelMap) -> None:
        stage = Stage("tables and maps", total=len(self.manifest.units))
        progress(stage)
        path, table = self.folder.path, UnitTable(self.folder.path / f".rows{NEW}", self.manifest.columns())
        told: Iterator[OfTheFamily] = iter(())
        reasons = learned.reasons
        if learned.family is not None:
            told = posteriors(path, self.found.done, learned.family, learned.common, each)
        try:
            for entry, record in zip(self.manifest.units, self.records(), strict=True):
                of_family = next(told, None) if record.state == "done" else None
                odd = reasons.get(entry.unit, ()) if of_family is not None else None
                if of_family is not None:
                    self.curves.append(of_family.curve)
                table.add(entry, record, of_family, odd)
                stage.done += 1
                progress(stage)
            new = path / f".{TABLE}{NEW}"
            table.write(new, {"driftlab": __version__, "SI": self.found.bias_unit})
            os.replace(new, path / TABLE)
        finally:
            table.close()

    def _overview(self, learned: FamilyAnalysis, pages: Collection[str]) -> FleetOverview:
        unit, family = tracked_unit(self.config.filter), learned.family
        T = np.zeros(0) if family is None else temperatures(family)
        d = len(learned.line.axes)
        return FleetOverview(
            title=f"Fleet {self.folder.out.name or self.folder.path.name}",
            records=self.records(),
            unit=unit,
            line=learned.line,
            T=T,
            curves=np.stack(self.curves) if self.curves else np.zeros((0, d, len(T)), dtype=np.float32),
            drawn=[name for name, _ in self.found.done] if self.curves else [],
            mean=None if family is None else (family.knots.values(T) @ family.mu.T).T,
            odd=learned.odd,
            effects=[_shown(effect, unit, learned.line.axes) for effect in learned.common.effects],
            links={name: f"{UNITS}/{name}/page/report.html" for name in pages},
            remarks=learned.lines,
        )


def _shown(found: SharedEffect, unit: BiasUnit, axes: Sequence[str]) -> Shown:
    """Return an effect as the report shows it, with its mean first coefficient in each lot."""
    per = found.unit.removeprefix(unit.si)
    lots = [
        (lot.lot, lot.units, axis, float(mean[0]) * unit.factor, float(sigma[0]) * unit.factor)
        for lot in found.lots
        for axis, mean, sigma in zip(axes, lot.mean, lot.sigma, strict=True)
    ]
    return Shown(
        described(found.effect),
        " ".join([*of_effect(found, unit, axes), found.effect.explanation]),
        f"{unit.shown}{per}",
        tuple(lots),
    )
