"""The chamber profile that tells most, before anything is recorded: `driftlab plan`."""

from __future__ import annotations

from collections.abc import Callable, Collection
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from driftlab.config import Config
from driftlab.results import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftlab.planning.search import Found


class PlanResult(Result):
    """A plan: `time` and `set_point` (M,) of the chosen profile, `temperature` (G,) and `sigma` (G, d) of its map.

    Attributes
    ----------
    found : Found
        Every profile that was judged, the chosen one first, and the Pareto curve.
    headline : str
        What to do, in a sentence.
    written : tuple of Path
        The files that were written.
    """

    def __init__(self, found: Found) -> None:
        self.found = found
        self.written: tuple[Path, ...] = ()

    @property
    def headline(self) -> str:
        """What to do, in a sentence."""
        raise NotImplementedError

    def plot(self) -> Figure:
        """Draw the profile, the expected sigma, and hours against sigma."""
        raise NotImplementedError

    def save(self, out: str | PathLike[str]) -> None:
        """Write `plan.json`, `setpoints.csv` and `report.html` into the folder `out`."""
        raise NotImplementedError


def plan(
    config: Config,
    hours: float = 8.0,
    *,
    range: str | tuple[float, float] | None = None,
    rate: str | None = None,
    lag: str | None = None,
    start: str | None = None,
    walk: str | None = None,
    sigma: str | None = None,
    kind: str | None = None,
    out: Path | None = None,
    progress: Callable[..., None] | None = None,
    read: Collection[Path] = (),
) -> PlanResult:
    """Find the chamber profile of `hours` that tells most of the config's map."""
    raise NotImplementedError
