"""Uncertainty budgets of bias, scale factor and misalignment over temperature, after the GUM (JCGM 100:2008).

The measurand is the bias b(T) of a unit at rest where its thermometer reads T, in the mean of warming and cooling, with
the level that it had in the mean over the soak. It is read off the fitted map; its sources are taken for independent::

    u(T)^2 = sum_i u_i(T)^2,    U(T) = k u(T),    k = 2,    about 95 % of a normal law

- *curve* (A): white noise and walk of the soak in the curve, what smoothing takes of it, misfits and holes: the modes
  of the map (`fusion_core.thermal.curve_error`), which know no level;
- *mean* (A): noise of the level, s / sqrt(n) of n samples with the deviation s about the curve; a curve that a stimulus
  shows together with M knows its level, and has none;
- *memory* (A): half of the difference D between warming and cooling, as probable as a memory is: sqrt(p E[D^2]) / 2,
  where D is largest;
- *power-ups* (A): the level from one recording to the next, of r >= 3 recordings with the deviation s:
  s sqrt(1 + 1/r) t(r - 1) / k, so that k = 2 covers as much as Student's law says; of a stimulus that of its fit;
- *placements* (A): the level of a triad in a field of known length (`driftlab.soak.placements`);
- *thermometer* (B): |db/dT| U_T / 2 for a thermometer whose expanded uncertainty U_T is given.

A term of M(T) of a triad has the uncertainty of its fit to a stimulus, by its parts where the fit is at hand:

- *equations* (A): noise of the segments or placements, and the walk of the bias between them;
- *choice* (A): a change over temperature that did not show, and the walks that are likely;
- *input* (B): the size of the input, as of gravity; the same in all scale factors;
- *stimulus* (A): all of these together, as the map's file keeps them.

Source: JCGM 100:2008, 4.2, 4.3, 5.1.2, 6.2 and G.3. N temperatures, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from driftlab.evaluation.limits import SIDE, Measured
from driftlab.soak.blocks import SoakSummary
from driftlab.soak.placements import Placements
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, MapRecord, TriadMatrix
from fusion_core.contracts.stimulus import PAIRS

K = 2.0  # coverage factor
COVERED = 0.9545  # of a normal law within K deviations
MIN_RECORDINGS = 3  # of two, a deviation is known to a factor of ten
MAX_ROWS, MATRIX_ROWS = 9, 5  # temperatures of a table, of bias and of M
STEPS = (1.0, 2.0, 2.5, 5.0, 10.0, 20.0, 25.0, 50.0, 100.0, 200.0)  # K, between them
NEAR = 0.4  # of a step: a round temperature so near to an end of the domain is left out


@dataclass(frozen=True, eq=False)
class UncertaintySource:
    """One source of a budget."""

    name: str  # `curve`, `mean`, ... as above
    kind: str  # of its evaluation: `A` by the observations, `B` otherwise
    u: Array  # (N, d): its standard uncertainty, SI


@dataclass(frozen=True, eq=False)
class UncertaintyBudget:
    """Quantities at temperatures, their sources of uncertainty, and those that are not known."""

    T: Array  # (N,), degC
    values: Array  # (N, d), SI: the bias of each axis, or the terms of M
    sources: Sequence[UncertaintySource]  # empty where the uncertainty is not known
    missing: Sequence[str] = ()  # what U does not cover, in sentences

    @property
    def u(self) -> Array | None:
        """Combined standard uncertainty (N, d), SI; None where it is not known."""
        return np.sqrt(sum(source.u**2 for source in self.sources)) if self.sources else None

    @property
    def U(self) -> Array | None:
        """Expanded uncertainty (N, d), SI; None where it is not known."""
        return None if self.u is None else K * self.u


def bias_budget(
    fitted: FittedMap,
    *,
    thermometer: float | None = None,
    soak: SoakSummary | None = None,
    placements: Placements | None = None,
    level: float = 0.0,
) -> UncertaintyBudget:
    """Return the budget of a fitted map at round temperatures of its domain, and at the ends of what was not recorded.

    `thermometer` is the expanded uncertainty of the thermometer, K. What a map's file does not keep, the power-ups of
    a soak of several recordings and placements, is in the budget where it is given; `level` is how far the level
    differs from one recording of a stimulus to another, 0 where it is not known.
    """
    record, error = fitted.record, fitted.record.error
    T = temperatures(*fitted.domain, holes=error.holes if error is not None else ())
    bias, shape = fitted.bias(T), (len(T), record.d)
    if error is None:
        return UncertaintyBudget(T, bias, [], ["anything: this kind of map does not say how sure its curve is"])
    sources = [UncertaintySource("curve", "A", fitted.sigma(T))]
    missing = [f"the curve between {low:.4g} and {high:.4g} °C: there is no sample" for low, high in error.holes]
    if record.samples and record.residual is not None:
        mean = np.broadcast_to(np.asarray(record.residual) / np.sqrt(record.samples), shape)
        sources += [] if _knows_its_level(record) else [UncertaintySource("mean", "A", mean)]
    else:
        missing.append("the noise of the level: the map's file does not say its samples")
    half, unknown = _memory(fitted)
    if half is None:
        missing.append(f"a hysteresis or lag, of which nothing is known: {unknown}")
    else:
        sources.append(UncertaintySource("memory", "A", np.broadcast_to(half, shape)))
    if placements is not None:
        own, across = _level(placements)
        sources.append(UncertaintySource("placements", "A", np.broadcast_to(own, shape)))
        missing += across
    ups = None if soak is None or placements is not None else power_ups(fitted, soak)
    ups = np.full(record.d, level) if level else ups
    if ups is None:
        missing.append("the level after another power-up: it was not measured (three recordings or more measure it)")
    else:
        sources.append(UncertaintySource("power-ups", "A", np.broadcast_to(ups, shape)))
    if thermometer is None:
        missing.append("the error of the thermometer: T is its reading")
    else:
        sources.append(UncertaintySource("thermometer", "B", np.abs(fitted.slope(T)) * thermometer / K))
    return UncertaintyBudget(T, bias, sources, missing)


def matrix_budget(
    matrix: TriadMatrix,
    *,
    thermometer: float | None = None,
    parts: Callable[[Array], Mapping[str, Array]] | None = None,
) -> UncertaintyBudget:
    """Return the budget of scale factor and misalignment at a few round temperatures, M row by row.

    `thermometer` is the expanded uncertainty of the thermometer, K; `parts` returns the deviations (N, 9) at T (N,) of
    a fit that is at hand, by source.
    """
    low, high = matrix.T[0], matrix.T[-1]
    T, h = temperatures(low, high, MATRIX_ROWS), 1e-3 * (high - low)
    terms = matrix.terms(T)
    if matrix.error is None:
        return UncertaintyBudget(T, terms, [], ["scale factor and misalignment: the map was imported without"])
    each = {"stimulus": matrix.sigma(T)} if parts is None else parts(T)
    sources = [
        UncertaintySource(name, "B" if name in ("input", "temperatures") else "A", u)
        for name, u in each.items()
        if np.any(u)
    ]
    if thermometer is not None:
        ends = np.clip([T - h, T + h], low, high)
        slope = (matrix.terms(ends[1]) - matrix.terms(ends[0])) / (ends[1] - ends[0])[:, None]
        sources.append(UncertaintySource("thermometer", "B", np.abs(slope) * thermometer / K))
    hidden = [PAIRS[k] for k in np.flatnonzero(matrix.free & ~np.array(matrix.told))]
    missing = ["axes and rates of the stimulus, which are taken as exact"] if matrix.frame == "given" else []
    if matrix.frame == "sensor":
        missing = ["the angles between the triad's own frame and the case"]
    if hidden:
        missing.append(f"terms {', '.join(hidden)} of M, which are not observable")
    return UncertaintyBudget(T, terms, sources, missing)


def temperatures(low: float, high: float, most: int = MAX_ROWS, holes: Sequence[tuple[float, float]] = ()) -> Array:
    """Return both ends of a domain and round temperatures between, degC; `most` at most.

    In place of those within a hole stand its ends.
    """
    for step in STEPS:
        between = np.arange(np.ceil((low + NEAR * step) / step), np.floor((high - NEAR * step) / step) + 1) * step + 0.0
        if len(between) <= most - 2:
            break
    T = np.concatenate([[low], between, [high]])
    for start, stop in holes:
        T = np.unique(np.where((start < T) & (stop > T), np.where((start + stop) / 2 > T, start, stop), T))
    return np.asarray(T)


def _knows_its_level(record: MapRecord) -> bool:
    """Return True where the error of the curve has its level, as of a stimulus, which shows bias and M together."""
    of_M = None if record.matrix is None else record.matrix.error
    return record.error is not None and of_M is not None and of_M.T == record.error.T


def _memory(fitted: FittedMap) -> tuple[Array | None, str]:
    """Return half of the difference between warming and cooling (d,) to reckon with, or None and why."""
    memory = fitted.record.memory
    if memory is None:
        return None, "the map's file does not say what its soak tells of it"
    evidence = memory.get("log_evidence")
    if evidence is None:
        return None, str(memory["why"])
    size, sigma = (np.array(memory[name], dtype=np.float64) for name in ("size", "sigma"))
    probable = 1 / (1 + np.exp(-np.clip(evidence, -500, 500)))
    return np.sqrt(probable * np.nan_to_num(size**2 + sigma**2)) / 2, ""


def _level(placements: Placements) -> tuple[Array, list[str]]:
    """Return the deviation (d,) of the level that placements determine, and what they do not."""
    levels, d = placements.levels, len(placements.levels.bias)
    states = [levels.level(axis) for axis in range(d)]
    across = ", ".join("xyz"[axis] for axis in range(d) if states[axis] == "tilt")
    missing = [f"the level across gravity ({across}), which is one with the tilt of the unit: values are changes"]
    sigma = np.where([state == "tilt" for state in states], 0.0, levels.sigma)  # that with an unknown scale factor too
    return sigma, missing * bool(across)


def power_ups(fitted: FittedMap, soak: SoakSummary) -> Array | None:
    """Return the uncertainty (d,) of the level at one more power-up; None of fewer than MIN_RECORDINGS recordings."""
    from scipy.special import stdtrit

    count = int(soak.recording.max()) + 1
    if count < MIN_RECORDINGS:
        return None
    left, weight = soak.bias - fitted.bias(np.clip(soak.T, *fitted.domain)), soak.span
    own = [soak.recording == k for k in range(count)]
    levels = np.array([np.average(left[rows], axis=0, weights=weight[rows]) for rows in own])
    student = stdtrit(count - 1, (1 + COVERED) / 2) / K
    return np.asarray(student * np.std(levels, axis=0, ddof=1) * np.sqrt(1 + 1 / count))


def expanded(measured: Measured) -> Array | None:
    """Return the expanded uncertainty (d,) of a measured quantity, of a skew law its wider side; None: not known."""
    if measured.low is None or measured.high is None:
        return None
    widest = np.maximum(measured.values - measured.low, measured.high - measured.values)
    return np.asarray(np.where(np.isfinite(widest), K / SIDE * widest, np.nan))
