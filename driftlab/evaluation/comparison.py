"""The comparison of several configs on one recording: by the paper's scores and by prediction.

Tables 5 to 12 of Fontanella et al., Sensors 18 (2018) 1457. The reference of an estimate is the centred 30 s average
of the sensor that its filter was given: calibrated, where the config has a calibration, else raw. An initial error is
added to every axis of the bias at the end of the alignment, unknown to the filter: the paper's 15 deg/h of a
gyro, of another sensor about five deviations of what it reads on average over one second.

Ranking: the bias wanders from one recording to the next by about the sigma that a prediction states, and all configs
meet the same wandering: another recording may move any error by that much. So two configs differ where ::

    |e_a - e_b| > max(sigma_a, sigma_b)

with e the rms error and sigma the rms deviation of predictions over the same horizon: over all axes, and axis by axis.
Judged is the longest horizon that is known of all configs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from driftlab import __version__
from driftlab.config import Config
from driftlab.evaluation import limits
from driftlab.evaluation.overview import ScoredRun, scored
from driftlab.evaluation.scores import LONGEST_FIRST, Scores, moving_average, over_axes, rms_over_time
from driftlab.evaluation.summary import Rows, remarks
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from driftlab.units import BiasUnit, duration, listed, unit_of
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.contracts import FittedMap, Sensor
from fusion_core.errors import ConfigError, NotAtRest

OFFSET = float(np.deg2rad(15.0) / 3600)  # rad/s: the residual error of tables 7, 10 and 12
THRESHOLD = 1e-5  # rad/s: converged, in table 12
SPREAD = 5.0  # of the noise at 1 Hz: the initial error of another sensor than a gyro; the paper's is 4.7 of its own
SEGMENTS = 5  # tables 8 to 11
TO_THE_END = LONGEST_FIRST[0]
OFTEN = "10 min"  # reported beside the longest, where there are more
REFUTED = 2.0  # sigma: what is off by more says too little of itself

Columns = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class InitialError:
    """The error that is added to the bias, and how near it must come to have converged, both in SI."""

    unit: BiasUnit
    size: float = OFFSET
    threshold: float = THRESHOLD

    @property
    def texts(self) -> tuple[str, str]:
        """Both with their units."""
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
    """Errors of one config in one condition, in SI, one value an axis."""

    first: Array  # (d,) rms over the first 30 s after the alignment (tables 6 and 7)
    whole: Array  # (d,) rms over the whole interval
    # (SEGMENTS, d) rms over equal parts, each run on its own; NaN: too short to align in (tables 8 and 10)
    segments: Array
    # (d,) time after the alignment at which the error falls below the threshold, s; NaN: never (table 12)
    convergence: Array
    estimates: Columns  # the run (`RunSegment.columns`)


@dataclass(frozen=True)
class Comparison(ScoredRun):
    """One config: its nominal run, and its errors in both conditions.

    `reference_residual` (d,) is the accuracy of its reference (table 5), `initial` the error of the other condition,
    `terms` those of the sensor's model that are taken off by a map: `bias x`, `scale x`, `misalignment xy`.
    """

    reference_residual: Array
    nominal: Condition
    offset: Condition
    initial: InitialError
    terms: tuple[str, ...]

    @cached_property
    def remarks(self) -> tuple[str, ...]:
        """Remarks on the nominal run, a sentence each."""
        return tuple(remarks(self))


def compare(configs: dict[str, Config], progress: Callable[[str], None] | None = None) -> dict[str, Comparison]:
    """Run every config on its source, nominal and with the initial error, whole and in segments.

    Raises
    ------
    DataError, ConfigError
        If a config cannot be run on the recording, or the configs are about different sensors.
    """
    _check_alike(configs)
    runs: dict[str, Comparison] = {}
    for name, config in configs.items():
        # the first one's error is that of all, whatever they take the noise for
        initial = next(iter(runs.values())).initial if runs else None
        runs[name] = _compared(name, config, initial, progress or (lambda what: None))
    return runs


def _check_alike(configs: dict[str, Config]) -> None:
    """Raise ConfigError where biases of different sensors would be in one table."""
    sensors = {name: config.filter.tracked for name, config in configs.items() if config.filter is not None}
    texts = {name: f"{sensor.channel} in {sensor.unit}" for name, sensor in sensors.items()}
    if len(set(texts.values())) > 1:
        each = ", ".join(f"{name}: {text}" for name, text in texts.items())
        raise ConfigError(f"the configs are about different sensors ({each}); compare configs of one sensor")


def _compared(name: str, config: Config, initial: InitialError | None, progress: Callable[[str], None]) -> Comparison:
    run = Run(config, RunLog())
    recording = concatenate(list(epochs(read(config, run.journal.faults), run.model.update_interval)))
    progress(f"{name}: nominal")
    initial = initial_error(run.model.tracked) if initial is None else initial
    nominal = _condition(run, recording, 0.0, initial.threshold)
    progress(f"{name}: with an initial error")
    off = Run(config, RunLog(), initial_error=initial.size)
    offset = _condition(off, recording, initial.size, initial.threshold)
    rate = nominal.estimates["rate"] - nominal.estimates["calibration"]
    away = rate - _reference(nominal.estimates)
    known = away[np.all(np.isfinite(away), axis=1)]
    residual = np.abs(np.mean(known, axis=0)) if len(known) else np.full(rate.shape[1], np.nan)
    of_run, sensor = vars(scored(run, nominal.estimates)), run.model.tracked
    terms = _terms(run.plan.fitted, sensor)
    return Comparison(
        **of_run, reference_residual=residual, nominal=nominal, offset=offset, initial=initial, terms=terms
    )


def _terms(fitted: FittedMap | None, sensor: Sensor) -> tuple[str, ...]:
    """Return the terms of a sensor that its map takes off."""
    axes, matrix = sensor.axes, None if fitted is None else fitted.record.matrix
    bias = [] if fitted is None else [f"bias {axis}" for axis in axes]
    strain = None if fitted is None else fitted.record.sensitivity
    told = (np.zeros((3, 3)) if one is None else np.reshape(one.told, (3, 3)) for one in (matrix, strain))
    of_M, of_G = map(np.argwhere, told)
    scale = (f"scale {axes[i]}" if i == j else f"misalignment {axes[i]}{axes[j]}" for i, j in of_M)
    return (*bias, *scale, *(f"g-sensitivity {axes[i]}{axes[j]}" for i, j in of_G))


def _condition(run: Run, recording: Chunk, initial_error: float, threshold: float) -> Condition:
    estimates, error = _estimated(run, recording)
    t, start = estimates["t"], run.journal.alignments[0].t
    below = np.abs(error) < threshold
    first = np.array([t[np.argmax(column)] - start if np.any(column) else np.nan for column in below.T])
    cuts = np.linspace(0, len(recording), SEGMENTS + 1).astype(int)
    parts = [recording.part(int(a), int(b)) for a, b in pairwise(cuts)]
    segments = np.array([_segment(run.config, part, initial_error, error.shape[1]) for part in parts])
    whole = [rms_over_time(estimates, error, start, length) for length in (30.0, np.inf)]
    return Condition(whole[0], whole[1], segments, first, estimates)


def _segment(config: Config, part: Chunk, initial_error: float, d: int) -> Array:
    run = Run(config, RunLog(), initial_error=initial_error)
    try:
        estimates, error = _estimated(run, part)
    except NotAtRest:
        return np.full(d, np.nan)
    return rms_over_time(estimates, error, run.journal.alignments[0].t)


def _estimated(run: Run, samples: Chunk) -> tuple[Columns, Array]:
    """Return the estimates of a run, and their error."""
    estimates = joined(run.over([samples]))
    return estimates, filter_error(estimates)


def _reference(estimates: Columns) -> Array:
    rate = estimates["rate"] - estimates["calibration"]
    return moving_average(estimates["t"], rate, estimates["tau"], estimates["still"])


def filter_error(estimates: Columns) -> Array:
    """Return estimate less reference (N, d), SI; NaN up to the end of the alignment and without a reference."""
    error = estimates["bias"] - estimates["calibration"] - _reference(estimates)
    return np.where(np.isfinite(estimates["coast"]), error, np.nan)


def tables(runs: Mapping[str, Comparison]) -> list[tuple[str, Rows]]:
    """Return tables of predictions, then the paper's: a title, and rows of a label and values (d,) of each config."""
    scores = [run.yardsticks for run in runs.values()]
    coast: list[tuple[str, list[Array]]] = []
    for name in LONGEST_FIRST:
        coast += [(f"coast, {name}", [y.coast[name] for y in scores])]
        coast += [(f"sigma, {name}", [y.coast_sigma[name] for y in scores])]
    return [("Error of the prediction, and the deviation that it states (not in the paper)", coast), *paper(runs)]


