"""What a file is by its first bytes: said where a source is given a file of another kind.

Which kind reads it follows from the `signatures` of the file sources that are installed, so what a message advises can
be done. The names of formats are known here, also of those that nothing reads.
"""

from __future__ import annotations

from pathlib import Path

from fusion_core.contracts.plugin import installed, kind_default
from fusion_core.errors import UnreadableFile

AS_CSV = "export it as CSV and use kind: csv"
FORMATS = {  # the first bytes of a file: what it is, and what to do with it where no source reads it
    b"\x89HDF": ("an HDF5 file", AS_CSV),
    b"MATLAB 7.3": ("a MAT file of version 7.3", AS_CSV),
    b"MATLAB 5.0": ("a MAT file", AS_CSV),
    b"CDF": ("a NetCDF-3 file", "convert it with `nccopy -k nc4 OLD NEW` and use kind: hdf5"),
    b"PAR1": ("a Parquet file", f"install a source for it, or {AS_CSV}"),
    b"ULog\x01\x12\x35": ("a PX4 log (ULog)", "install a source for it"),
    b"\xa3\x95\x80\x80": ("an ArduPilot log (DataFlash)", "install a source for it"),
    b"#ROSBAG V2.0": ("a ROS 1 bag", "install a source for it"),
    b"\x89MCAP0\r\n": ("an MCAP file", "install a source for it"),
    b"SQLite format 3\0": ("an SQLite database, as in a ROS 2 bag", f"install a source for it, or {AS_CSV}"),
    b"PK\x03\x04": ("a zip archive or a spreadsheet", f"unpack it, or {AS_CSV}"),
    b"\x1f\x8b": ("a gzip archive", "use kind: csv for text, or unpack it first"),
}


def kinds_of(first: bytes) -> list[str]:
    """Return the kinds of the installed sources whose files begin as `first` does."""
    found = [cls for cls in installed() if any(map(first.startswith, getattr(cls, "signatures", ())))]
    return sorted(map(kind_default, found))


def recognised(first: bytes) -> bool:
    """Whether it is known what a file is that begins so."""
    return any(map(first.startswith, FORMATS)) or bool(kinds_of(first))


def foreign(path: Path, first: bytes, kind: str) -> UnreadableFile:
    """Return the error for a file that is not of this kind, saying what it is by its `first` bytes."""
    known = next((what for magic, what in FORMATS.items() if first.startswith(magic)), None)
    kinds = [other for other in kinds_of(first) if other != kind]
    if kinds:
        what, advice = known[0] if known else f"a file of kind {kinds[0]}", f"use kind: {kinds[0]}"
    else:
        what, advice = known or (
            ("of an unknown format", "check the path") if b"\0" in first else ("a text file", "use kind: csv")
        )
    return UnreadableFile(f"{path}: is {what}, a file of kind {kind} was expected; {advice}")
