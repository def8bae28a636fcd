"""An open DataFlash log: its messages, the places of their rows, its parameters, and its damage.

Records that nothing known follows: whole ones before a gap, or ones whose tail was overwritten.

::

    kept where every number lies between the least and the largest of the whole records, or `ROOM` of their span beyond

A tail of garbage or of zeros hardly ever passes: many fields (counts of errors, states of health, rates) do not change
over a log, and random bytes as a float are seldom of its size.

A row may pass for whole and still hold damaged bytes, of which its time stamp tells:

::

    kept = the longest run of rows, others skipped, along which time does not go back

so the fewest rows are left out that time can be right without. Where more than `FEW` rows in a row would have to go,
nothing is damaged: the clock began anew, and they stay, for who reads them to see. At either end, where nothing
comes after to tell, a few rows that are farther from all others than these last altogether go as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numba import njit

from fusion_core.budget import COUNT, TimeBudget, check_count
from fusion_core.chunk import Array, Bytes, Flags, Integers
from fusion_core.errors import MissingChannel, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.settings import did_you_mean
from fusion_plugins.sources.dataflash import scan as records
from fusion_plugins.sources.dataflash.imu import Parameters

DESCRIBED, CHANGES = 100_000, 10_000
ABOUT = ("FMTU", "UNIT", "MULT", "PARM", "DSF", "PM")
"""Messages about the log itself."""


@dataclass(frozen=True, eq=False)
class MessageStream:
    """The rows of one message, of one instance where it has several.

    Attributes
    ----------
    message : Message
    at : (N,) array of int
        Where they begin in the file.
    data : (B,) array of uint8
        The file.
    unit : int or None
        The inertial unit that they are of, from 0; None for other messages.
    samples : dict of str to array
        The axes of their sensor, as soon as they were worked out.
    """

    message: records.Message
    at: Integers
    data: Bytes
    unit: int | None = None
    samples: dict[str, Array] = field(default_factory=dict, init=False)

    def values(self, label: str) -> Array:
        """Return a field of the rows."""
        return self.message.values(self.data, self.at, label)

    def pieces(self) -> Iterator[MessageStream]:
        """Yield the rows in order, some at a time: a column of a long log takes more memory than their places."""
        for start in range(0, len(self.at), records.ROWS):
            yield replace(self, at=self.at[start : start + records.ROWS])

    def extremes(self, label: str) -> tuple[float, float]:
        """Return the least and the largest value of a field that is a number; NaN where none is."""
        low = high = np.nan
        for part in self.pieces():
            values = part.values(label)
            low, high = float(np.fmin.reduce(values, initial=low)), float(np.fmax.reduce(values, initial=high))
        return low, high

    def time(self, label: str | None = None) -> Array:
        """Return the times of the rows (N,) in s since power-up, by their TimeUS or the clock `label`.

        Raises
        ------
        MissingChannel
            If the message has no clock.
        """
        label = label if label in records.CLOCKS and label in self.message.labels else self.message.clock
        if label is None:
            raise MissingChannel(f"{self.message.name}: its rows have no time stamp; name a message with TimeUS")
        t: Array = self.values(label)
        t *= records.CLOCKS[label]
        return t


class DataFlashMessages:
    """The messages of an open log.

    Parameters
    ----------
    path : Path
    data : (B,) array of uint8
        The whole file, mapped.
    wanted : iterable of str
        Names of the messages whose rows will be read.
    faults : Faults

    Raises
    ------
    UnreadableFile
        If no message is described, or what is described is beyond the budget.
    """

    def __init__(self, path: Path, data: Bytes, wanted: Iterable[str], faults: Faults) -> None:
        self.path, self.data = path, data
        self._instances: dict[str, dict[int, MessageStream]] = {}
        clock = TimeBudget(path, "what is no record")
        first = records.scan(data, {records.FMT: len(data) // records.FMT_LENGTH + 1}, clock)
        descriptions = first.at[records.FMT]
        check_count(path, "descriptions of messages (FMT)", len(descriptions), DESCRIBED)
        self._described = records.described(data, descriptions)
        self.counts = first.counts
        if not self._described:
            raise UnreadableFile(f"{path}: describes no message (FMT); it is cut at its beginning, copy it again")
        self.messages = self._by_name()
        for name, message in self.messages.items():
            if name in ABOUT:
                most = DESCRIBED if name in records.DESCRIPTIONS else COUNT
                check_count(path, f"records of {name}", int(self.counts[message.type]), most)
        wanted_messages = [message for name in dict.fromkeys([*wanted, *ABOUT]) for message in self._family(name)]
        types = {message.type for message in wanted_messages} | set(first.doubtful_types.tolist())
        second = records.scan(data, {kind: int(first.counts[kind]) for kind in types}, clock)
        self._at = second.at
        self._drop_redefined(faults)
        self._report(*self._with_doubtful(second), faults)
        self._add_units()

    def _by_name(self) -> dict[str, records.Message]:
        """Return the messages by name; of two of one name, the one with more rows."""
        messages: dict[str, records.Message] = {}
        for kind, descriptions in self._described.items():
            message = descriptions[0][1]
            if message.name not in messages or self.counts[kind] > self.counts[messages[message.name].type]:
                messages[message.name] = message
        return messages

    def _family(self, name: str) -> list[records.Message]:
        """Return the message, and of inertial units the same for other instances (IMU2, GYR1)."""
        names = [name, *(f"{name}{digit}" for digit in "12345")] if name in records.INERTIAL else [name]
        return [self.messages[one] for one in names if one in self.messages]

    def _with_doubtful(self, scanned: records.Scan) -> tuple[int, int, int]:
        """Take in the records in doubt that are credible; return bytes lost, the first of them, and the end."""
        credited: list[tuple[int, int]] = []
        for kind in np.unique(scanned.doubtful_types).tolist():
            message, at = self._described[kind][0][1], scanned.doubtful[scanned.doubtful_types == kind]
            if message.name not in ABOUT and len(self._described[kind]) == 1:
                whole = self._at[kind]
                at = at[credible(message, self.data, whole, at)].astype(whole.dtype)
                self._at[kind] = np.sort(np.concatenate([whole, at])) if len(at) else whole
                credited += [(pos, message.size) for pos in at.tolist()]
        lost, first, end = scanned.lost, scanned.first_lost, scanned.end
        for pos, size in sorted(credited):
            if pos < end:
                lost, first = lost - size, first + size if first == pos else first
            else:
                lost, first, end = lost + pos - end, first if lost or pos == end else end, pos + size
        return lost, first, end

    def _drop_redefined(self, faults: Faults) -> None:
        for kind, at in self._at.items():
            others = self._described[kind][1:]
            if others:
                before = at[at < others[0][0]]
                name = self._described[kind][0][1].name
                faults.add(f"rows of {name} behind another description of it, left out", len(at) - len(before),
                           f"at byte {others[0][0]}")  # fmt: skip
                self._at[kind] = before

    def _report(self, lost: int, where: int, end: int, faults: Faults) -> None:
        tail = self.data[end:]
        content = _end_of_content(tail)
        faults.add("bytes of the log that are no records, skipped", lost, f"at byte {where}")
        faults.add("bytes of a last record that is cut or damaged, skipped", content, f"at byte {end}")
        unwritten = f"at byte {end + content}"
        faults.add("bytes at the end that were never written (loss of power), skipped", len(tail) - content, unwritten)
        for name, label in (("DSF", "Dp"), ("PM", "LogDrop")):
            stream = self._rows(name)
            if stream is not None and len(stream.at) and stream.message.label(label) and stream.message.clock:
                dropped = stream.values(label)
                first = f"by t = {stream.time()[int(np.argmax(dropped > 0))]:.3f} s"
                faults.add(f"messages that the vehicle could not log ({name}.{label})", int(dropped.max()), first)
                return

    def _rows(self, name: str) -> MessageStream | None:
        message = self.messages.get(name)
        return None if message is None else MessageStream(message, self._at[message.type], self.data)

    def _add_units(self) -> None:
        """Give the messages the units that FMTU, UNIT and MULT name."""
        table = self._rows("FMTU")
        if table is None or not table.message.has(FmtType="bB", UnitIds="nNZ", MultIds="nNZ"):
            return
        units, sizes = self._names_of_units()
        kinds = table.values("FmtType").astype(int).tolist()
        texts = (table.message.text(self.data, table.at, label) for label in ("UnitIds", "MultIds"))
        by_type = {message.type: name for name, message in self.messages.items()}
        for kind, unit, size in zip(kinds, *texts, strict=True):
            if kind in by_type:
                message = self.messages[by_type[kind]]
                self.messages[by_type[kind]] = records.with_units(message, unit, size, units, sizes)

    def _names_of_units(self) -> tuple[dict[str, str], dict[str, float]]:
        units: dict[str, str] = {}
        sizes: dict[str, float] = {}
        if (rows := self._rows("UNIT")) is not None and rows.message.has(Id="bB", Label="nNZ"):
            units = dict(zip(_letters(rows), rows.message.text(self.data, rows.at, "Label"), strict=True))
        if (rows := self._rows("MULT")) is not None and rows.message.has(Id="bB", Mult="fd"):
            sizes = dict(zip(_letters(rows), (float(f"{size:.7g}") for size in rows.values("Mult")), strict=True))
        return units, sizes

    @cached_property
    def parameters(self) -> Parameters:
        """The parameters (PARM)."""
        rows = self._rows("PARM")
        if rows is None or not rows.message.has(Name="nNZ", Value="fd"):
            return Parameters([], np.empty(0, np.int64), np.empty(0))
        parameters = Parameters(rows.message.text(self.data, rows.at, "Name"), rows.at, rows.values("Value"))
        check_count(self.path, "changes of the inertial units' parameters (PARM)", parameters.steps, CHANGES)
        return parameters

    @property
    def units(self) -> dict[int, MessageStream]:
        """The inertial units: rows of IMU by instance, or of IMU, IMU2, IMU3 of earlier logs."""
        return self.instances("IMU")

    def instances(self, name: str) -> dict[int, MessageStream]:
        """Return the rows of a message by instance; 0 where it has none."""
        if name not in self._instances:
            self._instances[name] = self._by_instance(name)
        return self._instances[name]

    def _by_instance(self, name: str) -> dict[int, MessageStream]:
        streams: dict[int, MessageStream] = {}
        inertial = name in records.INERTIAL
        if name in self.messages and self.messages[name].instance:
            message = self.messages[name]
            found = self._places(message, str(message.instance))
            for k in sorted(found):
                at = np.concatenate(found.pop(k))
                streams[k] = MessageStream(message, at, self.data, k if inertial else None)
            return streams
        for message in self._family(name):
            digit = message.name.removeprefix(name)
            k = int(digit) - 1 if digit else 0
            streams[k] = MessageStream(message, self._at[message.type], self.data, k if inertial else None)
        return {k: stream for k, stream in streams.items() if len(stream.at)}

    def _places(self, message: records.Message, label: str) -> dict[int, list[Integers]]:
        """Return the places of each instance's rows, piece by piece, and give up those of all."""
        found: dict[int, list[Integers]] = {}
        for part in MessageStream(message, self._at.pop(message.type, np.empty(0, np.int64)), self.data).pieces():
            which = message.raw(self.data, part.at, label)
            for k in np.unique(which).tolist():
                found.setdefault(int(k), []).append(part.at[which == k])
        return found

    def missing(self, path: str) -> MissingChannel:
        """Return the error for a message that the log does not have."""
        have = sorted(((int(self.counts[m.type]), name) for name, m in self.messages.items()), reverse=True)
        have = [(rows, name) for rows, name in have if rows and name not in records.DESCRIPTIONS]
        name = path.partition(".")[0].partition("[")[0]
        listed = ", ".join(f"{known} ({rows} rows)" for rows, known in have[:20])
        advice = "set LOG_BITMASK and LOG_DISARMED before the next log"
        if name not in records.INERTIAL:
            advice = did_you_mean(name, [known for _, known in have], "correct the path", "'")
        return MissingChannel(f"{self.path}: has no message '{name}' for '{path}', it has {listed or 'none'}; {advice}")

    def sound(self, stream: MessageStream, faults: Faults | None, clock: str | None = None) -> MessageStream:
        """Return the rows whose time stamps are not damaged; the others go to `faults`, where it is given."""
        if clock is None and stream.message.clock is None:
            return stream
        if _rises(stream, clock):
            return stream
        good = plausible(stream.time(clock))
        if faults is not None and not np.all(good):
            where = f"at byte {stream.at[np.argmin(good)]}"
            faults.add("rows with a damaged time stamp, left out", int(np.sum(~good)), where)
        return replace(stream, at=stream.at[good])


