"""How far a fleet is, for whoever shows it.

What a fleet came to, in sentences for the line engineer.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any


@dataclass
class Stage:
    """One stage of a fleet, as it goes on.

    Attributes
    ----------
    name : str
        What is being done.
    total : int
        Units that it takes; 0 where that is not counted.
    done, failed : int
        So far.
    begun : float
        `time.monotonic`, s.
    """

    name: str
    total: int = 0
    done: int = 0
    failed: int = 0
    begun: float = field(default_factory=time.monotonic)

    def left(self) -> float | None:
        """Return the seconds until the end, if it goes on like that; None where that cannot be said yet."""
        took = time.monotonic() - self.begun
        if self.done < 3 or took < 1.0 or not self.total:
            return None
        return took / self.done * (self.total - self.done)

    def text(self) -> str:
        """Return how far it is: `512 of 5,000 units, 3 failed, 12 min left`."""
        if not self.total:
            return self.name
        failed = f", {self.failed:,} failed" if self.failed else ""
        left = self.left()
        rest = "" if left is None or self.done == self.total else f", {duration(left)} left"
        return f"{self.name}: {self.done:,} of {self.total:,} units{failed}{rest}"


FleetProgress = Callable[[Stage], None]


def duration(seconds: float) -> str:
    """Return a time as one says it: `45 s`, `12 min`, `3 h 20 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


NAMED = 10  # units that a line names
MOST = 20  # pages of units that stand out and were not asked for


def lines_of(content: Mapping[str, Any]) -> list[str]:
    """Return what the content of `fleet.json` says, most important first."""
    return [*_units(content), *_beside(content), *_family(content.get("family") or {})]


def _units(content: Mapping[str, Any]) -> list[str]:
    counts = content["counts"]
    now, done, failed = counts["done_now"], counts["done"], counts["failed"]
    before = counts["units"] - now
    when = "" if not before else f" ({now:,} of them now, {before:,} before)" if now else " (all of them before)"
    lines = [f"{units(counts['units'])}: {done:,} done, {failed:,} failed{when}"]
    if failed:
        lines += [f"failed: unit {unit}: {why}" for unit, why in content["failed"].items()]
        more = f"and {failed - len(content['failed']):,} more; " if failed > len(content["failed"]) else ""
        lines.append(f"{more}why each failed is in the column `error` of units.parquet")
    if limits := content.get("limits"):
        lines.append(f"limits: {', '.join(f'{count:,} {word}' for word, count in sorted(limits.items()))}")
    if seen := content.get("pass_with_hysteresis"):
        lines.append(f"of those that pass a hysteresis or lag is seen in {units(seen)}; no limit is set for it")
    return lines


def _beside(content: Mapping[str, Any]) -> list[str]:
    lines = []
    if left := content["left"]:
        verb = "is" if len(left) == 1 else "are"
        lines.append(
            f"{units(len(left))} {verb} not in the manifest any more ({some(left)}): the folders stay, the tables "
            "leave them out"
        )
    if without := content["kept_without_recordings"]:
        lines.append(
            f"of {units(len(without))} a recording is not there any more ({some(without)}): what was found before is "
            "kept; --force lets it go"
        )
    return lines


def _family(told: Mapping[str, Any]) -> list[str]:
    lines = list(told.get("lines") or [])
    odd: Mapping[str, Sequence[str]] = told.get("odd") or {}
    if odd:
        verb = "stands" if len(odd) == 1 else "stand"
        lines.append(f"{units(len(odd))} of {told['units']:,} {verb} out:")
        lines += [f"  unit {unit}: {'; '.join(why)}" for unit, why in list(odd.items())[:NAMED]]
        if len(odd) > NAMED:
            lines.append(f"  and {len(odd) - NAMED:,} more: the column `odd_why` of units.parquet")
        if len(odd) > MOST:
            lines.append(f"  pages are written of the first {MOST}; --pages NAME writes others")
    elif told.get("fitted") and told.get("judged", True):
        lines.append("no unit stands out")
    return [*lines, *(f"the line: {sentence}" for sentence in told.get("line") or ())]


def units(count: int) -> str:
    """Return a number of units, in words."""
    return "1 unit" if count == 1 else f"{count:,} units"


def some(names: Sequence[str]) -> str:
    """Return the first of some names, and how many more there are."""
    return ", ".join(names[:5]) + (f" and {len(names) - 5:,} more" if len(names) > 5 else "")
