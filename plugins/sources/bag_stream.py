"""The messages of one topic as columns in the order of time: what a bag's table joins."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_core.chunk import Array
from fusion_core.errors import BadValue
from fusion_core.faults import Faults
from fusion_plugins.sources.bag_layout import FRAME, Decoder, column
from fusion_plugins.sources.bag_storage import Batch, Connection, Integers
from fusion_plugins.sources.bag_types import Field, Types

STAMP = ("header.stamp.sec", "header.stamp.nanosec")
SECOND = 1_000_000_000  # ns


class Stream:
    """The wanted fields of one topic, batch by batch, then whole.

    Attributes
    ----------
    topic : str
    t : (N,) array
        Time of each message, s, never falling; there after `sort`.
    """

    def __init__(
        self, path: Path, found: Sequence[Connection], types: Types, fields: Mapping[str, Field | None], faults: Faults
    ) -> None:
        self.path, self.fields, self.faults = path, fields, faults
        self.topic, self.type = found[0].topic, found[0].type
        self.types = types
        self.stamped = types.has_header(self.type)
        leaves = [leaf for field in fields.values() if field is not None for leaf in field.leaves]
        self.leaves = list(
            dict.fromkeys([*(STAMP if self.stamped else ()), *leaves, *([FRAME] if self.stamped else [])])
        )
        self.t: Array = np.empty(0)
        self._decoders: dict[str, Decoder] = {}
        self._log: list[Integers] = []
        self._stamps: list[Integers] = []
        self._parts: list[dict[str, Array]] = []
        self._columns: dict[str, Array] = {}
        self._frame: bytes | None = None

    @property
    def span(self) -> str:
        """From when to when it has messages, in words."""
        return f"({self.t[0]:.3f} to {self.t[-1]:.3f} s)" if len(self.t) else "(no message)"

    def add(self, batch: Batch, connection: Connection) -> None:
        """Take the messages of a batch."""
        where = f"logged at {_moment(batch.times[0])}"
        if connection.type != self.type:
            self.faults.add(f"messages on {self.topic} of another type, left out", len(batch.times), where)
            return
        if connection.encoding not in self._decoders:
            self._decoders[connection.encoding] = Decoder(self.types, self.type, connection.encoding, self.leaves)
        columns, good = self._decoders[connection.encoding].decode(batch)
        bad = np.flatnonzero(~good)
        if len(bad):
            where = f"logged at {_moment(batch.times[bad[0]])}"
            self.faults.add(f"messages on {self.topic} that cannot be decoded, left out", len(bad), where)
        if not np.any(good):
            return
        n = len(good)
        parts = {path: column(field, columns, n)[good] for path, field in self.fields.items() if field is not None}
        self._parts.append(parts)
        self._log.append(batch.times[good])
        if self.stamped:
            sec, nanosec = (columns[name][good].astype(np.int64) for name in STAMP)
            self._stamps.append(sec * SECOND + nanosec)
            self._framed(columns[FRAME][good], batch.times[good])

    def _framed(self, frames: NDArray[Any], times: Integers) -> None:
        """Note where a message is of another frame than the first."""
        self._frame = bytes(frames[0]) if self._frame is None else self._frame
        other = np.flatnonzero(frames != self._frame)
        if len(other):
            shown = self._frame.decode("utf-8", "replace")
            what = f"messages on {self.topic} whose frame_id is not '{shown}', as that of the first"
            self.faults.add(what, len(other), f"logged at {_moment(times[other[0]])}")

    def sort(self, stamp: str) -> None:
        """Put the messages in the order of their time; raises BadValue where headers have none."""
        log = np.concatenate([np.empty(0, np.int64), *self._log])
        time, keep = log, np.ones(len(log), dtype=np.bool_)
        if stamp == "header" and self.stamped and len(log):
            time = np.concatenate(self._stamps)
            keep = time != 0
            if not np.any(keep):
                raise BadValue(
                    f"{self.path}: topic '{self.topic}' has a stamp of zero in all of its {len(time)} headers, times "
                    "were expected; set stamp: log"
                )
            what = f"messages on {self.topic} with a stamp of zero, left out"
            self.faults.add(what, int(np.sum(~keep)), f"message {int(np.argmin(keep)) + 1}")
        elif stamp == "header" and len(log):
            self.faults.add(
                f"messages on {self.topic} that have no header, taken by the log's time", len(log), "message 1"
            )
        order = np.flatnonzero(keep)
        falling = np.flatnonzero(np.diff(time[order]) < 0)
        if len(falling):
            at = _moment(time[order[falling[0] + 1]])
            what = f"messages on {self.topic} that stand after a later one, put in order"
            self.faults.add(what, len(falling), f"at {at}")
            order = order[np.argsort(time[order], kind="stable")]
        time = time[order]
        self.t = time // SECOND + (time % SECOND) * 1e-9
        for path in list(self._parts[0]) if self._parts else []:
            self._columns[path] = self._whole(path)[order]
        self._parts, self._log, self._stamps = [], [], []

    def values(self, path: str) -> Array:
        """Return a column; the time, where the path names the topic alone."""
        if self.fields[path] is None or path not in self._columns:
            return self.t
        return self._columns[path]

    def _whole(self, path: str) -> Array:
        """Return a column of all messages; raises BadValue where arrays in them differ in length."""
        parts = [part.pop(path) for part in self._parts]
        widths = sorted({part.shape[1] for part in parts if part.ndim > 1})
        if len(widths) > 1 or (widths and any(np.isnan(part[:, -1]).any() for part in parts if part.ndim > 1)):
            raise BadValue(
                f"{self.path}: '{path}' has arrays of up to {widths[-1]} values that differ in length, arrays of one "
                f"length were expected; name one value of them, as {path}[0]"
            )
        if widths:
            parts = [part if part.ndim > 1 else np.full((len(part), widths[0]), np.nan) for part in parts]
        return np.concatenate(parts)


def _moment(nanoseconds: np.int64) -> str:
    return f"{nanoseconds // SECOND}.{nanoseconds % SECOND:09d} s"
