"""ROS 2 bags of sqlite3 (`.db3`): a table of topics and one of messages.

Messages are read in the order in which they were written; those of other topics are passed over. What a recorder that
was killed left in a write-ahead log (`-wal`) beside the file is read with it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Set
from contextlib import closing
from pathlib import Path
from urllib import parse

import numpy as np

from fusion_core.budget import LISTED, PIECE, TEXTS, TimeBudget, check_size, size_of
from fusion_core.errors import UnreadableFile, quote
from fusion_core.faults import Faults
from fusion_plugins.sources.rosbag.storage import Batch, Connection, packed, ros2_name

SIGNATURE = b"SQLite format 3\0"
ROWS = 4096  # messages that are read at a time,
LARGE = 32_000_000  # or bytes of them
LEAST = 100  # bytes of a name in memory, however short
STEPS = 100_000  # of SQLite's machine, between two looks at the clock
SOUND = "AND typeof(data) = 'blob' AND typeof(timestamp) = 'integer'"  # which a damaged row may not be
TEXT = "WHERE typeof(id) = 'integer' AND typeof(name) = 'text' AND typeof(type) = 'text'"  # likewise
LANGUAGES = {"ros2msg": "msg", "ros2idl": "idl"}
REPAIR = "`sqlite3 OLD .recover | sqlite3 NEW` repairs it"


class Sqlite:
    """A bag file."""

    def __init__(self, path: Path, faults: Faults) -> None:
        self.path, self.faults = path, faults
        self.log = path.with_name(f"{path.name}-wal")
        self.clock = TimeBudget(path, "a query that gave no message")
        try:
            with self.clock, closing(self._connect()) as base:
                self.connections = list(self._topics(base))
        except (sqlite3.Error, MemoryError, ValueError) as error:
            raise self._beyond(error) or UnreadableFile(
                f"{path}: is no bag, or is damaged ({quote(error, 200)}); {REPAIR}"
            ) from None

    def count(self, connection: int) -> int | None:
        """Return the number of messages of a connection, None if a damaged file does not have it."""
        try:
            with self.clock, closing(self._connect()) as base:
                query = "SELECT COUNT(*) FROM messages WHERE topic_id = ?"
                return int(base.execute(query, (connection,)).fetchone()[0])
        except (sqlite3.Error, MemoryError, UnreadableFile):
            return None

    def batches(self, wanted: Set[int]) -> Iterator[Batch]:
        """Yield the messages of the wanted connections."""
        marks = ",".join("?" * len(wanted))
        query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) {SOUND} ORDER BY id"
        some: list[tuple[int, int, bytes]] = []
        read = taken = 0
        try:
            with closing(self._connect()) as base:
                rows = iter(base.execute(query, sorted(wanted)))
                while True:
                    with self.clock:
                        most = taken + LARGE
                        for row in rows:
                            some.append(row)
                            taken += len(row[2])
                            if len(some) == ROWS or taken > most:
                                break
                        self.clock.check(len(some))
                    read += len(some)
                    self._check_total(read, taken)
                    if not some:
                        return
                    yield from self._grouped(some)
                    some = []
        except (sqlite3.Error, MemoryError) as error:
            if (beyond := self._beyond(error)) is not None:
                raise beyond from None
            where = f"after {read + len(some)} messages"
            self.faults.add(f"damaged page ({quote(error, 200)}), what follows is lost; {REPAIR}", 1, where)
        yield from self._grouped(some)

    def _check_total(self, messages: int, size: int) -> None:
        """Raise UnreadableFile where the messages are more than the file has bytes for: its pages form a circle."""
        have = self.path.stat().st_size + (self.log.stat().st_size if self.log.exists() else 0)
        if size + messages > have:
            raise UnreadableFile(
                f"{self.path}: gives {messages:,} messages of {size_of(size)} in all, and has {size_of(have)}; {REPAIR}"
            )

    def _beyond(self, error: BaseException) -> UnreadableFile | None:
        """Return the error of a query that was ended because it took too much, None for any other."""
        try:
            self.clock.check()
        except UnreadableFile as late:
            return late
        if isinstance(error, MemoryError) or "too big" in str(error):
            return UnreadableFile(
                f"{self.path}: has a value of more than {size_of(LISTED)}, which is the limit; write it in "
                "smaller pieces"
            )
        return None

    def _grouped(self, rows: list[tuple[int, int, bytes]]) -> Iterator[Batch]:
        """Yield messages by their topic."""
        for number in sorted({topic for topic, *_ in rows}):
            _, times, messages = zip(*(row for row in rows if row[0] == number), strict=True)
            yield packed(number, np.array(times, dtype=np.int64), messages)

    def _connect(self) -> sqlite3.Connection:
        """Open for reading; without a log beside it, nothing is written next to the file."""
        log = self.log
        place = parse.quote(str(self.path.resolve()))
        if log.exists() and log.stat().st_size:
            base = self._limited(f"file:{place}?mode=ro")
            try:
                base.execute("SELECT name FROM sqlite_master")
                return base
            except sqlite3.Error:  # of a folder that cannot be written to
                base.close()
                self.faults.add(
                    "write-ahead log that cannot be read, left out; copy the bag to a folder of yours", 1, log.name
                )
        base = self._limited(f"file:{place}?mode=ro&immutable=1")
        base.execute("PRAGMA writable_schema = ON")  # else SQLite refuses a file that is shorter than its header says
        return base

    def _limited(self, place: str) -> sqlite3.Connection:
        """Open, with limits to what a value may take and a query may last."""
        base = sqlite3.connect(place, uri=True)
        base.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LISTED)
        base.set_progress_handler(self._late, STEPS)
        base.execute("PRAGMA trusted_schema = OFF")
        base.execute(f"PRAGMA hard_heap_limit = {PIECE}")
        return base

    def _late(self) -> bool:
        """Return True if a query is to be ended."""
        try:
            self.clock.check()
        except UnreadableFile:
            return True
        return False

    def _topics(self, base: sqlite3.Connection) -> Iterator[Connection]:
        # a virtual table has no page of its own, and nothing that is computed is read: it may take any time
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table' AND rootpage")}
        if not {"topics", "messages"} <= tables:
            raise ValueError(
                f"tables topics and messages were expected, it has {', '.join(sorted(map(str, tables))) or 'none'}"
            )
        for name in sorted(tables & {"topics", "messages", "message_definitions"}):
            computed = base.execute("SELECT COUNT(*) FROM pragma_table_xinfo(?) WHERE hidden > 1", (name,)).fetchone()
            if computed != (0,):
                raise ValueError(f"the table {name} has columns that are computed, values were expected")
        definitions: dict[str, tuple[str, str]] = {}
        texts = 0
        if "message_definitions" in tables:
            found = base.execute("SELECT topic_type, encoding, encoded_message_definition FROM message_definitions")
            for name, form, text in found:
                definitions[name] = LANGUAGES.get(form, ""), text if isinstance(text, str) else ""
                texts += len(definitions[name][1]) + LEAST
                check_size(self.path, "the text of its definitions", texts, TEXTS)
        for number, topic, kind, form in base.execute(
            "SELECT id, name, type, serialization_format FROM topics " + TEXT
        ):
            language, text = definitions.get(kind, ("", ""))
            texts += len(topic) + len(kind) + LEAST
            check_size(self.path, "the text of its definitions and topics", texts, TEXTS)
            yield Connection(number, topic, ros2_name(kind), text, language, str(form))
