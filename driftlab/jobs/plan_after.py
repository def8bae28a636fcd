"""What is still missing after what was recorded: `driftlab plan --after`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.config import Config, paths_of
from driftlab.identification.candidates import check_kinds
from driftlab.planning.continuation import Continuation, after, of_samples, read_parts
from driftlab.planning.detectability import DetectabilityReport, EffectEstimate, effects_in, predict_detectability
from driftlab.planning.request import Range, parse_request
from driftlab.planning.simulated_search import UnrecordedUnit, still_channels
from driftlab.planning.unit_model import fitted_map, twin_of
from driftlab.reports import plan_continuation, plan_effects
from driftlab.reports.plan import write_profile
from driftlab.results import Result
from driftlab.storage.folders import FILES, output_folder
from driftlab.storage.json import plain, write_json
from fusion_core.chunk import Array
from fusion_core.faults import Faults

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from rich.table import Table


class AfterResult(Result):
    """What was recorded and what is missing.

    `temperature` (G,) over the range, `sigma` (G, d) of the map so far, NaN where nothing was seen, and `sigma_after`
    (G, d) with the further profile, whose set points are `time` and `set_point` (M,).

    Attributes
    ----------
    found : After
        What was recorded, and every further profile that was judged, the best first.
    outlook : Outlook
        What the chosen profile would say of effects by itself.
    seen : tuple of Seen
        How large effects are in what was recorded.
    headline : str
        Whether it is enough, and what to record.
    """

    def __init__(
        self,
        found: Continuation,
        outlook: DetectabilityReport,
        seen: tuple[EffectEstimate, ...],
        read: Collection[Path],
    ) -> None:
        self.found, self.outlook, self.seen, self._read = found, outlook, seen, read
        best, before = found.chosen, found.recorded
        subject = before.subject
        self.name = f"plan after {before.hours:.3g} h of the {subject.channel}"
        self.headline = plan_continuation.headline(found)
        self._columns = {
            "time": best.profile.time, "set_point": best.profile.temperature,
            "temperature": best.temperature, "sigma": before.sigma, "sigma_after": best.sigma,
        }  # fmt: skip
        si = subject.unit.si
        self.units = {"time": "s", "set_point": "degC", "temperature": "degC", "sigma": si, "sigma_after": si}
        self.labels = {"sigma": subject.axes, "sigma_after": subject.axes}
        effects = {"effects": plan_effects.document(outlook)}
        self.summary: dict[str, Any] = plain(plan_continuation.document(found, self.lines()) | effects)

    def lines(self) -> list[str]:
        """Return what is known so far and on what that stands, a sentence each."""
        seen = plan_effects.seen_lines(self.seen, self.found.recorded.subject.unit)
        return [*plan_continuation.lines(self.found), *seen, *plan_effects.brief(self.outlook)]

    def table(self) -> Table:
        """Return the profiles for a terminal, the chosen one first."""
        return plan_continuation.table(self.found)

    def plot(self) -> Figure:
        """Draw sigma over temperature, so far and with the further profile."""
        from driftlab.reports.figures import figure_of

        return figure_of(plan_continuation.sigma_chart(self.found))

    def save(self, out: str | PathLike[str]) -> None:
        """Write `plan.json`, `setpoints.csv` and `report.html` into the folder `out`."""
        with output_folder(Path(out), "plan", self._read) as folder:
            self.write(folder)

    def write(self, folder: Path) -> None:
        """Write the files into a folder that is there."""
        mark, setpoints, report = (folder / name for name in FILES["plan"])
        write_profile(setpoints, self.found.chosen.profile)
        plan_continuation.write_report(
            report, self.found, self.outlook, self.lines(), self.name[0].upper() + self.name[1:]
        )
        write_json(mark, self.summary)


def plan_further(
    config: Config,
    recordings: Sequence[str],
    hours: float = 8.0,
    *,
    range: Range = None,
    effects: Sequence[str] = (),
    out: Path | None = None,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
    **given: str | None,
) -> AfterResult:
    """Say what recordings leave open, and which further profile of `hours` adds most.

    Parameters are those of `plan`, and `recordings` of the calibration, each `PATH` or `PATH::START:STOP`. The range is
    by default what was recorded, where the config says none.

    Raises
    ------
    ConfigError, DataError
        If what is asked cannot be meant, or a recording cannot be used.
    """
    check_kinds(effects, "--effects")
    used = [*read, *config.files(), *paths_of(recordings)]

    def result() -> AfterResult:
        say = progress or (lambda *state: None)
        say("reading what was recorded")
        parts, dt = read_parts(config, recordings, Faults())
        request = parse_request(config, hours, range=range or _seen(config, parts), **given)
        before = of_samples(parts, dt, request.subject, request.chamber)
        found = after(before, hours, request.target, progress)
        chamber, profile = request.chamber, found.chosen.profile
        say("effects")
        unit = UnrecordedUnit.of(before.subject, chamber.low, chamber.high, config.filter)
        body = lambda t: profile.body(t, chamber.lag)  # noqa: E731
        outlook = predict_detectability(unit, body, profile.duration, effects, still_channels(config))
        seen = effects_in(unit, before.parts, before.dt, effects)
        return AfterResult(found, outlook, seen, used)

    if out is None:
        return result()
    with output_folder(out, "plan", used) as folder:
        found = result()
        found.write(folder)
    return found


def _seen(config: Config, parts: Sequence[tuple[Array, Array]]) -> Range:
    """Return the temperatures of the recordings, where the config says of no range."""
    if fitted_map(config) is not None or twin_of(config) is not None:
        return None
    return min(float(T.min()) for T, _ in parts), max(float(T.max()) for T, _ in parts)
