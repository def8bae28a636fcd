"""The map of a unit, a prediction with it, and the figures that a line watches, each with its deviation.

The map is that of `fit-map` on the unit's soaks, held in memory by the config that the filter runs. A prediction is one
without a measurement. The figures are those of `driftlab.family.record.FIGURES`.

The residual is the rms of 30 s averages of the soak about the map. Its deviation is that from soak to soak: with
n averages whose noise has the covariance C after a curve was fitted to them, the mean square has the variance
2 tr(C^2) / n^2 about tr(C) / n, and most of it is the walk's. The curve is the family's basis. The swing is as sure as
the curve's change between its ends. One over T is as sure as its reference (`driftlab.evaluation.measurements`),
and the walk w of the density k that it happened to take has a mean square of which::

    E = k^2 T / 2,    Var = k^4 T^2 / 3

Squares of a walk are skew, of a few draws: their rms is taken for lognormal, sigma^2 = log(1 + Var / E^2) / 4 of its
logarithm, which for small Var / E^2 is what the derivative says. d axes.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from driftlab.commands.run import RunResult, run
from driftlab.commands.triad_map import TriadMapResult, fit_triad_map
from driftlab.config import Config, with_recording
from driftlab.evaluation.limits import SIDE
from driftlab.evaluation.measurements import coast_over, of_alignment, of_map
from driftlab.evaluation.scores import HORIZONS
from driftlab.family.record import Figure, RepeatedSoak, TermParabolas
from driftlab.family.repeatability import hysteresis_of, soaks_of
from driftlab.family.unit_noise import soaked_of
from driftlab.identification.config_edit import host_of, with_tracked
from driftlab.maps.assessment import MapVerdict
from driftlab.maps.fit import GatheredSoak, axes_of, fit_gathered, gather, usual_settings
from driftlab.maps.residual import AVERAGED
from driftlab.production.unit_terms import figures_of_terms
from driftlab.soak.blocks import means, runs
from driftlab.spc.charts import LEVEL
from driftlab.storage.json import plain
from driftlab.storage.ownership import seal
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.errors import FusionError
from fusion_core.faults import Faults
from fusion_core.units import bias_unit

if TYPE_CHECKING:
    from driftlab.evaluation.limits import Measured
    from driftlab.evaluation.scores import Scores
    from driftlab.family.unit_information import UnitInformation
    from driftlab.family.unit_noise import Densities
    from fusion_core.chunk import Array


@dataclass(frozen=True, eq=False)
class UnitMap:
    """The map of a unit."""

    config: Config  # with the map in memory, where its filter can use it
    settings: ThermalMap  # of its fit
    soak: GatheredSoak  # the samples
    verdict: MapVerdict
    triad: TriadMapResult | None = None  # its terms, where it has a stimulus

    @property
    def fitted(self) -> FittedMap:
        """The map itself."""
        return self.verdict.map

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of its axes."""
        return axes_of(self.fitted)

    @property
    def bias_unit(self) -> BiasUnit:
        """The unit in which its bias is shown."""
        return tracked_unit(self.config.filter)

    @property
    def file(self) -> str:
        """Name of its file in the folder of the unit."""
        return f"map{self.settings.suffix}"

    @property
    def lenient(self) -> Config:
        """The config for a recording that the map was not fitted on: beyond its domain the map is clamped.

        Its thermometer's noise alone takes a recording of the same chamber a few millikelvin beyond it.
        """
        if self.settings.outside != "refuse":
            return self.config
        return _with_map(self.config, self.settings.model_copy(update={"outside": "clamp"}), self.fitted)

    def terms(self) -> dict[str, Figure]:
        """Return its scale factors and misalignments; empty without a stimulus."""
        return {} if self.triad is None else figures_of_terms(self.triad.fit)

    def parabolas(self) -> TermParabolas | None:
        """Return them as its family takes them; None without a stimulus over temperature."""
        fit = None if self.triad is None else self.triad.fit
        if fit is None or fit.parabolas is None:
            return None
        c, covariance = fit.parabolas
        return TermParabolas(T=fit.domain, c=c, covariance=covariance)

    def sentences(self) -> list[str]:
        """Return the verdict on it in sentences, and what its stimulus does not tell."""
        return [*self.verdict.sentences(self.bias_unit), *([] if self.triad is None else self.triad.lines())]

    def content(self) -> bytes:
        """Return the content of its file."""
        return file_content(self.fitted, self.file)


def file_content(fitted: FittedMap, name: str) -> bytes:
    """Return the content of a map's file of some name, with its SHA-256 where it has a place for that."""
    in_memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # it waits for no disk to be read back
    with tempfile.TemporaryDirectory(prefix="driftlab-", dir=in_memory) as folder:
        path = Path(folder, name)
        fitted.save(path)
        seal(path)
        return path.read_bytes()


