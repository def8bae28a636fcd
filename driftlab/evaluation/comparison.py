"""Several configs on one recording, by the paper's yardsticks and by coasting.

Tables 5 to 12 of Fontanella et al., Sensors 18 (2018) 1457. The reference of an estimate is the centred 30 s average
of the sensor that its filter was given: calibrated, where the config has a calibration, else raw. An initial error is
added to every axis of the bias at the end of the alignment, and the filter is not told of it: the paper's 15 deg/h of a
gyro, of another sensor about five deviations of what it reads on average over one second.

What is said of a comparison: in sentences, for the terminal, the page and the JSON alike, and as that JSON.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.evaluation import limits
from driftlab.evaluation.limits import LimitResult
from driftlab.evaluation.overview import Overview, overview_of
from driftlab.evaluation.ranking import said
from driftlab.evaluation.run_limits import averages_of, judged
from driftlab.evaluation.scores import LONGEST_FIRST, Scores, moving_average, rms_over_time
from driftlab.evaluation.summary import Rows, remarks, summarise
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from driftlab.units import BiasUnit, unit_of
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import Sensor
from fusion_core.errors import ConfigError, NotAtRest

OFFSET = float(np.deg2rad(15.0) / 3600)  # rad/s: the residual error of tables 7, 10 and 12
THRESHOLD = 1e-5  # rad/s: converged, in table 12
SPREAD = 5.0  # of the noise at 1 Hz: the initial error of another sensor than a gyro; the paper's is 4.7 of its own
SEGMENTS = 5  # tables 8 to 11

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class InitialError:
    """What is added to the bias, and how near it must come to have converged, both in SI."""

    unit: BiasUnit
    size: float = OFFSET
    threshold: float = THRESHOLD

    @property
    def texts(self) -> tuple[str, str]:
        """Both as one reads them."""
        if self.unit.si == "rad/s":
            return "15 deg/h", "1e-5 rad/s"
        factor, shown = self.unit.factor, self.unit.shown
        return f"{self.size * factor:.3g} {shown}", f"{self.threshold * factor:.3g} {shown}"


def initial_error(sensor: Sensor) -> InitialError:
    """Return the paper's initial error for a gyro, for another sensor one of its own noise."""
    unit = unit_of(sensor)
    if unit.si == "rad/s":
        return InitialError(unit)
    size = float(f"{SPREAD * float(np.max(sensor.noise)) * unit.factor:.0e}")  # one digit, as it is shown
    return InitialError(unit, size / unit.factor, size / unit.factor / 10)


@dataclass(frozen=True)
class Condition:
    """Errors of one config in one condition, in SI, one value an axis.

    Attributes
    ----------
    first, whole : (d,) arrays
        Rms over the first 30 s after the alignment, and the whole interval (tables 6 and 7).
    segments : (SEGMENTS, d) array
        Rms over each of five equal parts of the recording, each run on its own (tables 8 and 10); NaN where a part
        is too short to align in.
    convergence : (d,) array
        Time after the alignment at which the error is first below the threshold, s; NaN where it never is (table 12).
    estimates : dict of str to array
        The run (`Stretch.columns`).
    """

    first: Array
    whole: Array
    segments: Array
    convergence: Array
    estimates: Columns


@dataclass(frozen=True)
class Comparison:
    """One config: the accuracy of its reference (d,) (table 5), both conditions, the nominal run at a glance.

    `remarks` are what to know of it, `judged` the limits of the config, if it has any; `span` is the time from the end
    of the alignment to the end, s; `moving` and `refused` are from and to of where the unit moved, and of what was
    refused, s; `sensor` is the one whose bias it is, `initial` its error.
    """

    reference_residual: Array
    nominal: Condition
    offset: Condition
    overview: Overview
    remarks: tuple[str, ...]
    judged: tuple[LimitResult, ...]
    span: float
    moving: tuple[tuple[float, float], ...]
    refused: tuple[tuple[float, float], ...]
    sensor: Sensor
    initial: InitialError

    @property
    def yardsticks(self) -> Scores:
        """How the filter and its coast did."""
        return self.overview.yardsticks

    @property
    def first_row(self) -> float:
        """Time of the recording's first row, s."""
        return self.overview.first_row


def compare(configs: dict[str, Config], progress: Callable[[str], None] | None = None) -> dict[str, Comparison]:
    """Run every config on its source, nominal and with the initial error, whole and in segments.

    Raises
    ------
    DataError, ConfigError
        If a config cannot be run on the recording, or the configs are about different sensors.
    """
    found: dict[str, Comparison] = {}
    _check_alike(configs)
    for name, config in configs.items():
        # what the first is given all are given, whatever they take the noise for
        initial = next(iter(found.values())).initial if found else None
        found[name] = _compared(config, initial, partial(_report, progress, name))
    return found


def _check_alike(configs: dict[str, Config]) -> None:
    """Raise ConfigError where biases of different sensors would be in one table."""
    sensors = {name: config.filter.tracked for name, config in configs.items() if config.filter is not None}
    texts = {name: f"{sensor.channel} in {sensor.unit}" for name, sensor in sensors.items()}
    if len(set(texts.values())) > 1:
        each = ", ".join(f"{name}: {text}" for name, text in texts.items())
        raise ConfigError(f"the configs are about different sensors ({each}); compare configs of one sensor")


