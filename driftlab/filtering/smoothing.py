"""Smoothing: estimates given all of the recording, the filter forwards, then the smoother backwards.

The filter's steps are in a file meanwhile, which is read from its end, so memory is that of one stretch. Where
the filter began anew (the unit was aligned again, at another attitude or bias) the smoother does too: nothing is known
across.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from driftlab.filtering.segment import RunSegment
from fusion_core.budget import next_array
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.errors import ConfigError
from fusion_core.model import Measurement, State, Transition
from fusion_core.smoother import Smoother


class FilterSteps(NamedTuple):
    """Steps of the filter over N epochs, as arrays: n states, m measured components, d axes.

    `begin` and `end` are the state before the first epoch and after the last, x beside P: (n, 1 + n). `fresh` tells
    whether `begin` is a prior. C (d, n_b) or (N, d, n_b) leads from the bias model's states to the bias; it has no rows
    where they are the bias.
    """

    rows: Integers  # () N
    fresh: Flags  # ()
    begin: Array
    end: Array
    F: Array
    Q: Array
    u: Array
    z: Array
    H: Array
    R: Array
    measured: Flags  # of the measurement
    used: Flags  # by the filter
    C: Array
    calibration: Array  # (N, d)

    @property
    def transition(self) -> Transition:
        """The steps."""
        return Transition(self.F, self.Q, self.u)

    @property
    def measurement(self) -> Measurement:
        """The measurement."""
        return Measurement(self.z, self.H, self.R, self.measured)


class Spool:
    """Steps of the filter in a file, written forwards and read backwards.

    Parameters
    ----------
    path : Path
        Of the file; `remove` it when it is not needed any more.
    keep : int
        Rows of an earlier run that stay.

    Raises
    ------
    ConfigError
        If the earlier run kept fewer.
    """

    def __init__(self, path: Path, keep: int = 0) -> None:
        self.path, self.rows = path, 0
        self.places: list[int] = []  # where each stretch begins in the file
        self.end: Array | None = None  # state after the last one
        with path.open("r+b" if keep and path.exists() else "w+b") as file:
            while self.rows < keep:
                self.places.append(file.tell())
                try:
                    step = _read(file)
                except (ValueError, EOFError, TypeError, OverflowError):
                    raise ConfigError(
                        f"--smooth: {path.parent} was begun without it; begin anew without --resume, or leave "
                        "--smooth out"
                    ) from None
                self.rows, self.end = self.rows + int(step.rows), step.end
            file.truncate()

    def add(self, stretch: RunSegment) -> None:
        """Add a stretch, which has its `model`."""
        assert stretch.model is not None, "the run keeps its model"
        transition, measurement = stretch.model
        begin = self.end if stretch.began is None else _packed(stretch.began)
        assert begin is not None, "the first stretch begins from a prior"
        self.end = _packed(stretch.estimates.state)
        N = len(stretch.epochs)
        C = np.empty((0, 0)) if transition.C is None else transition.C
        step = FilterSteps(
            np.array(N), np.array(stretch.fresh), begin, self.end, transition.F, transition.Q, transition.u,
            measurement.z, measurement.H, measurement.R, measurement.used, stretch.estimates.used, C,
            stretch.calibration,
        )  # fmt: skip
        with self.path.open("ab") as file:
            self.places.append(file.tell())
            for values in step:
                np.save(file, values, allow_pickle=False)
        self.rows += N

    def remove(self) -> None:
        """Remove the file."""
        self.path.unlink()

    def smoothed(self, reset: Flags, block: slice) -> Iterator[tuple[int, Array, Array, Array]]:
        """Yield the smoothed estimates, from the recording's end to its beginning.

        The first of their rows, x, sigma (N, n) and the bias (N, d) with the calibration's part.

        Parameters
        ----------
        reset : (n,) array of bool
            As the filter was given it.
        block : slice
            Where the states of the bias are.
        """
        smoother, stop = Smoother(len(reset), reset=reset), self.rows
        for place in reversed(self.places):
            with self.path.open("rb") as file:
                file.seek(place)
                step = _read(file)
            begin = State(step.begin[:, 0], step.begin[:, 1:])
            x, sigma = smoother.back(begin, step.transition, step.measurement, step.used)
            states = x[:, block]
            bias = states if step.C.size == 0 else np.einsum("...ij,...j->...i", step.C, states)
            stop -= len(x)
            yield stop, x, sigma, bias + step.calibration
            if step.fresh:
                smoother = Smoother(len(reset), reset=reset)


def _read(file: BinaryIO) -> FilterSteps:
    return FilterSteps(*(next_array(file) for _ in FilterSteps._fields))


def _packed(state: State) -> Array:
    return np.column_stack([state.x, state.P])
