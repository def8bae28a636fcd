"""The tables of the loop's benchmark: one row a case, one line a group."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loop_cases.answer import Result


def ratios(result: Result, by_name: Mapping[str, Result]) -> tuple[float, float]:
    """Return the error after over that before, and over the yardstick: the bed's, or the oracle's."""
    bed = by_name.get(result.bed or "")
    yardstick = result.oracle if bed is None else bed.before
    return result.after / result.before, result.after / yardstick


def row_of(result: Result, by_name: Mapping[str, Result]) -> str:
    """Return a case in a line, for progress."""
    if result.error:
        return f"{result.name}: {result.error} ({result.seconds:.0f} s)"
    said = ", ".join(result.said) or "nothing added"
    score = f"named {_score(result)}, false {len(result.false)}"
    before, yardstick = (_ratio(r) for r in ratios(result, by_name))
    return f"{result.name}: {result.verdict}, {said}; {score}; {before} of before, {yardstick} of yardstick"


def _score(result: Result) -> str:
    text = f"{result.right}/{len(result.truths)}" if result.truths else ""
    return text + (f" ~{result.related}" if result.related else "")


def _ratio(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else ""


def print_rows(title: str, results: Sequence[Result]) -> None:
    """Print a table in Markdown; errors in 1e-6 rad/s."""
    by_name = {result.name: result for result in results}
    print(f"\n### {title}\n\nErrors in 1e-6 rad/s (of the ovens: ppm), the constant removed. Yardstick: the same with")
    print("nothing planted, or with the map declared, or an oracle that knows the truth. ~: named by a relative (right")
    print("channel and physics, another shape).\n")
    heads = ("group", "case", "in it", "verdict", "added", "named", "false", "before", "after", "after/before",
             "after/yardstick", "s")  # fmt: skip
    print("| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for result in results:
        in_it, seconds = ", ".join(result.truths) or "nothing", f"{result.seconds:.0f}"
        if result.error:
            score = f"0/{len(result.truths)}" if result.truths else ""
            cells = [in_it, "**failed**", result.error.replace("|", " "), score, "", "", "", "", "", seconds]
        else:
            errors = (f"{e * 1e6:.3g}" for e in (result.before, result.after))
            cells = [in_it, result.verdict, ", ".join(result.said), _score(result), ", ".join(result.false), *errors,
                     *(_ratio(r) for r in ratios(result, by_name)), seconds]  # fmt: skip
        print("| " + " | ".join((result.group, result.name, *cells)) + " |")


def print_groups(results: Sequence[Result]) -> None:
    """Print one line a group: how many were named, what was false, and how the errors compare."""
    by_name = {result.name: result for result in results}
    heads = ("group", "cases", "failed", "named", "by a relative", "false", "cases with false",
             "after/before: median, worst", "after/yardstick: median, worst", "s: median, worst")  # fmt: skip
    print("\n| " + " | ".join(heads) + " |\n" + "|---" * len(heads) + "|")
    for group in dict.fromkeys(result.group for result in results):
        own = [result for result in results if result.group == group]
        done = [result for result in own if not result.error]
        both = np.array([ratios(result, by_name) for result in done]).reshape(-1, 2)
        cells = [
            str(len(own)), str(len(own) - len(done)),
            f"{sum(r.right for r in own)}/{sum(len(r.truths) for r in own)}", str(sum(r.related for r in own)),
            str(sum(len(r.false) for r in own)), str(sum(bool(r.false) for r in own)),
            _spread(both[:, 0]), _spread(both[:, 1]), _spread(np.array([r.seconds for r in own])),
        ]  # fmt: skip
        print("| " + " | ".join((group, *cells)) + " |")


def _spread(values: np.ndarray) -> str:
    known = values[np.isfinite(values)]
    return f"{np.median(known):.2f}, {known.max():.2f}" if len(known) else ""
