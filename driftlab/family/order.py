"""The units of a line in the order in which they were made, and their quantities as arrays.

By date, several of one day as the manifest has them. n units, d axes.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime

import numpy as np

from driftlab.family.record import FIGURES, UnitRecord
from fusion_core.chunk import Array


@dataclass(frozen=True, eq=False)
class Order:
    """Units in order.

    Attributes
    ----------
    units, lots, dates : tuple of str
    said : str
        What the order stands on.
    axes : tuple of str
    bias_unit : str
        SI.
    values, sigmas : dict of str to (n, d) array
        By quantity; not a number where it is not known.
    """

    units: tuple[str, ...]
    lots: tuple[str, ...]
    dates: tuple[str, ...]
    said: str
    axes: tuple[str, ...]
    bias_unit: str
    values: dict[str, Array]
    sigmas: dict[str, Array]


def ordered(records: Iterable[UnitRecord], levels: Mapping[str, Array]) -> Order:
    """Return the units that are done, in order; `levels` (d,) by unit become the quantity `level`."""
    units: list[str] = []
    lots: list[str] = []
    dates: list[str] = []
    kept: list[tuple[list[float], list[float]]] = []
    axes: tuple[str, ...] = ()
    unit = ""
    for record in records:
        if record.state != "done":
            continue
        axes, unit = axes or record.axes, unit or record.bias_unit
        units.append(record.unit)
        lots.append(record.lot)
        dates.append(record.date)
        kept.append(_figures(record, len(axes)))
    place, said = _places(dates)
    n, d = len(units), len(axes)
    shape = (n, len(FIGURES), d)
    values = np.array([own for own, _ in kept], dtype=np.float64).reshape(shape)[place]
    sigmas = np.array([own for _, own in kept], dtype=np.float64).reshape(shape)[place]
    names = [units[k] for k in place]
    level = np.array([levels.get(name, np.full(d, np.nan)) for name in names], dtype=np.float64).reshape(n, d)
    return Order(
        units=tuple(names),
        lots=tuple(lots[k] for k in place),
        dates=tuple(dates[k] for k in place),
        said=said,
        axes=axes,
        bias_unit=unit,
        values={**{name: values[:, k] for k, name in enumerate(FIGURES)}, "level": level},
        sigmas={**{name: sigmas[:, k] for k, name in enumerate(FIGURES)}, "level": np.full((n, d), np.nan)},
    )


def _figures(record: UnitRecord, d: int) -> tuple[list[float], list[float]]:
    values: list[float] = []
    sigmas: list[float] = []
    for name in FIGURES:
        figure = record.figures.get(name)
        for kept, own in ((values, figure and figure.value), (sigmas, figure and figure.sigma)):
            numbers = [np.nan if v is None or not np.isfinite(v) else float(v) for v in own or ()]
            kept += (numbers + [np.nan] * d)[:d]
    return values, sigmas


def _places(dates: list[str]) -> tuple[list[int], str]:
    """Return the places of units in their order, and what it stands on."""
    when = [_time(date) for date in dates]
    known = sum(time is not None for time in when)
    if known == 0:
        return list(range(len(dates))), "in the order of the manifest, which has no dates"
    last, sorting = min(time for time in when if time is not None), []
    for k, time in enumerate(when):
        last = last if time is None else time
        sorting.append((last, k))
    said = "in the order of their dates"
    if known < len(dates):
        said += f"; {len(dates) - known} without a date follow the unit that is before them in the manifest"
    return [k for _, k in sorted(sorting)], said


def _time(date: str) -> float | None:
    try:
        found = datetime.fromisoformat(date)
    except ValueError:
        return None
    return (found if found.tzinfo else found.replace(tzinfo=UTC)).timestamp()
