"""Segments of a run with their estimates, and the log of motion and refused epochs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.contracts import Alignment, Transition
from fusion_core.faults import Faults
from fusion_core.model import Estimates, Measurement, State

TEMPERATURES = ("temperature", "temperature_rate", "temperature_raw")  # the last one does not lag behind


class RunSegment(NamedTuple):
    """Estimates over consecutive epochs.

    Attributes
    ----------
    epochs : Chunk
        Input of the filter: each sensor as measured (N, d), and the other channels.
    rate : (N, d) array
        Reading of the tracked sensor less its known input (a gyro's: Earth rate), uncorrected: the measured
        bias. All of these are in the sensor's SI unit.
    bias, sigma : (N, d) arrays
        Bias after each update and its standard deviation; with the calibration's part, where there is one.
    coast, coast_sigma : (N, d) arrays
        Bias as predicted from the end of the alignment, no measurement used since; NaN before it.
    calibration : (N, d) array
        The calibration that was subtracted from the sensor before the filter; zero where there is none.
    still : (N,) array of bool
        Whether the unit stood still, by its sensors alone (`fusion_core.contracts.Detector`).
    estimates : Estimates
        Of all n states.
    began : State or None
        The filter's prior where it starts from one: at the first alignment and after each further one.
    model : (Transition, Measurement) or None
        Steps and measurements of the filter, where wanted; C leads from the states of the bias model to the bias.
    """

    epochs: Chunk
    rate: Array
    bias: Array
    sigma: Array
    coast: Array
    coast_sigma: Array
    calibration: Array
    still: Flags
    estimates: Estimates
    began: State | None
    model: tuple[Transition, Measurement] | None = None

    @property
    def fresh(self) -> bool:
        """True if the filter starts here from its prior."""
        return self.began is not None

    def columns(self) -> dict[str, NDArray[Any]]:
        """Return the stretch as named arrays of N rows: the data sets of `estimates.h5`."""
        estimates, epochs = self.estimates, self.epochs
        temperature = {k: epochs[k] for k in TEMPERATURES if k in epochs.channels}
        return {
            "t": epochs.t,
            "x": estimates.x,
            "sigma": estimates.sigma,
            "innovations": estimates.y,
            "white": estimates.white,
            "nis": estimates.nis,
            "used": estimates.used,
            "still": self.still,
            "tau": epochs["tau"],
            "rate": self.rate,
            "bias": self.bias,
            "bias_sigma": self.sigma,
            "coast": self.coast,
            "coast_sigma": self.coast_sigma,
            "calibration": self.calibration,
            **temperature,
        }


def joined(stretches: Iterable[RunSegment]) -> dict[str, NDArray[Any]]:
    """Return the columns of consecutive stretches, joined."""
    parts = [stretch.columns() for stretch in stretches]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


@dataclass
class Stretches:
    """Times from, to (s) at which something was so, and how often each axis (channel and name) was the cause."""

    spans: list[tuple[float, float]] = field(default_factory=list)
    axes: dict[str, int] = field(default_factory=dict)
    open: bool = False  # whether the last one goes on

    def note(self, t: Array, flags: Flags, causes: Flags, names: Sequence[str]) -> None:
        """Note where flags (N,) are true over consecutive epochs at t (N,), and their causes (N, D)."""
        for start, stop in runs(flags):
            for name, count in zip(names, np.sum(causes[start:stop], axis=0), strict=True):
                if count:
                    self.axes[name] = self.axes.get(name, 0) + int(count)
            begin = self.spans.pop()[0] if start == 0 and self.open else float(t[start])
            self.spans.append((begin, float(t[stop - 1])))
        if len(flags):
            self.open = bool(flags[-1])

    def worst(self) -> list[str]:
        """Return the axes that were the cause at least half as often as the one that was it most."""
        most = max(self.axes.values(), default=0)
        return [name for name, count in sorted(self.axes.items(), key=lambda item: -item[1]) if 2 * count >= most]


def runs(flags: Flags) -> list[tuple[int, int]]:
    """Return start and stop of each run of true values."""
    if not np.count_nonzero(flags):
        return []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in zip(edges[::2], edges[1::2], strict=True)]


@dataclass
class RunLog:
    """Log of a run: the stretches in which the unit moved, and in which the filter refused one that stood still."""

    faults: Faults = field(default_factory=Faults)
    alignments: list[Alignment] = field(default_factory=list)
    moving: Stretches = field(default_factory=Stretches)
    refused: Stretches = field(default_factory=Stretches)
    # updates with a channel beyond what an effect was fitted on, by the effect's kind and the channel
    beyond: Counter[tuple[str, str]] = field(default_factory=Counter)
