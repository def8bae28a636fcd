"""The limits of a config, held against what a run has measured.

For the Allan deviation of a run less its map, the input of its filter is averaged over a second or more. An average
counts where half of it or more was measured at rest; all stretches of such averages are analysed, short gaps bridged
where the unit did not move. It takes 86,400 averages a day, whatever the rate. K averages, d axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from driftlab.evaluation.limits import LimitResult, Measured, check_limits
from driftlab.evaluation.measurements import normal, of_allan, of_coast, of_map
from driftlab.noise.allan import curve
from driftlab.noise.allan_fit import fit
from driftlab.noise.recording import MIN_SAMPLES, MIN_STRETCH, Pieces, pieces
from driftlab.units import tracked_unit
from fusion_core.contracts import ThermalBias

if TYPE_CHECKING:
    from collections.abc import Sequence

    from driftlab.config import Config
    from driftlab.evaluation.overview import Overview
    from fusion_core.chunk import Array
    from fusion_core.contracts import Alignment, FittedMap


SHORTEST = 1.0  # s, of an average
Less = Callable[[Mapping[str, "Array"]], "Array"]


class Averages:
    """Averages of the rate less what a map explains of it, block after block of a run.

    Parameters
    ----------
    interval : float
        Of the updates, s.
    axes : sequence of str
        Of the sensor.
    less : callable, optional
        Returns, of a block of N rows, the map's part (N, d) of its rate, in SI.
    """

    def __init__(self, interval: float, axes: Sequence[str], less: Less | None = None) -> None:
        self.step, self.axes, self.less = interval * max(1, round(SHORTEST / interval)), list(axes), less
        self._parts: list[Array] = []  # (3 + d, K): index, time at rest and moving [s], sum of the rate at rest

    def add(self, block: Mapping[str, Array]) -> None:
        """Take the next rows: `t` and `tau` (N,) s, `still` (N,), `rate` (N, d), and what the map needs."""
        rate = block["rate"] if self.less is None else block["rate"] - self.less(block)
        still = block["still"].astype(bool)
        weight = block["tau"] * still
        index = np.floor((block["t"] - block["tau"] / 2) / self.step)
        starts = np.concatenate([[0], np.flatnonzero(np.diff(index)) + 1])
        sums = np.add.reduceat(np.column_stack([weight, block["tau"] * ~still, weight[:, None] * rate]), starts)
        self._parts.append(np.column_stack([index[starts], sums]))

    def measured(self) -> Measured:
        """Return the bias instability of all stretches at rest without a gap."""
        cut, values = self._whole()
        lasted = cut.samples * self.step
        if not cut.enough:
            longest, least = np.max(cut.places, initial=0) * self.step, MIN_STRETCH * self.step
            text = (
                f"{lasted:.4g} s at rest, {longest:.4g} s without a gap; record {MIN_SAMPLES * self.step:.4g} s or "
                f"more, {least:.4g} s of it without a gap"
            )
            return Measured(np.full(len(self.axes), np.nan), self.axes, missing=text)
        fits = [fit(curve(axis, self.step, stretches=cut.rows, missing=cut.missing)) for axis in values.T]
        of = "the rest less the map, " if self.less is not None else "the rest, "
        return of_allan(fits, self.axes, lasted, of=of)["bias_instability"]

    def noise(self) -> Measured:
        """Return the density of the white noise, from the differences of neighbouring averages.

        Each has the variance `noise^2 (1 / tau_1 + 1 / tau_2)`, of averages over tau; neighbours share one of the two,
        so `(sigma of noise / noise)^2 = 3 / (4 n)`.
        """
        rows = self._rows()
        counts = rows[:, 1] >= self.step / 2
        pairs = counts[1:] & counts[:-1] & (np.diff(rows[:, 0]) == 1)
        n, time = int(np.sum(pairs)), np.maximum(rows[:, 1:2], self.step / 2)
        if n < MIN_SAMPLES:
            text = f"{n * self.step:.4g} s at rest in a row; record {MIN_SAMPLES * self.step:.4g} s or more"
            return Measured(np.full(len(self.axes), np.nan), self.axes, missing=text)
        variance = np.diff(rows[:, 3:] / time, axis=0)[pairs] ** 2 / (1 / time[1:] + 1 / time[:-1])[pairs]
        measured = Measured(np.sqrt(np.mean(variance, axis=0)), self.axes, stands_on=f"{n * self.step:,.0f} s at rest")
        return normal(measured, measured.values * np.sqrt(0.75 / n), n * self.step)

    def _rows(self) -> Array:
        """Return index, time at rest and moving [s] and sum of the rate at rest (K, 3 + d) of all averages."""
        rows = np.concatenate(self._parts) if self._parts else np.zeros((0, 3 + len(self.axes)))
        if len(rows):  # an average may begin in one block and end in the next
            starts = np.concatenate([[0], np.flatnonzero(np.diff(rows[:, 0])) + 1])
            rows = np.column_stack([rows[starts, 0], np.add.reduceat(rows[:, 1:], starts)])
        return rows

    def _whole(self) -> tuple[Pieces, Array]:
        """Return the averages that count in pieces, and all (K, d) that these are rows of."""
        rows = self._rows()
        counts = rows[:, 1] >= self.step / 2
        known = counts | (rows[:, 2] > 0)  # what else was lost is a gap
        rows, counts = rows[known], counts[known]
        return pieces(rows[:, 0] * self.step, counts), rows[:, 3:] / np.maximum(rows[:, 1:2], self.step / 2)


def map_of(config: Config) -> FittedMap | None:
    """Return the map of the config's tracked sensor, from memory or its file; None where it has none."""
    settings = next((settings for settings in config.tracked_maps() if settings.has_map), None)
    return None if settings is None else settings.load()


def averages_of(config: Config, alignment: Alignment) -> Averages | None:
    """Return the averages that the limits of a config need of a run; None where none of them does.

    They are of the calibrated rate, or of the rate less the map's bias.
    """
    limits = config.limits
    if config.filter is None or limits is None or (limits.bias_instability is None and limits.noise is None):
        return None
    sensor = config.filter.tracked
    if sensor.calibration is not None:
        return Averages(alignment.dt, sensor.axes, lambda block: block["calibration"])
    fitted = map_of(config) if isinstance(sensor.bias, ThermalBias) else None
    if fitted is None:
        return Averages(alignment.dt, sensor.axes)
    clamped = replace(fitted, outside="clamp")  # the run has refused already what is to be refused
    return Averages(alignment.dt, sensor.axes, lambda block: clamped.bias(block["temperature"]))


def check_run_limits(
    config: Config, overview: Overview, alignment: Alignment, averages: Averages | None
) -> list[LimitResult]:
    """Judge a run by the limits of its config.

    The coast is that of the run; noise and bias instability are of `averages`, those of `averages_of`, which the
    survey has filled; residual, swing and hysteresis are of the map.
    """
    if config.limits is None or config.filter is None:
        return []
    align = config.filter.align
    fitted = map_of(config)
    measured = {"coast": of_coast(overview.yardsticks, overview.end - alignment.t, align)}
    if averages is not None and config.limits.noise is not None:
        measured["noise"] = averages.noise()
    if averages is not None and config.limits.bias_instability is not None:
        measured["bias_instability"] = averages.measured()
    if fitted is not None:
        measured |= of_map(fitted, tracked_unit(config.filter))
    return check_limits(config.limits, measured)
