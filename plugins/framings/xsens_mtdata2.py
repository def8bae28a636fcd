"""The messages MTData2 of Xsens (Movella) MTi units.

::

    FA | FF | 36 | length | item | item | ... | checksum          item = identifier (2) | size (1) | data

Big-endian. A length of FF is followed by two bytes with the length. All bytes behind FA add up to zero, modulo 256.
The items and their order are as the unit is set; an item that was not measured anew is left out of a
message, as the temperature is in most of them: the last one that came holds. Read are, as float32, float64 or fixed
point 12.20 (the last two bits of the identifier):

    1060 sample time (uint32, 0.1 ms) | 1020 packet counter (uint16) | 0810 temperature (degC)
    4020 acceleration (m/s^2)         | 8020 rate of turn (rad/s)

Source: Xsens, MT Low Level Communication Protocol Documentation, MT0101P, chapters 2 (message) and 5.3 (MTData2).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from fusion_core.chunk import Array, Bytes, Chunk, Integers
from fusion_core.contracts import Memory
from fusion_core.contracts.framing import DAMAGED, GARBAGE, Counter, Frames, Framing
from fusion_core.hookspecs import hookimpl
from fusion_plugins.framings.field import channel, counts

SYNC = b"\xfa\xff\x36"
LONGEST = 4096  # bytes of a message; the length of what looks like a longer one is damaged
IDENTIFIERS = {"temperature": 0x0810, "accel": 0x4020, "gyro": 0x8020}
AXES = {"temperature": 1, "accel": 3, "gyro": 3}
NUMBERS = {0: (">f4", 1.0), 1: (">i4", 2.0**-20), 3: (">f8", 1.0)}  # by the format bits: type and factor
CLOCKS = {"sample_time": (0x1060, ">u4"), "packet_counter": (0x1020, ">u2")}
INCOMPLETE = "messages without rate of turn or time, left out"

Channel = Literal["gyro", "accel", "temperature"]


class Item(NamedTuple):
    """The place of an item's data in a message, and their number of bytes."""

    start: int
    size: int


