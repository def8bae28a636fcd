"""Recordings as evidence: what the declared filter used of them, in blocks, and the filter of each axis over them.

A bias that moves over minutes is as well seen in means of some seconds as in the updates themselves, so the updates are
averaged in blocks; the filter over a block is that of the declared model, with the block as its update interval.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Config, with_recording
from driftlab.epochs import epochs
from driftlab.loop.declared import loosened, with_map
from driftlab.run import Run
from driftlab.stretch import Journal, Stretch
from driftlab.zupt import Zupt
from fusion_core.chunk import Array, Chunk, concatenate
from fusion_core.errors import ConfigError, EmptyRecording
from fusion_core.whitening import ScalarFilter

if TYPE_CHECKING:
    from driftlab.alignment import Alignment

BLOCKS = 8_000  # of all recordings together
FINE = 1.0  # s: what updates are averaged to before the length of a block is known

Progress = Callable[[str], None]


@dataclass(frozen=True)
class Record:
    """One recording in N blocks.

    Attributes
    ----------
    name : str
        What the recording is called.
    train : bool
        Whether it is for training, and not the calibration.
    chunk : Chunk
        `gyro` (N, d) is the rate less Earth rate in rad/s, `temperature` (N,) as measured, `tau` (N,) what was used.
    fresh : (N,) array of bool
        Where the unit was aligned.
    alignment : Alignment
        The first one.
    """

    name: str
    train: bool
    chunk: Chunk
    fresh: NDArray[np.bool_]
    alignment: Alignment

    def __len__(self) -> int:
        return len(self.chunk)


@dataclass(frozen=True)
class Evidence:
    """Recordings in blocks of one length, and the filter of each of the gyro's d axes over all of them, joined."""

    records: tuple[Record, ...]
    filters: tuple[ScalarFilter, ...]
    axes: tuple[str, ...]
    interval: float  # of a block, s

    def __len__(self) -> int:
        return sum(len(record) for record in self.records)

    @property
    def rate(self) -> Array:
        """Measured rate less Earth rate (N, d), rad/s."""
        return np.concatenate([record.chunk["gyro"] for record in self.records])

    @property
    def chunks(self) -> list[Chunk]:
        """The recordings' blocks."""
        return [record.chunk for record in self.records]

    @property
    def train(self) -> NDArray[np.bool_]:
        """Which of the N blocks are of training recordings."""
        return np.concatenate([np.full(len(record), record.train) for record in self.records])

    def split(self, values: Array) -> list[Array]:
        """Return the rows of values (N, ...) of each recording."""
        return np.split(values, np.cumsum([len(record) for record in self.records])[:-1])


def gather(config: Config, calibration: Sequence[str], train: Sequence[str], progress: Progress) -> Evidence:
    """Run the declared model over the recordings, and return what was measured at rest.

    Raises
    ------
    DataError, ConfigError
        If a recording cannot be used.
    """
    loose = loosened(config)
    fine, total = [], 0.0
    # one that serves as both is evidence once
    for name, training in {name: name in train for name in (*calibration, *train)}.items():
        progress(f"reading {name}")
        journal = Journal()
        run = Run(with_recording(loose, name), journal)
        marks: list[float] = []
        chunk = _joined(epochs(_used(run, marks), max(FINE, run.settings.update_interval)), name)
        fine.append((name, training, chunk, marks, journal.alignments[0]))
        total += float(np.sum(chunk["tau"]))
    _same_channels([(name, chunk) for name, _, chunk, _, _ in fine])
    assert config.filter is not None
    interval = max(FINE, config.filter.update_interval, np.ceil(total / BLOCKS))
    records = tuple(_record(*parts, interval=interval) for parts in fine)
    clamped = with_map(config, outside="clamp").filter
    assert clamped is not None
    settings = clamped.model_copy(update={"update_interval": interval})
    return Evidence(records, _filters(Zupt(settings), records), settings.gyro.bias.axes, interval)


