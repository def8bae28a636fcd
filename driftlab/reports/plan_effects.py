"""The effects that a plan would show: a table, a matrix of which are distinguished, sentences, JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from driftlab.planning.detectability import Detectability, DetectabilityReport, EffectEstimate
from driftlab.reports.tables import TextTable
from driftlab.units import BiasUnit, number

PLAINLY = 0.9  # share of the log-likelihood: with less left, another effect takes a part of it that is worth saying
HEADING = "Effects that it would identify"  # on a page


def table(outlook: DetectabilityReport) -> TextTable:
    """Return the table, in the order of the smallest size that is identified."""
    unit, factor = outlook.shown, outlook.shown.factor

    def row(item: Detectability) -> list[str]:
        size, best, worst = (number(v * factor, missing="none") for v in (item.found_from, item.best, item.worst))
        grid = best if best == worst else f"{best} to {worst}"
        return [item.name, size, grid, f"{item.nats:.1f}", ", ".join(item.confused_with)]

    sizes = (f"{name}\n[{unit.shown}]" for name in ("found from", "over its grid"))
    heads = ["effect", *sizes, f"of {number(outlook.size * factor)} {unit.shown}\n[log-likelihood]", "confused with"]
    title = "effects that the loop would find on it, from lowest to highest, on every axis alike"
    rows = [*map(row, outlook.effects), *([name, "not seen", "", "0", ""] for name in outlook.silent)]
    return TextTable(heads, rows, title, rigid=True, whole=False)


def matrix(outlook: DetectabilityReport) -> tuple[list[str], list[tuple[str, list[tuple[str, str]]]]]:
    """Return the effects, and for each what is left of its log-likelihood, in %, where another takes its part.

    Each with a word beside it where the two are not distinguished at twice the smallest size that is found.
    """

    def left(item: Detectability, other: str) -> tuple[str, str]:
        if other == item.name:
            return "", ""
        return f"{100 * item.left[other]:.0f}", "alike" if other in item.confused_with else ""

    names = [item.name for item in outlook.effects]
    return names, [(item.name, [left(item, name) for name in names]) for item in outlook.effects]


def section(outlook: DetectabilityReport) -> dict[str, Any]:
    """Return the section of a page: table, matrix of the shares that are left between the names, and sentences."""
    names, rows = matrix(outlook)
    return {"table": table(outlook), "names": names, "matrix": rows, "lines": lines(outlook)}


def brief(outlook: DetectabilityReport) -> list[str]:
    """Return in one sentence which effects the loop would find; none where there are none."""
    unit = outlook.shown
    parts = [
        f"{item.name} from {number(item.found_from * unit.factor)} {unit.shown} on"
        for item in outlook.effects
        if item.found
    ]
    never = [*(item.name for item in outlook.effects if not item.found), *outlook.silent]
    parts += [f"not {', '.join(never)}"] if never else []
    return [f"the loop would find on it {'; '.join(parts)} (--effects says which are distinguished)"] if parts else []


def lines(outlook: DetectabilityReport) -> list[str]:
    """Return the effects that would be found, and those that are distinguished, a sentence each."""
    unit = outlook.shown
    sentences = []
    for item in outlook.effects:
        if not item.found:
            sentences.append(
                f"{item.name}: the loop would find none of any size in this one recording; what is left out of it must "
                "show it too: record another one"
            )
            continue
        text = f"{item.name} of {number(item.found_from * unit.factor)} {unit.shown} or more would be found"
        sentences.append("; ".join([text, *_confusions(item)]))
    why = (
        f"this profile only ever {outlook.only}: it looks like a bend of the map"
        if outlook.only
        else "nothing shows it"
    )
    sentences += [f"{name}: is not seen at all; {why}" for name in outlook.silent]
    sentences += [f"{name} is held still: what follows it is not seen" for name in outlook.still]
    if not outlook.curve_known and any(item.effect.acts_on_input for item in outlook.effects):
        sentences.append("the curve is not known: what acts on its temperature is reckoned with one that bends")
    return sentences


def _confusions(item: Detectability) -> list[str]:
    """Return the effects that one is distinguished from, where it is not plain, when it is twice the smallest size."""
    nats = item.nats_found
    close = {name: share for name, share in item.left.items() if share < PLAINLY and name not in item.confused_with}
    parts = []
    if close:
        name, share = min(close.items(), key=lambda pair: pair[1])
        parts.append(f"distinguished from {name} by a log-likelihood of {_gain(share * nats)} of {_gain(nats)}")
    if item.confused_with:
        names = [f"{name} ({_gain(item.left[name] * nats)})" for name in item.confused_with]
        parts.append(f"not distinguished from {', '.join(names)} of a log-likelihood of {_gain(nats)}")
    return parts


def seen_lines(seen: Sequence[EffectEstimate], unit: BiasUnit) -> list[str]:
    """Return the sizes of effects in the recordings, as far as they are known."""
    sentences = []
    for item in seen:
        if not item.sigma < float("inf"):
            sentences.append(f"so far, {item.name}: not known, temperature has not turned back")
            continue
        size = f"{number(item.size * unit.factor)} ± {number(item.sigma * unit.factor)} {unit.shown}"
        word = "is in it, `driftlab explain` tells whether it is this" if item.sure else "not known yet"
        sentences.append(f"so far, {item.name}: {size} on {item.axis}, {word}")
    return sentences


def document(outlook: DetectabilityReport) -> list[dict[str, Any]]:
    """Return the effects as JSON holds them, sizes in the unit that is shown."""
    unit = outlook.shown

    def value(size: float) -> dict[str, Any] | None:
        return {"value": size * unit.factor, "unit": unit.shown} if size < float("inf") else None

    effects = [
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
    return [*effects, *silent]


def _gain(value: float) -> str:
    return f"{value:.1f}" if value < 10 else f"{value:.0f}"
