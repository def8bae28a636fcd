"""Byte streams through the decoders of devices, against decoders that are written here from the formats' definitions.

Never an exception; the memory between two pieces is small; any split gives the same samples and counts; and the samples
are those that the decoder here finds, no more and no fewer.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Callable
from functools import reduce
from operator import xor
from pathlib import Path
from typing import Any

import numpy as np

from torture.frames import SYNC, frame, mpeg_2, stream
from torture.grammar import NUMBER
from torture.outcome import Outcome, traceback_cause

CASES, WORKERS, LIMIT, IN_PROCESS = 60_000, 2, 5.0, True
MEMORY = 16 << 10  # bytes that may be kept between two pieces
RNG = np.random.Generator
NAMES = ("t", "gx", "gy", "gz", "T")
CHANNELS = {"gyro": {"path": ["gx", "gy", "gz"], "unit": "rad/s"}, "temperature": {"path": "T", "unit": "degC"}}
FIELDS = [{"name": "sequence", "type": "uint8"}, {"name": "gyro", "type": "float32", "count": 3, "unit": "rad/s"},
          {"name": "temperature", "type": "int16", "scale": 0.01, "unit": "degC"}]  # fmt: skip
COUNTER = {"field": "sequence", "modulo": 256}
SETTINGS: dict[str, dict[str, Any]] = {
    "text": {"kind": "text", "columns": list(NAMES), "channels": CHANNELS},
    "header": {"kind": "text", "channels": CHANNELS, "counter": {"field": "t", "modulo": 1000}},
    "nmea": {"kind": "text", "columns": list(NAMES), "channels": CHANNELS, "prefix": "$IMU,", "checksum": "nmea"},
    "binary": {
        "kind": "binary",
        "sync": "A5 5A",
        "fields": FIELDS,
        "checksum": {"kind": "CRC-32/ISO-HDLC"},
        "counter": COUNTER,
    },
    "sum": {"kind": "binary", "sync": "A5 5A", "fields": FIELDS, "checksum": {"kind": "sum8"}, "end": "0D 0A"},
    "bare": {"kind": "binary", "sync": "A5 5A", "fields": FIELDS},
    "kvh_a": {"kind": "kvh_1775", "interval": "10 ms"},
    "kvh_b": {"kind": "kvh_1775", "message": "B", "output": "rate"},
}
Samples = list[tuple[float, ...]]  # gyro x y z, temperature


def lines_of(name: str, stream: bytes) -> Samples:
    """Return the samples of a stream of lines."""
    found: Samples = []
    columns: list[str] | None = None if name == "header" else list(NAMES)
    for k, line in enumerate(stream.split(b"\n")[:-1]):
        if len(line) > 4096 or not line.isascii():
            continue
        text = line.decode().strip("\r \t")
        if name == "nmea":
            whole = re.fullmatch(r"([$!])(.*)\*([0-9A-Fa-f]{2})", text, re.DOTALL)
            if not whole or int(whole[3], 16) != reduce(xor, whole[2].encode(), 0) or not text.startswith("$IMU,"):
                continue
            text = whole[2].removeprefix("IMU,")
        cells = [cell.strip(" \t") for cell in text.split(",")]
        if name == "header" and {"t", "gx", "gy", "gz", "T"} <= set(cells):
            columns = cells
            continue
        if columns is None or len(cells) != len(columns) or (k == 0 and name != "nmea"):
            continue
        if not all(
            NUMBER.fullmatch(cell) or re.fullmatch(r"[+-]?(nan|inf|infinity)", cell, re.IGNORECASE) for cell in cells
        ):
            continue
        if name == "header" and not abs(float(cells[columns.index("t")])) < 1 << 63:
            continue
        found.append(tuple(float(cells[columns.index(path)]) for path in NAMES[1:]))
    return found


def other_header(stream: bytes) -> bool:
    """Tell if a line that is whole has most of the names and no number: the header of another device."""
    for line in stream.split(b"\n")[1:-1]:
        cells = [cell.strip() for cell in line.decode("latin-1").strip("\r \t").split(",")]
        if 2 < len(set(NAMES) & set(cells)) < 5 and not any(NUMBER.fullmatch(cell) for cell in cells):
            return True
    return False


def frames_of(name: str, stream: bytes) -> Samples:
    """Return the samples of a stream of frames: the first place where sync and checksum are right, then behind it."""
    kvh = name.startswith("kvh")
    size = {"binary": 21, "sum": 20, "bare": 17, "kvh_a": 36, "kvh_b": 40}[name]
    sync = bytes.fromhex("FE81FF55" if name == "kvh_a" else "FE81FF56") if kvh else SYNC
    found: Samples = []
    at = stream.find(sync)
    while 0 <= at <= len(stream) - size:
        one = stream[at : at + size]
        good = {
            "binary": lambda one=one: struct.unpack("<I", one[-4:])[0] == zlib.crc32(one[:-4]),
            "sum": lambda one=one: one[-2:] == b"\r\n" and one[-3] == sum(one[:-3]) % 256,
            "bare": lambda: True,
        }.get(name, lambda one=one: struct.unpack(">I", one[-4:])[0] == mpeg_2(one[:-4]))()
        if good and kvh:
            gyro = [w / (0.01 if name == "kvh_a" else 1.0) for w in struct.unpack(">3f", one[4:16])]
            found.append((*gyro, float(struct.unpack(">h", one[-6:-4])[0])))
        elif good:
            found.append((*struct.unpack("<3f", one[3:15]), struct.unpack("<h", one[15:17])[0] * 0.01))
        at = stream.find(sync, at + (size if good else 1))
    return found


def weight(memory: Any) -> int:
    """Return the bytes that a memory keeps."""
    if isinstance(memory, dict):
        memory = [*memory.keys(), *memory.values()]
    if isinstance(memory, tuple | list):
        return sum(map(weight, memory))
    return len(memory) if isinstance(memory, bytes | str) else 8


def decoded(framing: Any, pieces: list[bytes]) -> tuple[Samples, list[int], dict[str, int], int]:
    """Return samples, counts, rejections, and the most that was kept in memory."""
    memory, most = None, 0
    samples: Samples = []
    counts: list[int] = []
    rejected: dict[str, int] = {}
    for piece in pieces:
        frames, memory = framing.decode(piece, memory)
        most = max(most, weight(memory))
        counts += [] if frames.count is None else frames.count.tolist()
        for what, n in frames.rejected.items():
            rejected[what] = rejected.get(what, 0) + n
        if frames.N:
            columns = np.column_stack([frames.channels["gyro"], frames.channels["temperature"]])
            samples += map(tuple, columns.tolist())
    return samples, counts, rejected, most


def alike(one: Samples, other: Samples) -> bool:
    """Tell if two lists of samples are equal, NaN included."""
    if len(one) != len(other):
        return False
    return not one or bool(np.allclose(one, other, rtol=1e-6, atol=1e-300, equal_nan=True))


def prepare(folder: Path) -> None:
    """Nothing is needed."""


class Bench:
    """Each framing, tried on frames that are whole."""

    def __init__(self, folder: Path, case: Path) -> None:
        from fusion_core.contracts.framing import Framing
        from fusion_core.host.registry import registry

        classes = registry().classes(Framing)
        self.framings = {name: classes[values["kind"]].model_validate(values) for name, values in SETTINGS.items()}
        self.others = {}  # of third parties: those that need no settings
        for kind in classes.keys() - {"text", "binary", "kvh_1775"}:
            try:
                self.others[kind] = classes[kind].model_validate({"kind": kind})
            except ValueError:
                print(f"framing {kind} needs settings and is not tried")
        for name, framing in self.framings.items():
            whole = b"\n" + (b"t,gx,gy,gz,T\r\n" if name == "header" else b"")
            whole += b"".join(frame(name, k, (0.1, -0.2, k / 7), 25.0) for k in range(5))
            samples = decoded(framing, [whole])[0]
            if len(samples) != 5 or not alike(samples, self._oracle(name)(whole)):
                raise RuntimeError(f"{name}: {samples}")

    @staticmethod
    def _oracle(name: str) -> Callable[[bytes], Samples]:
        reader = lines_of if name in ("text", "header", "nmea") else frames_of
        return lambda raw: reader(name, raw)

    def case(self, number: int, rng: RNG, folder: Path) -> Outcome:
        """Decode whole and in pieces."""
        names = [*self.framings, *self.others]
        name = names[number % len(names)]
        framing = self.framings.get(name) or self.others[name]
        raw = stream(name if name in self.framings else "text", rng)
        cuts = (
            sorted(rng.integers(0, len(raw) + 1, int(rng.choice([1, 2, 8]))).tolist())
            if rng.random() < 0.9
            else list(range(len(raw)))
        )
        pieces = [raw[a:b] for a, b in zip([0, *cuts], [*cuts, len(raw)], strict=True)]
        outcome = self._outcome(name, framing, raw, pieces)
        if outcome.kind not in ("accepted", "clean"):
            (folder / "stream.bin").write_bytes(raw)
            (folder / "cuts.txt").write_text(f"{name} {cuts}\n")
        return outcome

    def _outcome(self, name: str, framing: Any, raw: bytes, pieces: list[bytes]) -> Outcome:
        import traceback

        try:
            with np.errstate(all="ignore"):
                whole, counts, rejected, _ = decoded(framing, [raw])
                split, counts_2, rejected_2, most = decoded(framing, pieces)
        except Exception as error:
            if name == "header" and type(error).__name__ == "MissingChannel" and other_header(raw):
                return Outcome("clean")
            text = traceback.format_exc()
            return Outcome("traceback", f"{name}: {traceback_cause(text)}", text)
        if not alike(whole, split) or counts != counts_2 or rejected != rejected_2:
            return Outcome("nonsense", f"{name}: split otherwise, other samples or counts", f"{rejected} {rejected_2}")
        if most > MEMORY:
            return Outcome("nonsense", f"{name}: memory grows", f"{most} bytes")
        if name in self.framings and not alike(whole, expected := self._oracle(name)(raw)):
            return Outcome("nonsense", f"{name}: not the samples that are in the stream", f"{whole}\n{expected}")
        return Outcome("accepted" if whole else "clean")
