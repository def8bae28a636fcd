"""The error of a thermometer from its readings: the steps it rounds to, and its noise before the rounding.

A reading is ``r = round((T + n) / q) q`` with n ~ N(0, s^2), or a mean of such readings. Its mean at a temperature is::

    T + q sum_h (-1)^h a^(h h) sin(2 pi h T / q) / (pi h),    a = exp(-2 pi^2 s^2 / q^2)

a sawtooth that the noise rounds off. No averaging takes it out, and it goes with the temperature: it is the error that
counts. Steps q show in the characteristic function of the readings, R(1/q) = |mean of exp(2 pi i r / q)| over the
temperatures that were gone through: one where every reading is a multiple of q, next to zero of a fine thermometer.

Source: B. Widrow and I. Kollar, Quantization Noise, Cambridge University Press (2008), chapters 4 and 19. N readings.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from fusion_core import recursions
from fusion_core.chunk import Array

READINGS = ("temperature_step", "temperature_variance")
"""Channels of what a thermometer's samples showed up to an epoch: its steps in K, and their variance in K^2."""

FINE = 2e-3  # K, of the histogram of the readings
PADDED = 4  # times its length: over so many frequencies goes one period to either side
STEPS = (0.02, 6.0)  # K, that are looked for
LARGEST = 2.0  # K: a larger change is a jump of the temperature
MIN_SPECTRUM = 0.15  # of the characteristic function: with less, no steps are seen
CHANCE = 4.0  # times what so many readings of a fine thermometer have, in the mean
PROMINENT = 3.0  # times what stands beside it
PASSAGES = 200  # of a soak: a movement is taken over one of them
ALL_NOISE = 100.0  # of an exponent: beyond, nothing of the steps is left
PASSED = 2.0  # movements from one reading to the next: shorter steps are averaged out
STILL = 0.125  # of a step: so far the temperature may move within an average
PART = 0.75  # of a step: a movement is taken over so much of it, to tell steps from holds
MIN_WHILE_MOVING = 0.5  # of the characteristic function: where less of it is left then, holds were taken for steps
NOISELESS = 0.1  # of a step: with less noise before the rounding, steps are jumps
DIVIDED = 0.4  # of the squares of jumps: a mean of readings leaves two thirds of them
NEAR = 0.25  # of a step: while the temperature moves so far, readings stay, unless noise makes a mean of several levels
STAYING = 0.2  # of them
SAME = 1e-6  # of a step: a difference that is rounding of numbers
ONE = 1.1  # units, of a usual change: readings that change by one unit, on a ramp between holds too, have that step
MEDIAN = 0.455  # of squares of normal numbers, of their mean
AVERAGED = 100  # readings that a mean may be of
RESTING = 3.0  # deviations of what noise makes of a rest: a larger difference is a movement
ROUNDED = np.linspace(0.0, 1.0, 201)  # values of a


class Steps(NamedTuple):
    """Steps of a thermometer and its noise before the rounding, K; zero where none are seen."""

    size: float
    noise: float


NO_STEPS = Steps(0.0, 0.0)


def steps_of(T: Array) -> Steps:
    """Return the steps of a thermometer that shows T (N,) in degC, one after the other, as readings or as means.

    Those of a soak, which goes through many of them. Temperatures count by how far the unit moves there, so that a
    chamber which stays at whole degrees is not taken for steps.
    """
    return _steps_of(np.asarray(T, dtype=np.float64).tobytes())


