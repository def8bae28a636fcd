"""The result of a command: arrays by name, with units, as tables, figures and files."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import nullcontext
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np
from numpy.typing import NDArray

from driftlab.evaluation.limits import EXIT, outcome
from driftlab.reports.charts import Chart
from driftlab.reports.figures import figure_of
from driftlab.storage.folders import output_folder

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

Units = Mapping[str, str | tuple[str, ...]]


R = TypeVar("R", bound="Result")


class Result(Mapping[str, NDArray[Any]]):
    """Arrays by name, time along the first axis: `result["bias"]`, or `result.bias`.

    Attributes
    ----------
    name : str
        What it is the result of.
    units : mapping of str to str, or to one str a column
        Unit of each array.
    labels : mapping of str to tuple of str
        What the columns of each (N, d) array are called.
    summary : dict
        What a program may want to know, in SI; the content of the command's JSON.
    limits_verdict : str
        Whether the limits of the config are kept, in one line; empty where there are none.
    command : str
        Whose folder of files it is.
    """

    name: str
    units: Units = {}  # noqa: RUF012 - read alone
    labels: Mapping[str, tuple[str, ...]] = {}
    summary: dict[str, Any]
    limits_verdict: str = ""
    command: ClassVar[str] = ""
    _columns: Mapping[str, Any]
    _read: Collection[Path] = ()  # files that it was made from: none of them may be in the folder that it is saved to

    def plot(self) -> Figure:
        """Draw the chart of the result, with units on every axis."""
        return figure_of(self._chart())

    def _chart(self) -> Chart:
        raise NotImplementedError

    def save(self, out: str | PathLike[str]) -> None:
        """Write the files of the command into the folder `out`, under its rules; raises ConfigError or Unwritable."""
        with output_folder(Path(out), self.command, self._read) as folder:
            self._write(folder)

    def _write(self, folder: Path) -> None:
        """Write the files into a folder that is there."""
        raise NotImplementedError

    @property
    def exit_status(self) -> int:
        """Exit status of the command where limits are enforced."""
        return EXIT[outcome(self.limits_verdict)]

    def lines(self) -> list[str]:
        """Return the notes on it, a sentence each."""
        return []

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            values: NDArray[Any] = self._columns[name]
            return values
        except KeyError:
            raise KeyError(f"{name}; there are {', '.join(self._columns)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name.startswith("_") or name not in self._columns:
            raise AttributeError(f"{type(self).__name__} has no '{name}'; its arrays are {', '.join(self)}")
        return self[name]

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self})

    def to_polars(self) -> pl.DataFrame:
        """Return the arrays as a table; each column says its unit: `t [s]`, `bias_x [rad/s]`.

        Where arrays differ in length, as the set points of a plan and its sigma over temperature, those stand in it
        that are as long as the last.
        """
        import polars as pl

        columns: dict[str, NDArray[Any]] = {}
        arrays = dict(self._columns)
        N = len(next(reversed(arrays.values()), ()))
        for name, values in ((name, values) for name, values in arrays.items() if len(values) == N):
            d = 1 if values.ndim == 1 else values.shape[1]
            unit = self.units.get(name)
            units = unit if isinstance(unit, tuple) else (unit,) * d
            labels = self.labels.get(name) or tuple(str(k) for k in range(d))
            names = [name] if values.ndim == 1 else [f"{name}_{label}" for label in labels]
            titles = [f"{title} [{unit}]" if unit else title for title, unit in zip(names, units, strict=True)]
            columns |= dict(zip(titles, np.atleast_2d(values.T), strict=True))
        return pl.DataFrame({name: np.ascontiguousarray(values) for name, values in columns.items()})

    def _repr_html_(self) -> str:
        drawing = io.BytesIO()
        self.plot().savefig(drawing, format="png", dpi=80)
        picture = f'<img src="data:image/png;base64,{base64.b64encode(drawing.getvalue()).decode()}"/>'
        notes = "".join(f"<li>{html.escape(line)}</li>" for line in self.lines())
        arrays = "".join(f"<li>{html.escape(line)}</li>" for line in self._arrays())
        return (
            f"<h4>{html.escape(self.name)}</h4><ul>{notes}</ul>{picture}"
            f"<details><summary>{len(self)} arrays</summary><ul>{arrays}</ul></details>"
        )

    def __repr__(self) -> str:
        notes = [f"note: {line}" for line in self.lines()]
        return "\n  ".join([f"{type(self).__name__}: {self.name}", *self._arrays(), *notes])

    def _arrays(self) -> list[str]:
        """Return the name of each array, with its columns and its unit."""
        texts = []
        for name in self:
            unit, labels = self.units.get(name), self.labels.get(name)
            text = unit if isinstance(unit, str) or unit is None else ", ".join(unit)
            texts.append(name + (f" ({', '.join(labels)})" if labels else "") + (f" [{text}]" if text else ""))
        return texts

    # two results are the same where they are one: arrays have no truth value
    __eq__ = object.__eq__
    __hash__ = object.__hash__


def in_folder(out: str | PathLike[str] | None, command: str, read: Collection[Path], make: Callable[[], R]) -> R:
    """Make a result; with `out`, write its files into that folder, which is looked at before anything is computed."""
    with nullcontext() if out is None else output_folder(Path(out), command, read) as folder:
        result = make()
        result._read = read
        if folder is not None:
            result._write(folder)
    return result
