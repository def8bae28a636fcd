"""What `explain` finds, as arrays; its files are made in a folder of the system's, and kept in memory."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.config import Config, paths_of
from driftlab.identification.result import Identification
from driftlab.jobs.explain import explain
from driftlab.results import Result
from driftlab.storage.folders import output_folder

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from driftlab.identification.records import Progress

PREDICTED = ("reference", "before", "after", "before_sigma", "after_sigma")


class ExplainResult(Result):
    """What was missing: the verdict, the new config, and what both models predict of the holdout.

    Arrays are those of `prediction.h5`, one holdout recording after the other: `t` (N,), `reference`, `before`,
    `after`, `before_sigma`, `after_sigma` (N, d), and `recording` (N,), the number of the recording.

    Attributes
    ----------
    verdict : str
        `explained`, `nothing_missing`, `unexplained`, `ambiguous` or `refuted`.
    config : str
        The new config, as YAML; the map that it names is among the files that `save` writes.
    closed : Closed
        Everything that the loop found.
    """

    def __init__(self, closed: Identification, files: dict[str, bytes], read: Collection[Path]) -> None:
        self.closed, self.verdict, self.summary = closed, closed.verdict.word, closed.content
        self.config = files["explained.yaml"].decode()
        self._files, self._read = files, read
        outcomes = closed.outcomes
        self.name = f"{self.verdict.replace('_', ' ')}, judged on {', '.join(o.name for o in outcomes)}"
        self._columns = {name: np.concatenate([getattr(o, name) for o in outcomes]) for name in ("t", *PREDICTED)}
        self._columns["recording"] = np.repeat(np.arange(len(outcomes)), [len(o.t) for o in outcomes])
        self.units = {"t": "s", **dict.fromkeys(PREDICTED, closed.search.columns.evidence.unit.si)}
        self.labels = dict.fromkeys(PREDICTED, tuple(closed.search.columns.evidence.axes))

    def lines(self) -> list[str]:
        """Return what was found, a sentence each."""
        return list(self.closed.lines)

    def plot(self, k: int = 0) -> Figure:
        """Draw the prediction of the k-th holdout recording, before and after, and its errors."""
        from driftlab.reports.explain import prediction_chart
        from driftlab.reports.figures import figure_of

        return figure_of(prediction_chart(self.closed.outcomes[k], self.closed.search.columns.evidence.axes))

    def save(self, out: str | PathLike[str]) -> None:
        """Write the files of `driftlab explain` into the folder `out`."""
        with output_folder(Path(out), "explain", self._read) as folder:
            for name, content in self._files.items():
                (folder / name).write_bytes(content)


def explained(
    config: Config,
    recordings: Mapping[str, Sequence[str]],
    out: Path | None,
    progress: Progress | None,
    *,
    estimate: bool = False,
    without: Collection[str] = (),
    read: Collection[Path] = (),
) -> ExplainResult:
    """Close the loop on the recordings for `calibration`, `train` and `holdout`; the rest is as that of `explain`."""
    used = [*read, *config.files(), *(path for names in recordings.values() for path in paths_of(names))]
    show = progress or (lambda text: None)
    with TemporaryDirectory(prefix="driftlab-") as scratch:
        folder = Path(scratch) / "explained" if out is None else out
        how: dict[str, Any] = {**recordings, "estimate": estimate, "without": without, "read": read}
        closed = explain(config, out=folder, progress=show, **how)
        return ExplainResult(closed, {path.name: path.read_bytes() for path in sorted(folder.iterdir())}, used)