def paper(runs: Mapping[str, Comparison]) -> list[tuple[str, Rows]]:
    """Return the paper's tables 5 to 11: a title, and rows of a label and the values (d,) of each config."""
    size, _ = next(iter(runs.values())).initial.texts
    conditions = {
        "nominal": [run.nominal for run in runs.values()],
        f"{size} at the start": [run.offset for run in runs.values()],
    }
    numbers = zip(conditions.items(), ("6", "7"), ("8, 9", "10, 11"), strict=True)
    whole: list[tuple[str, Rows]] = []
    parts: list[tuple[str, Rows]] = []
    for (name, each), table, segments in numbers:
        rows = [("first 30 s", [c.first for c in each]), ("whole interval", [c.whole for c in each])]
        whole.append((f"Rms error, {name} (table {table})", rows))
        rows = [(f"segment {k + 1}", [c.segments[k] for c in each]) for k in range(SEGMENTS)]
        rows.append(("mean", [np.mean(c.segments, axis=0) for c in each]))
        rows.append(("deviation", [np.std(c.segments, axis=0, ddof=1) for c in each]))
        parts.append((f"Rms error of five segments, {name} (tables {segments})", rows))
    residuals = [run.reference_residual for run in runs.values()]
    return [("Residual of the 30 s average (table 5)", [("mean residual", residuals)]), *whole, *parts]