def _letters(rows: MessageStream) -> list[str]:
    return [chr(code % 256) for code in rows.values("Id").astype(int)]


def _end_of_content(tail: Bytes) -> int:
    """Return the number of bytes before an end of nothing but 0 or 255, at least 16 of them."""
    last = 0
    for fill in (0, 255):
        other = np.flatnonzero(tail != fill)
        begin = int(other[-1]) + 1 if len(other) else 0
        last = begin if fill == 0 else min(last, begin)
    return last if len(tail) - last >= 16 else len(tail)


ROOM = 0.25  # of the span of a field
MIN_WHOLE_RECORDS = 3  # whole records that say what a field can be


def credible(message: records.Message, data: Bytes, whole: Integers, doubtful: Integers) -> Flags:
    """Return the records in doubt (D,) whose values those of whole ones at `whole` (N,) cover, as flags."""
    good = np.full(len(doubtful), len(whole) >= MIN_WHOLE_RECORDS)
    for label in message.numbers if np.any(good) else ():
        known, shown = (message.values(data, at, label) for at in (whole, doubtful))
        known = known[np.isfinite(known)]
        if len(known):
            low, high = float(np.min(known)), float(np.max(known))
            room = ROOM * (high - low)
            inside = (shown >= low - room) & (shown <= high + room)
            good &= inside if inside.ndim == 1 else np.all(inside, axis=1)
    return good


