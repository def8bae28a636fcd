"""Message types of a bag: their fields, by rosbags' parser of .msg and .idl texts, and the units that types prescribe.

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

from fusion_core.budget import Clock, size_of
from fusion_core.errors import UnreadableFile, shown
from fusion_plugins.sources.bag_storage import Connection

Definition = tuple[Any, Any]  # of rosbags: (number of the sort, what it is)
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # rosbags.interfaces.Nodetype
SIZES = {
    "bool": "u1", "byte": "u1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4",
    "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8",
}  # fmt: skip
LONGEST = 256_000  # bytes of a definition, of which the parser takes some seconds at worst
FIELDS, DEEP, LENGTH = 10_000, 64, 1000  # fields of a type that are listed, types in one another, letters of a path
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
        self.clock = Clock(path, "the definitions of its message types")
        self._add(get_typestore(Stores.EMPTY).fielddefs)
        if any(not c.definition and c.encoding == "cdr" for c in connections):
            self._add(get_typestore(Stores.LATEST).fielddefs)  # a bag from before definitions were written into it

    def check(self, connection: Connection) -> None:
        """Raise UnreadableFile where messages of a connection cannot be read, without the file's name."""
        self.add(connection)
        topic = f"topic '{connection.topic}'"
        if connection.encoding not in ("cdr", "ros1"):
            raise UnreadableFile(
                f"{topic} has messages encoded as '{shown(connection.encoding)}', cdr or ros1 was expected; record it "
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
            elif (found := self._readable(node, path, None)) is not None and found.sort != "struct":
                yield path
            elif node[0] == NAME and len(inside) < DEEP and len(path) < LENGTH:
                inside.append((f"{path}.", iter(self.fields.get(node[1], ()))))

    def has_header(self, kind: str) -> bool:
        """Whether messages of a type begin with a header, which has a stamp and a frame."""
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

    def _add(self, found: Mapping[str, Any]) -> None:
        for name, (_, fields) in found.items():
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
            self.broken[connection.type] = shown(error)

    def _complete(self, kind: str) -> None:
        """Raise KeyError, with its name, where a type or one inside it is not known."""
        left, seen = [kind], {kind}
        while left:
            for _, (sort, what) in self.fields[left.pop(0)]:
                inner, name = what[0] if sort in (ARRAY, SEQUENCE) else (sort, what)
                if inner == NAME and name not in seen:
                    seen.add(name)
                    left.append(name)