def verdict(runs: Mapping[str, Comparison]) -> str:
    """Return the config that predicts best, and whether that is more than chance."""
    first, scores = next(iter(runs.values())), {name: run.yardsticks for name, run in runs.items()}
    return coast_verdict(scores, first.unit, min(run.span for run in runs.values()))


def limit_lines(runs: Mapping[str, Comparison]) -> list[str]:
    """Return the verdict on the limits of each config that has some, in a line."""
    return [f"{name}: {limits.verdict(run.judged)}" for name, run in runs.items() if run.judged]


def notes(runs: Mapping[str, Comparison]) -> list[str]:
    """Return the remarks, each with the name of its config; one that holds for all stands once.

    Where a map has scale factor and misalignment, the terms that each config takes off come first.
    """
    first, *others = [run.remarks for run in runs.values()]
    shared = [line for line in first if others and all(line in lines for lines in others)]
    single = [f"{name}: {line}" for name, run in runs.items() for line in run.remarks if line not in shared]
    moved = any(not term.startswith("bias") for run in runs.values() for term in run.terms)
    terms = [f"{name}: takes off {', '.join(run.terms) or 'no term'}" for name, run in runs.items() if moved]
    return [*terms, *(f"all: {line}" for line in shared), *single]


def as_json(runs: Mapping[str, Comparison], recording: str) -> dict[str, Any]:
    """Return the comparison for programs, in SI; the names of a rate's errors say so."""
    initial = next(iter(runs.values())).initial
    unit, rate = initial.unit, initial.unit.si == "rad/s"
    configs = {
        name: {
            unit.key("reference_residual"): run.reference_residual,
            "nominal": _condition_document(run.nominal, unit),
            "initial_error_15_deg_h" if rate else "initial_error": _condition_document(run.offset, unit),
            unit.key("coast_rmse"): run.yardsticks.coast,
            unit.key("coast_sigma"): run.yardsticks.coast_sigma,
            **({"coast_heading_error_rad": run.yardsticks.heading} if run.sensor.integral else {}),
            "share": run.yardsticks.share,
            "notes": run.remarks,
            "terms": run.terms,
            **({"limits": [row.as_json(unit) for row in run.judged]} if run.judged else {}),
        }
        for name, run in runs.items()
    }
    return {
        "schema": 1,
        "driftlab": __version__,
        "recording": recording,
        **unit.note,
        **({} if rate else {"initial_error": initial.size}),
        unit.key("threshold"): initial.threshold,
        "verdict": verdict(runs),
        "configs": configs,
    }


def _condition_document(condition: Condition, unit: BiasUnit) -> dict[str, Any]:
    return {
        unit.key("rmse_first_30_s"): condition.first,
        unit.key("rmse_whole"): condition.whole,
        unit.key("segments"): condition.segments,
        "convergence_s": condition.convergence,
    }


@dataclass(frozen=True)
class Axes:
    """The best config and the next compared axis by axis: names of axes."""

    better: tuple[str, ...]
    alike: tuple[str, ...]
    worse: tuple[str, ...]


@dataclass(frozen=True)
class Ranking:
    """The configs by the error of their predictions over one horizon."""

    horizon: str  # its name
    errors: dict[str, float]  # of each config, the smallest first: rms over the axes, SI
    sigmas: dict[str, float]  # rms over the axes of the deviation, SI
    best: tuple[str, ...]  # the config of the smallest error, and those that do not differ from it
    axes: Axes | None  # the first of `errors` against the next one; None without one, and of a single axis


def ranking(runs: Mapping[str, Scores], horizons: Sequence[str] = LONGEST_FIRST) -> Ranking | None:
    """Rank runs over the first of the horizons that is known of all; None where there is none."""
    for horizon in horizons:
        errors = {name: over_axes(y.coast[horizon]) for name, y in runs.items()}
        if np.all(np.isfinite(list(errors.values()))):
            break
    else:
        return None
    order = sorted(errors, key=errors.__getitem__)
    sigmas = {name: over_axes(runs[name].coast_sigma[horizon]) for name in order}
    first = order[0]
    best = [n for n in order if errors[n] - errors[first] <= max(sigmas[n], sigmas[first])]
    axes = _axes(runs[first], runs[order[1]], horizon) if len(order) > 1 and len(runs[first].axes) > 1 else None
    return Ranking(horizon, {name: errors[name] for name in order}, sigmas, tuple(best), axes)