@hookimpl
class XsensMtdata2(Framing):
    """Xsens MTi units, messages MTData2."""

    kind: Literal["xsens_mtdata2"] = "xsens_mtdata2"
    channels: Annotated[tuple[Channel, ...], Field(min_length=1)] = ("gyro", "accel", "temperature")
    """Items to read; leave out those that the unit is not set to send."""
    clock: Literal["sample_time", "packet_counter"] = "sample_time"
    """Item that has the time: the sample time in 0.1 ms, or the counter of messages."""

    @classmethod
    def examples(cls) -> Iterable[Self]:
        """Return both clocks."""
        return (cls(), cls(clock="packet_counter"))

    @property
    def device_counter(self) -> Counter:
        """The sample time, or the packet counter."""
        return Counter(2**32, 1e-4) if self.clock == "sample_time" else Counter(2**16)

    def decode(self, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
        """Return the messages that end in `data`; the memory is the begun one, and the last value of each channel."""
        rest, held = memory or (b"", {})
        stream = rest + data
        messages: list[tuple[int, int]] = []  # place and length of each whole message
        rejected = garbage = at = 0
        while (place := stream.find(SYNC, at)) >= 0:
            garbage, at = garbage + place - at, place
            length = _length(stream, at)
            if length is None or at + length > len(stream):
                break
            if length and sum(stream[at + 1 : at + length]) % 256 == 0:
                messages.append((at, length))
                at += length
            else:
                rejected, garbage, at = rejected + 1, garbage + 1, at + 1
        else:
            keep = max(at, len(stream) - len(SYNC) + 1)
            garbage, at = garbage + keep - at, keep
        frames, held = self._frames(stream, messages, held, {GARBAGE: garbage, DAMAGED: rejected})
        return frames, (stream[at:], held)

    def encode(self, chunk: Chunk, begun: int) -> bytes:
        """Return the messages of samples, in single precision, with the temperature in each."""
        identifier, code = CLOCKS[self.clock]
        items = {identifier: counts(self.device_counter, chunk.t, begun)[:, None].astype(code)}
        for name in sorted(self.channels, key=IDENTIFIERS.__getitem__):
            items[IDENTIFIERS[name]] = chunk[name].reshape(len(chunk), -1).astype(">f4")
        parts = []
        for identifier, values in items.items():
            data = values.view(np.uint8)
            parts += [_repeated(identifier.to_bytes(2, "big") + bytes([data.shape[1]]), len(chunk)), data]
        body = np.concatenate(parts, axis=1)
        head = _repeated(SYNC + bytes([body.shape[1]]), len(chunk))
        total = np.sum(head[:, 1:], axis=1, dtype=np.int64) + np.sum(body, axis=1, dtype=np.int64)
        return np.column_stack([head, body, (-total % 256).astype(np.uint8)]).tobytes()

    def _frames(
        self, stream: bytes, whole: list[tuple[int, int]], held: Mapping[str, Array], rejected: dict[str, int]
    ) -> tuple[Frames, dict[str, Array]]:
        """Return the samples of whole messages, and the last value of each channel for those that follow."""
        values = {name: np.full((len(whole), AXES[name]), np.nan) for name in self.channels}
        count, timed = np.zeros(len(whole), dtype=np.int64), np.zeros(len(whole), dtype=bool)
        places = np.array(whole, dtype=np.int64).reshape(-1, 2)
        text = np.frombuffer(stream, np.uint8)
        for rows in _alike(text, places):
            at, length = places[rows[0]]
            messages = text[places[rows, 0, None] + np.arange(length)]
            items = _items(stream[at : at + length])
            if (number := self._clock(messages, items)) is not None:
                count[rows], timed[rows] = number, True
            for name in self.channels:
                if (columns := _numbers(messages, items, name)) is not None:
                    values[name][rows] = columns
        good = timed & (np.isfinite(values["gyro"][:, 0]) if "gyro" in values else True)
        rejected[INCOMPLETE] = int(np.sum(~good))
        if "temperature" in values:
            values["temperature"] = _hold(values["temperature"], held.get("temperature"))
            if len(whole):
                held = {"temperature": values["temperature"][-1]}
        channels: dict[str, Array] = {name: channel(name, columns[good]) for name, columns in values.items()}
        left = {what: n for what, n in rejected.items() if n}
        return Frames(int(np.sum(good)), channels, count[good], left), dict(held)

    def _clock(self, messages: Bytes, items: Mapping[int, Item]) -> Integers | None:
        """Return the time or the counter (N,) of messages, None where they have none."""
        identifier, code = CLOCKS[self.clock]
        item = items.get(identifier)
        if item is None or item.size != np.dtype(code).itemsize:
            return None
        return _view(messages, item, np.dtype(code))[:, 0].astype(np.int64)


def _repeated(data: bytes, N: int) -> Bytes:
    return np.tile(np.frombuffer(data, np.uint8), (N, 1))


def _length(stream: bytes, at: int) -> int | None:
    """Return the length of the message that begins at `at`; None where it is still to come, 0 where it is none."""
    if at + 4 > len(stream):
        return None
    if stream[at + 3] < 0xFF:
        return 5 + stream[at + 3]
    if at + 6 > len(stream):
        return None
    length = int.from_bytes(stream[at + 4 : at + 6], "big")
    return 7 + length if length <= LONGEST else 0


def _alike(text: Bytes, places: Integers) -> Iterable[Integers]:
    """Yield the rows of `places` in groups whose messages have the same items at the same places."""
    for length in np.unique(places[:, 1]):
        rows = np.flatnonzero(places[:, 1] == length)
        while len(rows):
            begin = int(places[rows[0], 0])
            items = _items(text[begin : begin + length].tobytes())
            heads = [place for item in items.values() for place in range(item.start - 3, item.start)] or [3]
            same = np.all(text[places[rows, 0, None] + heads] == text[begin + np.array(heads)], axis=1)
            yield rows[same]
            rows = rows[~same]


def _items(message: bytes) -> dict[int, Item]:
    """Return the items of a message by their identifiers."""
    at, end, items = 4 if message[3] < 0xFF else 6, len(message) - 1, {}
    while at + 3 <= end and at + 3 + message[at + 2] <= end:
        items[int.from_bytes(message[at : at + 2], "big")] = Item(at + 3, message[at + 2])
        at += 3 + message[at + 2]
    return items


def _numbers(messages: Bytes, items: Mapping[int, Item], name: str) -> Array | None:
    """Return the values (N, d) of a channel, in whatever number format and coordinate system; None where not sent."""
    for identifier, item in items.items():
        code, factor = NUMBERS.get(identifier & 0x3, ("", 0.0))
        if identifier & 0xFFF0 == IDENTIFIERS[name] and code and item.size == AXES[name] * np.dtype(code).itemsize:
            return _view(messages, item, np.dtype(code)).astype(np.float64) * factor
    return None


def _view(messages: Bytes, item: Item, number: np.dtype[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(messages[:, item.start : item.start + item.size]).view(number)


def _hold(values: Array, before: Array | None) -> Array:
    """Return (N, 1) with the last number that came where there is none; `before` is that of the messages before."""
    row = np.where(np.isfinite(values[:, 0]), np.arange(1, len(values) + 1), 0)
    known = np.concatenate([[[np.nan]] if before is None else [before], values])
    return np.asarray(known[np.maximum.accumulate(row)] if len(values) else values, dtype=np.float64)
