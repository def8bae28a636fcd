"""The bytes that a device sent, as a logger wrote them to a file: any framing, over a file in place of a port.

::

    blocks of bytes  ->  framing: whole samples  ->  the device's counter, or the number of the sample: their times

A counter that is a clock gives the time by itself; one that counts frames, and a device without one, need `interval`.
Counts that a counter has passed over are a gap, and reported. A field called `time` is the time as it stands. A gzip
archive is read as it is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from fusion_core import contracts
from fusion_core.budget import TEXTS, check_all
from fusion_core.chunk import Array, Integers
from fusion_core.contracts.file_source import Conversions
from fusion_core.contracts.framing import DAMAGED, REPEATED
from fusion_core.errors import UnreadableFile, seconds
from fusion_core.faults import LOST, RESTARTS, Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.host.registry import Installed
from fusion_core.units import problem
from fusion_plugins.sources.unpacked import Stream, beginning, opened

BLOCK = 1 << 20  # bytes decoded at a time
HEAD = 1 << 18  # bytes at the beginning that tell the usual step of the counter
OFF = 0.02  # of the declared interval: more is reported
CHANCE = 0.05  # that a counter is at its beginning after some loss: less may be a restart
BEGUN = (
    "losses that may be restarts, as the device's counter is at its beginning behind them (then time is too long; "
    "use the parts before and behind as PATH::START:STOP)"
)
TIME = "time"
STAMP = ""  # under which a block gives the times that are made here: no field is called so


@hookimpl
class BinaryLog(contracts.FileSource):
    """A file of the bytes that a device sent; a gzip archive is read as it is."""

    suffixes: ClassVar[tuple[str, ...]] = (".bin", ".dat", ".raw")

    kind: Literal["binary_log"] = "binary_log"
    framing: Annotated[contracts.Framing, Installed()]
    """Format of the device's bytes."""
    channels: Mapping[str, contracts.Channel] = Field(default_factory=dict)
    """Channels of the framing to read, by name; all by default."""

    def check_time(self) -> None:
        """Take the channels from the framing where none are named, and see that it can tell the time.

        Raises
        ------
        PydanticCustomError
            If an interval is needed and missing, or given beside a field `time`.
        """
        named = self.framing.decode(b"", None)[0].channels
        if not self.channels:  # set before anyone sees the model: a validator may not return another one
            object.__setattr__(self, "channels", {name: contracts.Channel(path=name) for name in named})
        counter = self.framing.device_counter
        if TIME in self.channels and self.interval is not None:
            raise problem("both a field time and an interval are given; remove the interval")
        if TIME not in self.channels and self.interval is None and (counter is None or counter.tick is None):
            has = "no counter" if counter is None else "a counter of frames"
            raise problem(f"the framing has {has} and no clock; write interval: 10 ms (the time between samples)")

    @contextmanager
    def open(self, path: Path, faults: Faults) -> Iterator[contracts.Table]:
        """Open the file; raises UnreadableFile where it has no frame and is of another kind."""
        with opened(path) as file:
            first = beginning(file, path)
            head, _ = self.framing.decode(file.read(HEAD), None)
            head, _ = head.without_repeats(contracts.Frames(0, {}))
            file.seek(0)
            if head.N == 0 and contracts.recognised(first):
                raise contracts.foreign(path, first, self.kind)
            stamps = Stamps(self.framing.device_counter, self.interval, head, faults)
            yield FramedFile(path, file, self.framing, stamps)

    def _time(self, block: contracts.Block, conversions: Conversions, seen: int) -> Array:
        return self._values(TIME, block, conversions) if TIME in self.channels else block.read(STAMP)


class FramedFile(contracts.Table):
    """The frames in an open file."""

    noun: ClassVar[str] = "field"

    def __init__(self, path: Path, file: Stream, framing: contracts.Framing, stamps: Stamps) -> None:
        self.path, self.file, self.framing, self.stamps = path, file, framing, stamps

    @cached_property
    def names(self) -> Sequence[str]:
        """The framing's channels."""
        return list(self.framing.decode(b"", None)[0].channels)

    def unit(self, path: str) -> str | None:
        """Return the SI unit of a channel that has one by its name: the framing has converted it."""
        usual = contracts.USUAL.get(path)
        return usual.si if usual and usual.example else None

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[contracts.Block]:
        """Yield the samples of `BLOCK` bytes at a time; raises UnreadableFile where the first TEXTS bytes hold none."""
        memory, length, whole, damaged = None, 0, 0, 0
        while data := self.file.read(BLOCK):
            length += len(data)
            frames, memory = self.framing.decode(data, memory)
            check_all(frames.N)
            damaged += frames.rejected.get(DAMAGED, 0)
            whole += frames.N
            frames, t = self.stamps.of(frames)
            if not whole and length > TEXTS:
                break
            if frames.N:
                yield contracts.Block(frames.N, {**frames.channels, STAMP: t}.__getitem__)
        if whole == 0:
            raise UnreadableFile(
                f"{self.path}: has no whole frame of kind {self.framing.kind} in {length} bytes, and {damaged} damaged "
                "ones; correct source.framing, or name another file"
            )


