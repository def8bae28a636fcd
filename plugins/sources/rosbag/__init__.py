"""Recordings in ROS bags: ROS 1, and ROS 2 as a folder, as sqlite3 (`.db3`) or as MCAP.

::

    path of a channel              column
    /imu/data                      the time of the messages on a topic
    /imu/data.angular_velocity.x   a field of them; `.angular_velocity` is its three axes
    /imu/temperature.temperature   a field of another topic: joined by time to the rows

Rows are the messages of the time channel's topic, by the stamp in their header or by the log's. Only chunks with wanted
messages are read, and of these only wanted fields, block after block; topics that are joined to the rows are held as a
whole.

The files of a bag: one `.bag`, `.mcap` or `.db3`, or a folder of them in their order.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from fusion_core.budget import COPIED, check_count, keep, temporary_folder, unpacked_at_most
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.contracts import Block, FileSource, Table, foreign, head
from fusion_core.contracts.file_source import RecordingWriter
from fusion_core.errors import BadValue, MissingChannel, UnreadableFile, check_installed
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_core.settings import did_you_mean
from fusion_plugins.sources.joining import interval, joined
from fusion_plugins.sources.rosbag import mcap, ros1, sqlite
from fusion_plugins.sources.rosbag.decoding import FRAME, Decoder, Field, Types, column
from fusion_plugins.sources.rosbag.storage import Batch, ChunkedFile, Connection, plain, zstd
from fusion_plugins.sources.unpacked import damaged, unpacking

Storage = ChunkedFile | sqlite.Sqlite
ROWS = 65_536  # messages that are decoded before they are passed on
SHOWN = 30  # topics or fields in a message


@hookimpl
class Rosbag(FileSource):
    """A ROS bag: a file, or the folder of a ROS 2 bag."""

    signatures: ClassVar[tuple[bytes, ...]] = (ros1.SIGNATURE, mcap.SIGNATURE, b"SQLite format 3\0")
    suffixes: ClassVar[tuple[str, ...]] = (".bag", ".mcap", ".db3")
    written: ClassVar[tuple[str, ...]] = (".bag", ".mcap")

    kind: Literal["rosbag"] = "rosbag"
    stamp: Literal["header", "log"] = "header"
    """Clock: the stamps in the messages' headers, or the times of recording."""

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the bag; raises UnreadableFile where it is of another kind or damaged, ConfigError without rosbags."""
        check_installed("rosbag", "rosbags", "ROS bags", "ros")
        leading = self.channels.get("time") or self.channels.get("gyro") or next(iter(self.channels.values()))
        with storages(path, self.kind, faults) as files:
            yield Topics(path, files, leading.paths[0], self.stamp, faults)

    @classmethod
    def writer(cls, path: Path, suffix: str, note: str) -> RecordingWriter:
        """Begin a bag of ROS 1 or an MCAP file of ROS 2; raises ConfigError without rosbags."""
        check_installed("rosbag", "rosbags", "ROS bags", "ros")
        from fusion_plugins.sources.rosbag.writer import BagWriter

        return BagWriter(path, ros1=suffix == ".bag", note=note)


class Topics(Table):
    """The topics of an open bag."""

    noun: ClassVar[str] = "topic"

    def __init__(self, path: Path, files: list[Storage], leading: str, stamp: str, faults: Faults) -> None:
        self.path, self.files, self.leading, self.stamp, self.faults = path, files, leading, stamp, faults
        self.topics: dict[str, list[Connection]] = {}
        for file in files:
            for connection in file.connections:
                self.topics.setdefault(connection.topic, []).append(connection)
        if not self.topics:
            raise UnreadableFile(f"{path}: has no topic, or none before its damage; record it again")
        self.types = Types([connection for of_topic in self.topics.values() for connection in of_topic], path)

    @cached_property
    def names(self) -> Sequence[str]:
        """Every topic, for its time, and the numbers of its messages."""
        paths: list[str] = []
        for topic, (connection, *_) in self.topics.items():
            try:
                self.types.check(connection)
            except UnreadableFile:
                continue
            paths += [topic, *(f"{topic}.{field}" for field in self.types.paths(connection.type))]
        return paths

    def has(self, path: str) -> bool:
        """Return True if `path` can be read; raises MissingChannel that lists topics or fields where it cannot."""
        self._field(path)
        return True

    def unit(self, path: str) -> str | None:
        """Return the unit that the type of the messages prescribes; s for a time."""
        field = self._field(path)[1]
        return "s" if field is None else field.unit

    def blocks(self, paths: Sequence[str], size: int) -> Iterator[Block]:
        """Yield blocks of at least ROWS rows in the order of their time; what is joined to them is read before."""
        wanted = {path: self._field(path) for path in [self.leading, *paths]}
        streams: dict[str, TopicStream] = {}
        for topic, _ in wanted.values():
            fields = {path: field for path, (of, field) in wanted.items() if of == topic}
            streams[topic] = TopicStream(self.path, self.topics[topic], self.types, fields, self.stamp, self.faults)
        rows = streams.pop(wanted[self.leading][0])
        for _ in self._read(streams):
            pass
        for stream in streams.values():
            stream.take(final=True)
        step, overlap = None, dict.fromkeys(streams, False)
        for final in self._read({rows.topic: rows}):
            rows.take(final=final)
            if len(rows.t):
                step = interval(rows.t) if step is None else step
                zero, columns = float(rows.t[0]), {path: rows.values(path) for path in paths if path in rows.fields}
                for stream in streams.values():
                    for path in stream.fields:
                        columns[path] = joined(rows.t - zero, stream.t - zero, stream.values(path), step)
                overlap = {topic: overlap[topic] or stream.meets(rows.t) for topic, stream in streams.items()}
                yield Block(len(rows.t), columns.__getitem__)
        for topic, meets in overlap.items():
            if step is not None and not meets:
                raise self._apart(rows, streams[topic])

    def _read(self, streams: dict[str, TopicStream]) -> Iterator[bool]:
        """Read topics, in one pass through each file; yield False where ROWS messages have come, True at the end."""
        for file in self.files:
            by_id = {c.id: (streams[c.topic], c) for c in file.connections if c.topic in streams}
            for batch in file.batches(by_id.keys()) if by_id else ():
                stream, connection = by_id[batch.connection]
                stream.add(plain(batch, self.path) if connection.encoding == "cdr" else batch, connection)
                if stream.pending >= ROWS:
                    yield False
        yield True

    def _apart(self, rows: TopicStream, stream: TopicStream) -> BadValue:
        if not len(stream.t):
            wrong = "; ".join(self.faults.lines(notes=False))
            return BadValue(
                f"{self.path}: topic '{stream.topic}' has no message that can be read"
                + (f" ({wrong})" if wrong else "")
                + "; name another topic, or leave its channel out"
            )
        spans = f"'{rows.topic}' (to {rows.t[-1]:.3f} s)" if len(rows.t) else f"'{rows.topic}'"
        return BadValue(
            f"{self.path}: topics {spans} and '{stream.topic}' {stream.span} have no time in common, the same "
            "clock was expected; "
            + ("set stamp: log" if self.stamp == "header" else "name a topic that was recorded with it")
        )

    def _field(self, path: str) -> tuple[str, Field | None]:
        """Return the topic and the field of a path, None for the time; raises MissingChannel."""
        topic = max((t for t in self.topics if path == t or path.startswith(f"{t}.")), key=len, default=None)
        if topic is None:
            raise self._no_topic(path)
        connection = self.topics[topic][0]
        try:
            self.types.check(connection)
        except UnreadableFile as error:
            raise UnreadableFile(f"{self.path}: {error}") from None
        if path == topic:
            return topic, None
        wanted = path[len(topic) + 1 :]
        field = self.types.find(connection.type, wanted)
        if field is None:
            have = list(self.types.paths(connection.type))
            raise MissingChannel(
                f"{self.path}: topic '{topic}' of {connection.type} has no field '{wanted}' of numbers, it has "
                f"{_listed(have, len(have))}; " + did_you_mean(wanted, have, f"name {topic}.FIELD", "'")
            )
        return topic, field

    def _count(self, topic: str) -> str:
        counts = [file.count(c.id) for file in self.files for c in file.connections if c.topic == topic]
        return "?" if None in counts else str(sum(count or 0 for count in counts))

    def _no_topic(self, path: str) -> MissingChannel:
        named = path.partition(".")[0]
        some = list(self.topics.items())[:SHOWN]
        have = [f"{topic} ({of_topic[0].type}, {self._count(topic)} messages)" for topic, of_topic in some]
        return MissingChannel(
            f"{self.path}: has no topic '{named}', it has {_listed(have, len(self.topics))}; "
            + did_you_mean(named, self.topics, "name one of them, then its field, as /imu.angular_velocity.x", "'")
        )


def _listed(words: Sequence[str], count: int) -> str:
    return ", ".join(words[:SHOWN]) + (f" and {count - SHOWN} more" if count > SHOWN else "")


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
        connections: Sequence[Connection],
        types: Types,
        fields: Mapping[str, Field | None],
        stamp: str,
        faults: Faults,
    ) -> None:
        self.path, self.fields, self.faults, self.types = path, fields, faults, types
        self.topic, self.type = connections[0].topic, connections[0].type
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

    def meets(self, t: Array) -> bool:
        """Return True if the times of the topic and t (N,), both rising, overlap."""
        return len(self.t) > 0 and bool(self.t[0] <= t[-1] and self.t[-1] >= t[0])

    def add(self, batch: Batch, connection: Connection) -> None:
        """Take the messages of a batch in; raises BadValue where arrays in them differ in length."""
        if connection.type != self.type:
            self._note("of another type, left out", np.ones(len(batch.times), np.bool_), batch.times)
            return
        if connection.encoding not in self._decoders:
            self._decoders[connection.encoding] = Decoder(self.types, self.type, connection.encoding, self.leaves)
        columns, good = self._decoders[connection.encoding].decode(batch)
        self._note("that cannot be decoded, left out", ~good, batch.times)
        if not np.any(good):
            return
        time = self._timed(batch.times, columns, good)
        fields = {path: field for path, field in self.fields.items() if field is not None}
        self._check_widths(fields)
        self._parts.append({path: column(field, columns, len(good))[good] for path, field in fields.items()})
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
        self._note("that stand after a later one, put in order", time < np.maximum.accumulate(time), time, "at")
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

    def _timed(self, log: Integers, columns: Mapping[str, NDArray[Any]], good: Flags) -> Integers:
        """Return the times of messages, ns, and leave out of `good` those that have none."""
        n = int(np.sum(good))
        self._seen += n
        if self.bare:
            self.faults.add(f"messages on {self.topic} that have no header, taken by the log's time", n, "message 1")
        if not self.stamped:
            return log
        self._frame = bytes(columns[FRAME][good][0]) if self._frame is None else self._frame
        shown, other = self._frame.decode("utf-8", "replace"), good & (columns[FRAME] != self._frame)
        self._note(f"whose frame_id is not '{shown}', as that of the first", other, log)
        sec, nanosec = (columns[name].astype(np.int64) for name in STAMP)
        time: Integers = sec * SECOND + nanosec
        zero = good & (time == 0)
        self._note("with a stamp of zero, left out", zero, log)
        self._zero += int(np.sum(zero))
        good &= ~zero
        return time

    def _check_widths(self, fields: Mapping[str, Field]) -> None:
        """Raise BadValue where a field is of arrays that differ in length."""
        for path, field in fields.items():
            widths = {width for decoder in self._decoders.values() for width in decoder.widths[field.leaves[0]]}
            if field.sort == "array" and len(widths) > 1:
                raise BadValue(
                    f"{self.path}: '{path}' has arrays of {min(widths)} to {max(widths)} values, arrays of one length "
                    f"were expected; name one value of them, as {path}[0]"
                )

    def _note(self, what: str, which: Flags, times: Integers, at: str = "logged at") -> None:
        """Count messages, by flags and the times (n,) of all in ns."""
        if np.any(which):
            first = times[np.argmax(which)]
            where = f"{at} {first // SECOND}.{first % SECOND:09d} s"
            self.faults.add(f"messages on {self.topic} {what}", int(np.sum(which)), where)


FILES = 500  # that are open at a time
PARTS = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")


@contextmanager
def storages(path: Path, kind: str, faults: Faults) -> Iterator[list[Storage]]:
    """Open the files of a bag.

    Raises
    ------
    UnreadableFile
        If there is none, or one is of another kind or damaged.
    """
    folder = path.parent if path.name == "metadata.yaml" else path
    with ExitStack() as stack:
        paths = _parts(folder) if folder.is_dir() else [path]
        check_count(path, "files of a bag", len(paths), FILES)
        yield [_opened(part, kind, faults, stack) for part in paths]


def _parts(folder: Path) -> list[Path]:
    """Return the files of a folder, by the numbers in their names."""
    parts = [part for part in folder.iterdir() if part.name.endswith(PARTS) and part.is_file()]
    if not parts:
        raise UnreadableFile(f"{folder}: is a folder without a .db3 or .mcap file, a bag was expected; name a bag")
    return sorted(parts, key=lambda part: [int(s) if s.isdigit() else s for s in re.split(r"(\d+)", part.name)])


def _opened(path: Path, kind: str, faults: Faults, stack: ExitStack) -> Storage:
    first = head(path)
    if path.suffix == ".zstd":
        path = _whole(path, stack)
        first = head(path)
    if first.startswith(sqlite.SIGNATURE):
        return sqlite.Sqlite(path, faults)
    if first.startswith(ros1.SIGNATURE):
        return ros1.Ros1(path, stack.enter_context(path.open("rb")), faults)
    if first.startswith(mcap.SIGNATURE):
        return mcap.Mcap(path, stack.enter_context(path.open("rb")), faults)
    if first.startswith(b"#ROSBAG V"):
        version = first.partition(b"\n")[0].decode("latin-1")
        raise UnreadableFile(
            f"{path}: is of version {version}, #ROSBAG V2.0 was expected; convert it with `rosbag fix`"
        )
    raise foreign(path, first, kind)


def _whole(path: Path, stack: ExitStack) -> Path:
    """Return a temporary file with what a compressed one holds, as far as it is whole."""
    unpacked, most = stack.enter_context(temporary_folder(path)) / path.stem, unpacked_at_most(path)
    try:
        with zstd().open(path, "rb") as packed, unpacked.open("wb") as file:
            while data := packed.read(COPIED):
                keep(path, data, file, most)
    except (OSError, EOFError, zstd().ZstdError) as error:
        raise damaged(path, str(error)) from None
    return unpacked
