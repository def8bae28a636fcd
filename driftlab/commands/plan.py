"""The chamber profile of the smallest map uncertainty, before anything is recorded or after it: `driftlab plan`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.commands.console import say, say_lines, terminal
from driftlab.commands.family_map import family_of
from driftlab.commands.inputs import ConfigLike, DataLike, Place, Progress, config_of, recordings_of
from driftlab.commands.result import Result, in_folder
from driftlab.commands.triad_map import names_of_terms
from driftlab.config import Config, paths_of
from driftlab.family.mixed_model import Family
from driftlab.identification.candidates import check_kinds
from driftlab.planning.chamber import Profile
from driftlab.planning.continuation import Continuation, continuation_of, of_samples, read_parts
from driftlab.planning.detectability import DetectabilityReport, EffectEstimate, effects_in, predict_detectability
from driftlab.planning.discrimination import DiscriminationCriterion, preferred
from driftlab.planning.request import PlanRequest, parse_request, quantity, read_hours
from driftlab.planning.search import SearchResult, search
from driftlab.planning.short_soak import ShortSoakPlan, shortened
from driftlab.planning.simulated_search import still_channels
from driftlab.planning.turntable import TurntablePlan, plan_turntable
from driftlab.planning.unit_model import UnitModel, fitted_map, twin_of
from driftlab.reports import plan_continuation, plan_effects, plan_short_soak
from driftlab.reports import plan_turntable as plan_turntable_page
from driftlab.reports.charts import Chart
from driftlab.reports.plan import PlanPage, page_of_search, write_profile
from driftlab.reports.tables import TextTable
from driftlab.storage.folders import FILES
from driftlab.storage.json import plain, write_json
from driftlab.triad.model import AXES, GROUPS, TERMS
from driftlab.units import tracked_unit
from fusion_core.chunk import Array
from fusion_core.errors import ConfigError
from fusion_core.faults import Faults

TABLE = "100 deg/s"  # fastest rate of a turntable


class PlanResult(Result):
    """A plan: `time` and `set_point` (M,) of the chosen profile, `temperature` (G,) and `sigma` (G, d) of its map.

    With terms of a turntable, `sigma` (G, 12) is that of each term.

    After recordings `sigma` is of the map so far, NaN where nothing was seen, and `sigma_after` (G, d) with the further
    profile. With a family, `without_family` (G, d) is the error of the best map without it after the same soak.

    Attributes
    ----------
    found : SearchResult, Continuation, ShortSoakPlan or TurntablePlan
        Every profile that was judged, and the chosen one.
    outlook : DetectabilityReport or None
        What the chosen profile would say of effects; None with a family.
    seen : tuple of EffectEstimate
        How large effects are in what was recorded.
    headline : str
        What to record, and what comes of it.
    """

    command = "plan"

    def __init__(
        self,
        name: str,
        rated: SearchResult | Continuation | ShortSoakPlan | TurntablePlan,
        page: PlanPage,
        sigmas: Mapping[str, Array],
        axes: Sequence[str],
        si: str,
        outlook: DetectabilityReport | None = None,
        seen: tuple[EffectEstimate, ...] = (),
    ) -> None:
        self.name, self.found, self.outlook, self.seen = name, rated, outlook, seen
        self._page, self.headline = page, page.headline
        profile: Profile = rated.chosen.profile
        self._columns = {
            "time": profile.time, "set_point": profile.temperature, "temperature": rated.chosen.temperature, **sigmas,
        }  # fmt: skip
        each = tuple(si if name.startswith("bias") else "1" for name in axes) if len(axes) == len(TERMS) else si
        self.units = {"time": "s", "set_point": "degC", "temperature": "degC", **dict.fromkeys(sigmas, each)}
        self.labels = dict.fromkeys(sigmas, tuple(axes))
        self.summary = plain(page.document)

    def lines(self) -> list[str]:
        """Return the reasons for this profile, the knowledge so far, and the basis of the plan, a sentence each."""
        return self._page.lines

    def table(self) -> TextTable:
        """Return the profiles for a terminal, the chosen one first."""
        return self._page.table

    def _chart(self) -> Chart:
        """Return the sigma that is expected over temperature; with a family, over the length of the soak."""
        return self._page.chart

    def _write(self, folder: Path) -> None:
        mark, setpoints, report, segments = (folder / name for name in FILES["plan"])
        profile = self.found.chosen.profile
        write_profile(setpoints, profile)
        self._page.write(report, self.name[0].upper() + self.name[1:], profile)
        if isinstance(self.found, TurntablePlan):
            segments.write_text(self.found.chosen.table(), encoding="utf-8")
        write_json(mark, self.summary)


def plan(
    config: ConfigLike,
    hours: str | float = 8.0,
    *,
    range: str | tuple[float, float] | None = None,
    rate: str | None = None,
    lag: str | None = None,
    start: str | None = None,
    walk: str | None = None,
    sigma: str | None = None,
    kind: str | None = None,
    effects: Sequence[str] = (),
    channel: str | None = None,
    after: DataLike = None,
    family: Place | None = None,
    terms: str | None = None,
    table: str | None = None,
    out: Place | None = None,
    progress: Progress | None = None,
) -> PlanResult:
    """Find the chamber profile of least map uncertainty.

    With a sigma to reach, the shortest one that reaches it.

    Parameters
    ----------
    config : as that of `run`
        With a map, and a filter or a simulated unit, whose noise is reckoned with.
    hours : str or float
        How long the chamber may take; a number alone is in hours.
    range : str or (float, float), optional
        E.g. '-20..50 degC'; default: the config's.
        A pair is in degC. The config's is that of its fitted map, or of the chamber that its source simulates; after
        recordings it is theirs, and with a family the family's.
    rate : str, optional
        Fastest that the chamber can; default: 2 K/min.
    lag : str, optional
        Of the unit behind the chamber; default: 10 min.
    start : str, optional
        Where it begins; default: 25 degC.
    walk : str, optional
        Of the unit's bias; default: the config's.
    sigma : str, optional
        Aim, e.g. '3 deg/h': says the shortest hours.
    kind : str, optional
        Kind of map, instead of the config's.
    effects : sequence of str
        Effects that the profile is to distinguish.
        As `("hysteresis", "thermal_lag")`, in place of all that are installed; the profile is then the one that
        distinguishes them best among those whose sigma is nearly the best.
    channel : as that of `run`
    after : as `data` of `run`, or a list of them, optional
        What was recorded already; may be repeated.
        The result says what is still missing, and whether it is enough.
    family : path, optional
        Of a fleet: says how short a soak may be.
        Its `family.json`; noise and walk are those of its units.
    terms : str, optional
        Terms of a gyro to tell on a turntable: bias,scale,misalignment.
        The plan is then of temperatures, faces and rates; segments.csv in `out` is what `fit-map --terms` reads.
    table : str, optional
        With --terms, the fastest rate of the table; default: 100 deg/s.
    out : path, optional
        Folder for set points and report.
    progress : callable, optional
        Called with texts.

    Returns
    -------
    PlanResult
        `time`, `set_point` (M,) of the chosen profile, `temperature` (G,) and `sigma` (G, d) that its map will have.
        With `after`, `sigma` is of the map so far, and `sigma_after` (G, d) with the further profile; with `family`,
        `sigma` is of the chosen short soak, and `without_family` (G, d) of the same without it.

    Raises
    ------
    ConfigError, DataError, MapError
        If what is asked cannot be meant, the hours are too few, a recording cannot be used, or the family is of another
        sensor.
    """
    understood = config_of(config).tracking(channel)
    if terms is None and table is not None:
        raise ConfigError("--table: is the rate of a turntable; say which terms it is to tell, e.g. --terms scale")
    options = {"rate": rate, "lag": lag, "start": start, "walk": walk, "sigma": sigma, "kind": kind}
    inquiry = _Inquiry(understood, read_hours(hours), range, options, effects, progress or (lambda *state: None))
    if terms is not None:
        if family is not None or after is not None or effects or sigma is not None:
            raise ConfigError("--terms: plans a turntable; leave --family, --after, --effects and --sigma out")
        return in_folder(out, "plan", understood.files(), partial(inquiry.turned, terms, table or TABLE))
    if family is not None:
        if after is not None or effects:
            raise ConfigError("--family: tells how short a soak may be; leave --after and --effects out")
        law = family_of(understood, Path(family))
        return in_folder(out, "plan", [Path(family), *understood.files()], partial(inquiry.short, law))
    check_kinds(effects, "--effects")
    if after is not None:
        recordings = recordings_of(after, None, "after")
        read = [*understood.files(), *paths_of(recordings)]
        return in_folder(out, "plan", read, partial(inquiry.after, recordings))
    return in_folder(out, "plan", understood.files(), partial(inquiry.first, inquiry.request(range)))


@dataclass(frozen=True)
class _Inquiry:
    """The wishes for a plan; `options` are texts for `parse_request`."""

    config: Config
    hours: float
    range: str | tuple[float, float] | None
    options: Mapping[str, str | None]
    effects: Sequence[str]
    report: Progress

    def request(self, range: str | tuple[float, float] | None) -> PlanRequest:
        """Return the request over a range; None: the config's."""
        return parse_request(self.config, range=range, **self.options)

    def first(self, request: PlanRequest) -> PlanResult:
        """Plan what is recorded first."""
        chamber = request.chamber
        rated = search(request.subject, chamber, self.hours, request.target, self.report)
        unit = request.subject.with_curve(chamber.low, chamber.high)
        if self.effects:
            rated = preferred(rated, DiscriminationCriterion(unit, chamber, self.hours, self.effects))
        outlook, subject = self._outlook(unit, rated.chosen.profile, chamber.lag), rated.subject
        page = page_of_search(rated, request.lag_of, outlook)
        name, sigmas = f"plan of {rated.hours:g} h for the {subject.channel}", {"sigma": rated.chosen.sigma}
        return PlanResult(name, rated, page, sigmas, subject.axes, subject.unit.si, outlook)

    def after(self, recordings: Sequence[str]) -> PlanResult:
        """Plan what is still missing after recordings."""
        self.report("reading what was recorded")
        parts, dt, memory = read_parts(self.config, recordings, Faults())
        request = self.request(self.range or self._span(parts))
        chamber = request.chamber
        before = of_samples(parts, dt, request.subject, chamber, memory)
        rated, subject = continuation_of(before, self.hours, request.target, self.report), before.subject
        unit = subject.with_curve(chamber.low, chamber.high)
        outlook = self._outlook(unit, rated.chosen.profile, chamber.lag)
        seen = effects_in(unit, before.parts, before.dt, self.effects)
        page = plan_continuation.page_of(rated, outlook, seen)
        name = f"plan after {before.hours:.3g} h of the {subject.channel}"
        sigmas = {"sigma": before.sigma, "sigma_after": rated.chosen.sigma}
        return PlanResult(name, rated, page, sigmas, subject.axes, subject.unit.si, outlook, seen)

    def short(self, law: Family) -> PlanResult:
        """Plan a short soak of a unit whose family is known."""
        request, unit = self.request(self.range or law.knots.domain), tracked_unit(self.config.filter)
        noise, walk = np.asarray(request.subject.noise), np.asarray(request.subject.walk)
        noise_of = "as the config says"
        if law.bands is not None:
            typical, noise_of = law.bands.noise, f"the median of {law.units} units"
            noise = np.array(typical.white)
            walk = walk if self.options["walk"] else np.array(typical.walk)
        self.report("parts of the range")
        rated = shortened(law, request.chamber, self.hours, noise, walk, request.target)
        page = plan_short_soak.page_of(rated, unit, noise_of)
        name = f"plan of a short soak for the {law.channel}"
        sigmas = {"sigma": rated.chosen.sigma, "without_family": rated.chosen.without_family}
        return PlanResult(name, rated, page, sigmas, law.axes, unit.si)

    def turned(self, terms: str, table: str) -> PlanResult:
        """Plan the sequence of a turntable."""
        wanted = [j for name in names_of_terms(terms) for j in GROUPS[name]]
        request, rate = self.request(self.range), quantity("table", table, "rad/s", TABLE)
        subject = request.subject
        if len(subject.axes) != len(AXES) or subject.unit.si != "rad/s" or rate <= 0:
            raise ConfigError(
                f"--terms: a turntable tells of a gyro of three axes at a rate, not of {subject.channel} "
                f"({', '.join(subject.axes)}) at {table}; give a gyro's config, and e.g. --table '100 deg/s'"
            )
        found = plan_turntable(subject, request.chamber, self.hours, rate, wanted)
        page = plan_turntable_page.page_of(found)
        return PlanResult(f"plan of a turntable for the {subject.channel}", found, page, {"sigma": found.chosen.sigma},
                          [name.replace(" ", "_") for name in TERMS], "rad/s")  # fmt: skip

    def _outlook(self, unit: UnitModel, profile: Profile, lag: float) -> DetectabilityReport:
        self.report("effects")
        return predict_detectability(
            unit, lambda t: profile.body(t, lag), profile.duration, self.effects, still_channels(self.config)
        )

    def _span(self, parts: Sequence[tuple[Array, Array]]) -> tuple[float, float] | None:
        """Return the temperatures of the recordings, where the config says of no range."""
        if fitted_map(self.config) is not None or twin_of(self.config) is not None:
            return None
        return min(float(T.min()) for T, _ in parts), max(float(T.max()) for T, _ in parts)


def arguments_of(arguments: dict[str, Any], options: dict[str, Any]) -> dict[str, Any]:
    """Split the effects."""
    names = arguments.get("effects")
    return {**arguments, "effects": [] if names is None else [name.strip() for name in names.split(",")]}


def show(result: PlanResult, given: Mapping[str, Any]) -> None:
    """Print the plan; of effects that were named, which are distinguished."""
    say(f"{result.headline}\n")
    terminal().print(result.table())
    say_lines(result.lines())
    if given["effects"] and result.outlook is not None:
        terminal().print(plan_effects.table(result.outlook))
        say_lines(plan_effects.lines(result.outlook))
    if given["out"] is not None:
        names = FILES["plan"] if isinstance(result.found, TurntablePlan) else FILES["plan"][:3]
        say(f"written to {given['out']}/: {', '.join(names)}\n")