def _report(progress: Callable[[str], None] | None, name: str, what: str) -> None:
    if progress is not None:
        progress(f"{name}: {what}")


def _compared(config: Config, initial: InitialError | None, progress: Callable[[str], None]) -> Comparison:
    journal = RunLog()
    run = Run(config, journal)
    recording = concatenate(list(epochs(read(config, journal.faults), run.model.update_interval)))
    progress("nominal")
    initial = initial_error(run.model.tracked) if initial is None else initial
    nominal = _condition(config, recording, 0.0, initial.threshold, journal)
    progress("with an initial error")
    offset = _condition(config, recording, initial.size, initial.threshold, RunLog())
    rate = nominal.estimates["rate"] - nominal.estimates["calibration"]
    away = rate - _reference(nominal.estimates)
    known = away[np.all(np.isfinite(away), axis=1)]
    residual = np.abs(np.mean(known, axis=0)) if len(known) else np.full(rate.shape[1], np.nan)
    first = journal.alignments[0]
    averages = averages_of(config, first)
    overview = overview_of(nominal.estimates, run.model, first, first_row=journal.faults.first_row, averages=averages)
    notes = remarks(summarise(overview, run.model, journal), run.model)
    return Comparison(
        reference_residual=residual,
        nominal=nominal,
        offset=offset,
        overview=overview,
        remarks=tuple(notes),
        judged=tuple(judged(config, overview, first, averages)),
        span=overview.end - first.t,
        moving=tuple(journal.moving.spans),
        refused=tuple(journal.refused.spans),
        sensor=run.model.tracked,
        initial=initial,
    )


def _condition(config: Config, recording: Chunk, initial_error: float, threshold: float, journal: RunLog) -> Condition:
    estimates = joined(Run(config, journal, initial_error=initial_error).over([recording]))
    error = filter_error(estimates)
    t, start = estimates["t"], journal.alignments[0].t
    below = np.abs(error) < threshold
    first = np.array([t[np.argmax(column)] - start if np.any(column) else np.nan for column in below.T])
    cuts = np.linspace(0, len(recording), SEGMENTS + 1).astype(int)
    parts = [recording.part(int(a), int(b)) for a, b in pairwise(cuts)]
    segments = np.array([_segment(config, part, initial_error, error.shape[1]) for part in parts])
    whole = [rms_over_time(estimates, error, start, length) for length in (30.0, np.inf)]
    return Condition(whole[0], whole[1], segments, first, estimates)


def _segment(config: Config, part: Chunk, initial_error: float, d: int) -> Array:
    journal = RunLog()
    try:
        estimates = joined(Run(config, journal, initial_error=initial_error).over([part]))
    except NotAtRest:
        return np.full(d, np.nan)
    return rms_over_time(estimates, filter_error(estimates), journal.alignments[0].t)


def _reference(estimates: Columns) -> Array:
    rate = estimates["rate"] - estimates["calibration"]
    return moving_average(estimates["t"], rate, estimates["tau"], estimates["still"])


def filter_error(estimates: Columns) -> Array:
    """Return estimate less reference (N, d), SI; NaN up to the end of the alignment and without a reference."""
    error = estimates["bias"] - estimates["calibration"] - _reference(estimates)
    return np.where(np.isfinite(estimates["coast"]), error, np.nan)


def tables(found: dict[str, Comparison]) -> list[tuple[str, Rows]]:
    """Return the coast and then the paper's tables: a title, and rows of a label and the values (d,) of each config."""
    every = [c.yardsticks for c in found.values()]
    coast: list[tuple[str, list[Array]]] = []
    for name in LONGEST_FIRST:
        coast += [(f"coast, {name}", [y.coast[name] for y in every])]
        coast += [(f"sigma, {name}", [y.coast_sigma[name] for y in every])]
    return [("Coast error, and the deviation that it says it has (not in the paper)", coast), *paper(found)]


def paper(found: dict[str, Comparison]) -> list[tuple[str, Rows]]:
    """Return the paper's tables 5 to 11: a title, and rows of a label and the values (d,) of each config."""
    every = list(found.values())
    size, _ = every[0].initial.texts

    def segments(get: Callable[[Comparison], Condition]) -> Rows:
        rows = [(f"segment {k + 1}", [get(c).segments[k] for c in every]) for k in range(SEGMENTS)]
        mean = ("mean", [np.mean(get(c).segments, axis=0) for c in every])
        return [*rows, mean, ("deviation", [np.std(get(c).segments, axis=0, ddof=1) for c in every])]

    def whole(get: Callable[[Comparison], Condition]) -> Rows:
        return [("first 30 s", [get(c).first for c in every]), ("whole interval", [get(c).whole for c in every])]

    return [
        ("Residual of the 30 s average (table 5)", [("mean residual", [c.reference_residual for c in every])]),
        ("Rms error, nominal (table 6)", whole(lambda c: c.nominal)),
        (f"Rms error, {size} at the start (table 7)", whole(lambda c: c.offset)),
        ("Rms error of five segments, nominal (tables 8, 9)", segments(lambda c: c.nominal)),
        (f"Rms error of five segments, {size} at the start (tables 10, 11)", segments(lambda c: c.offset)),
    ]


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