class Stamps:
    """The times of the samples of a file, one block after the other.

    Parameters
    ----------
    counter : Counter or None
        The device's.
    interval : float or None
        Between samples, as declared, s.
    head : Frames
        Of the beginning of the file: the median step of a clock is one sample.
    faults : Faults
        Where lost samples and the like are reported.
    """

    def __init__(
        self, counter: contracts.Counter | None, interval: float | None, head: contracts.Frames, faults: Faults
    ) -> None:
        self.counter, self.faults = counter, faults
        self.tick = interval if counter is None or counter.tick is None else counter.tick  # of a count [s]
        self.step = 1
        if counter is not None and counter.tick is not None and head.count is not None and head.N > 1:
            self.step = max(1, int(np.median(np.diff(head.count) % counter.modulo)))
            measured = self.step * counter.tick
            if interval is not None and abs(measured / interval - 1) > OFF:
                apart = f"{measured * 1e3:.4g} ms and not {interval * 1e3:.4g} ms"
                self.faults.add(
                    f"rate not as declared: samples are {apart} apart by the device's clock; correct source.interval",
                    1, "at the start",
                )  # fmt: skip
        self.x = 0  # the counter without its wraps; of the last sample
        self.losses = 0  # times that samples were lost
        self.last = contracts.Frames(0, {})

    def of(self, frames: contracts.Frames) -> tuple[contracts.Frames, Array]:
        """Return the next N samples less repeated ones, and their times (N,), s from the first; report the others."""
        where = "at the start" if self.last.N == 0 else self._after(self.x)
        for what, count in frames.rejected.items():
            self.faults.add(what, count, where)
        frames, again = frames.without_repeats(self.last)
        x = np.array([self.x])
        if frames.N:
            steps = np.ones(frames.N, dtype=np.int64) if frames.count is None else self._steps(frames.count)
            steps[0] *= self.last.N > 0
            x = self.x + np.cumsum(steps)
            self.last = frames
        if len(again):
            self.faults.add(REPEATED, len(again), self._after(x[again[0] - 1] if again[0] else self.x))
        self.x = int(x[-1])
        return frames, np.asarray(x[: frames.N] * (self.tick or 0.0), dtype=np.float64)

    def _after(self, x: int) -> str:
        return f"after {seconds(x * (self.tick or 0.0))}"

    def _add(self, what: str, counts: Integers, steps: Integers) -> None:
        """Count (N,) cases of what is wrong; `steps` lead to each of the samples."""
        k = int(np.argmax(counts > 0))
        self.faults.add(what, int(np.sum(counts)), self._after(self.x + int(np.sum(steps[:k]))))

    def _steps(self, count: Integers) -> Integers:
        """Return the steps of the counter, without its wraps; one that ran backwards has begun anew."""
        assert self.counter is not None
        modulo, before = self.counter.modulo, self.last.count
        steps = np.diff(count, prepend=count[0] - self.step if before is None else before[-1]) % modulo
        anew = steps == 0
        if self.counter.tick is not None:
            anew |= steps > modulo // 2
        steps = np.where(anew, self.step, steps)
        steps[0] *= before is not None  # the first sample is at zero
        self._add(RESTARTS, anew.astype(np.int64), steps)
        lost = np.maximum(np.rint(steps / self.step) - 1, 0).astype(np.int64)
        self._add(LOST, lost, steps)
        times = self.losses + np.cumsum(lost > 0)
        self.losses = int(times[-1])
        begun = (lost > 0) & (count < 2 * self.step) & (times * 2 * self.step < CHANCE * modulo)
        self._add(BEGUN, begun.astype(np.int64), steps)
        return steps