def _axes(a: Scores, b: Scores, horizon: str) -> Axes:
    """Return the axes on which a is better than b, not different, and worse."""
    gain = b.coast[horizon] - a.coast[horizon]
    bound = np.maximum(a.coast_sigma[horizon], b.coast_sigma[horizon])
    better, alike, worse = (
        tuple(axis for axis, yes in zip(a.axes, which, strict=True) if yes)
        for which in (gain > bound, np.abs(gain) <= bound, gain < -bound)
    )
    return Axes(better, alike, worse)


def coast_verdict(runs: Mapping[str, Scores], unit: BiasUnit, span: float) -> str:
    """Return the config that predicts best, by how much, and whether it is more than the sigma.

    All are of one recording; `span` is from the end of the alignment to its end, s.
    """
    ranked = ranking(runs)
    if ranked is None:
        return "The config that predicts best is not known: too little of the recording is at rest after the alignment."
    text = _single(ranked, unit) if len(runs) == 1 else _several(ranked, unit)
    text = text.replace(TO_THE_END, f"{TO_THE_END} ({duration(span)})", 1)
    return text + _shorter(runs, ranked, span)


def _single(ranked: Ranking, unit: BiasUnit) -> str:
    ((name, error),) = ranked.errors.items()
    size = f"{unit.number(error)} {unit.shown}"
    return f"{name} predicts with an error of {size}, {ranked.horizon}; there is nothing to compare it with."


def _several(ranked: Ranking, unit: BiasUnit) -> str:
    """Return a sentence on several configs over the horizon of a ranking."""
    best = ranked.best
    over = "" if ranked.axes is None else " rms over the axes"
    values = {name: unit.number(value) for name, value in ranked.errors.items()}
    others = ", ".join(f"{name} {value}" for name, value in values.items() if name not in best) + f" {unit.shown}"
    if len(best) == 1:
        return (
            f"On this one recording {best[0]} predicts best: {ranked.horizon} {values[best[0]]} {unit.shown}{over}, "
            f"{others}; they differ by more than {_sigma(ranked, list(values)[:2], unit)}{_agree(ranked)}."
        )
    worse = f"; worse: {others}" if len(best) < len(values) else ""
    return (
        f"On this one recording no difference is proven between {listed(best)}: {ranked.horizon} "
        f"{listed([values[n] for n in best])} {unit.shown}{over}, "
        f"within {_sigma(ranked, best, unit)}{_disagree(ranked)}{worse}."
    )


def _sigma(ranked: Ranking, names: Sequence[str], unit: BiasUnit) -> str:
    """Return the sigma that the configs of these names differ by less or more than."""
    largest = max(names, key=ranked.sigmas.__getitem__)
    whose = f" of {largest}" if len({unit.number(ranked.sigmas[name]) for name in names}) > 1 else ""
    return f"the sigma{whose} ({unit.number(ranked.sigmas[largest])} {unit.shown})"


def _agree(ranked: Ranking) -> str:
    """Return the remarks on axes that rank the best otherwise than their rms, and on its sigma."""
    first, rival = list(ranked.errors)[:2]
    parts, axes = [], ranked.axes
    if axes is not None:
        parts = [f"not on {listed(axes.alike)}"] if axes.alike else []
        parts += [f"on {listed(axes.worse)} {rival} is better"] if axes.worse else []
    text = f", but {' and '.join(parts)}" if parts else "" if axes is None else ", and all axes agree"
    error, sigma = ranked.errors[first], ranked.sigmas[first]
    if error > REFUTED * sigma:
        text += f". Itself it is off by {error / sigma:.1f} times its sigma, which is too small to tell chance by"
    return text


def _disagree(ranked: Ranking) -> str:
    """Return on which axes the two smallest differ although their rms does not."""
    axes = ranked.axes
    if axes is None or not (axes.better or axes.worse):
        return ""
    pairs = zip(ranked.errors, (axes.better, axes.worse), strict=False)
    return f", but {' and '.join(f'{name} is better on {listed(on)}' for name, on in pairs if on)}"


def _shorter(runs: Mapping[str, Scores], ranked: Ranking, span: float) -> str:
    """Return the ranking over ten minutes beside that over the whole; empty where they are the whole."""
    short = ranking(runs, [OFTEN]) if ranked.horizon == TO_THE_END and span > 600.0 and len(runs) > 1 else None
    if short is None:
        return ""
    if set(short.best) == set(ranked.best):
        return f" Over {OFTEN} the same."
    if len(short.best) == 1:
        return f" Over {OFTEN} {short.best[0]} predicts best."
    return f" Over {OFTEN} none is proven between {listed(short.best)}."
