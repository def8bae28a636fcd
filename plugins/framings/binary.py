"""Frames of a fixed layout between sync bytes and a checksum.

::

    sync | field | field | ... | checksum | end

The stream is searched for `sync`. Where it stands, the bytes up to the length of a frame are one if the checksum, the
constant fields and `end` are right; the search then goes on behind them. If not, the search goes on one byte behind
the sync: what looked like the beginning of a frame was damaged, torn, or stood by chance in the middle of one. So a
frame that arrived whole is found wherever the stream was torn before it, and sync bytes inside its payload are never
looked at. Only the checksum tells a chance sync from a true one: without it, a torn stream can give a false frame.

Checksums are sums, exclusive or, and the CRCs of the *Catalogue of parametrised CRC algorithms*
(reveng.sourceforge.io/crc-catalogue) by their names there, as in `CRC-32/MPEG-2`; the library `fastcrc` computes them.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache, cached_property
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BeforeValidator, Field, PlainSerializer, model_validator

from fusion_core.chunk import Array, Bytes, Chunk, Flags, Integers
from fusion_core.contracts import Memory
from fusion_core.contracts.framing import DAMAGED, GARBAGE, Counter, Frames, Framing
from fusion_core.hookspecs import hookimpl
from fusion_core.settings import Settings, did_you_mean
from fusion_core.units import problem
from fusion_plugins.framings.field import VALID, DeviceCounter, channel, check_channel, counts, sent

SIMPLE = {"sum8": 1, "sum16": 2, "xor8": 1}  # kinds that need no table: their size in bytes


class Checksum(Settings):
    """The bytes behind the fields of a frame that say whether it is whole."""

    kind: str
    """Name: sum8, sum16, xor8, or a CRC of the catalogue."""
    start: Annotated[int, Field(ge=0, le=1 << 16)] = 0
    """First byte that is covered; the frame's first is 0."""
    byte_order: Literal["big", "little"] | None = None
    """Byte order of the checksum; that of the frame by default."""
    complement: bool = False
    """True if what is sent is the two's complement, so that all bytes add up to zero."""

    @model_validator(mode="after")
    def _known(self) -> Self:
        if self.kind not in SIMPLE and _crc(self.kind) is None:
            advice = did_you_mean(self.kind, names(), "write e.g. CRC-16/MODBUS", "'")
            text = f"checksum '{self.kind}' is neither one of {', '.join(SIMPLE)} nor a CRC of the catalogue; {advice}"
            raise problem(text)
        return self

    @cached_property
    def size(self) -> int:
        """Number of bytes."""
        return SIMPLE.get(self.kind) or int(self.kind.split("/")[0].removeprefix("CRC-")) // 8

    def good(self, frames: Bytes, order: Literal["big", "little"]) -> Flags:
        """Return the frames (N, L) that end with the checksum of the bytes before it, as flags (N,)."""
        body, sent = frames[:, self.start : -self.size], frames[:, -self.size :]
        sent = sent if (self.byte_order or order) == "big" else sent[:, ::-1]
        value = np.zeros(len(frames), dtype=np.int64)
        for k in range(self.size):
            value = value << 8 | sent[:, k]
        return np.asarray(value == self._of(body), dtype=np.bool_)

    def sent(self, body: Bytes, order: Literal["big", "little"]) -> Bytes:
        """Return the checksums (N, size) that stand behind frames (N, L)."""
        value = self._of(body[:, self.start :]).astype(">i8").reshape(-1, 1).view(np.uint8)[:, -self.size :]
        return value if (self.byte_order or order) == "big" else value[:, ::-1]

    def _of(self, body: Bytes) -> Integers:
        if self.kind == "xor8":
            return np.asarray(np.bitwise_xor.reduce(body, axis=1), dtype=np.int64)
        if self.kind in SIMPLE:
            total = np.sum(body, axis=1, dtype=np.int64)
            return np.asarray((-total if self.complement else total) % (1 << 8 * self.size), dtype=np.int64)
        crc = _crc(self.kind)
        assert crc is not None, "the kind was checked"
        n, text = body.shape[1], body.tobytes()
        return np.array([crc(text[k : k + n]) for k in range(0, len(text), n)], dtype=np.int64)


@cache
def _crc(name: str) -> Callable[[bytes], int] | None:
    import fastcrc

    match = re.fullmatch(r"CRC-(8|16|32)/([A-Z0-9][A-Z0-9-]*)", name)
    if match is None:
        return None
    module = getattr(fastcrc, f"crc{match[1]}")
    algorithm = match[2].lower().replace("-", "_")
    return getattr(module, algorithm) if algorithm in module.algorithms_available else None


