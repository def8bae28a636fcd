"""What the declared and the explained config predict of the holdout, which nothing was fitted to."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.filtering.run import Run
from driftlab.filtering.stretch import Journal, joined
from driftlab.judging.overview import overview_of
from driftlab.judging.summary import summarise
from driftlab.judging.yardsticks import moving_average
from driftlab.loop.evidence import Progress
from fusion_core.chunk import Array

PREDICTED = ("reference", "before", "after", "before_sigma", "after_sigma")


@dataclass(frozen=True)
class Outcome:
    """One holdout recording through both configs: N times, d axes, rad/s; the summaries are those of the runs."""

    name: str
    t: Array
    temperature: Array | None
    reference: Array
    before: Array
    after: Array
    before_sigma: Array
    after_sigma: Array
    summaries: tuple[dict[str, Any], dict[str, Any]]


def outcome_of(declared: Config, explained: Config, recording: str, progress: Progress) -> Outcome:
    """Run one holdout recording through both configs."""
    found, runs = [], []
    for what, config in (("declared", declared), ("explained", explained)):
        progress(f"running {recording} through the {what} config")
        journal = Journal()
        run = Run(with_recording(config, recording), journal)
        found.append(joined(run))
        runs.append((run, journal))
    first, second = found
    before, after = (
        summarise(overview_of(columns, run.model, journal.alignments[0]), run.model, journal)
        for columns, (run, journal) in zip((first, second), runs, strict=True)
    )
    reference = moving_average(first["t"], first["rate"], first["tau"], first["still"])
    coasting = np.isfinite(first["coast"][:, 0])
    t, old, old_sigma = (first[name][coasting] for name in ("t", "coast", "coast_sigma"))
    new, new_sigma = (second[name][coasting] for name in ("coast", "coast_sigma"))
    T = next((columns["temperature"][coasting] for columns in found if "temperature" in columns), None)
    return Outcome(recording, t, T, reference[coasting], old, new, old_sigma, new_sigma, (before, after))


def write_prediction(path: Path, outcomes: Sequence[Outcome]) -> None:
    """Write `prediction.h5`: a group for each holdout recording."""
    import h5py

    whole = io.BytesIO()  # HDF5 itself does not survive a full disk
    with h5py.File(whole, "w") as file:
        for outcome in outcomes:
            stem = Path(outcome.name.partition("::")[0]).stem
            name, k = stem, 2
            while name in file:
                name, k = f"{stem}_{k}", k + 1
            group = file.create_group(name)
            group.attrs["recording"] = Path(outcome.name).name
            columns = (
                ("t", outcome.t, "s"),
                *((n, getattr(outcome, n), "rad/s") for n in PREDICTED),
            )
            for column, values, unit in columns:
                group.create_dataset(column, data=values).attrs["unit"] = unit
            group["t"].attrs["first_row"] = outcome.summaries[0]["t"]["first_row_s"]
    path.write_bytes(whole.getbuffer())
