"""`driftlab run`: a recording through a config, to files."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from driftlab import __version__
from driftlab.config import Config
from driftlab.outputs import EstimatesFile, output_folder, write_json
from driftlab.overview import Overview, survey
from driftlab.report import write_report
from driftlab.run import Run
from driftlab.summary import summarise
from driftlab.tracker import Journal


@dataclass(frozen=True)
class Result:
    """What a run leaves: the content of its files."""

    summary: dict[str, Any]
    overview: Overview


def run_to_folder(
    config: Config, out: Path, *, title: str, progress: Callable[[float, int], None] | None = None
) -> Result:
    """Run a config and write `estimates.h5`, `summary.json` and `report.html` into the folder `out`.

    Parameters
    ----------
    config : Config
        With the recording as its source.
    out : Path
        Folder; it appears when all files are whole.
    title : str
        Of the report.
    progress : callable, optional
        Called with the recording's time in s and the number of updates so far.

    Raises
    ------
    DataError, ConfigError
        If the recording cannot be used.
    """
    journal = Journal()
    run = Run(config, journal)
    text = config.as_yaml()
    with output_folder(out) as folder:
        file = EstimatesFile(folder / "estimates.h5", run.model, {"driftlab": __version__, "config": text})
        count = 0
        try:
            for stretch in run:
                file.append(stretch)
                count += len(stretch.epochs)
                if progress is not None:
                    progress(float(stretch.epochs.t[-1]), count)
        finally:
            file.close()
        overview = survey(folder / "estimates.h5", run.model, journal.alignments[0])
        summary = {
            "schema": 1,
            "driftlab": __version__,
            "recording": config.source.name if config.source else "",
            **summarise(overview, run.model, journal),
        }
        write_json(folder / "summary.json", summary)
        write_report(folder / "report.html", overview, summary, title=title, config=text, m=run.model.m)
    return Result(summary, overview)
