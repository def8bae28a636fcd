"""Yield of a line and the reasons of what is not accepted (Pareto), as a whole and by a column of the units' table.

A unit is accepted where it was calibrated, keeps every limit of the config (`driftlab.evaluation.limits`), and is not
in doubt. The 95 % interval of a share is Clopper and Pearson's. Whether the yield differs between the groups of a
column is Pearson's chi-squared, by the permutation law of the accepted units over the groups: right for few units and
rare reasons alike.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate
from typing import Any

import numpy as np

from driftlab.family.record import UnitRecord, figure_name
from driftlab.spc.capability import share_beyond
from driftlab.spc.stratification import ALPHA, groups_of
from fusion_core.faults import in_doubt

UNITS = {"T_low": "°C", "T_high": "°C", "hours": "h"}  # of columns
UNDECIDED = "undecided"
SAID = {"fail": "above limit", UNDECIDED: "undecided", "not measured": "not measured"}
_Judged = tuple[list[str], bool, bool]  # reasons of a unit, whether it stands out, and whether it is undecided
DRAWS = 9999  # permutations
CELLS = 10_000_000  # groups of all draws


@dataclass(frozen=True)
class YieldGroup:
    """Units of a group, those of them that were accepted, that stand out (`odd`), and the units by reason."""

    name: str
    units: int
    accepted: int
    odd: int = 0
    reasons: Mapping[str, int] = field(default_factory=dict)  # of what was not accepted, most units first
    undecided: int = 0  # of what was not accepted
    accepted_odd: int = 0  # accepted, and unlike the others all the same: limits see what they are of

    @property
    def share(self) -> float:
        """The share that was accepted, 1."""
        return self.accepted / self.units

    @property
    def interval(self) -> tuple[float, float]:
        """Its 95 % interval."""
        return share_beyond(self.accepted, self.units)

    def as_json(self) -> dict[str, Any]:
        """Return it as `fleet.json` has it."""
        return {
            "units": self.units, "accepted": self.accepted, "yield": self.share, "yield_95": [*self.interval],
            "odd": self.odd, "reasons": dict(self.reasons), "undecided": self.undecided,
            "accepted_odd": self.accepted_odd,
        }  # fmt: skip


@dataclass(frozen=True)
class Yield:
    """Yield of all units, and by column.

    Attributes
    ----------
    whole : YieldGroup
    covered : tuple of int
        Units that the first reasons of the whole explain together, one more reason each; a unit may have several.
    by : mapping of str to tuple of YieldGroup
        In the order of the groups' first units.
    p : mapping of str to float
        Probability of yields that differ so much between the groups of a column by chance.
    judged : bool
        Whether the config has limits; else every unit that was calibrated is accepted.
    """

    whole: YieldGroup
    covered: tuple[int, ...] = ()
    by: Mapping[str, tuple[YieldGroup, ...]] = field(default_factory=dict)
    p: Mapping[str, float] = field(default_factory=dict)
    judged: bool = False

    def differs(self, column: str) -> bool:
        """Return True if the yield differs between the groups of a column by more than chance."""
        return self.p[column] < ALPHA / len(self.p)

    def titled(self, column: str) -> str:
        """Return the name of a column with its unit."""
        return f"{column} [{UNITS[column]}]" if column in UNITS else column

    def text(self, column: str) -> str:
        """Return the probability in words: `p = 0.02`."""
        return "p ≤ 0.0001" if self.p[column] <= 1e-4 else f"p = {self.p[column]:.2g}"

    def as_json(self) -> dict[str, Any]:
        """Return it as `fleet.json` has it."""
        by = {
            column: {"p": self.p[column], "groups": [{column: one.name, **one.as_json()} for one in groups]}
            for column, groups in self.by.items()
        }
        return {**self.whole.as_json(), "judged": self.judged, "covered": list(self.covered), "by": by}

    def sentences(self) -> list[str]:
        """Return the yield and its reasons, and the columns by whose groups it differs."""
        whole = self.whole
        why = "limits do not see why" if self.judged else "no limits are set"
        unlike = f"accepted units that stand out: {whole.accepted_odd:,} of {whole.accepted:,}; {why}"
        more_than_limits = [unlike] if whole.accepted_odd else []
        if not whole.reasons:
            return more_than_limits
        first = ", ".join(f"{reason} ({count:,})" for reason, count in [*whole.reasons.items()][:3])
        more = f" and {len(whole.reasons) - 3:,} more" if len(whole.reasons) > 3 else ""
        open_ = f"; {whole.undecided:,} undecided" if whole.undecided else ""
        yielded = f"yield: {whole.accepted:,} of {whole.units:,} units, {_per_cent(whole)}"
        lines = [f"{yielded}{open_}; not accepted: {first}{more}", *more_than_limits]
        for column, groups in self.by.items():
            if self.differs(column):
                least, most = (f(groups, key=lambda one: one.share) for f in (min, max))
                lines.append(
                    f"yield differs by {column} ({self.text(column)}): "
                    f"{least.name} {_per_cent(least)}, {most.name} {_per_cent(most)}"
                )
        return lines


def _per_cent(group: YieldGroup) -> str:
    low, high = group.interval
    return f"{100 * group.share:.3g} % (95 %: {100 * low:.3g} to {100 * high:.3g} %)"


def yields_of(records: Sequence[UnitRecord], odd: Collection[str] = (), by: Iterable[str] = ()) -> Yield:
    """Return the yield of units, of which `odd` stand out, and by the columns `by`: COLUMNS, or the manifest's own."""
    known: dict[tuple[str, ...], list[str]] = {}  # of a line of many units few differ
    known_odd = set(odd)
    judged = [
        (known.setdefault(tuple(own), own), record.unit in known_odd, undecided(record))
        for record, own in zip(records, map(reasons, records), strict=True)
    ]
    whole, why = _group("", judged), [own for own, *_ in judged]
    place = {reason: k for k, reason in enumerate(whole.reasons)}
    first = Counter(min(place[reason] for reason in of_unit) for of_unit in why if of_unit)
    covered = tuple(accumulate(first[k] for k in place.values()))
    groups: dict[str, tuple[YieldGroup, ...]] = {}
    for column in dict.fromkeys(by):
        parts = dict[str, list[_Judged]]()
        for name, of_unit in zip(groups_of(records, column), judged, strict=True):
            parts.setdefault(name, []).append(of_unit)
        groups[column] = tuple(_group(name, part) for name, part in parts.items())
    p = {
        column: chance([one.units for one in parts], [one.accepted for one in parts])
        for column, parts in groups.items()
    }
    return Yield(whole, covered, groups, p, any(record.limits for record in records))


