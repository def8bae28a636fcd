"""Messages as arrays: where the fields of a message stand is found once, and holds for every message of that layout.

::

    CDR     4 bytes of encapsulation, then each number at a multiple of its size, counted from there
    ROS 1   one after the other, little endian
    both    string, sequence: length u32, then the bytes or the items; array: the items

A layout depends on the lengths of strings and sequences alone, so one message is walked through its definition, and of
all others it is enough to compare these lengths: in one step, as columns of one NumPy array. What differs gets a layout
of its own. Sources: OMG CDR (formal/02-06-51), wiki.ros.org/msg.

Message types of a bag: their fields, by rosbags' parser of .msg and .idl texts, and the units that types prescribe.

::

    path of a field          what it is
    angular_velocity.x       a number
    angular_velocity         a struct of numbers: one column each
    covariance, covariance[4]   an array of numbers, or one of them
    header.stamp             a time or a duration, s
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion_core.budget import TimeBudget, size_of
from fusion_core.chunk import Array, Flags, Integers
from fusion_core.errors import UnreadableFile, quote
from fusion_plugins.sources.joining import records
from fusion_plugins.sources.rosbag.storage import Batch, Connection

MAX_LAYOUTS = 8  # layouts at a time
STEPS = 100_000  # of a walk through one message, and
LENGTHS = 4096  # strings and sequences in it: what has more cannot be decoded
MAX_NESTING = 64  # types within one another
FRAME_LENGTH = 256  # bytes of a string that are compared
WIDE = 1024  # values of an array that can be channels
FRAME = "header.frame_id"
ITEM = re.compile(r"(.*)\[(\d+)\]")


class MessageLayout(NamedTuple):
    """The places of the wanted fields in messages of one layout.

    Attributes
    ----------
    record : dtype
        The wanted numbers by their paths, and the lengths that tell the layout by `#k`; as long as holds them all.
    lengths : dict of str to int
        The values of the fields `#k` in messages of this layout.
    """

    record: np.dtype[np.void]
    lengths: Mapping[str, int]


class Decoder:
    """Messages of one type in one encoding."""

    def __init__(self, types: Types, kind: str, encoding: str, leaves: Sequence[str]) -> None:
        self.types, self.kind, self.encoding = types, kind, encoding
        self.clock = TimeBudget(types.path, f"messages of {kind}, each of a layout of its own,")
        self.leaves = list(leaves)
        self.widths: dict[str, set[int]] = {leaf: set() for leaf in leaves}  # lengths of arrays that messages had
        self._layouts: list[MessageLayout] = []

    def decode(self, batch: Batch) -> tuple[dict[str, NDArray[Any]], Flags]:
        """Return the wanted numbers as columns of (n,) or, of arrays, (n, length), and which messages could be read.

        A number that a message does not have, of a sequence too short for its index, is NaN.
        """
        columns: dict[str, NDArray[Any]] = {}
        left, good = np.arange(len(batch.starts)), np.ones(len(batch.starts), dtype=np.bool_)
        with self.clock:
            for layout in list(self._layouts):
                left = left[~self._take(layout, batch, left, columns)]
            while len(left):
                self.clock.check()
                first = int(left[0])
                try:
                    layout = self._layout(batch.data, int(batch.starts[first]), int(batch.sizes[first]))
                except ValueError:
                    good[first] = False
                    left = left[1:]
                    continue
                self._layouts = [layout, *self._layouts[: MAX_LAYOUTS - 1]]
                taken = self._take(layout, batch, left, columns)
                taken[0] = True
                left = left[~taken]
            self.clock.check(len(good))
        return columns, good

    def _take(self, layout: MessageLayout, batch: Batch, at: Integers, columns: dict[str, NDArray[Any]]) -> Flags:
        """Copy what messages of a layout hold into the columns; return which they were."""
        fits = batch.sizes[at] >= layout.record.itemsize
        if not np.any(fits):
            return fits
        values = records(batch.data, batch.starts[at[fits]], layout.record)
        same = np.ones(len(values), dtype=np.bool_)
        for name, value in layout.lengths.items():
            same &= values[name] == value
        fits[fits] = same
        rows = at[fits]
        for leaf, widths in self.widths.items():
            shape = layout.record[leaf].shape if leaf in (layout.record.names or ()) else (0,)
            if len(rows) and shape:
                widths.add(shape[0])
        for name in layout.record.names or ():
            if not name.startswith("#"):
                _put(columns, name, len(batch.starts), rows, values[name][same])
        return fits

    def _layout(self, data: bytes, start: int, size: int) -> MessageLayout:
        walk = _Walk(self.types, memoryview(data)[start : start + size], self.encoding == "cdr", self.leaves)
        walk.through(self.kind)
        places = {**walk.lengths_at, **walk.places}
        formats, offsets = [form for form, _ in places.values()], [offset for _, offset in places.values()]
        need = max((o + np.dtype(f).itemsize for f, o in zip(formats, offsets, strict=True)), default=0)
        if not 0 < need <= size:
            raise ValueError("the message is cut")
        record = np.dtype({"names": list(places), "formats": formats, "offsets": offsets, "itemsize": need})
        return MessageLayout(record, walk.lengths)


def _put(columns: dict[str, NDArray[Any]], name: str, n: int, rows: Integers, values: NDArray[Any]) -> None:
    """Put values into rows of a column, which is made, and made wider, where that is needed."""
    kind = values.dtype if values.dtype.kind == "S" else np.dtype(np.float64)
    if values.dtype.kind in "iu" and values.dtype.itemsize >= 4 and name.endswith("sec"):
        kind = np.dtype(np.int64)  # of a stamp, to the nanosecond
    known = columns.get(name)
    width = values.shape[1:]
    if known is None or known.shape[1:] < width or known.dtype.itemsize < kind.itemsize:
        made = np.full((n, *width), np.nan, kind) if kind.kind == "f" else np.zeros((n, *width), kind)
        if known is not None:
            made[(..., slice(known.shape[1])) if known.ndim > 1 else ...] = known
        columns[name] = known = made
    known[(rows, slice(width[0])) if width else rows] = values


class _Walk:
    """One message, walked through its definition until all wanted fields are found."""

    def __init__(self, types: Types, data: memoryview, aligned: bool, wanted: Sequence[str]) -> None:
        self.types, self.data, self.aligned = types, data, aligned
        self.left = {re.sub(r"\[\d+\]$", "", path) for path in wanted}
        self.wanted = wanted
        self.at, self.order, self.steps, self.depth = 0, "<", 0, 0
        self.places: dict[str, tuple[Any, int]] = {}  # type and place of each wanted number
        self.lengths: dict[str, int] = {}
        self.lengths_at: dict[str, tuple[Any, int]] = {}
        if aligned:
            if len(data) < 4 or data[0] != 0 or data[1] > 1:
                raise ValueError("no plain CDR")
            self.order = "<" if data[1] else ">"
            self._note("<u2", 0, data[1] << 8)
            self.at = 4

    def through(self, kind: str) -> None:
        """Walk through a message."""
        for name, node in self.types.fields[kind]:
            self._value(node, name)
            if not self.left:
                return

    def _value(self, node: Definition, path: str) -> None:
        sort, what = node
        self.steps += 1
        if self.steps > STEPS or self.depth > MAX_NESTING:
            raise ValueError("a message without end")
        if sort == NAME:
            self.depth += 1
            for name, inner in self.types.fields[what]:
                self._value(inner, f"{path}.{name}")
                if not self.left:
                    return
            self.depth -= 1
        elif sort == BASE:
            self._base(what[0], path)
        elif sort == ARRAY:
            self._items(what[0], what[1], path)
        elif sort == SEQUENCE:
            self._items(what[0], self._length(), path)

    def _base(self, kind: str, path: str) -> None:
        if kind == "string":
            length = self._length()
            if path in self.left:
                self.places[path] = (f"S{min(max(length, 1), FRAME_LENGTH)}", self.at if length else self.at - 1)
                self.left.discard(path)
            self._go(length)
        else:
            self._numbers(kind, None, path)

    def _numbers(self, kind: str, count: int | None, path: str) -> None:
        """Go past a number, or `count` of them, and keep where they are if they are wanted."""
        if kind not in SIZES:
            raise ValueError(f"values of type {kind}")
        form = np.dtype(f"{self.order}{SIZES[kind]}")
        if self.aligned and count != 0:
            self.at += -(self.at - 4) % form.itemsize
        if path in self.left:
            self.left.discard(path)
            if path in self.wanted and count != 0:
                if (count or 0) > WIDE:
                    raise ValueError(f"an array of {count} values")
                self.places[path] = (form if count is None else (form, (count,)), self.at)
            for one in self.wanted:
                k = ITEM.fullmatch(one)
                if k and k[1] == path and int(k[2]) < (count or 0):
                    self.places[one] = (form, self.at + int(k[2]) * form.itemsize)
        self._go(form.itemsize * (1 if count is None else count))

    def _items(self, node: Definition, count: int, path: str) -> None:
        if node[0] == BASE and node[1][0] != "string":
            self._numbers(node[1][0], count, path)
            return
        for k in range(count):
            self._value(node, f"{path}[{k}]")
            if not self.left:
                return

    def _length(self) -> int:
        """Return the length of a string or a sequence, which tells the layout, and go past it."""
        if self.aligned:
            self.at += -(self.at - 4) % 4
        form = f"{self.order}u4"
        place = self.at
        self._go(4)
        length = int(np.frombuffer(self.data[place : place + 4], form)[0])
        if length > len(self.data):
            raise ValueError("a length is beyond the message")
        self._note(form, place, length)
        return length

    def _note(self, form: str, place: int, value: int) -> None:
        if len(self.lengths) >= LENGTHS:
            raise ValueError("a message of too many strings")
        name = f"#{len(self.lengths)}"
        self.lengths[name], self.lengths_at[name] = value, (form, place)

    def _go(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("the message is cut")


def column(field: Field, columns: Mapping[str, NDArray[Any]], n: int) -> Array:
    """Return a field of n messages as float64, (n,) or (n, d)."""
    none = np.full(n, np.nan)
    parts = [np.asarray(columns.get(leaf, none), dtype=np.float64) for leaf in field.leaves]
    if field.sort == "time":
        result: Array = parts[0] + parts[1] * 1e-9
        return result
    return parts[0] if field.sort in ("number", "array") else np.column_stack(parts)


Definition = tuple[Any, Any]  # of rosbags: (number of the sort, what it is)
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # rosbags.interfaces.Nodetype
SIZES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
LONGEST = 256_000  # bytes of a definition, of which the parser takes some seconds at worst
FIELDS, MAX_TYPE_DEPTH, LENGTH = (
    10_000,
    64,
    1000,
)  # fields of a type that are listed, types in one another, letters of a path
TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
HEADER = "std_msgs/msg/Header"
UNITS = {  # of fields, by the type they stand in, as the comments of the types' definitions say
    ("sensor_msgs/msg/Imu", "angular_velocity"): "rad/s",
    ("sensor_msgs/msg/Imu", "linear_acceleration"): "m/s^2",
    ("sensor_msgs/msg/Temperature", "temperature"): "degC",
    ("sensor_msgs/msg/MagneticField", "magnetic_field"): "T",
    ("sensor_msgs/msg/FluidPressure", "fluid_pressure"): "Pa",
    ("sensor_msgs/msg/Range", "range"): "m",
    ("sensor_msgs/msg/NavSatFix", "latitude"): "deg",
    ("sensor_msgs/msg/NavSatFix", "longitude"): "deg",
    ("sensor_msgs/msg/NavSatFix", "altitude"): "m",
    ("sensor_msgs/msg/BatteryState", "voltage"): "V",
    ("sensor_msgs/msg/BatteryState", "temperature"): "degC",
    ("sensor_msgs/msg/BatteryState", "current"): "A",
    ("geometry_msgs/msg/Twist", "linear"): "m/s",
    ("geometry_msgs/msg/Twist", "angular"): "rad/s",
    ("geometry_msgs/msg/Accel", "linear"): "m/s^2",
    ("geometry_msgs/msg/Accel", "angular"): "rad/s^2",
}


class Field(NamedTuple):
    """A field that can be read.

    Attributes
    ----------
    leaves : tuple of str
        The numbers it is made of, by their paths; of an array, its own path alone.
    sort : str
        `number`, `array`, `struct` or `time`.
    unit : str or None
        That its type prescribes.
    """

    leaves: tuple[str, ...]
    sort: str
    unit: str | None


class Types:
    """The types of a bag's messages: `fields[type]` is a list of (name, definition)."""

    def __init__(self, connections: Sequence[Connection], path: Path = Path()) -> None:
        from rosbags.typesys import Stores, get_typestore

        self.fields: dict[str, list[tuple[str, Definition]]] = {}
        self.broken: dict[str, str] = {}
        self._seen: set[str] = set()
        self.path = path
        self.clock = TimeBudget(path, "the definitions of its message types")
        self._add(get_typestore(Stores.EMPTY).fielddefs)
        if any(not c.definition and c.encoding == "cdr" for c in connections):
            self._add(get_typestore(Stores.LATEST).fielddefs)  # a bag from before definitions were written into it

    def check(self, connection: Connection) -> None:
        """Raise UnreadableFile where messages of a connection cannot be read, without the file's name."""
        self.add(connection)
        topic = f"topic '{connection.topic}'"
        if connection.encoding not in ("cdr", "ros1"):
            raise UnreadableFile(
                f"{topic} has messages encoded as '{quote(connection.encoding)}', cdr or ros1 was expected; record it "
                "with a ROS message type"
            )
        try:
            self._complete(connection.type)
        except KeyError as error:
            why = self.broken.get(connection.type)
            why = f"is not in the bag ({error.args[0]})" if why is None else f"is damaged ({why})"
            raise UnreadableFile(
                f"{topic} is of type {connection.type}, whose definition {why}, one was expected; "
                "`ros2 bag convert` writes it where the type is installed"
            ) from None

    def find(self, kind: str, path: str) -> Field | None:
        """Return the field of a type that a path names, None where there is none that can be read."""
        node: Definition = (NAME, kind)
        unit: str | None = None
        for token in re.findall(r"[^.\[\]]+|\[\d+\]|.", path):
            sort, what = node
            if token == ".":
                continue
            if token.startswith("[") and sort in (ARRAY, SEQUENCE):
                node = what[0]
            elif sort == NAME and token in dict(self.fields.get(what, ())):
                node, unit = dict(self.fields[what])[token], UNITS.get((what, token), unit)
            else:
                return None
        return self._readable(node, path, unit)

    def paths(self, kind: str) -> Iterator[str]:
        """Yield the paths of all numbers of a type, and of arrays of numbers."""
        inside = [("", iter(self.fields.get(kind, ())))]
        for _ in range(FIELDS):
            if not inside:
                return
            prefix, fields = inside[-1]
            name, node = next(fields, ("", None))
            path = prefix + name
            if node is None:
                inside.pop()
            elif (field := self._readable(node, path, None)) is not None and field.sort != "struct":
                yield path
            elif node[0] == NAME and len(inside) < MAX_TYPE_DEPTH and len(path) < LENGTH:
                inside.append((f"{path}.", iter(self.fields.get(node[1], ()))))

    def has_header(self, kind: str) -> bool:
        """Return True if messages of a type begin with a header, which has a stamp and a frame."""
        return next(iter(self.fields.get(kind, ())), None) == ("header", (NAME, HEADER))

    def _readable(self, node: Definition, path: str, unit: str | None) -> Field | None:
        sort, what = node
        if sort == BASE:
            return Field((path,), "number", unit) if what[0] in SIZES else None
        if sort in (ARRAY, SEQUENCE):
            item, name = what[0]
            return Field((path,), "array", unit) if item == BASE and name[0] in SIZES else None
        if what in TIMES:
            return Field((f"{path}.sec", f"{path}.nanosec"), "time", "s")
        fields = self.fields.get(what, [])
        if fields and all(kind == BASE and name[0] in SIZES for _, (kind, name) in fields):
            return Field(tuple(f"{path}.{name}" for name, _ in fields), "struct", unit)
        return None

    def _add(self, definitions: Mapping[str, Any]) -> None:
        for name, (_, fields) in definitions.items():
            self.fields.setdefault(name, [(field, (int(sort), what)) for field, (sort, what) in fields])

    def add(self, connection: Connection) -> None:
        """Read the definition that a connection brings along; one that is damaged is kept in mind."""
        if not connection.definition or connection.definition in self._seen:
            return
        self._seen.add(connection.definition)
        if len(connection.definition) > LONGEST:
            self.broken[connection.type] = f"{size_of(len(connection.definition))}, at most {size_of(LONGEST)} are read"
            return
        with self.clock:
            self._parse(connection)

    def _parse(self, connection: Connection) -> None:
        from rosbags.typesys import get_types_from_idl, get_types_from_msg

        try:
            if connection.language == "idl":
                line = "=" * 80 + "\n"
                for part in connection.definition.split(line):
                    text = part.partition("\n")[2] if part.startswith("IDL: ") else part
                    if text.strip():
                        self._add(get_types_from_idl(text))
            else:
                self._add(get_types_from_msg(connection.definition, connection.type))
        except Exception as error:  # of a text that is none the parser raises more than its own errors
            self.broken[connection.type] = quote(error)

    def _complete(self, kind: str) -> None:
        """Raise KeyError, with its name, where a type or one inside it is not known."""
        left, reached = [kind], {kind}
        while left:
            for _, (sort, what) in self.fields[left.pop(0)]:
                inner, name = what[0] if sort in (ARRAY, SEQUENCE) else (sort, what)
                if inner == NAME and name not in reached:
                    reached.add(name)
                    left.append(name)