def _used(stretches: Iterable[Stretch], marks: list[float]) -> Iterator[Chunk]:
    """Yield the epochs that the filter used; note in `marks` when the unit was aligned."""
    previous: Chunk | None = None
    for stretch in stretches:
        if stretch.fresh:
            marks.append(float(stretch.epochs.t[0]))
        rows = stretch.epochs
        channels = {k: v for k, v in rows.channels.items() if k not in ("dt", "tau", "temperature_raw")}
        channels["gyro"] = stretch.rate
        if "temperature_raw" in rows.channels:
            channels["temperature"] = rows["temperature_raw"]  # no lag of ours may enter what is fitted
        kept = Chunk(rows.t, channels, previous).where(stretch.estimates.used)
        if len(kept):
            yield kept
            previous = kept.last()


def _joined(chunks: Iterable[Chunk], name: str) -> Chunk:
    found = list(chunks)
    if sum(map(len, found)) < 2:
        raise EmptyRecording(f"{name}: is nowhere at rest for long enough; check filter.gyro.noise and the units")
    return concatenate(found)


def _same_channels(found: Sequence[tuple[str, Chunk]]) -> None:
    first, reference = found[0]
    for name, chunk in found[1:]:
        missing = sorted(set(reference.channels) ^ set(chunk.channels))
        if missing:
            raise ConfigError(
                f"channel '{missing[0]}' is in only one of {first} and {name}; "
                "name under source.channels what all recordings have"
            )


def _record(
    name: str, train: bool, fine: Chunk, marks: list[float], alignment: Alignment, *, interval: float
) -> Record:
    channels = {k: v for k, v in fine.channels.items() if k != "tau"}
    chunk = _joined(epochs([Chunk(fine.t, channels, fine.previous)], interval), name)
    fresh = np.zeros(len(chunk), dtype=bool)
    fresh[np.minimum(np.searchsorted(chunk.t, [chunk.t[0], *marks]), len(chunk) - 1)] = True
    return Record(name, train, chunk, fresh, alignment)


def _filters(model: Zupt, records: Sequence[Record]) -> tuple[ScalarFilter, ...]:
    """Return the filter of each axis: its integral and its bias states."""
    place, block = model.integrals["gyro"], model.blocks["gyro"]
    d = place.stop - place.start
    labels = block.stop - block.start
    if labels != d:
        raise ConfigError(f"explain needs a bias model with one state an axis; this one has {labels} for {d} axes")
    parts = [_steps(model, record) for record in records]
    F, Q, white = (np.concatenate(part) for part in zip(*parts, strict=True))
    prior, measurement = model.prior(), model.measurement(1)
    tau = np.concatenate([record.chunk["tau"] for record in records])
    fresh = np.concatenate([record.fresh for record in records])
    found = []
    for axis in range(d):
        pair = np.array([place.start + axis, block.start + axis])
        rows, columns = np.ix_(pair, pair)
        walk = Q[:, rows, columns] - white[:, rows, columns]
        if not np.any(walk[:, 1, 1] > 0):
            raise ConfigError("filter.gyro.bias.walk: is zero, and explain estimates it; declare a small one")
        b = np.stack([tau, np.zeros_like(tau)], axis=1)
        found.append(
            ScalarFilter(
                np.ascontiguousarray(F[:, rows, columns]), white[:, rows, columns], walk, b, np.array([1.0, 0.0]),
                float(measurement.R[pair[0], pair[0]]), prior.P[rows, columns], fresh,
            )
        )  # fmt: skip
    return tuple(found)


def _steps(model: Zupt, record: Record) -> tuple[Array, Array, Array]:
    """Return F, Q and the white part of Q over a recording's blocks, (N, n, n) each."""
    steps, _ = model.bias_steps(record.chunk, [None] * len(model.triads))
    transition = model.transition(record.chunk, steps, record.alignment)
    shape = (len(record), model.n, model.n)
    white = model.white(record.chunk)
    return np.broadcast_to(transition.F, shape), np.broadcast_to(transition.Q, shape), np.broadcast_to(white, shape)
