"""How error is measured where the true bias is not known.

The reference is the centred moving average of the gyro, Earth rate removed, over 30 s (Fontanella et al. 2018,
sec. 6). Two yardsticks on it: the *filter error* of the running estimate (tables 6 to 11), and the *coast error* of
what is predicted from the end of the alignment with no further measurement, which is what a user feels when the
vehicle drives off.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numba import njit

from fusion_core.chunk import Array
from fusion_core.model import Flags

WINDOW = 30.0  # s, of the moving average
HORIZONS = {"1 min": 60.0, "5 min": 300.0, "10 min": 600.0, "to the end": np.inf}


@dataclass(frozen=True)
class Yardsticks:
    """Errors in rad/s, one value an axis; NaN where the recording does not reach.

    Attributes
    ----------
    axes : tuple of str
        Names of the d axes.
    filter_first, filter_whole : (d,) arrays
        Rms of estimate less reference, over the first 30 s after the alignment and the whole interval.
    coast : dict of str to (d,) array
        Rms of prediction less reference, for each horizon.
    heading : dict of str to float
        Angle about the vertical that the prediction is wrong by at the end of each horizon, rad.
    """

    axes: tuple[str, ...]
    filter_first: Array
    filter_whole: Array
    coast: dict[str, Array]
    heading: dict[str, float]


def moving_average(t: Array, rate: Array, tau: Array, used: Flags, window: float = WINDOW) -> Array:
    """Return the centred moving average (N, d) of rates that lasted tau each.

    NaN where the window reaches beyond the recording, or less than nine tenths of it were measured at rest.
    """
    return np.asarray(_average(t, np.ascontiguousarray(rate), np.where(used, tau, 0.0), t[0] - tau[0], window))


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _average(t: Array, rate: Array, weight: Array, begin: float, window: float) -> Array:
    # sums from the first row of each window up to its last, which both only ever move on
    N, d = rate.shape
    out = np.full((N, d), np.nan)
    typical = np.zeros(d)  # taken out, so that the sums stay small
    for k in range(N):
        for j in range(d):
            typical[j] += rate[k, j] / N
    angle, time = np.zeros((N + 1, d)), np.zeros(N + 1)
    for k in range(N):
        time[k + 1] = time[k] + weight[k]
        for j in range(d):
            angle[k + 1, j] = angle[k, j] + (rate[k, j] - typical[j]) * weight[k]
    first = last = 0
    for k in range(N):
        while first < N and t[first] <= t[k] - window / 2 - 1e-9:
            first += 1
        while last < N and t[last] < t[k] + window / 2 + 1e-9:
            last += 1
        lasted = time[last] - time[first]
        inside = t[k] - window / 2 >= begin and t[k] + window / 2 <= t[-1] + 1e-9
        if inside and lasted >= 0.9 * window - 1e-6:
            for j in range(d):
                out[k, j] = (angle[last, j] - angle[first, j]) / lasted + typical[j]
    return out


class Tally:
    """The sums behind the yardsticks of a run, taken stretch by stretch."""

    def __init__(self, d: int) -> None:
        self.start = np.inf  # of the coast [s]
        self.end = -np.inf  # of the run [s]
        self._errors = {name: _Squares(d) for name in ("first 30 s", "whole", *HORIZONS)}
        self._turn = {name: np.zeros(d) for name in HORIZONS}

    def add(self, estimates: Mapping[str, Array], reference: Array) -> None:
        """Count the next rows of the estimates, with their reference (N, d) in rad/s, NaN where there is none."""
        t, used = estimates["t"], estimates["used"].astype(bool)
        if len(t) == 0:
            return
        self.end = float(t[-1])
        first = int(np.argmax(np.isfinite(estimates["coast"][:, 0])))  # no earlier row is coasting, and each later one
        if np.isnan(estimates["coast"][first, 0]):
            return
        rows = slice(first, None)
        t, used, reference = t[rows], used[rows], reference[rows]
        self.start = min(self.start, float(t[0]))
        bias, coast, rate = (estimates[name][rows] for name in ("bias", "coast", "rate"))
        known = np.isfinite(reference[:, 0])
        error, coast_error = bias - reference, coast - reference
        lasted, ahead = np.where(used, estimates["tau"][rows], 0.0), coast - rate
        self._errors["first 30 s"].add(error, known, int(np.searchsorted(t, self.start + 30.0)))
        self._errors["whole"].add(error, known, len(t))
        for name, horizon in HORIZONS.items():
            stop = len(t) if np.isinf(horizon) else int(np.searchsorted(t, self.start + horizon))
            self._errors[name].add(coast_error, known, stop)
            self._turn[name] += lasted[:stop] @ ahead[:stop]

    def yardsticks(self, up: Array | None, axes: tuple[str, ...]) -> Yardsticks:
        """Return the yardsticks of the rows that were added."""
        coast, heading = {}, {}
        for name, horizon in HORIZONS.items():
            reached = np.isinf(horizon) or self.end - self.start >= horizon
            coast[name] = self._errors[name].rms() if reached else np.full(len(axes), np.nan)
            known = reached and self._errors[name].count > 0 and len(axes) == 3
            heading[name] = np.nan if up is None or not known else float(abs(self._turn[name] @ up))
        return Yardsticks(axes, self._errors["first 30 s"].rms(), self._errors["whole"].rms(), coast, heading)


class _Squares:
    """Sum and number of squared errors."""

    def __init__(self, d: int) -> None:
        self.total, self.count = np.zeros(d), 0

    def add(self, error: Array, known: Flags, stop: int) -> None:
        self.count += int(np.count_nonzero(known[:stop]))
        some = np.where(known[:stop, None], error[:stop], 0.0)
        self.total += np.einsum("ij,ij->j", some, some)

    def rms(self) -> Array:
        return np.sqrt(self.total / self.count) if self.count else np.full(len(self.total), np.nan)


def measure(estimates: Mapping[str, Array], up: Array | None, axes: tuple[str, ...]) -> Yardsticks:
    """Measure a run by its estimates, all of them at once."""
    used = estimates["used"].astype(bool)
    tally = Tally(estimates["bias"].shape[1])
    tally.add(estimates, moving_average(estimates["t"], estimates["rate"], estimates["tau"], used))
    return tally.yardsticks(up, axes)


def rms(values: Array) -> Array:
    """Return the root of the mean square (d,) of the rows that are finite; NaN where there are none."""
    values = values[np.all(np.isfinite(values), axis=1)]
    return np.sqrt(np.mean(values**2, axis=0)) if len(values) else np.full(values.shape[1], np.nan)
