"""A map as a table in a CSV file: temperature, bias and its deviation, in rows a fixed step apart.

A reader that draws straight lines between the rows is off by at most step^2 / 8 times the largest second derivative;
what it really is off by is measured between the rows as they are written.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts import Exporter, FittedMap, Loss
from fusion_core.hookspecs import hookimpl
from fusion_core.units import Quantity, Unit

DIGITS = ".9g"
BETWEEN = 10  # places a step at which the loss is measured


class CsvTable(Exporter):
    """A table of temperature, bias and deviation."""

    suffix: ClassVar[str] = ".csv"

    kind: Literal["csv_table"] = "csv_table"
    step: Annotated[float, Unit("delta_degC", positive=True, example="0.5 K")] = Quantity(0.5, "0.5 K")
    """Temperature from one row to the next."""

    def export(self, fitted: FittedMap, path: Path) -> Loss:
        """Write a row each `step` of the map's domain, ends included."""
        low, high = fitted.domain
        count = max(int(np.ceil((high - low) / self.step - 1e-9)), 1)
        T = np.linspace(low, high, count + 1)
        bias, sigma = fitted.bias(T), fitted.sigma(T)
        axes = [str(axis) for axis in range(bias.shape[1])] if bias.shape[1] != 3 else ["x", "y", "z"]
        names = ["temperature", *(f"bias_{axis}" for axis in axes), *(f"sigma_{axis}" for axis in axes)]
        rows = [[format(value, DIGITS) for value in row] for row in np.column_stack([T, bias, sigma])]
        written = np.array(rows, dtype=np.float64)
        largest = self._largest(fitted, written[:, 0], written[:, 1 : 1 + len(axes)])
        said = ", ".join(f"{value:.3g}" for value in largest)
        record = fitted.record
        head = [
            f"# {record.kind} of the {record.channel}: temperature in degC, bias and sigma in {record.unit}",
            f"# straight lines between the rows are off by at most {said} {record.unit}",
            ",".join(names),
        ]
        path.write_text("\n".join([*head, *(",".join(row) for row in rows)]) + "\n", encoding="utf-8")
        return Loss(largest, ("what is beyond the first and the last row",))

    def _largest(self, fitted: FittedMap, T: Array, bias: Array) -> Array:
        """Return the largest error (d,) of straight lines between rows T (n,), bias (n, d)."""
        between = np.linspace(*fitted.domain, (len(T) - 1) * BETWEEN + 1)
        lines = np.stack([np.interp(between, T, column) for column in bias.T], axis=1)
        return np.asarray(np.max(np.abs(lines - fitted.bias(between)), axis=0))


@hookimpl
def exporters() -> list[type[Exporter]]:
    """Register the plugin."""
    return [CsvTable]
