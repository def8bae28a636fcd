"""The messages of one topic as columns in the order of time, block after block: what a bag's table joins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.errors import BadValue
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag.decoding import FRAME, Decoder, Field, Types, column
from fusion_plugins.sources.rosbag.storage import Batch, Connection, Integers

STAMP = ("header.stamp.sec", "header.stamp.nanosec")
SECOND = 1_000_000_000  # ns
HELD = 2048  # messages: an earlier one may come so many later and still be put in order


class TopicStream:
    """The wanted fields of one topic: batch by batch in, in the order of time out.

    Attributes
    ----------
    topic : str
    t : (N,) array
        Time of each message that was last taken, s, never falling.
    pending : int
        Messages that were added and not yet taken.
    """

    def __init__(
        self,
        path: Path,
        found: Sequence[Connection],
        types: Types,
        fields: Mapping[str, Field | None],
        stamp: str,
        faults: Faults,
    ) -> None:
        self.path, self.fields, self.faults, self.types = path, fields, faults, types
        self.topic, self.type = found[0].topic, found[0].type
        self.stamped = stamp == "header" and types.has_header(self.type)
        self.bare = stamp == "header" and not self.stamped
        leaves = [leaf for field in fields.values() if field is not None for leaf in field.leaves]
        self.leaves = list(dict.fromkeys([*leaves, *((*STAMP, FRAME) if self.stamped else ())]))
        self.t: Array = np.empty(0)
        self.pending = 0
        self._decoders: dict[str, Decoder] = {}
        self._times: list[Integers] = []
        self._parts: list[dict[str, Array]] = []
        self._columns: dict[str, Array] = {}
        self._frame: bytes | None = None
        self._seen = self._zero = 0

    @property
    def span(self) -> str:
        """From when to when it has messages, in words."""
        return f"({self.t[0]:.3f} to {self.t[-1]:.3f} s)" if len(self.t) else "(no message)"

    def add(self, batch: Batch, connection: Connection) -> None:
        """Take the messages of a batch in; raises BadValue where arrays in them differ in length."""
        if connection.type != self.type:
            self._note("of another type, left out", len(batch.times), f"logged at {_moment(batch.times[0])}")
            return
        if connection.encoding not in self._decoders:
            self._decoders[connection.encoding] = Decoder(self.types, self.type, connection.encoding, self.leaves)
        columns, good = self._decoders[connection.encoding].decode(batch)
        if not np.all(good):
            first = _moment(batch.times[np.argmin(good)])
            self._note("that cannot be decoded, left out", int(np.sum(~good)), f"logged at {first}")
        if not np.any(good):
            return
        time = self._timed(batch.times, columns, good)
        n = len(good)
        self._parts.append({
            path: self._same(path, field, column(field, columns, n))[good]
            for path, field in self.fields.items()
            if field is not None
        })  # fmt: skip
        self._times.append(time[good])
        self.pending += int(np.sum(good))

    def take(self, *, final: bool) -> None:
        """Put what was added in order of time into `t`; unless `final`, keep the last ones, which others may precede.

        Raises
        ------
        BadValue
            If the stamps of all messages were zero.
        """
        if final and self._zero and self._zero == self._seen:
            raise BadValue(
                f"{self.path}: topic '{self.topic}' has a stamp of zero in all of its {self._zero} headers, times "
                "were expected; set stamp: log"
            )
        time = np.concatenate([np.empty(0, np.int64), *self._times])
        late = time < np.maximum.accumulate(time)
        order = np.arange(len(time))
        if np.any(late):
            self._note("that stand after a later one, put in order", int(np.sum(late)), f"at {_moment(time[late][0])}")
            order = np.argsort(time, kind="stable")
        cut = len(order) if final else max(len(order) - HELD, 0)
        now, later = order[:cut], order[cut:]
        whole = {path: np.concatenate([part[path] for part in self._parts]) for path in (self._parts or [{}])[0]}
        self._columns = {path: values[now] for path, values in whole.items()}
        self._parts = [{path: values[later] for path, values in whole.items()}] if len(later) else []
        self._times = [time[later]]
        self.pending = len(later)
        self.t = time[now] // SECOND + (time[now] % SECOND) * 1e-9

    def values(self, path: str) -> Array:
        """Return a column of what was last taken; the time, where the path names the topic alone."""
        return self.t if self.fields[path] is None else self._columns.get(path, np.empty(0))

    def _timed(self, log: Integers, columns: Mapping[str, NDArray[Any]], good: NDArray[np.bool_]) -> Integers:
        """Return the times of messages, ns, and leave out of `good` those that have none."""
        n = int(np.sum(good))
        self._seen += n
        if self.bare:
            self._note("that have no header, taken by the log's time", n, "message 1")
        if not self.stamped:
            return log
        self._framed(columns[FRAME][good], log[good])
        sec, nanosec = (columns[name].astype(np.int64) for name in STAMP)
        time: Integers = sec * SECOND + nanosec
        zero = good & (time == 0)
        if np.any(zero):
            self._note(
                "with a stamp of zero, left out", int(np.sum(zero)), f"logged at {_moment(log[np.argmax(zero)])}"
            )
            self._zero += int(np.sum(zero))
            good &= ~zero
        return time

    def _framed(self, frames: NDArray[Any], times: Integers) -> None:
        """Note where a message is of another frame than the first."""
        self._frame = bytes(frames[0]) if self._frame is None else self._frame
        other = np.flatnonzero(frames != self._frame)
        if len(other):
            shown = self._frame.decode("utf-8", "replace")
            where = f"logged at {_moment(times[other[0]])}"
            self._note(f"whose frame_id is not '{shown}', as that of the first", len(other), where)

    def _same(self, path: str, field: Field, values: Array) -> Array:
        """Return a column; raises BadValue where it is of arrays that differ in length."""
        if field.sort == "array":
            widths = {width for decoder in self._decoders.values() for width in decoder.widths[field.leaves[0]]}
            if len(widths) > 1:
                raise BadValue(
                    f"{self.path}: '{path}' has arrays of {min(widths)} to {max(widths)} values, arrays of one length "
                    f"were expected; name one value of them, as {path}[0]"
                )
        return values

    def _note(self, what: str, count: int, where: str) -> None:
        self.faults.add(f"messages on {self.topic} {what}", count, where)


def _moment(nanoseconds: np.int64) -> str:
    return f"{nanoseconds // SECOND}.{nanoseconds % SECOND:09d} s"
