"""What is said of a comparison: in sentences, for the terminal, the page and the JSON alike, and as that JSON."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from driftlab import __version__
from driftlab.judging import limits
from driftlab.judging.ranking import said

if TYPE_CHECKING:
    from driftlab.judging.compare import Comparison, Condition


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


def as_json(found: dict[str, Comparison], recording: str) -> dict[str, Any]:
    """Return the comparison for programs, in SI; the names of a rate's errors say so."""
    initial = next(iter(found.values())).initial
    unit = initial.unit
    rate = unit.si == "rad/s"
    disturbed = "initial_error_15_deg_h" if rate else "initial_error"
    size = {} if rate else {"initial_error": initial.size}

    def condition(c: Condition) -> dict[str, Any]:
        return {
            unit.key("rmse_first_30_s"): c.first,
            unit.key("rmse_whole"): c.whole,
            unit.key("segments"): c.segments,
            "convergence_s": c.convergence,
        }

    configs = {
        name: {
            unit.key("reference_residual"): c.reference_residual,
            "nominal": condition(c.nominal),
            disturbed: condition(c.offset),
            unit.key("coast_rmse"): c.yardsticks.coast,
            unit.key("coast_sigma"): c.yardsticks.coast_sigma,
            **({"coast_heading_error_rad": c.yardsticks.heading} if c.sensor.integral else {}),
            "share": c.yardsticks.share,
            "notes": c.remarks,
            **({"limits": [row.as_json(unit) for row in c.judged]} if c.judged else {}),
        }
        for name, c in found.items()
    }
    head = {
        "schema": 1,
        "driftlab": __version__,
        "recording": recording,
        **unit.note,
        **size,
        unit.key("threshold"): initial.threshold,
    }
    head["verdict"] = verdict(found)
    return {**head, "configs": configs}
