"""The raw samples of a live source as a file, while they come: `driftlab live --record FILE.h5`.

One data set for each channel, in SI and to the last bit what the filter got, so that `driftlab run` with the same
config and the file gives the live estimates again.
"""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from driftlab import __version__
from driftlab.files.folders import FULL, check_writable
from driftlab.files.hdf5_stream import GrowingFile, beside, continued, reading, reason, sync
from driftlab.files.locks import Lock
from fusion_core.chunk import Chunk
from fusion_core.contracts import Source
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable
from fusion_core.host.registry import registry

MARK = "recorded by driftlab"
SIGNATURE = b"\x89HDF\r\n\x1a\n"
UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}  # of the others: SI, as converted
COLUMNS = {name: {"unit": unit} for name, unit in UNITS.items()}


class Recorder:
    """A recording in progress, locked (`PATH.lock`) until it is closed.

    Parameters
    ----------
    path : Path
        Of the file.
    config : str
        Kept in it.
    resume : bool
        Whether to go on with the file where it is there; its time goes on too.
    force : bool
        Whether to replace a recording that is there, once the first samples have come.

    Raises
    ------
    ConfigError
        If the file is there and is not to be continued, is being written, or cannot be written.
    """

    def __init__(self, path: Path, config: str, *, resume: bool, force: bool = False) -> None:
        self.path, self.config = Path(os.path.realpath(path)), config
        self.named = path  # as messages call it
        self.file: GrowingFile | None = None
        self.last = -np.inf  # time of the last row [s]
        self.started: float | None = None  # time zero in s since 1970
        self._shift: float | None = None
        self.kept: Path | None = None  # what could not be read, under its new name
        there = self.path.exists()
        if there and not resume and not force:
            raise ConfigError(f"--record {path}: is there already; name another file, or go on with it with --resume")
        if there and not self.path.is_file():
            raise ConfigError(f"--record {path}: is no file; name another")
        if not self.path.parent.is_dir():
            raise ConfigError(f"--record {path}: there is no folder {path.parent}; make it, or name another")
        try:
            check_writable(self.path.parent)
            self.lock = self._locked()
        except OSError as error:
            kind = Unwritable if error.errno in FULL else ConfigError
            raise kind(f"--record {path}: cannot be written ({reason(error)}); name another place") from None
        try:
            if there and resume:
                self._continue()
            elif there:
                self._check(self._attributes())
        except BaseException:
            self.lock.release()
            raise

    def _locked(self) -> Lock:
        lock = Lock(self.path.with_name(self.path.name + ".lock"), f"--record {self.named}")
        new = beside(self.path)
        if new.exists() and not lock.left_over:  # else a recording left it that was killed
            lock.release()
            raise ConfigError(f"--record {self.named}: {new.name} is in the way; move it, or name another file")
        lock.sign()
        return lock

    def _attributes(self) -> dict[str, Any]:
        with reading(self.path) as old:
            return {name: attribute(self.path, old, name) for name in old.attrs}

    def _check(self, attributes: dict[str, Any]) -> None:
        if not str(attributes.get("program", "")).startswith(MARK):
            raise UnreadableFile(f"{self.named}: was not {MARK}; name another file with --record")

    def _continue(self) -> None:
        try:
            attributes = self._attributes()
        except UnreadableFile:
            if not _torn(self.path):
                raise
            self._put_aside()
            return
        self._check(attributes)
        self.started = float(attributes["started"])
        self.file = continued(self.path, None, attributes, COLUMNS)
        if self.file.rows:
            with reading(self.path) as old:
                self.last = float(old["time"][-1])

    def _put_aside(self) -> None:
        """Keep a file that was killed before it could be read, or is damaged, under another name, and begin anew."""
        number = 1
        while (name := self.path.with_name(f"{self.path.name}.unreadable-{number}")).exists():
            number += 1
        os.rename(self.path, name)
        self.kept = name

    @property
    def rows(self) -> int:
        """How many rows are safe."""
        return self.file.rows if self.file is not None else 0

    def add(self, chunk: Chunk) -> Chunk:
        """Take a chunk and return it as it is recorded: after a pause, with times that go on."""
        if len(chunk) == 0:
            return chunk
        now = time.time() - float(chunk.t[-1])
        if self.started is None:
            self.started = now
        if self._shift is None:
            step = float(np.median(np.diff(chunk.t))) if len(chunk) > 1 else 1e-3
            late = self.last + step - float(chunk.t[0])
            self._shift = 0.0 if self.file is None else max(now - self.started, late)
        if self._shift:
            chunk = Chunk(chunk.t + self._shift, chunk.channels)
        if self.file is None:
            attributes = {"program": f"{MARK} {__version__}", "config": self.config, "started": self.started}
            self.file = GrowingFile(self.path, attributes, COLUMNS)
        self.file.append({"time": chunk.t, **chunk.channels})
        return chunk

    def flush(self) -> None:
        """Write what was added; from here on it survives."""
        if self.file is not None:
            self.file.flush()

    def close(self) -> None:
        """Write the rest, close the file and have it reach the disk."""
        try:
            if self.file is not None:
                self.file.close()
                sync(self.path)
        finally:
            self.lock.release()


def _torn(path: Path) -> bool:
    """Whether a file that HDF5 cannot read begins like one of its own, or is empty."""
    return SIGNATURE.startswith(_begins(path))


def _begins(path: Path) -> bytes:
    with path.open("rb") as file:
        return file.read(len(SIGNATURE))


def recorded_source(path: Path, live: Source | None = None) -> Source:
    """Return the source that reads a recording of a live one, or of `live` the bytes that its device sent.

    Raises
    ------
    UnreadableFile
        If the file is neither.
    """
    plain = (path.is_file() and _begins(path) != SIGNATURE) or path == Path("-")
    if live is not None and plain and (raw := live.of_file(path)) is not None:
        return raw
    with reading(path) as file:
        if not str(attribute(path, file, "program") or "").startswith(MARK):
            raise UnreadableFile(f"{path}: was not {MARK}; name its channels in a config with a source for files")
        channels = {name: {"path": name} for name in file}
    kind = registry().classes(Source)["hdf5"]
    source = kind.model_validate({"kind": "hdf5", "path": str(path), "channels": channels})
    assert isinstance(source, Source)
    return source


def started_at(path: Path) -> float | None:
    """Return when the recording of a live run began, s since 1970; None of any other file."""
    import h5py

    if not (path.is_file() and h5py.is_hdf5(path)):
        return None
    with reading(path) as file:
        ours = str(attribute(path, file, "program") or "").startswith(MARK)
        return float(attribute(path, file, "started")) if ours and "started" in file.attrs else None