def fit_unit_map(config: Config, soaks: Sequence[str], faults: Faults, stimulus: Sequence[str] = ()) -> UnitMap:
    """Fit the map that a config names, or the usual one, on soaks; raises as `fit-map`.

    With recordings of a stimulus it has scale factor and misalignment beside the bias of the soaks.
    """
    settings = usual_settings(config, faults)
    soak = gather(config, soaks, faults, keep=True)
    fitted = fit_gathered(config, settings, soak, of_both_ways=True)
    triad = None
    if stimulus:
        with_bias = _with_map(config, settings, fitted)
        triad = fit_triad_map(with_bias, stimulus, "scale,misalignment", None, None, None)
        fitted = triad.map
        for text in triad.faults.doubts:
            faults.doubt(f"its stimulus: {text}")
    verdict = MapVerdict(fitted, settings, soak.summary, soak.placements, soak.used, faults.doubts, soak.memory)
    return UnitMap(_with_map(config, settings, verdict.map), settings, soak, verdict, triad)


def _with_map(config: Config, settings: ThermalMap, fitted: FittedMap) -> Config:
    """Return the config with the map in the place of the one that it names, or else in its bias model.

    Raises ConfigError where it names none and its bias model follows none.
    """
    if config.filter is None:
        return config
    loaded, tracked = settings.with_fitted(fitted), config.filter.tracked
    if tracked.calibration is not None:
        return with_tracked(config, calibration=loaded)
    with bias_unit(tracked.unit):
        return with_tracked(config, bias=host_of(tracked.bias).model_copy(update={"map": loaded}))


@dataclass(frozen=True, eq=False)
class CoastResult:
    """A run, and its prediction."""

    name: str  # of the recording
    in_sample: bool  # whether the map was fitted on it
    figures: dict[str, Figure]  # the coasts
    limits: list[dict[str, Any]]  # those of the config, checked against run and map
    notes: list[str]
    doubts: list[str]  # whether the recording is what its config says
    result: RunResult | None  # None where the config has no filter


def coasted(unit: UnitMap, tests: Sequence[str], soaks: Sequence[str], walk: Array) -> CoastResult:
    """Run the filter with a unit's map on its tests, or else on its first soak; of several tests the worst counts.

    A test in doubt is worse than any other.

    `walk` (d,) is the density of its bias, SI/sqrt(s).

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used.
    """
    if unit.config.filter is None:
        nothing = Figure.of(np.full(len(unit.axes), np.nan), np.full(len(unit.axes), np.nan))
        figures = dict.fromkeys(NAMES.values(), nothing)
        return CoastResult("", in_sample=False, figures=figures, limits=[], notes=[], doubts=[], result=None)
    config = unit.lenient if tests else unit.config
    name, result = max(((name, run(with_recording(config, name))) for name in tests or soaks[:1]), key=_badness)
    of_run = result.run
    noise = of_alignment(of_run.sensor, of_run.alignment, of_run.model.align)
    coasts = coasts_of(of_run.yardsticks, of_run.span, noise.values, walk)
    limits = plain([row.as_json(unit.bias_unit) for row in result.judged])
    return CoastResult(name, not tests, coasts, limits, result.lines(), of_run.doubts, result)


def _badness(one: tuple[str, RunResult]) -> tuple[bool, float]:
    """Return True first of a run in doubt, then the largest error of prediction over ten minutes, or a shorter time."""
    scores = (one[1].run.yardsticks.coast[horizon] for horizon in ("10 min", "5 min", "1 min"))
    known = next((values for values in scores if np.any(np.isfinite(values))), np.zeros(1))
    return bool(one[1].run.doubts), float(np.nanmax(known))


NAMES = {"1 min": "coast_1min", "5 min": "coast_5min", "10 min": "coast", "to the end": "coast_end"}
MAX_AVERAGES = 300  # whose covariance is computed


def figures_of(fitted: FittedMap, soaked: UnitInformation, densities: Densities) -> dict[str, Figure]:
    """Return the figures of map and soak."""
    measured = of_map(fitted)
    return {
        "residual": Figure.of(measured["residual"].values, residual_sigma(measured["residual"].values, soaked)),
        "noise": Figure.of(densities.white, densities.white_sigma),
        "walk": Figure.of(densities.walk, densities.walk_sigma),
        "swing": Figure.of(measured["swing"].values, _sigma(measured["swing"])),
        "hysteresis": hysteresis_of(soaked.recordings, densities.white, densities.likely, soaked.knots.step),
        "soaks": soaks_of(soaked.recordings, soaked.knots.step),
    }


SAME = 0.9  # of the range of the widest soak, that another must cover to repeat it