def reasons(record: UnitRecord) -> list[str]:
    """Return the reasons for which a unit is not accepted, first what it is in doubt for; none where it is accepted.

    Errors and doubts that differ in a name of a file or a number are one reason. That limits are undecided is no
    further reason of a unit in doubt, of which none passes.
    """
    if record.state == "failed":
        return [f"not calibrated: {_general(record.error, record.unit) or 'no reason given'}"]
    doubts = dict.fromkeys(in_doubt(_general(text, record.unit) for text in record.doubts))
    rows = ((figure_name(str(row["name"])).replace("_", " "), str(row["verdict"])) for row in record.limits)
    said = {verdict: text for verdict, text in SAID.items() if not doubts or verdict != UNDECIDED}
    return [*doubts, *(f"{name} {said[verdict]}" for name, verdict in rows if verdict in said)]


def undecided(record: UnitRecord) -> bool:
    """Return True if a unit is neither accepted nor known to fail: in doubt, or within the guard of a limit."""
    verdicts = {str(row["verdict"]) for row in record.limits}
    return record.state == "done" and "fail" not in verdicts and (bool(record.doubts) or UNDECIDED in verdicts)


def _general(text: str, unit: str) -> str:
    """Return the first part of a message with names of files and numbers left out, as those of other units are."""
    text = re.sub(r"^\S*[/\\]\S*: ", "", text.partition(";")[0]).replace(unit, "…")
    text = re.sub(r"[^\s:;,'\"]*[/\\][^\s:;,'\"]*\.\w+", "…", text)
    text = re.sub(r"[-+]?\d[\d.,]*(?:[eE][-+]?\d+)?", "…", text)
    return re.sub("(… ?)+", "… ", text).strip()


def _group(name: str, judged: Sequence[_Judged]) -> YieldGroup:
    """Return a group of units, of which each has its reasons, and whether it stands out and is undecided."""
    why, odd, left = zip(*judged, strict=True) if judged else ((), (), ())
    counts = Counter(reason for of_unit in why for reason in of_unit)
    both = sum(stands_out and not of_unit for of_unit, stands_out in zip(why, odd, strict=True))
    accepted = sum(not of_unit for of_unit in why)
    return YieldGroup(name, len(why), accepted, sum(odd), dict(counts.most_common()), sum(left), both)


def chance(units: Sequence[int], accepted: Sequence[int]) -> float:
    """Return the probability of shares that differ so much between groups, were those accepted dealt out by chance.

    By 9,999 draws of them, so at least 1e-4; of more than a thousand groups by fewer, at least 999.
    """
    n, got = np.array(units, dtype=np.int64), np.array(accepted, dtype=np.int64)
    share = np.sum(got) / np.sum(n)
    if len(n) < 2 or share in (0.0, 1.0):
        return 1.0
    rng, left, draws, above = np.random.default_rng(0), max(min(DRAWS, CELLS // len(n)), 999), 0, 0
    seen = np.sum((got - n * share) ** 2 / n) * (1 - 1e-9)
    while draws < left:
        size = min(left - draws, max(CELLS // (10 * len(n)), 1))
        dealt = rng.multivariate_hypergeometric(n, int(np.sum(got)), size=size, method="marginals")
        above += int(np.sum(np.sum((dealt - n * share) ** 2 / n, axis=-1) >= seen))
        draws += size
    return (1 + above) / (1 + draws)
