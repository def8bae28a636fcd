"""What a function of the Python API gives: arrays by name, with units, as tables, figures and files."""

from __future__ import annotations

import base64
import html
import io
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from os import PathLike
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

Units = Mapping[str, str | tuple[str, ...]]


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
    """

    name: str
    units: Units
    labels: Mapping[str, tuple[str, ...]]
    summary: dict[str, Any]
    _columns: Mapping[str, NDArray[Any]]

    @abstractmethod
    def plot(self) -> Figure:
        """Draw what there is to see, with units on every axis."""

    @abstractmethod
    def save(self, out: str | PathLike[str]) -> None:
        """Write what the command writes, under the same rules; raises ConfigError or Unwritable."""

    def lines(self) -> list[str]:
        """Return what one should know of it, a sentence each."""
        return []

    def __getitem__(self, name: str) -> NDArray[Any]:
        try:
            return self._columns[name]
        except KeyError:
            raise KeyError(f"{name}; there are {', '.join(self._columns)}") from None

    def __iter__(self) -> Iterator[str]:
        return iter(self._columns)

    def __len__(self) -> int:
        return len(self._columns)

    def __getattr__(self, name: str) -> NDArray[Any]:
        if name.startswith("_") or name not in self._columns:
            raise AttributeError(f"{type(self).__name__} has no '{name}'; its arrays are {', '.join(self)}")
        return self._columns[name]

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *self})

    def to_polars(self) -> pl.DataFrame:
        """Return the arrays as a table; each column says its unit: `t [s]`, `bias_x [rad/s]`.

        Where arrays differ in length, as the set points of a plan and its sigma over temperature, those stand in it
        that are as long as the last.
        """
        import polars as pl

        found: dict[str, NDArray[Any]] = {}
        arrays = dict(self._columns)
        N = len(next(reversed(arrays.values()), ()))
        for name, values in ((name, values) for name, values in arrays.items() if len(values) == N):
            d = 1 if values.ndim == 1 else values.shape[1]
            unit = self.units.get(name)
            units = unit if isinstance(unit, tuple) else (unit,) * d
            labels = self.labels.get(name) or tuple(str(k) for k in range(d))
            names = [name] if values.ndim == 1 else [f"{name}_{label}" for label in labels]
            found |= dict(zip(map(_column, names, units), np.atleast_2d(values.T), strict=True))
        return pl.DataFrame({name: np.ascontiguousarray(values) for name, values in found.items()})

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{html.escape(line)}</li>" for line in self.lines())
        arrays = "".join(f"<li>{html.escape(line)}</li>" for line in self._arrays())
        return (
            f"<h4>{html.escape(self.name)}</h4><ul>{notes}</ul>{picture(self.plot())}"
            f"<details><summary>{len(self)} arrays</summary><ul>{arrays}</ul></details>"
        )

    def __repr__(self) -> str:
        notes = [f"note: {line}" for line in self.lines()]
        return "\n  ".join([f"{type(self).__name__}: {self.name}", *self._arrays(), *notes])

    def _arrays(self) -> list[str]:
        """Return what each array is called, its columns and its unit."""
        found = []
        for name in self:
            unit, labels = self.units.get(name), self.labels.get(name)
            shown = unit if isinstance(unit, str) or unit is None else ", ".join(unit)
            found.append(name + (f" ({', '.join(labels)})" if labels else "") + (f" [{shown}]" if shown else ""))
        return found

    # two results are the same where they are one: arrays have no truth value
    __eq__ = object.__eq__
    __hash__ = object.__hash__


def _column(name: str, unit: str | None) -> str:
    return f"{name} [{unit}]" if unit else name


def picture(figure: Figure) -> str:
    """Return a figure as an element of a page."""
    drawing = io.BytesIO()
    figure.savefig(drawing, format="png", dpi=80)
    return f'<img src="data:image/png;base64,{base64.b64encode(drawing.getvalue()).decode()}"/>'
