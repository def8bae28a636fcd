"""What a fleet came to, in sentences for the line engineer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

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
