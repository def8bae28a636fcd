"""The line of the example: a family with odd units, a lot that is shifted and a hysteresis that no unit shows alone.

What is planted is known here and nowhere else: driftlab is given recordings and a manifest.
"""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import family
import numpy as np
from family import Unit

PLAY = 0.1  # deg/h a K: as sure as one soak is of it (1 sigma an axis); alone, a unit shows three times as much
SHIFT = 250.0  # deg/h on x, of one lot
LOTS = 10
PART = 0.4  # of the range, that new units are soaked over
FRESH = "L10"  # lot of the new units
LATER = "L11"  # lot of the second half of a later day, with SHIFT
TREND = 0.02  # by which the noise of y grows, a unit of that day


@dataclass(frozen=True)
class Line:
    """A line with planted faults.

    Attributes
    ----------
    units, fresh, later : list of Unit
        The family, new units of it, and those of a later day, on which the line has moved.
    shifted : str
        The lot that is.
    hours, short : float
        Of a whole soak, and of one over PART of the range at the same rate.
    folder : Path
        Where recordings and manifests are.
    """

    units: list[Unit]
    fresh: list[Unit]
    later: list[Unit]
    shifted: str
    hours: float
    short: float
    folder: Path

    @property
    def odd(self) -> dict[str, str]:
        """Planted faults, by unit."""
        return {unit.name: unit.odd for unit in self.units if unit.odd}


def make(
    folder: Path, count: int = 200, hours: float = 2.0, dt: float = 1.0, fresh: int = 12, seed: int = 7, later: int = 40
) -> Line:
    """Make the line's recordings and manifests in a folder: `family.csv`, `new.csv`, `whole.csv` and `later.csv`.

    `seed` deals it; the new units are soaked short and, to compare with, whole.
    """
    late = f"L{7 * LOTS // 10:02d}"
    units = family.plant(family.shifted(family.deal(count, seed, lots=LOTS, play=PLAY), late, SHIFT), seed=seed)
    new = [
        replace(unit, name=f"N{k:02d}", lot=FRESH, date=str(np.datetime64(units[-1].date) + np.timedelta64(k + 1, "D")))
        for k, unit in enumerate(family.deal(fresh, seed + 1000, play=PLAY))
    ]
    day = later_day(later, seed, np.datetime64(new[-1].date) + np.timedelta64(7, "D"))
    line = Line(units, new, day, late, hours, PART * hours, folder)
    for unit in units:
        family.write(folder / "soaks" / f"{unit.name}.h5", family.soak(unit, hours, dt=dt, seed=seed))
    for unit in new:
        family.write(folder / "whole" / f"{unit.name}.h5", family.soak(unit, hours, dt=dt, seed=seed + 1))
        short = family.soak(unit, line.short, part=PART, dt=dt, seed=seed)
        family.write(folder / "short" / f"{unit.name}.h5", short)
    for unit in day:
        family.write(folder / "later" / f"{unit.name}.h5", family.soak(unit, hours, dt=dt, seed=seed + 2))
    write_manifest(folder / "later.csv", day, "later")
    write_manifest(folder / "family.csv", units, "soaks")
    write_manifest(folder / "new.csv", new, "short")
    write_manifest(folder / "whole.csv", new, "whole")
    return line


def later_day(count: int, seed: int, date: np.datetime64) -> list[Unit]:
    """Return the units of a later day: the second half is of a shifted lot, noise has a trend, three units are odd."""
    dealt = family.deal(count, seed + 2000, play=PLAY)
    units = [
        replace(
            unit, name=f"D{k:02d}", lot=FRESH if 2 * k < count else LATER, date=str(date),
            noise=unit.noise * np.array([1.0, 1.0 + TREND * k, 1.0]),
        )
        for k, unit in enumerate(dealt)
    ]  # fmt: skip
    return family.plant(family.shifted(units, LATER, SHIFT), 3 / count, seed)


def write_manifest(path: Path, units: Sequence[Unit], where: str) -> None:
    """Write a row a soak: unit, role, path, lot, date, and the chamber that it was in."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["unit", "role", "path", "lot", "date", "chamber"])
        rows.writerows(_rows(units, where))


def _rows(units: Sequence[Unit], where: str) -> Iterator[list[str]]:
    for k, unit in enumerate(units):
        yield [unit.name, "calibration", f"{where}/{unit.name}.h5", unit.lot, unit.date, f"K{k % 4 + 1}"]