def repeated(config: Config, soaks: Mapping[str, str], tests: Sequence[str]) -> tuple[list[RepeatedSoak], list[str]]:
    """Return each soak of a unit by itself, where two or more are over the same range, and notes.

    `soaks` are paths by name; a soak over another range repeats none. The level is over the range that they share.
    """
    units, notes = dict[str, UnitMap](), list[str]()
    for name, soak in soaks.items():
        try:
            units[name] = fit_unit_map(config, [soak], Faults())
        except FusionError as error:
            notes.append(f"no figures of {name} by itself: {error}")
    ranges = {name: unit.fitted.domain for name, unit in units.items()}
    low, high = max(ranges.values(), key=lambda one: one[1] - one[0], default=(0.0, 0.0))
    same = [n for n, (a, b) in ranges.items() if min(b, high) - max(a, low) >= SAME * (high - low)]
    if len(same) < 2:
        return [], notes
    T = np.linspace(max(ranges[name][0] for name in same), min(ranges[name][1] for name in same), 25)
    result = []
    for place, (name, soak) in enumerate(soaks.items()):
        if name not in same:
            continue
        unit = units[name]
        soaked, densities = soaked_of(name, unit.axes, unit.soak.rows(unit.fitted.record.channel))
        level = unit.fitted.bias(T).mean(axis=0)
        own = {**figures_of(unit.fitted, soaked, densities), LEVEL: Figure.of(level, np.full(len(level), np.nan))}
        try:
            own |= coasted(unit, tests, [soak], soaked.walk).figures
        except FusionError as error:
            notes.append(f"no prediction of {name} by itself: {error}")
        result.append(RepeatedSoak(name=name, place=place, figures=own))
    return result, notes


def coasts_of(yardsticks: Scores, length: float, noise: Array, walk: Array) -> dict[str, Figure]:
    """Return the errors of prediction of a run.

    `length` is that after the alignment, s, `noise` and `walk` (d,) the densities of white noise and walk.
    """
    coasts = {}
    for horizon in HORIZONS:
        measured = coast_over(horizon, yardsticks, length, noise)
        known = not measured.missing
        values = measured.values if known else np.full(len(measured.axes), np.nan)
        walked = np.minimum(walk**2 * min(HORIZONS[horizon], length) / 2, values**2)  # a map fitted on it took the rest
        positive = np.where(values > 0, values, np.nan)
        spread = 4 * (_sigma(measured) / positive) ** 2 + 4 / 3 * (walked / positive**2) ** 2 if known else values
        coasts[NAMES[horizon]] = Figure.of(values, _rms_sigma(values, spread))
    return coasts


def _sigma(measured: Measured) -> Array:
    if measured.low is None or measured.high is None:
        return np.full(len(measured.axes), np.nan)
    return np.asarray((measured.high - measured.low) / (2 * SIDE))


def _rms_sigma(rms: Array, spread: Array) -> Array:
    """Return the deviation (d,) of a rms (d,) of which the mean square has so large a variance over its square (d,)."""
    return np.asarray(rms * np.sqrt(np.log1p(spread)) / 2)


def residual_sigma(residual: Array, soaked: UnitInformation) -> Array:
    """Return the deviation (d,) from soak to soak of the residual (d,) of a unit."""
    rows = soaked.recordings
    n = sum(float(np.sum(part.span)) for part in rows) / AVERAGED
    count = sum(len(part.T) for part in rows)
    size = max(round(AVERAGED * count / (n * AVERAGED)), -(-count // MAX_AVERAGES), 1)
    parts = [runs([0], len(part.T), size) for part in rows]
    T = np.concatenate([means(part.T, cuts) for part, cuts in zip(rows, parts, strict=True)])
    Q = np.linalg.svd(soaked.knots.values(T), full_matrices=False)
    U = Q[0][:, Q[1] > 1e-6 * Q[1][0]]
    walks, at = np.zeros((len(T), len(T))), 0
    for part, cuts in zip(rows, parts, strict=True):
        t = part.t[cuts] - part.t[0]
        walks[at : at + len(t), at : at + len(t)] = np.minimum(t[:, None], t[None, :])
        at += len(t)
    walks = walks - U @ (U.T @ walks)
    walks = walks - (walks @ U) @ U.T
    white, walk = soaked.white**2 / AVERAGED, soaked.walk**2
    share, K = max(1 - U.shape[1] / len(T), 0.0), len(T)
    squares = white**2 * share / n + 2 * white * walk * np.trace(walks) / (n * K) + walk**2 * np.sum(walks**2) / K**2
    mean = white * share + walk * np.trace(walks) / K
    # a share of the residual: how large the walk is, a soak knows no better than it knows the residual
    return _rms_sigma(residual, 2 * squares / np.maximum(mean, np.finfo(float).tiny) ** 2)
