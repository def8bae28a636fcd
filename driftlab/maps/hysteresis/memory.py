"""The answer to whether a bias remembers which temperatures came before: seen, none larger than X, or undecided."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from fusion_core.chunk import Array

Answer = Literal["seen", "none", "undecided"]


@dataclass(frozen=True, eq=False)
class Memory:
    """What a soak says of memories, in SI; d axes.

    Attributes
    ----------
    answer : str
        "seen", "none" (larger than `none_larger_than`), or "undecided" (cannot be told on this soak).
    kinds : tuple of str
        Kinds of effects that the soak cannot tell from one another, the likeliest first; empty unless seen.
    size, sigma : (d,) arrays
        Warming less cooling where it is largest, and its standard deviation; NaN where it is unknown.
    none_larger_than : (d,) array
        What this soak would have shown with 95 %: of up less down, where it is largest; infinite where it is unknown.
    where : (d,) array
        Temperature of the largest difference, degC; NaN where it is unknown.
    why : str
        What the answer stands on; where it is undecided, which soak would tell.
    T, difference, spread : (G,), (G, d) and (G, d) arrays
        Warming less cooling over temperature, and its standard deviation; empty unless seen.
    """

    answer: Answer
    kinds: tuple[str, ...]
    size: Array
    sigma: Array
    none_larger_than: Array
    where: Array
    why: str
    T: Array = field(default_factory=lambda: np.empty(0))
    difference: Array = field(default_factory=lambda: np.empty((0, 0)))
    spread: Array = field(default_factory=lambda: np.empty((0, 0)))

    @classmethod
    def unknown(cls, d: int, why: str) -> Memory:
        """Return that nothing can be told on d axes, and why."""
        nothing = np.full(d, np.nan)
        return cls("undecided", (), nothing, nothing, np.full(d, np.inf), nothing, why)

    def as_json(self) -> dict[str, Any]:
        """Return it for programs, in SI; null where a number is unknown."""
        numbers = ("size", "sigma", "none_larger_than")
        found = {name: [_finite(value) for value in getattr(self, name)] for name in numbers}
        where = [_finite(value) for value in self.where]
        return {"answer": self.answer, "kinds": list(self.kinds), **found, "at_degC": where, "why": self.why}


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
