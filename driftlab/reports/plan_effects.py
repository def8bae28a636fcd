"""What a plan shows of effects: a table, a matrix of what is told from what, sentences, JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from driftlab.planning.detectability import Detectability, DetectabilityReport, EffectEstimate
from driftlab.units import BiasUnit

if TYPE_CHECKING:
    from rich.table import Table

PLAINLY = 0.9  # share of the nats: with less left, another effect takes a part of it that is worth saying


def heads(outlook: DetectabilityReport) -> list[str]:
    """Return the heads of the table's columns."""
    unit = outlook.shown
    size = f"{_number(outlook.size * unit.factor)} {unit.shown}"
    sizes = (f"{name}\n[{unit.shown}]" for name in ("found from", "over its grid"))
    return ["effect", *sizes, f"of {size}\n[nats]", "not told from"]


def cells(outlook: DetectabilityReport) -> list[list[str]]:
    """Return the rows of the table, what is found at the smallest size first."""
    return [_row(outlook, item) for item in outlook.effects] + [
        [name, "not seen", "", "0", ""] for name in outlook.silent
    ]


def _row(outlook: DetectabilityReport, item: Detectability) -> list[str]:
    factor = outlook.shown.factor
    sizes = [_size(value * factor) for value in (item.found_from, item.best, item.worst)]
    grid = sizes[1] if sizes[1] == sizes[2] else f"{sizes[1]} to {sizes[2]}"
    return [item.name, sizes[0], grid, f"{item.nats:.1f}", ", ".join(item.confused_with)]


def table(outlook: DetectabilityReport) -> Table:
    """Return the table for a terminal."""
    from rich.table import Table

    result = Table(title="effects that the loop would find on it, from lowest to highest, on every axis alike")
    result.title_justify = "left"
    first, *others = heads(outlook)
    result.add_column(first, no_wrap=True)
    for head in others:
        result.add_column(head, justify="right")
    for row in cells(outlook):
        result.add_row(*row)
    return result


def matrix(outlook: DetectabilityReport) -> tuple[list[str], list[tuple[str, list[tuple[str, str]]]]]:
    """Return the effects, and for each what is left of its nats, in %, where another takes its part.

    Each with a word beside it where the two are not told apart at twice the smallest size that is found.
    """
    names = [item.name for item in outlook.effects]
    return names, [(item.name, [_left(item, name) for name in names]) for item in outlook.effects]


def _left(item: Detectability, other: str) -> tuple[str, str]:
    if other == item.name:
        return "", ""
    return f"{100 * item.left[other]:.0f}", "alike" if other in item.confused_with else ""


def section(outlook: DetectabilityReport) -> dict[str, Any]:
    """Return what the page shows: the table, and the matrix of shares that are left."""
    names, rows = matrix(outlook)
    return {
        "heads": [head.replace("\n", " ") for head in heads(outlook)],
        "rows": cells(outlook),
        "names": names,
        "matrix": rows,
        "lines": lines(outlook),
    }


def brief(outlook: DetectabilityReport) -> list[str]:
    """Return in one sentence which effects the loop would find; none where there are none."""
    unit = outlook.shown
    found = [
        f"{item.name} from {_number(item.found_from * unit.factor)} {unit.shown} on"
        for item in outlook.effects
        if item.found
    ]
    never = [*(item.name for item in outlook.effects if not item.found), *outlook.silent]
    said = [*found, *([f"not {', '.join(never)}"] if never else [])]
    return [f"the loop would find on it {'; '.join(said)} (--effects says what is told from what)"] if said else []


def lines(outlook: DetectabilityReport) -> list[str]:
    """Return what is found and what is told apart, a sentence each."""
    unit = outlook.shown
    said = []
    for item in outlook.effects:
        if not item.found:
            said.append(
                f"{item.name}: the loop would find none of any size in this one recording; what is left out of it must "
                "show it too: record another one"
            )
            continue
        text = f"{item.name} of {_number(item.found_from * unit.factor)} {unit.shown} or more would be found"
        said.append("; ".join([text, *_told(item)]))
    why = (
        f"this profile only ever {outlook.only}: it looks like a bend of the map"
        if outlook.only
        else "nothing shows it"
    )
    said += [f"{name}: is not seen at all; {why}" for name in outlook.silent]
    said += [f"{name} is held still: what follows it is not seen" for name in outlook.still]
    if not outlook.curve_known and any(item.effect.acts_on_input for item in outlook.effects):
        said.append("the curve is not known: what acts on its temperature is reckoned with one that bends")
    return said


def _told(item: Detectability) -> list[str]:
    """Return from what an effect is told apart, where it is not plain, when it is twice the smallest size."""
    close = {name: share for name, share in item.left.items() if share < PLAINLY and name not in item.confused_with}
    found = []
    if close:
        name, share = min(close.items(), key=lambda pair: pair[1])
        found.append(f"told apart from {name} by {_nats(share * item.nats_found)} of {_nats(item.nats_found)} nats")
    if item.confused_with:
        names = [f"{name} ({_nats(item.left[name] * item.nats_found)})" for name in item.confused_with]
        found.append(f"not told apart from {', '.join(names)} of {_nats(item.nats_found)} nats")
    return found


def seen_lines(seen: Sequence[EffectEstimate], shown: BiasUnit) -> list[str]:
    """Return how large effects are in what was recorded, as far as that is known."""
    said = []
    for item in seen:
        if not item.sigma < float("inf"):
            said.append(f"so far, {item.name}: cannot be told at all, temperature has not turned back")
            continue
        size = f"{_number(item.size * shown.factor)} ± {_number(item.sigma * shown.factor)} {shown.shown}"
        word = "is in it, `driftlab explain` tells whether it is this" if item.sure else "cannot be told yet"
        said.append(f"so far, {item.name}: {size} on {item.axis}, {word}")
    return said


def document(outlook: DetectabilityReport) -> list[dict[str, Any]]:
    """Return the effects as JSON holds them, sizes in the unit that is shown."""
    unit = outlook.shown

    def value(size: float) -> dict[str, Any] | None:
        return {"value": size * unit.factor, "unit": unit.shown} if size < float("inf") else None

    found = [
        {
            "kind": item.effect.kind,
            "name": item.name,
            "nats": item.nats,
            "of": value(outlook.size),
            "threshold": item.threshold,
            "found_from": value(item.found_from),
            "best": value(item.best),
            "worst": value(item.worst),
            "share_left": item.left,
            "confused_with": list(item.confused_with),
        }
        for item in outlook.effects
    ]
    silent = [{"kind": name.split()[0], "name": name, "nats": 0.0, "found_from": None} for name in outlook.silent]
    return [*found, *silent]


def _size(value: float) -> str:
    return _number(value) if value < float("inf") else "none"


def _nats(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"


def _number(value: float) -> str:
    return f"{value:.3g}" if value < 1000 else f"{value:.0f}"
