"""Logs of ArduPilot vehicles (.bin, or .log as text): rows of an inertial unit, as its sensor measured them.

::

    path IMU.GyrX      of the unit that `imu` names        IMU[1].GyrX    of that one
    path BARO.Temp     of the first instance, joined to the rows in time

The rows are those of the message of channel `time`; all others are joined to them. Where `compensated` is not `keep`,
gyros and accelerometers are in the frame of the board, without the autopilot's corrections (`imu`).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from fusion_core.contracts import FileSource, Table, foreign, head
from fusion_core.contracts.file_source import RecordingWriter
from fusion_core.faults import Faults
from fusion_core.hookspecs import hookimpl
from fusion_plugins.sources.joining import mapped
from fusion_plugins.sources.unpacked import plain_file, unpacking

SIGNATURE = b"\xa3\x95\x80"
TEXT = b"FMT, "  # of a log as text
NEAR = 1 << 16  # bytes within which a log whose beginning is damaged shows its first description


@hookimpl
class DataFlash(FileSource):
    """A DataFlash log of an ArduPilot vehicle, from the card or as a ground station downloads it."""

    signatures: ClassVar[tuple[bytes, ...]] = (SIGNATURE, TEXT)
    suffixes: ClassVar[tuple[str, ...]] = (".bin", ".BIN")
    written: ClassVar[tuple[str, ...]] = (".bin",)
    product: ClassVar[str | None] = "ardupilot_log"

    kind: Literal["dataflash"] = "dataflash"
    imu: Annotated[int, Field(ge=0)] = 0
    """Number of the inertial unit, from 0: paths that begin with IMU, GYR or ACC and name none are of this one."""
    compensated: Literal["undo", "refuse", "keep"] = "undo"
    """Of what the autopilot corrected: undo it, refuse a log with a learned polynomial, or keep all as logged."""

    @unpacking
    def open(self, path: Path, faults: Faults) -> Iterator[Table]:
        """Open the log; raises UnreadableFile where it is of another kind, MissingChannel where it lacks the unit."""
        # with the compiler, which nothing else may need
        from fusion_plugins.sources.dataflash.log import DataFlashMessages
        from fusion_plugins.sources.dataflash.table import Messages

        paths = [path for channel in self.channels.values() for path in channel.paths]
        wanted = {path.partition(".")[0].partition("[")[0] for path in paths}
        with _binary(path, faults) as place:
            first, data = head(place), mapped(place)
            if not first.startswith(SIGNATURE) and SIGNATURE not in data[:NEAR].tobytes():
                raise foreign(path, first, self.kind)
            log = DataFlashMessages(path, data, wanted | {"IMU"}, faults)
            of_rows = self.channels["time"].paths[0] if "time" in self.channels else paths[0]
            yield Messages(log, self.imu, self.compensated, faults, of_rows)

    @classmethod
    def writer(cls, path: Path, suffix: str, note: str) -> RecordingWriter:
        """Begin a log."""
        from fusion_plugins.sources.dataflash.writer import DataFlashWriter

        return DataFlashWriter(path, note)

    @classmethod
    def parameters(cls, path: Path) -> Mapping[str, float]:
        """Return the parameters that a log ends with."""
        from fusion_plugins.sources.dataflash.log import DataFlashMessages

        faults = Faults()
        with plain_file(path) as plain, _binary(plain, faults) as place:
            return DataFlashMessages(path, mapped(place), (), faults).parameters.last


@contextmanager
def _binary(path: Path, faults: Faults) -> Iterator[Path]:
    """Yield the path of a binary log, of one as text that of a temporary file."""
    if not head(path).startswith(TEXT):
        yield path
        return
    from fusion_plugins.sources.dataflash.text import binary

    with binary(path, faults) as place:
        yield place
