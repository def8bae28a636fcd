"""The chamber profile that tells most, before anything is recorded: `driftlab plan`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.config import Config
from driftlab.identification.candidates import check_kinds
from driftlab.planning.detectability import DetectabilityReport, predict_detectability
from driftlab.planning.discrimination import DiscriminationCriterion, preferred
from driftlab.planning.request import PlanRequest, Range, parse_request
from driftlab.planning.search import SearchResult, search
from driftlab.planning.simulated_search import UnrecordedUnit, still_channels
from driftlab.reports import plan_effects
from driftlab.reports.plan import document, headline, lines, sigma_chart, table, write_profile, write_report
from driftlab.results import Result
from driftlab.storage.folders import FILES, output_folder
from driftlab.storage.json import plain, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table


class PlanResult(Result):
    """A plan: `time` and `set_point` (M,) of the chosen profile, `temperature` (G,) and `sigma` (G, d) of its map.

    Attributes
    ----------
    found : Found
        Every profile that was judged, the chosen one first, and the Pareto curve.
    outlook : Outlook
        What the chosen profile would say of effects.
    headline : str
        What to record, and what comes of it.
    """

    def __init__(self, found: SearchResult, outlook: DetectabilityReport, request: PlanRequest, config: Config) -> None:
        self.found, self.outlook, self.config, self._request = found, outlook, config, request
        best, subject = found.chosen, found.subject
        self.name = f"plan of {found.hours:g} h for the {subject.channel}"
        self.headline = headline(found)
        self._columns = {
            "time": best.profile.time, "set_point": best.profile.temperature,
            "temperature": best.temperature, "sigma": best.sigma,
        }  # fmt: skip
        self.units = {"time": "s", "set_point": "degC", "temperature": "degC", "sigma": subject.unit.si}
        self.labels = {"sigma": subject.axes}
        self.summary: dict[str, Any] = plain(
            document(found, self.lines()) | {"effects": plan_effects.document(outlook)}
        )

    def lines(self) -> list[str]:
        """Return why this profile, and on what the plan stands, a sentence each."""
        return [*lines(self.found, self._request.lag_of), *plan_effects.brief(self.outlook)]

    def table(self) -> Table:
        """Return the profiles for a terminal, the chosen one first."""
        return table(self.found)

    def plot(self) -> Figure:
        """Draw the sigma that is expected over temperature, and that of the classic staircase."""
        from driftlab.reports.figures import figure_of

        return figure_of(sigma_chart(self.found))

    def save(self, out: str | PathLike[str]) -> None:
        """Write `plan.json`, `setpoints.csv` and `report.html` into the folder `out`."""
        with output_folder(Path(out), "plan", self.config.files()) as folder:
            self._write(folder)

    def _write(self, folder: Path) -> None:
        mark, setpoints, report = (folder / name for name in FILES["plan"])
        write_profile(setpoints, self.found.chosen.profile)
        write_report(report, self.found, self.lines(), self.name[0].upper() + self.name[1:], self.outlook)
        write_json(mark, self.summary)


def plan(
    config: Config,
    hours: float = 8.0,
    *,
    range: Range = None,
    rate: str | None = None,
    lag: str | None = None,
    start: str | None = None,
    walk: str | None = None,
    sigma: str | None = None,
    kind: str | None = None,
    effects: Sequence[str] = (),
    out: Path | None = None,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
) -> PlanResult:
    """Find the chamber profile that tells most of the config's map; with `out`, write it into that folder too.

    Parameters
    ----------
    config : Config
        With a filter or a simulated unit, and a map.
    hours : float
        How long the chamber may take.
    range : str or (float, float), optional
        As `-20..50 degC`; that of the config's fitted map, or of the chamber that its source simulates.
    rate, lag, start, walk, sigma : str, optional
        As the options of the command: fastest change, time constant of the unit behind the chamber, temperature at the
        beginning, density of the unit's walk, sigma to reach.
    kind : str, optional
        Of the map, in place of the config's.
    effects : sequence of str
        Kinds of effects that are to be told apart, in place of all that are installed; the profile is then the one that
        tells them best among those whose sigma is nearly the best.
    out : Path, optional
        Folder for `plan.json`, `setpoints.csv` and `report.html`; it appears when all files are whole.
    progress : callable, optional
        Called with texts.
    read : collection of Path
        Files that are needed beside the config's: none of them may be in `out`.

    Raises
    ------
    ConfigError
        If what is asked cannot be meant, the hours are too few, or `out` must not be replaced.
    """
    given = {"rate": rate, "lag": lag, "start": start, "walk": walk, "sigma": sigma, "kind": kind}
    check_kinds(effects, "--effects")
    request = parse_request(config, hours, range=range, **given)
    if out is None:
        return _planned(config, hours, request, effects, progress)
    with output_folder(out, "plan", [*read, *config.files()]) as folder:
        result = _planned(config, hours, request, effects, progress)
        result._write(folder)
    return result


def _planned(
    config: Config, hours: float, request: PlanRequest, effects: Sequence[str], progress: Callable[..., None] | None
) -> PlanResult:
    chamber = request.chamber
    found = search(request.subject, chamber, hours, request.target, progress)
    unit = UnrecordedUnit.of(request.subject, chamber.low, chamber.high, config.filter)
    if effects:
        found = preferred(found, DiscriminationCriterion(unit, chamber, hours, effects))
    if progress is not None:
        progress("effects")
    profile = found.chosen.profile
    outlook = predict_detectability(
        unit, lambda t: profile.body(t, chamber.lag), profile.duration, effects, still_channels(config)
    )
    return PlanResult(found, outlook, request, config)
