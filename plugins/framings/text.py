"""Lines of numbers: one sample a line, between separators.

::

    prefix 1.25, -0.5, 23.1 *4F

A line is a sample if it has as many cells as there are columns, all of them numbers. What came before the first line
end of a stream is left out, since its beginning is not known, unless it begins with the `prefix`. Text has nothing
that tells a flipped digit from a true one, unless the device adds the checksum of NMEA 0183: an asterisk and the
exclusive or of what stands between the first character ($ or !) and it, as two hexadecimal digits.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property, reduce
from operator import xor
from typing import Annotated, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from fusion_core.chunk import Chunk
from fusion_core.contracts import Channel, Memory
from fusion_core.contracts.framing import DAMAGED, GARBAGE, Counter, Frames, Framing
from fusion_core.errors import MissingChannel
from fusion_core.hookspecs import hookimpl
from fusion_core.units import problem
from fusion_plugins.framings.field import DeviceCounter, channel, check_channel, counts, sent

LONGEST = 4096  # bytes of a line
UNKNOWN, BEGUN, OVERLONG = range(3)  # where the unfinished line began: before the stream, within it, too far back


@hookimpl
class Text(Framing):
    """Lines of numbers between separators."""

    kind: Literal["text"] = "text"
    separator: Literal[",", ";", "\t", " "] = ","
    """Separator of cells; a space stands for any number of spaces and tabs."""
    columns: tuple[str, ...] | None = None
    """Names of the columns in order; without them, a line of names is waited for."""
    prefix: str = ""
    """Beginning of every line of samples, as in "$IMU,"."""
    checksum: Literal["nmea"] | None = None
    """Checksum at the end of a line."""
    channels: Annotated[Mapping[str, Channel], Field(min_length=1)]
    """Channels of the columns."""
    counter: DeviceCounter | None = None
    """The column by which the device counts."""

    @model_validator(mode="after")
    def _check(self) -> Self:
        for name, column in self.channels.items():
            check_channel(name, column.unit, len(column.paths))
        if self.columns is not None:
            missing = next((path for path in self._needed if path not in self.columns), None)
            if missing is not None:
                raise problem(f"no column is called '{missing}'; columns are {', '.join(self.columns)}")
        return self

    @property
    def device_counter(self) -> Counter | None:
        """The counter in each line, where there is one."""
        return None if self.counter is None else self.counter.as_counter()

    @cached_property
    def _needed(self) -> list[str]:
        paths = [path for column in self.channels.values() for path in column.paths]
        return list(dict.fromkeys(paths + ([self.counter.field] if self.counter else [])))

    def decode(self, data: bytes, memory: Memory) -> tuple[Frames, Memory]:
        """Return the lines that end in `data`; the memory is the line that has not, and the columns."""
        state, rest, columns = memory or (UNKNOWN, b"", self.columns)
        *lines, rest = (rest + data).split(b"\n")
        rows: list[list[float]] = []
        garbage = damaged = 0
        for line in lines:
            text, whole = (None, None) if state == OVERLONG or len(line) > LONGEST else self._payload(line)
            names = self._header(text, columns, state) if text is not None and whole else None
            row = self._row(text, columns) if text is not None and whole and (state == BEGUN or self.prefix) else None
            state = BEGUN
            if names is not None:
                columns = names
            elif whole is False:
                damaged += 1
            elif row is not None:
                rows.append(row)
            else:
                garbage += len(line) + 1
        if len(rest) > LONGEST or (rest and state == OVERLONG):
            garbage, rest, state = garbage + len(rest), b"", OVERLONG
        rejections = {GARBAGE: garbage, DAMAGED: damaged}
        frames = self._frames(rows, {what: n for what, n in rejections.items() if n})
        return frames, (state, rest, columns)

    def encode(self, chunk: Chunk, begun: int) -> bytes:
        """Return the lines of samples; before the first one, the columns' names where the config does not fix them."""
        names = self.columns or tuple(self._needed)
        cells = np.full((len(chunk), len(names)), "0", dtype=object)
        for name, column in self.channels.items():
            values = chunk.t if name == "time" else chunk[name]
            for path, numbers in zip(column.paths, sent(name, values, column.unit).T, strict=True):
                cells[:, names.index(path)] = list(map(repr, numbers.tolist()))
        if self.counter is not None:
            count = counts(self.counter.as_counter(), chunk.t, begun)
            cells[:, names.index(self.counter.field)] = list(map(str, count.tolist()))
        rows = cells.tolist() if self.columns or begun else [names, *cells.tolist()]
        return "".join(self._line(row) for row in rows).encode()

    def _line(self, cells: Sequence[str]) -> str:
        text = self.prefix + self.separator.join(cells)
        check = "" if self.checksum is None else f"*{reduce(xor, text[1:].encode(), 0):02X}"
        return f"{text}{check}\r\n"

    def _payload(self, line: bytes) -> tuple[str | None, bool | None]:
        """Return the cells' text and whether the checksum is right; (None, None) where it is no line of the device."""
        try:
            text = line.decode("ascii").strip("\r \t")
        except UnicodeDecodeError:
            return None, None
        if not text.replace("\t", " ").isprintable():  # Python takes some control characters for spaces
            return None, None
        if self.checksum is not None:
            text, star, digits = text.rpartition("*")
            if not star or text[:1] not in ("$", "!"):
                return None, None
            if digits.upper() != f"{reduce(xor, text[1:].encode(), 0):02X}":
                return None, False
        if not text.startswith(self.prefix):
            return None, None
        return text[len(self.prefix) :], True

    def _cells(self, text: str) -> list[str]:
        return text.split() if self.separator == " " else text.split(self.separator)

    def _header(self, text: str, columns: tuple[str, ...] | None, state: int) -> tuple[str, ...] | None:
        """Return the columns' names where the line is a header and they are not fixed by the config.

        Raises MissingChannel where it is the header of another device; one that is torn or damaged is none.
        """
        if self.columns is not None or not any(character.isalpha() for character in text):
            return None
        names = tuple(cell.strip() for cell in self._cells(text))
        if all(path in names for path in self._needed):
            return names
        begun = state == BEGUN or bool(self.prefix)
        most = sum(path in names for path in self._needed) > len(self._needed) // 2
        if begun and columns is None and most and not any(_numbers([name]) for name in names):
            missing = next(path for path in self._needed if path not in names)
            raise MissingChannel(
                f"text: the device's header has no column '{missing}', it has {', '.join(names)}; correct the channels"
            )
        return None

    def _row(self, text: str, columns: tuple[str, ...] | None) -> list[float] | None:
        """Return the numbers of the needed columns, or None."""
        cells = self._cells(text)
        if columns is None or len(cells) != len(columns) or "_" in text:  # which Python takes for part of a number
            return None
        numbers = _numbers(cells)
        if numbers is None:
            return None
        if self.counter is not None and not abs(numbers[columns.index(self.counter.field)]) < 1 << 63:
            return None
        return [numbers[columns.index(path)] for path in self._needed]

    def _frames(self, rows: list[list[float]], rejected: dict[str, int]) -> Frames:
        values = np.array(rows, dtype=np.float64).reshape(len(rows), len(self._needed))
        place = {path: k for k, path in enumerate(self._needed)}
        channels = {
            name: channel(name, values[:, [place[p] for p in column.paths]], column.unit)
            for name, column in self.channels.items()
        }
        count = None if self.counter is None else np.rint(values[:, place[self.counter.field]]).astype(np.int64)
        return Frames(len(rows), channels, count, rejected)


def _numbers(cells: Sequence[str]) -> list[float] | None:
    """Return the numbers in cells, None where one is none."""
    try:
        return [float(cell) for cell in cells]
    except ValueError:
        return None
