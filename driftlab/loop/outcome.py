"""What the declared and the explained config predict of a holdout recording, which nothing was fitted to."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from driftlab.units import BiasUnit
from fusion_core.chunk import Array


@dataclass(frozen=True)
class Outcome:
    """One holdout recording through both configs: N times, d axes, SI.

    `summaries` are those of the two runs, `remarks` what a user should know of the second.
    """

    name: str
    unit: BiasUnit
    t: Array
    temperature: Array | None
    reference: Array
    before: Array
    after: Array
    before_sigma: Array
    after_sigma: Array
    summaries: tuple[dict[str, Any], dict[str, Any]]
    remarks: tuple[str, ...]
