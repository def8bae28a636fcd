"""Rows that cannot be used: left out, counted and reported, the same way for every source.

The filter predicts across what is left out; it never interpolates. Only time that runs backwards is refused,
since then no order of the rows is known to be right.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fusion_core.errors import EmptyRecording, TimeBackwards

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from fusion_core.chunk import Array, Chunk

LARGEST = 1e30  # in SI; no sensor shows more, and the squares of what is beyond it are no numbers
LOST = "samples lost on the way, by the device's counter"
NO_FRAME = "bytes that came for a second or more without a frame, check baudrate and framing"


@dataclass
class Fault:
    """How often one thing was wrong, and where it was seen first."""

    count: int
    first: str


@dataclass
class Faults:
    """What was wrong with a recording that was used all the same."""

    found: dict[str, Fault] = field(default_factory=dict)

    def add(self, what: str, count: int, first: str) -> None:
        """Count `count` more cases of `what`; `first` says where the first of them is."""
        if count:
            known = self.found.setdefault(what, Fault(0, first))
            known.count += count

    def lines(self) -> list[str]:
        """Return one sentence for each kind of fault."""
        return [f"{what}: {fault.count} (first {fault.first})" for what, fault in self.found.items()]


def usable(chunks: Iterable[Chunk], faults: Faults, name: str, start: float = 0.0) -> Iterator[Chunk]:
    """Pass on the rows that can be used, each chunk with the sample before it as `previous`.

    A channel named `valid` says with zero that a row must not be used; it is not passed on. `start` is how many seconds
    after the first row of its file the first chunk begins.

    Raises
    ------
    TimeBackwards
        If a time stamp is smaller than the one before it.
    EmptyRecording
        If no row is left.
    """
    previous: Chunk | None = None
    first: float | None = None
    for chunk in chunks:
        if len(chunk) == 0:  # a live source that has nothing to say
            continue
        kept = _finite(chunk, faults)
        first = float(kept.t[0]) - start if first is None and len(kept) else first
        kept = _forward(kept, previous, faults, name, first, start)
        if len(kept) == 0:
            continue
        yield type(kept)(kept.t, kept.channels, previous)
        previous = kept.last()
    if previous is None:
        why = f" ({'; '.join(faults.lines())})" if faults.found else ""
        raise EmptyRecording(
            f"{name}: has no usable row{why}; check the channels' paths and units, and the START:STOP range"
        )


def _finite(chunk: Chunk, faults: Faults) -> Chunk:
    keep = np.abs(chunk.t) <= LARGEST  # neither NaN
    faults.add(
        "rows with a time stamp that is not a number, left out", int(np.sum(~keep)), f"after t = {_t(chunk, keep)}"
    )
    for channel, values in chunk.channels.items():
        if channel != "valid" and _all_usable(values):
            continue
        good = np.abs(values) <= LARGEST  # neither NaN
        if channel == "valid":
            good &= values != 0
        good = good if good.ndim == 1 else np.all(good, axis=1)
        bad = keep & ~good
        beyond = "is not a finite number" if not np.all(np.isfinite(values)) else f"is beyond {LARGEST:g}"
        what = "rows flagged as not valid" if channel == "valid" else f"rows where {channel} {beyond}"
        if np.any(bad):
            faults.add(f"{what}, left out", int(np.sum(bad)), f"at t = {chunk.t[np.argmax(bad)]:.6g} s")
            keep = keep & good
    kept = chunk if np.all(keep) else chunk.where(keep)
    channels = {name: values for name, values in kept.channels.items() if name != "valid"}
    return type(chunk)(kept.t, channels, chunk.previous)


def _all_usable(values: Array) -> bool:
    """Whether no value is NaN or beyond LARGEST: the sum of squares shows it in one pass (else, they are looked at)."""
    flat = values.ravel()
    with np.errstate(invalid="ignore", over="ignore"):
        return bool(np.dot(flat, flat) <= LARGEST**2)


def _t(chunk: Chunk, keep: NDArray[np.bool_]) -> str:
    before = chunk.t[: int(np.argmin(keep))]
    return f"{before[-1]:.6g} s" if len(before) else "the start"


def _forward(
    chunk: Chunk, previous: Chunk | None, faults: Faults, name: str, first: float | None, start: float
) -> Chunk:
    if len(chunk) == 0 or first is None:
        return chunk
    step = np.diff(chunk.t, prepend=chunk.t[0] - 1 if previous is None else previous.t[-1])
    if np.all(step > 0):
        return chunk
    if np.any(step < 0):
        k = int(np.argmax(step < 0))
        stop = np.floor((chunk.t[k] - step[k] - first) * 1e3) / 1e3  # the row before it is left out, too
        part = f"{name.partition('::')[0]}::{f'{start:g}' if start else ''}:{stop:.3f}"
        raise TimeBackwards(
            f"{name}: time runs backwards by {-step[k]:.6g} s at t = {chunk.t[k]:.6g} s; sort the rows, or cut it "
            f"before that: {part}"
        )
    repeated = step == 0
    faults.add(
        "rows that repeat a time stamp, left out", int(np.sum(repeated)), f"at t = {chunk.t[np.argmax(repeated)]:.6g} s"
    )
    return chunk.where(~repeated)
