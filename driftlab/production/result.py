"""The result of `driftlab.fleet`: the fleet's table as arrays, and its summary."""

from __future__ import annotations

import shutil
from functools import cached_property
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from driftlab.commands.result import Result
from driftlab.family.record import FIGURES, UnitRecord
from driftlab.production.fleet_folder import FAMILY, REPORT, TABLE
from driftlab.production.tables import COLUMNS
from driftlab.production.unit_folders import UnitFolders, UnitPlace
from driftlab.production.unit_store import UnitStore
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    import polars as pl
    from matplotlib.figure import Figure

OF_A_UNIT = ("unit", "lot", "date", "T_low", "T_high", "hours", "samples", "odd")
OF_AN_AXIS = tuple(name for name, c in COLUMNS.items() if c.type == "number" and name not in (*OF_A_UNIT, "seconds"))


class FleetResult(Result):
    """A fleet: of the units that are done `unit`, `lot`, `date`, `odd` (U,), and their figures (U, d), as `noise`.

    Attributes
    ----------
    path : Path
        The fleet's folder.
    failed : dict of str to str
        Of each unit that failed, why.
    """

    def __init__(self, out: Path, summary: dict[str, Any]) -> None:
        self.path, self.summary = out, summary
        self.name = f"fleet of {summary['counts']['units']} units"

    @cached_property
    def _done(self) -> pl.DataFrame:
        """The rows of the units that are done, read when an array is asked for."""
        import polars as pl

        names = [*OF_A_UNIT, *OF_AN_AXIS, "axis", "bias_unit"]
        return pl.read_parquet(self.path / TABLE, columns=[*names, "state"]).filter(state="done").drop("state")

    @cached_property
    def _axes(self) -> tuple[str, ...]:
        return tuple(self._done["axis"].unique(maintain_order=True).to_list())

    @cached_property
    def _columns(self) -> dict[str, NDArray[Any]]:  # type: ignore[override]
        d, table = len(self._axes), self._done
        columns = {name: table[name].gather_every(d).to_numpy() for name in OF_A_UNIT}
        columns["odd"] = table["odd"].fill_null(False).gather_every(d).to_numpy()
        for name in OF_AN_AXIS:
            if table[name].count():
                columns[name] = table[name].fill_null(np.nan).to_numpy().reshape(-1, d)
        return columns

    @property
    def units(self) -> dict[str, str]:  # type: ignore[override]
        """Unit of each array."""
        si = str(self._done["bias_unit"][0])
        return {name: COLUMNS[name].unit.replace("SI", si) for name in self if COLUMNS[name].unit}

    @property
    def labels(self) -> dict[str, tuple[str, ...]]:  # type: ignore[override]
        """Names of the columns of each (U, d) array: the axes."""
        return dict.fromkeys((name for name in self if name in OF_AN_AXIS), self._axes)

    @cached_property
    def _folders(self) -> UnitFolders:
        url = self.summary.get("store")
        return UnitPlace(self.path, b"") if url is None else UnitStore(url, str(self.summary["id"]))

    @property
    def written(self) -> list[str]:
        """The files in the fleet's folder, in words."""
        names = [name for name in (TABLE, FAMILY, REPORT) if (self.path / name).is_file()]
        pages = len(self.summary["pages"])
        made, root = len(self._folders.names("certificate.html")), self._folders.root
        more = [f"pages of {pages:,} in {root}/NAME/page/"] * bool(pages) + [f"{made:,} certificates"] * bool(made)
        return [*names, f"{root}/", *more]

    @property
    def exit_status(self) -> int:
        """Exit status where limits are enforced: 1 where a unit fails one, 3 where one is not known to pass all."""
        limits = self.summary["limits"]
        return 1 if limits.get("fail") else 3 * (limits.get("pass", 0) < self.summary["counts"]["units"])

    @property
    def failed(self) -> dict[str, str]:
        """The reason of each unit that failed."""
        rows = self.to_polars().filter(state="failed").select("unit", "error")
        return {str(unit): str(error) for unit, error in rows.iter_rows()}

    def record(self, unit: str) -> UnitRecord:
        """Return the record of a unit; raises ConfigError where there is none of that name."""
        record = self._folders.record(unit)
        if record is None:
            raise ConfigError(f"unit {unit}: is not in {self.path}; `unit` names those that are")
        return record

    def to_polars(self) -> pl.DataFrame:
        """Return `units.parquet`: a row a unit and axis, in SI."""
        import polars as pl

        return pl.read_parquet(self.path / TABLE)

    def lines(self) -> list[str]:
        """Return the summary of the fleet in sentences."""
        return list(self.summary["lines"])

    def plot(self) -> Figure:
        """Draw noise, walk, swing, residual and error of prediction of every unit, in the order of the manifest."""
        from matplotlib.figure import Figure

        drawn = [name for name in FIGURES if name in self]
        figure = Figure(figsize=(8, 1.8 * len(drawn)), layout="constrained")
        axes = figure.subplots(len(drawn), sharex=True, squeeze=False)[:, 0]
        odd = self["odd"]
        for one, name in zip(axes, drawn, strict=True):
            one.plot(self[name], ".", markersize=3, label=self.labels[name])
            one.plot(
                np.flatnonzero(odd), self[name][odd].max(axis=1), "o", color="black", fillstyle="none", label="odd"
            )
            one.set_ylabel(f"{name} [{self.units[name]}]")
        axes[0].legend(loc="upper right", ncols=4, fontsize="small")
        axes[-1].set_xlabel("unit, in the order of the manifest")
        return figure

    def save(self, out: str | PathLike[str]) -> None:
        """Copy the fleet's folder to `out`, which must not be there; raises ConfigError."""
        if Path(out).exists():
            raise ConfigError(f"out {out}: exists; name a folder that does not")
        shutil.copytree(self.path, out)
