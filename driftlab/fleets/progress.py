"""How far a fleet is, for whoever shows it."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field


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


Progress = Callable[[Stage], None]


def duration(seconds: float) -> str:
    """Return a time as one says it: `45 s`, `12 min`, `3 h 20 min`."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"
