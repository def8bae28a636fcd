"""One holdout recording, opened last, through the declared and the explained config."""

from __future__ import annotations

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.evaluation.limits import Measured
from driftlab.evaluation.measurements import of_alignment, of_coast
from driftlab.evaluation.overview import Overview, overview_of
from driftlab.evaluation.scores import moving_average
from driftlab.evaluation.summary import remarks, summarise
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.identification.records import Progress
from driftlab.identification.result import Outcome
from driftlab.units import tracked_unit


def outcome_of(
    declared: Config, explained: Config, recording: str, progress: Progress
) -> tuple[Outcome, tuple[dict[str, Measured], dict[str, Measured]]]:
    """Run one holdout recording through both configs; return what they predict, and what of each is limited."""
    found, runs = [], []
    for what, config in (("declared", declared), ("explained", explained)):
        progress(f"running {recording} through the {what} config")
        journal = RunLog()
        run = Run(with_recording(config, recording), journal)
        found.append(joined(run))
        runs.append((run, journal))
    first, second = found
    overviews = [
        overview_of(columns, run.model, journal.alignments[0])
        for columns, (run, journal) in zip((first, second), runs, strict=True)
    ]
    before, after = (
        summarise(overview, run.model, journal) for overview, (run, journal) in zip(overviews, runs, strict=True)
    )
    reference = moving_average(first["t"], first["rate"], first["tau"], first["still"])
    coasting = np.isfinite(first["coast"][:, 0])
    t, old, old_sigma = (first[name][coasting] for name in ("t", "coast", "coast_sigma"))
    new, new_sigma = (second[name][coasting] for name in ("coast", "coast_sigma"))
    outcome = Outcome(
        recording,
        tracked_unit(declared.filter),
        t,
        next((columns["temperature_raw"][coasting] for columns in found if "temperature_raw" in columns), None),
        reference[coasting],
        old,
        new,
        old_sigma,
        new_sigma,
        (before, after),
        tuple(remarks(overviews[1], runs[1][0].model, runs[1][1])),
    )
    old_limited, new_limited = (_limited(overview, *pair) for overview, pair in zip(overviews, runs, strict=True))
    return outcome, (old_limited, new_limited)


def _limited(overview: Overview, run: Run, journal: RunLog) -> dict[str, Measured]:
    """Return what of a run has limits."""
    alignment = journal.alignments[0]
    noise = of_alignment(run.model.tracked, alignment, run.model.align)
    return {"noise": noise, "coast": of_coast(overview.yardsticks, overview.end - alignment.t, run.model.align)}