def names() -> list[str]:
    """Return every kind of checksum."""
    import fastcrc

    crcs = [
        f"CRC-{width}/{algorithm.upper().replace('_', '-')}"
        for width in (8, 16, 32)
        for algorithm in sorted(getattr(fastcrc, f"crc{width}").algorithms_available)
    ]
    return [*SIMPLE, *crcs]


TYPES = {f"{word}{8 * size}": f"{code}{size}" for word, code in (("int", "i"), ("uint", "u")) for size in (1, 2, 4, 8)}
TYPES |= {"float32": "f4", "float64": "f8"}
MAX_FRAMES = 65_536  # frames looked at together


def _hexadecimal(value: Any) -> Any:
    if isinstance(value, bytes):
        return value
    try:
        return bytes.fromhex(value)
    except (TypeError, ValueError):
        raise problem(f"{value!r} are no bytes; write them as text in hexadecimal, as in 'FE 81 FF 55'") from None


Hex = Annotated[bytes, BeforeValidator(_hexadecimal), PlainSerializer(lambda value: value.hex(" ").upper())]


class BinaryField(Settings):
    """One field: `count` numbers of one type, one behind the other. Without a name they are passed over."""

    name: str | None = None
    """Channel that the field is; without a name it is passed over."""
    type: Literal["int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "float32", "float64"]
    """Type of the numbers."""
    count: Annotated[int, Field(ge=1, le=4096)] = 1
    """Count of numbers, one behind the other."""
    scale: float = 1.0
    """Value = number * scale + offset, in `unit`."""
    offset: float = 0.0
    """Added to number * scale."""
    unit: str | None = None
    """Unit of the value."""
    equals: int | None = None
    """Value of the number in every whole frame."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.name is not None:
            check_channel(self.name, self.unit, self.count)
        return self

    def numbers(self, values: Array) -> Array:
        """Return values in `unit` as the numbers that are sent, held at the ends of what the type can hold."""
        raw = (values - self.offset) / self.scale
        kind = np.dtype(TYPES[self.type])
        return raw if kind.kind == "f" else np.clip(np.rint(raw), np.iinfo(kind).min, np.iinfo(kind).max)


@hookimpl
class Binary(Framing):
    """Frames of a fixed layout between sync bytes and a checksum."""

    kind: Literal["binary"] = "binary"
    sync: Hex
    """Bytes that every frame begins with, in hexadecimal."""
    byte_order: Literal["big", "little"] = "little"
    """Byte order of the numbers."""
    fields: Annotated[tuple[BinaryField, ...], Field(min_length=1)]
    """The fields between sync and checksum, in order."""
    checksum: Checksum | None = None
    """Checksum behind the fields, which says whether the frame is whole."""
    end: Hex = b""
    """Bytes that every frame ends with, in hexadecimal."""
    length: Annotated[int, Field(ge=1, le=1 << 16)] | None = None
    """Length of a whole frame in bytes, to check the fields by."""
    counter: DeviceCounter | None = None
    """The field by which the device counts."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        named = [field.name for field in self.fields if field.name is not None]
        if not self.sync:
            raise problem("sync is empty; write the bytes that every frame begins with, as in 'FE 81 FF 55'")
        twice = next((name for name in named if named.count(name) > 1), None)
        if twice:
            raise problem(f"two fields are called '{twice}'; write one with a count, or rename one")
        if self.counter is not None and self.counter.field not in named:
            raise problem(f"counter: no field is called '{self.counter.field}'; fields are {', '.join(named)}")
        if self.length is not None and self.length != self._size:
            raise problem(f"length is {self.length} and the fields add up to {self._size} bytes; correct one of them")
        if self.checksum is not None and self.checksum.start >= self._size - len(self.end) - self.checksum.size:
            raise problem(f"checksum: start {self.checksum.start} is behind the fields; count from the first sync byte")
        return self

    @property
    def device_counter(self) -> Counter | None:
        """The counter in each frame, where there is one."""
        return None if self.counter is None else self.counter.as_counter()

    @cached_property
    def _layout(self) -> np.dtype[Any]:
        order = ">" if self.byte_order == "big" else "<"
        parts: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [("sync", f"V{len(self.sync)}")]
        parts += [(f"f{k}", order + TYPES[field.type], (field.count,)) for k, field in enumerate(self.fields)]
        if self.checksum is not None:
            parts.append(("checksum", f"V{self.checksum.size}"))
        return np.dtype([*parts, ("end", f"V{len(self.end)}")] if self.end else parts)

    @property
    def _size(self) -> int:
        return int(self._layout.itemsize)

    def encode(self, chunk: Chunk, begun: int) -> bytes:
        """Return the frames of samples; a field that is no channel is what it must equal, or zero."""
        frames = np.zeros(len(chunk), self._layout)
        frames["sync"] = np.void(self.sync)
        for k, field in enumerate(self.fields):
            if self.counter is not None and field.name == self.counter.field:
                frames[f"f{k}"] = counts(self.counter.as_counter(), chunk.t, begun)[:, None]
            elif field.name is None or (field.name == VALID and VALID not in chunk.channels):
                frames[f"f{k}"] = (field.name == VALID) if field.equals is None else field.equals
            else:
                values = chunk.t if field.name == "time" else chunk[field.name]
                frames[f"f{k}"] = field.numbers(sent(field.name, values, field.unit))
        if self.end:
            frames["end"] = np.void(self.end)
        if self.checksum is not None:
            raw = frames.view(np.uint8).reshape(len(frames), self._size)
            stop = self._size - len(self.end)
            at = stop - self.checksum.size
            raw[:, at:stop] = self.checksum.sent(raw[:, :at], self.byte_order)
        return frames.tobytes()

    def decode(self, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
        """Return the frames that end in `data`; the memory is what may be the beginning of the next one."""
        stream = memory + data if memory else data
        frames: list[bytes] = []
        rejected, garbage, at, window = 0, 0, 0, 1
        while (place := stream.find(self.sync, at)) >= 0:
            garbage, at = garbage + place - at, place
            possible = min((len(stream) - at) // self._size, window)
            if possible == 0:
                return self._frames(frames, garbage, rejected), stream[at:]
            good = self._good_in_a_row(stream, at, possible)
            if good:
                frames.append(stream[at : at + good * self._size])
                at += good * self._size
                window = min(2 * window, MAX_FRAMES)
            if good < possible:
                window = 1
                if stream.startswith(self.sync, at):
                    rejected, garbage, at = rejected + 1, garbage + 1, at + 1
        keep = max(at, len(stream) - len(self.sync) + 1)
        return self._frames(frames, garbage + keep - at, rejected), stream[keep:]

    def _good_in_a_row(self, stream: bytes, at: int, possible: int) -> int:
        """Return the number of whole frames that stand one behind the other from `at` on, at most `possible`."""
        size = self._size
        frames: Bytes = np.frombuffer(stream, np.uint8, possible * size, at).reshape(possible, size)
        n = _until_false(np.all(frames[:, : len(self.sync)] == np.frombuffer(self.sync, np.uint8), axis=1))
        frames = frames[:n]
        good = np.ones(n, dtype=bool)
        if self.end:
            good &= np.all(frames[:, -len(self.end) :] == np.frombuffer(self.end, np.uint8), axis=1)
        values = frames.reshape(-1).view(self._layout)
        for k, field in enumerate(self.fields):
            if field.equals is not None:
                good &= np.all(values[f"f{k}"] == field.equals, axis=1)
        if self.checksum is not None:
            n = _until_false(good)
            return _until_false(self.checksum.good(frames[:n, : size - len(self.end)], self.byte_order))
        return _until_false(good)

    def _frames(self, frames: list[bytes], garbage: int, rejected: int) -> Frames:
        values = np.frombuffer(b"".join(frames), self._layout)
        channels: dict[str, Array] = {}
        count = None
        for k, field in enumerate(self.fields):
            if field.name is None:
                continue
            if self.counter is not None and field.name == self.counter.field:
                count = values[f"f{k}"][:, 0].astype(np.int64)
                continue
            numbers = values[f"f{k}"].astype(np.float64)
            if field.scale != 1 or field.offset != 0:
                numbers = numbers * field.scale + field.offset
            channels[field.name] = channel(field.name, numbers, field.unit)
        rejections = {GARBAGE: garbage, DAMAGED: rejected}
        return Frames(len(values), channels, count, {what: n for what, n in rejections.items() if n})


def _until_false(flags: Flags) -> int:
    k = int(flags.argmin()) if len(flags) else 0
    return len(flags) if not len(flags) or flags[k] else k
