"""How error is measured where the true bias is not known.

The reference is the centred moving average of the gyro, Earth rate removed, over 30 s (Fontanella et al. 2018,
sec. 6). Two yardsticks on it: the *filter error* of the running estimate (tables 6 to 11), and the *coast error* of
what is predicted from the end of the alignment with no further measurement, which is what a user feels when the
vehicle drives off.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

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
    weight = np.where(used, tau, 0.0)
    typical = np.mean(rate, axis=0)  # taken out, so that the sums stay small
    angle = np.vstack([np.zeros(rate.shape[1]), np.cumsum((rate - typical) * weight[:, None], axis=0)])
    time = np.concatenate([[0.0], np.cumsum(weight)])
    first = np.searchsorted(t, t - window / 2 - 1e-9, side="right")
    last = np.searchsorted(t, t + window / 2 + 1e-9, side="left")
    lasted = time[last] - time[first]
    inside = (t - window / 2 >= t[0] - tau[0]) & (t + window / 2 <= t[-1] + 1e-9) & (lasted >= 0.9 * window)
    average = (angle[last] - angle[first]) / np.where(lasted > 0, lasted, 1.0)[:, None] + typical
    return np.where(inside[:, None], average, np.nan)


def measure(estimates: dict[str, Array], up: Array | None, axes: tuple[str, ...]) -> Yardsticks:
    """Measure a run by its estimates (`driftlab.outputs.read_estimates`)."""
    t, tau, used = estimates["t"], estimates["tau"], estimates["used"].astype(bool)
    reference = moving_average(t, estimates["rate"], tau, used)
    coasting = np.isfinite(estimates["coast"][:, 0])
    start = t[coasting][0] if np.any(coasting) else np.inf
    error = estimates["bias"] - reference
    coast_error = estimates["coast"] - reference
    turned = np.where(coasting & used, tau, 0.0)[:, None] * np.nan_to_num(estimates["coast"] - estimates["rate"])
    coast, heading = {}, {}
    for name, horizon in HORIZONS.items():
        reached = np.isinf(horizon) or (len(t) > 0 and t[-1] - start >= horizon)
        within = coasting & (t < start + horizon)
        coast[name] = rms(coast_error[within]) if reached else np.full(error.shape[1], np.nan)
        turn = np.sum(turned[within], axis=0)
        vertical = reached and up is not None and len(turn) == 3
        heading[name] = float(abs(turn @ up)) if vertical and np.any(coasting) else np.nan
    return Yardsticks(axes, rms(error[coasting & (t < start + 30.0)]), rms(error[coasting]), coast, heading)


def rms(values: Array) -> Array:
    """Return the root of the mean square (d,) of the rows that are finite; NaN where there are none."""
    values = values[np.all(np.isfinite(values), axis=1)]
    return np.sqrt(np.mean(values**2, axis=0)) if len(values) else np.full(values.shape[1], np.nan)
