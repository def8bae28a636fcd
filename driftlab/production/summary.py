"""Progress of a fleet while it goes on, and its summary in sentences for the line engineer.

Progress is a bar where a person is looking, a line now and then where a log is written.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from pydantic import BaseModel, Field

from driftlab import __version__
from driftlab.commands.console import session, terminal
from driftlab.production.unit_terms import sentence_of
from driftlab.spc.acknowledgements import Acknowledgement
from driftlab.spc.gauge_study import GaugeStudy
from driftlab.spc.yields import Yield
from driftlab.units import duration, units
from fusion_core.escaping import line


@dataclass
class Stage:
    """One stage of a fleet, as it goes on."""

    name: str
    total: int = 0  # units that it takes; 0 where that is not counted
    done: int = 0  # so far
    failed: int = 0
    begun: float = field(default_factory=time.monotonic)  # s

    def left(self) -> float | None:
        """Return the seconds until the end, if it goes on like that; None as long as that is not known."""
        took = time.monotonic() - self.begun
        if self.done < 3 or took < 1.0 or not self.total:
            return None
        return took / self.done * (self.total - self.done)

    def text(self) -> str:
        """Return the progress in words: `512 of 5,000 units, 3 failed, 12 min left`."""
        if not self.total:
            return self.name
        failed = f", {self.failed:,} failed" if self.failed else ""
        left = self.left()
        rest = "" if left is None or self.done == self.total else f", {duration(left)} left"
        return f"{self.name}: {self.done:,} of {self.total:,} units{failed}{rest}"


FleetProgress = Callable[[Stage], None]
EVERY = 30.0  # s between lines of a log


@contextmanager
def fleet_progress() -> Iterator[FleetProgress]:
    """Show the stages of a fleet on standard error, with units done and failed, and an estimate of the end.

    With -v it is noted how long each took.
    """
    from rich.progress import BarColumn, Progress, TextColumn

    quiet, console = session().quiet, terminal(stderr=True)
    columns = (BarColumn(bar_width=24), TextColumn("{task.description}", markup=False))
    bars = Progress(*columns, console=console, transient=True, disable=quiet or not console.is_terminal)
    bar = bars.add_task("", total=None)
    current, written = Stage(""), time.monotonic()

    def note() -> None:
        if current.name:
            session().stages.append((current.name, time.monotonic() - current.begun))

    def report(stage: Stage) -> None:
        nonlocal current, written
        if stage is not current:
            note()
        current = stage
        if not bars.disable:
            bars.update(bar, description=stage.text(), completed=stage.done, total=stage.total or None)
        elif not quiet and time.monotonic() - written >= EVERY:
            written = time.monotonic()
            sys.stderr.write(f"{line(stage.text())}\n")
            sys.stderr.flush()

    try:
        with bars:
            yield report
    finally:
        note()


NAMED = 10  # units that a line names
SHOWN = 5  # groups of units with the same recordings
MAX_PAGES = 20  # pages of units that stand out and were not asked for


class FamilySummary(BaseModel):
    """The family's part of a fleet's summary: its sentences, the reasons of units that stand out, and the line.

    `alarms` are why units are out of control, by frozen limits and run rules; `acknowledged` has the notes on units
    whose alarms are all known, `open` the units with others, odd ones among both. `capability` has the indices,
    `charts` limits, changes and lots of each chart, `differences` the figures that differ between groups of units.
    """

    units: int
    fitted: bool = True
    odd: dict[str, list[str]] = {}
    lines: list[str] = []
    line: list[str] = []
    alarms: dict[str, list[str]] = {}
    acknowledged: dict[str, dict[str, str]] = {}
    open: list[str] = []
    capability: list[dict[str, Any]] = []
    charts: list[dict[str, Any]] = []
    differences: list[dict[str, Any]] = []
    judged: bool = True

    def sentences(self) -> list[str]:
        """Return the summary in sentences."""
        lines, count = list(self.lines), len(self.odd)
        if count:
            still = [(unit, why) for unit, why in self.odd.items() if unit not in self.acknowledged]
            known = f", {count - len(still):,} of them acknowledged" if len(still) < count else ""
            end = ":" if still else ""
            lines.append(f"{units(count)} of {self.units:,} {'stands' if count == 1 else 'stand'} out{known}{end}")
            lines += [f"  unit {unit}: {'; '.join(why)}" for unit, why in still[:NAMED]]
            if len(still) > NAMED:
                lines.append(f"  and {len(still) - NAMED:,} more: the column `odd_why` of units.parquet")
            if count > MAX_PAGES:
                lines.append(f"  pages are written of the first {MAX_PAGES}; --pages NAME writes others")
        elif self.fitted and self.judged:
            lines.append("no unit stands out")
        lines += [f"the line: {sentence}" for sentence in self.line]
        notes = list(self.acknowledged.items())
        lines += [f"acknowledged: unit {unit}: {n['note']} ({n['by']}, {n['at'][:10]})" for unit, n in notes[:NAMED]]
        if len(notes) > NAMED:
            lines.append(f"and {len(notes) - NAMED:,} more units are acknowledged: `family.acknowledged` of fleet.json")
        return lines


class FleetSummary(BaseModel):
    """The content of `fleet.json`: `failed` has the first units that failed, `left` those not in the manifest."""

    schema_: Annotated[Literal[1], Field(alias="schema")] = 1
    program: str = "driftlab fleet"
    complete: bool = False
    driftlab: str = __version__
    plugins: list[dict[str, Any]] = []
    units_from: str = ""
    counts: dict[str, int]
    limits: dict[str, int] = {}
    acceptance: Annotated[str, Field(exclude=True)] = ""
    pass_with_hysteresis: int = 0
    terms: dict[str, Any] | None = None
    yields: Annotated[Yield | None, Field(exclude=True)] = None
    gauge: Annotated[GaugeStudy | None, Field(exclude=True)] = None
    acknowledgements: list[Acknowledgement] = []
    id: str | None = None
    store: str | None = None
    replaced: list[str] = []
    kept_without_recordings: list[str] = []
    same_recordings: list[list[str]] = []
    left: list[str] = []
    failed: dict[str, str] = {}
    certificates_failed: Annotated[list[str], Field(exclude=True)] = []
    seconds: dict[str, float] = {}
    key: str | None = None
    family: FamilySummary | None = None
    pages: list[str] | None = None
    config: str = ""

    def content(self) -> dict[str, Any]:
        """Return the content of the file, with its summary in sentences."""
        content = self.model_dump(by_alias=True, exclude_none=True)
        config = content.pop("config")
        found = {} if self.yields is None else {"yield": self.yields.as_json()}
        found |= {} if self.gauge is None else {"gauge": self.gauge.as_json()}
        return {**content, **found, "lines": self.sentences(), "config": config}

    def sentences(self) -> list[str]:
        """Return the summary in sentences, most important first."""
        family = [] if self.family is None else self.family.sentences()
        gauge = [] if self.gauge is None else self.gauge.sentences()
        terms = [] if self.terms is None else [sentence_of(self.terms)]
        return [*self._of_units(), *self._of_the_manifest(), *self.certificates_failed, *terms, *family, *gauge]

    def _of_units(self) -> list[str]:
        now, done, failed = (self.counts[name] for name in ("done_now", "done", "failed"))
        before = self.counts["units"] - now
        when = "" if not before else f" ({now:,} of them now, {before:,} before)" if now else " (all of them before)"
        doubt = f" ({count:,} of them in doubt)" if (count := self.counts.get("in_doubt", 0)) else ""
        lines = [f"{units(self.counts['units'])}: {done:,} done{doubt}, {failed:,} failed{when}"]
        if failed:
            lines += [f"failed: unit {unit}: {why}" for unit, why in self.failed.items()]
            more = f"and {failed - len(self.failed):,} more; " if failed > len(self.failed) else ""
            lines.append(f"{more}why each failed is in the column `error` of units.parquet")
        lines += [self.acceptance] if self.acceptance else []
        lines += [] if self.yields is None else self.yields.sentences()
        if count := self.pass_with_hysteresis:
            lines.append(f"of those that pass a hysteresis or lag is seen in {units(count)}; no limit is set for it")
        return lines

    def _of_the_manifest(self) -> list[str]:
        lines, left, without = [], self.left, self.kept_without_recordings
        if left:
            verb = "is" if len(left) == 1 else "are"
            lines.append(
                f"{units(len(left))} {verb} not in the manifest any more ({some(left)}): the folders stay, the tables "
                "leave them out"
            )
        for names in self.same_recordings[:SHOWN]:
            lines.append(f"units {some(names)} have the same recordings and count as {len(names)}: name these once")
        if without:
            lines.append(
                f"of {units(len(without))} a recording is not there any more ({some(without)}): their results "
                "are kept; --force drops them"
            )
        return lines


def some(names: Sequence[str]) -> str:
    """Return the first of some names, and how many more there are."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5:,} more" if len(names) > 5 else "")
