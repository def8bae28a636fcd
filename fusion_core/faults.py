"""Rows that cannot be used: left out, counted and reported, the same way for every source.

The filter predicts across what is left out; it never interpolates. Only time that runs backwards is refused,
since then no order of the rows is known to be right.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from fusion_core.checks import FEW
from fusion_core.chunk import Array, Chunk, Flags
from fusion_core.errors import EmptyRecording, TimeBackwards, moment

LARGEST = 1e30  # in SI; no sensor shows more, and the squares of what is beyond it are no numbers
RANGES = {"temperature": (-273.15, 5000.0, "degC")}  # of what can be; a logger writes -999 where it has nothing
DOUBT = "doubt"  # in the provenance of a map: why its soak may not be what its config said
LOST = "samples lost on the way, by the device's counter"
RESTARTS = "restarts or jumps of the device's counter"
NO_FRAME = "bytes that came for a second or more without a frame, check baudrate and framing"


def in_doubt(doubts: Iterable[str]) -> list[str]:
    """Return doubts about a recording as sentences that begin with that."""
    return [f"in doubt: {text}" for text in doubts]


@dataclass
class Fault:
    """A count of one fault, and the place of its first case; 0 for a note."""

    count: int
    first: str

    def line(self, what: str) -> str:
        """Return it as a sentence; `what` is the name it was counted under."""
        return f"{what}: {self.count} (first {self.first})" if self.count else what


@dataclass
class Faults:
    """The faults of a recording that was used all the same.

    Attributes
    ----------
    found : dict of str to Fault
    first_row : float or None
        When the recording that is read begins, in its own seconds: what `when` counts from. Its source says so, or
        `usable` does.
    unavailable : str
        Why a live source has nothing to read at the moment, in a few words; empty while it can be read.
    rows, usable : int
        How many rows came, and how many of them are used.
    doubts : list of str
        Sentences on why the recording may not be what its config says: no limit passes on it.
    """

    found: dict[str, Fault] = field(default_factory=dict)
    first_row: float | None = None
    unavailable: str = ""
    rows: int = 0
    usable: int = 0
    doubts: list[str] = field(default_factory=list)

    def add(self, what: str, count: int, first: str) -> None:
        """Count `count` more cases of `what`; `first` says where the first of them is."""
        if count:
            known = self.found.setdefault(what, Fault(0, first))
            known.count += count

    def note(self, text: str) -> None:
        """Keep a sentence about the recording that counts nothing: which of several sensors was read."""
        self.found.setdefault(text, Fault(0, ""))

    def doubt(self, text: str) -> None:
        """Note a sentence on why the recording may not be what its config says."""
        self.note(text)
        self.doubts += [text] * (text not in self.doubts)

    def when(self, t: float) -> str:
        """Return the moment t, in the recording's own seconds, as text: `812.0 s (t = 1760000812.0 s in the file)`."""
        return moment(t, self.first_row)

    def since(self, t: float) -> float:
        """Return the seconds from the first row to t, in the recording's own seconds."""
        return t - (self.first_row or 0.0)

    def lines(self, *, notes: bool = True, doubts: bool = True) -> list[str]:
        """Return one sentence for each kind of fault, and each note and doubt, where those are wanted too."""
        faults = list(self.found.items())  # at once: of a live run, another thread may ask
        wanted = [(what, fault) for what, fault in faults if doubts or what not in self.doubts]
        return [fault.line(what) for what, fault in wanted if fault.count or notes]


def usable(chunks: Iterable[Chunk], faults: Faults, name: str, start: float = 0.0) -> Iterator[Chunk]:
    """Pass on the rows that can be used.

    A channel named `valid` says with zero that a row must not be used; it is not passed on. `start` is how many seconds
    after the first row of its file the first chunk begins; it counts where the source does not say when that row was.

    Raises
    ------
    TimeBackwards
        If a time stamp is smaller than the one before it.
    EmptyRecording
        If no row is left.
    """
    last: float | None = None  # time of the row before
    faults.first_row = None  # of the recording before
    for chunk in chunks:
        if len(chunk) == 0:  # a live source that has nothing to say
            continue
        faults.rows += len(chunk)
        if faults.first_row is None and len(finite := chunk.t[np.abs(chunk.t) <= LARGEST]):  # neither NaN
            faults.first_row = float(finite[0]) - start
        rows = _forward(_finite(chunk, faults), last, faults, name)
        if len(rows):
            last = float(rows.t[-1])
            yield rows
    if last is None:
        why = f" ({'; '.join(wrong)})" if (wrong := faults.lines(notes=False)) else ""
        raise EmptyRecording(
            f"{name}: has no usable row{why}; check the channels' paths and units, and the START:STOP range"
        )