@lru_cache(maxsize=1)
def _steps_of(shown: bytes) -> Steps:
    """Return them of the bytes of T: a soak and its map ask for the same."""
    T = np.frombuffer(shown)
    if len(T) < 2 * PASSAGES or not np.ptp(T) > 2 * STEPS[0]:
        return NO_STEPS
    moved = _movement(T)
    usual = _usual(moved)
    size = _period(T, moved, max(STEPS[0], PASSED * usual))
    if size == 0.0:
        return NO_STEPS
    readings(T, memory := started())
    unit, changes = memory[3], np.abs(np.diff(T))  # which says exactly what the spectrum says to half a frequency
    if np.sum(changes**2) < ONE * unit * np.sum(changes):
        size = float(unit)
    elif unit > 0 and abs(size - round(size / unit) * unit) < size**2 / (2 * PADDED * np.ptp(T)):
        size = float(round(size / unit) * unit)
    over = moved  # a step at least: over less, it moves at the jumps alone
    if usual * (len(T) // PASSAGES) < size:
        over = _movement(T, int(size * len(T) / float(np.sum(moved))))
    # of means of readings between which it hardly moves: noise is averaged out, the sawtooth is not
    n = int(np.clip(STILL * size / usual, 1, len(T) // (2 * PASSAGES)))
    stop = len(T) // n * n
    means, weights = T[:stop].reshape(-1, n).mean(axis=1), over[:stop].reshape(-1, n).sum(axis=1)
    left = float(np.average(np.diff(means, n=2) ** 2, weights=weights[1:-1])) / 6
    passed = float(np.abs(np.average(np.exp(2j * np.pi * means / size), weights=weights)))
    spread = min(2 * (np.pi / size) ** 2 * left, ALL_NOISE)
    a = float(np.interp(passed * np.exp(spread), _characteristic(), ROUNDED))
    noise = size * float(np.sqrt(-np.log(max(a, ROUNDED[1])) / 2)) / np.pi
    steps = Steps(size, max(noise, noise_before(size, float(np.mean(np.diff(T, n=2) ** 2)) / 6)))
    return steps if _jumps(T, steps, moved) else NO_STEPS


def _jumps(T: Array, steps: Steps, moved: Array) -> bool:
    """Return True if the readings jump and flicker as under such steps, or hold or rest at places that are alike.

    On a path that `moved` (N,) so many K there is a jump for each step, which a mean may divide in two; a little noise
    spreads it over several means, and those between the jumps stay the same while the temperature moves. With more
    noise before the rounding readings flicker instead, and a mean of AVERAGED of them still does.
    """
    squares = np.diff(T) ** 2
    if steps.noise < NOISELESS * steps.size:
        jumped = float(np.sum(squares) - len(squares) * np.median(squares) / MEDIAN)
        same = float(np.mean(squares < (SAME * steps.size) ** 2))  # those of a fine thermometer on a staircase are not
        jumps = same > STAYING and jumped > DIVIDED * steps.size * float(np.sum(moved))
        return jumps or _stay(T, steps.size, moved) > STAYING
    noise, variance = _flicker()
    flicker = steps.size**2 * float(np.interp(steps.noise / steps.size, noise, variance))
    return float(np.mean(squares)) > 2 * flicker / AVERAGED


def _stay(T: Array, size: float, moved: Array) -> float:
    """Return the share of readings that are the same after the temperature moved by a part of a step of `size` K."""
    passing = _while_passing(T, moved, size)
    n = int(np.clip(NEAR * size / _usual(passing), 1, len(T) // 2))
    same, moving = np.abs(T[n:] - T[:-n]) < SAME * size, passing[n:] > _usual(passing) / 2
    return float(np.sum(same & moving)) / max(int(np.sum(moving)), 1)


def _movement(T: Array, n: int = 0) -> Array:
    """Return the movement of the temperature from one reading to the next (N,), whatever its steps and noise.

    By the means of `n` readings before and after; 0: of one in PASSAGES of a soak.
    """
    n = n or max(3, len(T) // PASSAGES)
    total = np.cumsum(np.concatenate([[0.0], np.full(n, T[0]), T, np.full(n, T[-1])]))
    mean = (total[n:] - total[:-n]) / n
    moved = np.abs(mean[n : n + len(T)] - mean[: len(T)]) / n  # of those after each less those before
    # what the noise of two means makes of a temperature that rests
    rest = np.sqrt(np.mean(np.diff(T, n=2) ** 2) / 6 * 2 / n) / n
    return np.asarray(np.maximum(moved - RESTING * rest, 0.0) + np.finfo(float).tiny)


def _period(T: Array, moved: Array, least: float) -> float:
    """Return the largest period of the readings that stands out, `least` K or more; 0 where none does."""
    place = np.rint((T - T.min()) / FINE).astype(np.int64)
    count = 1 << int(np.ceil(np.log2(PADDED * (place.max() + 1))))
    spectrum = np.abs(np.fft.rfft(np.bincount(place, moved, count))) / np.sum(moved)
    f = np.arange(len(spectrum)) / (count * FINE)
    spectrum[f < 1 / STEPS[1]] = 0.0
    enough = max(MIN_SPECTRUM, CHANCE * float(np.linalg.norm(moved) / np.sum(moved)))
    for k in np.flatnonzero((spectrum > enough) & (f < 1 / least)):
        low = int(0.8 * k)
        about = spectrum[low : int(1.25 * k) + 1]
        beside = np.delete(about, slice(max(k - low - PADDED, 0), k - low + PADDED + 1))
        beside = beside if len(beside) else about  # of few steps in all
        prominent = spectrum[k] == about.max() and spectrum[k] > PROMINENT * np.sqrt(np.mean(beside**2))
        if prominent and _while_moving(T, moved, 1 / float(f[k])) > max(MIN_SPECTRUM, MIN_WHILE_MOVING * spectrum[k]):
            return 1 / float(f[k])
    return 0.0


def _while_moving(T: Array, moved: Array, size: float) -> float:
    """Return the characteristic function at steps of `size` K, a movement taken over a part of one; 0: too short."""
    moved = _while_passing(T, moved, size)
    if size < PASSED * _usual(moved):
        return 0.0
    return float(np.abs(np.average(np.exp(2j * np.pi * T / size), weights=moved)))


def _while_passing(T: Array, moved: Array, size: float) -> Array:
    """Return the movement from one reading to the next (N,), taken over a part of a step of `size` K.

    Over more, a short ramp counts in part for the holds before and after it, and those of a staircase are alike: of 5 K
    they pass for steps of a third of that. What readings have of true steps, holds or not, stays.
    """
    n, usual = len(T), _usual(moved)
    noise = RESTING * float(np.sqrt(np.mean(np.diff(T, n=2) ** 2) / 3))
    while (shorter := max(3, int(PART * size / usual), int((noise / usual) ** (2 / 3)))) < n:
        n, moved = shorter, _movement(T, shorter)
        usual = _usual(moved)
    return moved


def _usual(moved: Array) -> float:
    """Return the usual movement (N,) from one reading to the next, where it moves."""
    return float(np.average(moved, weights=moved))


def _characteristic() -> Array:
    """Return the characteristic function of means of readings at the frequency of their steps, for each of ROUNDED."""
    phase, h = (np.arange(512) + 0.5) / 512, np.arange(1, 12)[:, None]
    waves = (-1.0) ** h * np.sin(2 * np.pi * h * phase) / (np.pi * h)
    away = ROUNDED[:, None] ** (h[:, 0] ** 2) @ waves
    return np.asarray(np.abs(np.mean(np.exp(2j * np.pi * (phase + away)), axis=1)))


@lru_cache(maxsize=1)
def _flicker() -> tuple[Array, Array]:
    """Return noise before the rounding, in steps (R,), and the variance that readings have about their mean (R,)."""
    noise = np.linspace(0.0, 1.0, 201)
    h = np.arange(1, 200)[:, None]
    return noise, noise**2 + np.sum((1 - np.exp(-4 * (np.pi * h * noise) ** 2)) / (2 * np.pi**2 * h**2), axis=0)


def noise_before(step: float, variance: float) -> float:
    """Return the noise before the rounding in K, from the variance in K^2 that readings have about their mean.

    At one temperature they flicker between two steps or more: over all temperatures by
    s^2 + sum_h q^2 (1 - a^(2 h h)) / (2 pi^2 h^2).
    """
    noise, variances = _flicker()
    return float(step * np.interp(variance / step**2, variances, noise)) if step > 0 else 0.0


def sawtooth(step: float, noise: float, harmonics: int = 5) -> Array:
    """Return the variances in K^2 of the harmonics of what a mean reading is off by; the last has the rest."""
    h = np.arange(1, 60)
    size = max(step, np.finfo(float).tiny)
    power = size**2 / (2 * np.pi**2 * h**2) * np.exp(-4 * (np.pi * h * noise / size) ** 2)
    return np.append(power[: harmonics - 1], np.sum(power[harmonics - 1 :]))


class ThermometerReadings(NamedTuple):
    """Step of which all changes up to each of N readings are multiples, K, and variance of the readings, K^2.

    The step is 0 where there is none; the variance is that about a temperature that moves evenly.
    """

    step: Array
    variance: Array


def readings(T: Array, memory: Array) -> ThermometerReadings:
    """Look at readings T (N,) in degC; `memory` is of those before (`started`), and is changed."""
    seen = ThermometerReadings(np.empty(len(T)), np.empty(len(T)))
    recursions.steps_and_variance(T, memory, LARGEST, *seen)
    return seen


def started() -> Array:
    """Return the memory before the first reading.

    The last two and how many there were, the step, the variance.
    """
    return np.zeros(5)
