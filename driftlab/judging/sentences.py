"""What is said of a comparison, for the terminal, the page and the JSON alike."""

from __future__ import annotations

from typing import TYPE_CHECKING

from driftlab.judging import limits
from driftlab.judging.ranking import said

if TYPE_CHECKING:
    from driftlab.judging.compare import Comparison


def verdict(found: dict[str, Comparison]) -> str:
    """Return who coasts best, and whether that is more than chance."""
    unit = next(iter(found.values())).initial.unit
    return said({name: c.yardsticks for name, c in found.items()}, unit, min(c.span for c in found.values()))


def limit_lines(found: dict[str, Comparison]) -> dict[str, str]:
    """Return, of each config that has limits, whether it keeps them, in a line."""
    return {name: limits.verdict(c.judged) for name, c in found.items() if c.judged}


def notes(found: dict[str, Comparison]) -> list[str]:
    """Return what one should know, each with the name of its config; what is true of all is said once."""
    every = [c.remarks for c in found.values()]
    shared = [line for line in every[0] if len(every) > 1 and all(line in remarks for remarks in every)]
    own = [f"{name}: {line}" for name, c in found.items() for line in c.remarks if line not in shared]
    return [*(f"all: {line}" for line in shared), *own]