def _finite(chunk: Chunk, faults: Faults) -> Chunk:
    keep = None  # all
    if not all_within(chunk.t, -LARGEST, LARGEST):
        keep = np.abs(chunk.t) <= LARGEST  # neither NaN
        lost = len(keep) - int(np.count_nonzero(keep))
        faults.add("rows with a time stamp that is not a number, left out", lost, _after(chunk, keep, faults))
    for channel, values in chunk.channels.items():
        low, high, unit = RANGES.get(channel, (-LARGEST, LARGEST, ""))
        if channel != "valid" and all_within(values, low, high):
            continue
        good = (values >= low) & (values <= high)  # neither NaN
        if channel == "valid":
            good &= values != 0
        good = good if good.ndim == 1 else np.all(good, axis=1)
        keep = np.ones(len(chunk), dtype=np.bool_) if keep is None else keep
        bad = keep & ~good
        beyond = f"is beyond {low:g} to {high:g} {unit}" if unit else f"is beyond {LARGEST:g}"
        beyond = beyond if np.all(np.isfinite(values)) else "is not a finite number"
        what = "rows flagged as not valid" if channel == "valid" else f"rows where {channel} {beyond}"
        if np.any(bad):
            faults.add(f"{what}, left out", int(np.sum(bad)), f"at {faults.when(chunk.t[np.argmax(bad)])}")
            keep = keep & good
    rows = chunk if keep is None or np.count_nonzero(keep) == len(keep) else chunk.where(keep)
    if "valid" not in rows.channels:
        return rows
    return Chunk(rows.t, {name: values for name, values in rows.channels.items() if name != "valid"}, chunk.previous)


def all_within(values: Array, low: float, high: float) -> bool:
    """Return True if no value is NaN or beyond the range."""
    if values.size < FEW and values.dtype.kind == "f" and float(np.vdot(values, values)) < min(high, -low) ** 2:
        return True  # of few nearly always, and quickly
    flat = values.ravel()
    return bool(flat.min(initial=high) >= low and flat.max(initial=low) <= high)  # False of NaN


def _after(chunk: Chunk, keep: Flags, faults: Faults) -> str:
    k, good = int(np.argmin(keep)), np.flatnonzero(keep)
    if k:
        return f"after {faults.when(chunk.t[k - 1])}"
    return f"before {faults.when(chunk.t[good[0]])}" if len(good) else "in rows that have none"


BEGIN_AGAIN = {
    86_400.0: "it is the time of a day: add 86,400 s to the rows behind each midnight",
    **{
        2.0**bits * unit: f"its counter of {bits} bits began again: add {2**bits:,} {name} to the rows behind that"
        for bits, unit, name in ((16, 1e-3, "ms"), (32, 1e-3, "ms"), (32, 1e-6, "µs"))
    },
}
"""By how many s a time that begins again goes back."""


def advice_backwards(steps: Array, k: int) -> str:
    """Return the advice on a time of which the k-th of the steps (N,), s, goes back."""
    usual = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    for whole, advice in BEGIN_AGAIN.items():
        if 30 * usual < whole and abs(whole + steps[k] - usual) <= 2 * usual + 1e-9 * whole:
            return advice
    return "sort the rows"


def _forward(chunk: Chunk, last: float | None, faults: Faults, name: str) -> Chunk:
    if len(chunk) == 0 or faults.first_row is None:
        return chunk
    t, before = chunk.t, float(chunk.t[0]) - 1 if last is None else last
    if t[0] > before and (len(t) == 1 or np.all(t[1:] > t[:-1])):
        return chunk
    step = np.diff(t, prepend=before)
    if np.any(step < 0):
        k = int(np.argmax(step < 0))
        # the row before it is left out, too
        stop = np.floor((chunk.t[k] - step[k] - faults.first_row) * 1e3) / 1e3
        path, _, span = name.partition("::")
        raise TimeBackwards(
            f"{name}: time runs backwards by {-step[k]:.6g} s at {faults.when(chunk.t[k])}; "
            f"{advice_backwards(step, k)}, or cut it before that: {path}::{span.partition(':')[0]}:{stop:.3f}"
        )
    repeated = step == 0
    where = f"at {faults.when(chunk.t[np.argmax(repeated)])}"
    faults.add("rows that repeat a time stamp, left out", int(np.sum(repeated)), where)
    return chunk.where(~repeated)