FEW = 8  # rows in a row: damage is a sector of 512 bytes, which holds so many
MIN_HOLE = 60.0  # s: a hole that is shorter is a hole


def _rises(stream: MessageStream, clock: str | None) -> bool:
    """Return True if the time never goes back, and no few rows at either end are far from all others."""
    at, last = stream.at, -np.inf
    ends = at if len(at) < 2 * FEW + 2 else np.concatenate([at[: FEW + 1], at[-FEW - 1 :]])
    if not np.all(_near(replace(stream, at=ends).time(clock))):
        return False
    for part in stream.pieces():
        t = part.time(clock)
        if t[0] < last or np.any(t[1:] < t[:-1]):
            return False
        last = t[-1]
    return True


def plausible(t: Array) -> Flags:
    """Return the time stamps t (N,) in s, in the order of the file, that are not damaged, as flags."""
    good = np.ones(len(t), dtype=np.bool_)
    if np.any(t[1:] < t[:-1]):
        good = _rising(t)
        edges = np.flatnonzero(np.diff(np.concatenate(([True], good, [True]))))
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            good[begin:end] = end - begin > FEW
    rows = np.flatnonzero(good)
    good[rows[~_near(t[rows])]] = False
    return good


def _near(t: Array) -> Flags:
    """Return the rows that are not a few beyond a hole, at either end, that is longer than all the rest, as flags."""
    good = np.ones(len(t), dtype=np.bool_)
    for part, flags, sign in ((t, good, 1), (t[::-1], good[::-1], -1)):
        for k in range(1, min(FEW, len(t) - FEW - 1) + 1):  # the first k rows, and the last
            if sign * (part[k] - part[k - 1]) > max(sign * (part[-1] - part[k]), MIN_HOLE):
                flags[:k] = False
    return good


@njit(cache=True, nogil=True)  # type: ignore[untyped-decorator]
def _rising(t: Array) -> Flags:
    """Return the samples of t (N,) on the longest subsequence that does not fall, as flags (patience sorting)."""
    n, piles = len(t), 0
    tops, before, last = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n)  # last: t at the top of each pile
    for k in range(n):
        rises = piles > 0 and last[piles - 1] <= t[k]  # as almost always
        pile = piles if rises else np.searchsorted(last[:piles], t[k], side="right")
        tops[pile], last[pile] = k, t[k]
        before[k] = tops[pile - 1] if pile else -1
        piles = max(piles, pile + 1)
    good = np.zeros(n, np.bool_)
    k = tops[piles - 1] if n else -1
    while k >= 0:
        good[k] = True
        k = before[k]
    return good
