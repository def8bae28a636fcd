"""How short a soak may be where the unit's family is known: `driftlab plan --family`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.config import Config
from driftlab.family.file import load_family
from driftlab.planning.request import Range, parse_request
from driftlab.planning.short_soak import ShortSoakPlan, shortened
from driftlab.reports import plan_short_soak
from driftlab.reports.plan import write_profile
from driftlab.results import Result
from driftlab.storage.folders import FILES, output_folder
from driftlab.storage.json import plain, write_json
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table


class PlanFamilyResult(Result):
    """A plan: `time` and `set_point` (M,) of the chosen soak, `temperature` (G,), and of its map `sigma` (G, d).

    `without_family` (G, d) is the error that the best map without the family has after the same soak.

    Attributes
    ----------
    found : Shortened
        Every part and length that was judged.
    headline : str
        What to soak, and what comes of it.
    """

    def __init__(self, found: ShortSoakPlan, unit: BiasUnit, noise_of: str, read: Collection[Path]) -> None:
        self.found, self.unit, self._noise_of, self._read = found, unit, noise_of, read
        best, law = found.chosen, found.family
        self.name = f"plan of a short soak for the {law.channel}"
        self.headline = plan_short_soak.headline(found, unit)
        self._columns = {
            "time": best.profile.time, "set_point": best.profile.temperature, "temperature": best.temperature,
            "sigma": best.sigma, "without_family": best.own,
        }  # fmt: skip
        self.units = {"time": "s", "set_point": "degC", "temperature": "degC"} | dict.fromkeys(
            ("sigma", "without_family"), unit.si
        )
        self.labels = {"sigma": law.axes, "without_family": law.axes}
        self.summary: dict[str, Any] = plain(plan_short_soak.document(found, unit, self.lines()))

    def lines(self) -> list[str]:
        """Return what the family is worth, and on what the plan stands, a sentence each."""
        return plan_short_soak.lines(self.found, self.unit, self._noise_of)

    def table(self) -> Table:
        """Return sigma by share of the range and length for a terminal."""
        return plan_short_soak.table(self.found, self.unit)

    def plot(self) -> Figure:
        """Draw sigma over the length of the soak."""
        from driftlab.reports.figures import figure_of

        return figure_of(plan_short_soak.hours_chart(self.found, self.unit))

    def save(self, out: str | PathLike[str]) -> None:
        """Write `plan.json`, `setpoints.csv` and `report.html` into the folder `out`."""
        with output_folder(Path(out), "plan", self._read) as folder:
            self.write(folder)

    def write(self, folder: Path) -> None:
        """Write the files into a folder that is there."""
        mark, setpoints, report = (folder / name for name in FILES["plan"])
        write_profile(setpoints, self.found.chosen.profile)
        title = self.name[0].upper() + self.name[1:]
        plan_short_soak.write_report(report, self.found, self.unit, self.lines(), title)
        write_json(mark, self.summary)


def plan_with_family(
    config: Config,
    family: Path,
    hours: float = 8.0,
    *,
    range: Range = None,
    out: Path | None = None,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
    **given: str | None,
) -> PlanFamilyResult:
    """Say how short a soak of at most `hours` may be, of which part of the range, for a unit of a family.

    Parameters are those of `plan`; the range is by default the family's, noise and walk are those of its units.

    Raises
    ------
    ConfigError, MapError
        If what is asked cannot be meant, or the family is of another sensor.
    """
    if config.filter is None:
        raise ConfigError("filter: is missing, so it is not known whose bias the family is to tell; write one")
    tracked = config.filter.tracked
    law = load_family(family, channel=tracked.channel, bias_unit=tracked.unit, axes=tuple(tracked.axes))
    used = [*read, family, *config.files()]

    def result() -> PlanFamilyResult:
        request = parse_request(config, hours, range=range or law.knots.domain, **given)
        noise, walk, whose = np.asarray(request.subject.noise), np.asarray(request.subject.walk), "as the config says"
        if law.bands is not None:
            typical, whose = law.bands.noise, f"the median of {law.units} units"
            noise = np.array(typical.white)
            walk = walk if given.get("walk") else np.array(typical.walk)
        if progress is not None:
            progress("parts of the range")
        found = shortened(law, request.chamber, hours, noise, walk, request.target)
        return PlanFamilyResult(found, tracked_unit(config.filter), whose, used)

    if out is None:
        return result()
    with output_folder(out, "plan", used) as folder:
        found = result()
        found.write(folder)
    return found
