"""A map as a table in a CSV file: temperature, bias and its deviation, in rows a fixed step apart.

A reader that draws straight lines between the rows is off by at most step^2 / 8 times the largest second derivative;
what it really is off by is measured between the rows as they are written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from fusion_core.contracts import Export, Exporter, Loss, SensorLoss, beyond_a_map
from fusion_core.errors import ConfigError
from fusion_core.escaping import csv_cell, csv_comment
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit
from fusion_plugins.exporters.mat import between, rows_of

DIGITS = ".9g"


@hookimpl
class CsvTable(Exporter):
    """A table of temperature, bias and deviation."""

    suffix: ClassVar[str] = ".csv"

    kind: Literal["csv_table"] = "csv_table"
    step: Annotated[float, Unit("delta_degC", positive=True, example="0.5 K")] = Quantity(0.5, "0.5 K")
    """Temperature from one row to the next."""

    def export(self, what: Export, path: Path) -> Loss:
        """Write a row each `step` of the map's domain, ends included."""
        first, *others = what.mapped
        if others:
            names = ", ".join(sensor.channel for sensor in what.mapped)
            raise ConfigError(f"export {self.kind}: {names} have maps, a table holds one; give the map's file")
        fitted = first.fitted
        T = rows_of(fitted.domain, self.step)
        header = ["temperature", *(f"{name}_{axis}" for name in ("bias", "sigma") for axis in first.axes)]
        cells = np.column_stack([T, fitted.bias(T), fitted.sigma(T)])
        rows = [[format(value, DIGITS) for value in row] for row in cells]
        written = np.array(rows, dtype=np.float64)
        straight = between(written[:, 0], written[:, 1 : 1 + len(first.axes)], "linear")
        _, effects = beyond_a_map(first)
        loss = Loss((SensorLoss.measured(first, straight),), ("what is beyond the first and the last row", *effects))
        head = [
            f"{fitted.record.kind} of the {first.channel}: temperature in degC, bias and sigma in {first.unit}",
            "straight lines between the rows:",
            *loss.lines(),
        ]
        lines = [*map(csv_comment, head), ",".join(map(csv_cell, header)), *(",".join(row) for row in rows)]
        path.write_text("\n".join(lines) + "\n", encoding="utf-8")
        return loss
