"""ROS 2 bags of sqlite3 (`.db3`): a table of topics and one of messages.

Messages are read in the order in which they were written; those of other topics are passed over. What a recorder that
was killed left in a write-ahead log (`-wal`) beside the file is read with it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Set
from contextlib import closing
from itertools import compress
from pathlib import Path
from urllib.parse import quote

import numpy as np

from fusion_core.errors import UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins.sources.bag_storage import Batch, Connection, ros2_name

SIGNATURE = b"SQLite format 3\0"
ROWS = 4096
SOUND = "AND typeof(data) = 'blob' AND typeof(timestamp) = 'integer'"  # which a damaged row may not be
TEXT = "WHERE typeof(id) = 'integer' AND typeof(name) = 'text' AND typeof(type) = 'text'"  # likewise
LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl"}
REPAIR = "`sqlite3 OLD .recover | sqlite3 NEW` repairs it"


class Sqlite:
    """A bag file."""

    def __init__(self, path: Path, faults: Faults) -> None:
        self.path, self.faults = path, faults
        try:
            with closing(self._connect()) as base:
                self.connections = list(self._topics(base))
        except (sqlite3.Error, ValueError) as error:
            raise UnreadableFile(f"{path}: is no bag, or is damaged ({error}); {REPAIR}") from None

    def count(self, connection: int) -> int | None:
        """Return how many messages a connection has, None where a damaged file does not tell."""
        try:
            with closing(self._connect()) as base:
                query = "SELECT COUNT(*) FROM messages WHERE topic_id = ?"
                return int(base.execute(query, (connection,)).fetchone()[0])
        except sqlite3.Error:
            return None

    def batches(self, wanted: Set[int]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections."""
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) {SOUND} ORDER BY id"
        some: list[tuple[int, int, bytes]] = []
        read = 0
        try:
            with closing(self._connect()) as base:
                for row in base.execute(query, sorted(wanted)):
                    some.append(row)
                    if len(some) == ROWS:
                        read += len(some)
                        yield from self._grouped(some)
                        some = []
        except sqlite3.Error as error:
            where = f"after {read + len(some)} messages"
            self.faults.add(f"damaged page ({error}), what follows is lost; {REPAIR}", 1, where)
        yield from self._grouped(some)

    def _grouped(self, rows: list[tuple[int, int, bytes]]) -> Iterator[Batch]:
        """Yield messages by their topic."""
        if rows:
            topics, times, messages = zip(*rows, strict=True)
            for number in sorted(set(topics)):
                mine = [topic == number for topic in topics]
                yield self._batch(number, list(compress(times, mine)), list(compress(messages, mine)))

    def _batch(self, number: int, times: list[int], messages: list[bytes]) -> Batch:
        sizes = np.array([len(data) for data in messages], dtype=np.int64)
        return Batch(number, np.array(times, dtype=np.int64), b"".join(messages), np.cumsum(sizes) - sizes, sizes)

    def _connect(self) -> sqlite3.Connection:
        """Open for reading; without a log beside it, nothing is written next to the file."""
        log = self.path.with_name(f"{self.path.name}-wal")
        place = quote(str(self.path.resolve()))
        if log.exists() and log.stat().st_size:
            base = sqlite3.connect(f"file:{place}?mode=ro", uri=True)
            try:
                base.execute("SELECT name FROM sqlite_master")
                return base
            except sqlite3.Error:  # of a folder that cannot be written to
                base.close()
                self.faults.add(
                    "write-ahead log that cannot be read, left out; copy the bag to a folder of yours", 1, log.name
                )
        base = sqlite3.connect(f"file:{place}?mode=ro&immutable=1", uri=True)
        base.execute("PRAGMA writable_schema = ON")  # else SQLite refuses a file that is shorter than its header says
        return base

    def _topics(self, base: sqlite3.Connection) -> Iterator[Connection]:
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise ValueError(
                f"tables topics and messages were expected, it has {', '.join(sorted(map(str, tables))) or 'none'}"
            )
        definitions: dict[str, tuple[str, str]] = {}
        if "message_definitions" in tables:
            found = base.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            definitions = {name: (LANGUAGES.get(form, ""), text) for name, form, text in found}
        for number, topic, kind, form in base.execute(
            "SELECT id, name, type, serialization_format FROM topics " + TEXT
        ):
            language, text = definitions.get(kind, ("", ""))
            yield Connection(number, topic, ros2_name(kind), text, language, form)
