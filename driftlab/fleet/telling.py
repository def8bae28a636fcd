"""The files of a fleet as a whole: a row a unit and axis, the units' maps with the family, and the report."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from driftlab import __version__
from driftlab.family.law import Family
from driftlab.fleet.doing import Count
from driftlab.fleet.folder import NEW, FleetFolder
from driftlab.fleet.kept import UNITS, record_of, soaked_of
from driftlab.fleet.learning import Learned
from driftlab.fleet.manifest import Entry, Manifest
from driftlab.fleet.progress import Progress, Stage
from driftlab.fleet.table import OfTheFamily, Table

TABLE = "units.parquet"


def written(folder: Path) -> bool:
    """Whether all that is written of a fleet as a whole is there."""
    return (folder / TABLE).is_file()


def write_table(manifest: Manifest, folder: FleetFolder, found: Count, learned: Learned, progress: Progress) -> None:
    """Write `units.parquet`; it is there whole or not at all."""
    stage = Stage("tables", total=len(manifest.units))
    progress(stage)
    table = Table(folder.path / f".rows{NEW}", manifest.columns())
    try:
        for entry in manifest.units:
            record = record_of(folder.unit(entry.unit))
            if record is None:
                raise RuntimeError(f"unit {entry.unit} has no record any more")
            with_family = learned.family if record.state == "done" else None
            said = None if with_family is None else _of_the_family(folder, entry, with_family, learned)
            table.add(entry, record, said)
            stage.done += 1
            progress(stage)
        new = folder.path / f".{TABLE}{NEW}"
        table.write(new, {"driftlab": __version__, "SI": found.bias_unit})
        os.replace(new, folder.path / TABLE)
    finally:
        table.close()


def _of_the_family(folder: FleetFolder, entry: Entry, family: Family, learned: Learned) -> OfTheFamily:
    """Return what the family says of a unit."""
    soaked = soaked_of(folder.path / UNITS / entry.unit)
    posterior = family.posterior(soaked, entry.lot)
    B = family.knots.values(np.linspace(*family.knots.domain, 4 * family.knots.intervals + 1))
    variance = np.einsum("gi,dij,gj->d", B, posterior.covariance, B) / len(B)
    return OfTheFamily(
        family.knots.peaks,
        posterior.c,
        np.sqrt(np.diagonal(posterior.covariance, axis1=1, axis2=2)),
        np.sqrt(variance),
        odd=tuple(learned.odd.get(entry.unit, ())),
    )
