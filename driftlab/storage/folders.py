"""Folders of results that are whole or not there, and their locks.

A command writes to `OUT.partial`, which it locks, and renames it to OUT when all files are whole. Three rules:

- What driftlab did not write is never removed. A folder is replaced only if it holds files of the same command, as it
  wrote them (`driftlab.storage.ownership`), and nothing else; `OUT.partial` is used again only if its lock file says
  that driftlab made it.
- Results that cannot be computed again (from a device, or from a recording that is not there any more) are replaced
  only on demand.
- What would make the end fail is refused at the beginning.

Where OUT cannot be renamed (a mount point, the working directory), `OUT.partial` is inside it and its files are moved
one by one, the one that says that all are there last. The next command does the rest where one was killed meanwhile.

A lock file is locked with `flock` as long as its process lives, and has the mark of its owner. A process that is killed
leaves no lock, only the file, which the next one takes. On a file system without locks there is the mark alone.
"""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import stat
import sys
from collections.abc import Collection, Iterator
from contextlib import contextmanager, suppress
from datetime import datetime
from fnmatch import fnmatch
from pathlib import Path

from driftlab.storage import system
from driftlab.storage.hdf5 import reading, reason
from driftlab.storage.ownership import check_folder, foreign, is_as, sign, written
from fusion_core.data_sets import attribute
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}  # not a mistake of usage


class Folder:
    """A folder of results and its `.partial`, held for one command; the arguments are those of `output_folder`."""

    def __init__(
        self, out: Path, command: str, read: Collection[Path], *, resume: bool, force: bool, recording: Path | None
    ) -> None:
        self.out, self.subject, self.command = out, f"--out {out}", command
        self.force, self.recording = force, recording if resume else None
        self.folder = Path(os.path.realpath(out))
        with refusals(self.subject, "name a folder that can be"):
            self.inside = self.folder.is_dir() and cannot_be_renamed(self.folder)
            home = self.folder if self.inside else self.folder.parent
            self.partial = home / f"{self.folder.name or 'results'}.partial"
            if self.folder.is_symlink():
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
            self._check_files(read)
            if self.inside and (self.partial / BEFORE).exists() and (self.partial / LOCK).exists():
                self._finish_moving()
            self.check_target()
            home.mkdir(parents=True, exist_ok=True)
            self._check_rights(home)
            self.lock = self._take_partial(resume=resume)

    @property
    def shown(self) -> Path:
        """`.partial` in messages: relative to the working directory, if `out` was."""
        return self.partial if self.out.is_absolute() else Path(os.path.relpath(self.partial))

    def unwritable(self, error: OSError) -> Unwritable:
        """Return the error of a step on the way that the system refused."""
        subject = self.subject
        if isinstance(error.filename, str | bytes):
            name = Path(os.fsdecode(error.filename))
            if not any(Path(os.path.realpath(name)).is_relative_to(place) for place in (self.folder, self.partial)):
                subject = str(name)
        where = f"what was written so far is in {self.shown}"
        return Unwritable(f"{subject}: cannot be written ({reason(error)}); make room or name another place, {where}")

    def _check_files(self, read: Collection[Path]) -> None:
        for path in read:
            real = Path(os.path.realpath(path))
            replaced = real.is_relative_to(self.folder) and (
                not self.inside or (real.parent == self.folder and matches(real.name, FILES[self.command]))
            )
            if replaced or real.is_relative_to(self.partial):
                raise ConfigError(f"{self.subject}: holds {path}, which is used here; name another folder")

    def check_target(self) -> None:
        """Raise ConfigError where the folder must not be replaced."""
        if not self.folder.exists():
            return
        names = set(self._names() if self.folder.is_dir() else [self.folder.name])
        first, second = FILES[self.command][:2]
        if names and not any(fnmatch(name, second) for name in written(self.folder / first)):
            raise ConfigError(
                f"{self.subject}: exists and is not the output of an earlier {self.command}; move it away, or name "
                "another folder"
            )
        names -= {LOCK, BEFORE}
        others = sorted(name for name in names if not matches(name, FILES[self.command]))
        if others:
            raise ConfigError(
                f"{self.subject}: holds {', '.join(others[:5])} of another command, which would be lost; name another "
                "folder"
            )
        check_folder(self.subject, [] if self.force else foreign(self.folder, first, names))
        self._check_can_be_computed_again(self.folder)

    def _names(self) -> list[str]:
        names = os.listdir(self.folder)
        if not self.inside:
            return names
        # what a file system brings along stays where it is
        return [name for name in names if name not in (self.partial.name, "lost+found") and name[0] != "."]

    def _check_can_be_computed_again(self, folder: Path) -> None:
        why = None if self.force else only_copy(folder, self.recording)
        if why is not None:
            live = "go on with --resume and the same --record, or " if folder == self.partial else ""
            force = ", or give --force to replace it" if self.command == "run" else ""
            raise ConfigError(f"{self.subject}: {folder.name} {why}; {live}name another folder{force}")

    def _check_rights(self, home: Path) -> None:
        """Raise OSError where the rename at the end would fail."""
        for place in {home, self.folder} if self.folder.exists() else {home}:
            check_writable(place)
        if not hasattr(os, "geteuid"):
            return
        user, above = os.geteuid(), home.stat()
        sticky = self.folder.exists() and not self.inside and above.st_mode & stat.S_ISVTX
        if sticky and user not in (0, above.st_uid, self.folder.stat().st_uid):
            raise OSError(errno.EPERM, "a folder of another user", str(self.folder))

    def _take_partial(self, *, resume: bool) -> Lock:
        try:
            self.partial.mkdir()
        except FileExistsError:
            if self.partial.is_symlink() or not self.partial.is_dir():
                raise self._foreign([self.partial.name]) from None
        names = os.listdir(self.partial)
        known = [*WORKING, *(pattern for patterns in FILES.values() for pattern in patterns)]
        others = sorted(name for name in names if not matches(name, known))
        if (names and LOCK not in names) or others:
            raise self._foreign(others or names)
        lock = Lock(self.partial / LOCK, self.subject)
        try:
            if not (resume and "checkpoint.npz" in names):
                self._check_can_be_computed_again(self.partial)
            if not resume:
                for name in set(names) - {LOCK}:
                    remove(self.partial / name)
            lock.sign()
        except BaseException:
            lock.release(remove=False)
            raise
        return lock

    def _foreign(self, names: list[str]) -> ConfigError:
        return ConfigError(
            f"{self.subject}: {self.shown} exists, and driftlab did not write {', '.join(sorted(names)[:5])} there; "
            "move it away, or name another folder"
        )

    def publish(self) -> None:
        """Give the files their final place; raises ConfigError or OSError."""
        try:
            self.check_target()
        except ConfigError as error:
            raise ConfigError(f"{error}; the new results are in {self.shown}") from None
        if self.inside:
            self._move_in()
            self.lock.release()
            with suppress(OSError):  # empty, if nobody has begun another one meanwhile
                self.partial.rmdir()
            return
        before = self.partial / BEFORE
        if self.folder.exists():
            os.rename(self.folder, before)
        self.lock.let_rename()
        try:
            os.rename(self.partial, self.folder)
        except OSError:
            if before.exists():
                os.rename(before, self.folder)
            raise
        shutil.rmtree(self.folder / BEFORE, ignore_errors=True)
        self.lock.release(self.folder / LOCK)

    def _move_in(self) -> None:
        """Move the files in one by one; `BEFORE` in `.partial`, the first of the files before, says that it has begun.

        So after a kill all that is there is known: by the first of the files before, or by that of the new ones.
        """
        first, before = FILES[self.command][0], self.partial / BEFORE
        if not before.exists():
            if (self.folder / first).exists():
                os.replace(self.folder / first, before)
            else:
                before.touch()
        old, new = written(before), written(self.partial / first)
        there = [name for name in {*old, *new} if os.path.lexists(self.folder / name)]
        there = [name for name in there if not is_as(self.folder / name, new.get(name, ""))]
        others = [name for name in there if name == first or not is_as(self.folder / name, old.get(name, ""))]
        check_folder(self.subject, [] if self.force else others)
        for name in there:
            remove(self.folder / name)
        for name in sorted(set(os.listdir(self.partial)) - {LOCK, BEFORE}, key=first.__eq__):
            os.replace(self.partial / name, self.folder / name)
        before.unlink()

    def _finish_moving(self) -> None:
        """Do the rest where a command was killed while it moved its files in."""
        lock, first = Lock(self.partial / LOCK, self.subject), FILES[self.command][0]
        try:
            if written(self.partial / first):
                self._move_in()
            elif written(self.folder / first):  # the last of them had its place already
                (self.partial / BEFORE).unlink()
        finally:
            lock.release(remove=False)

    def leave(self) -> None:
        """Give up: files that were written stay in `.partial`, which goes if there are none."""
        if not self.partial.exists():  # the last step of all failed
            self.lock.release(self.folder / LOCK)
        elif set(os.listdir(self.partial)) <= {LOCK}:
            self.lock.release()
            self.partial.rmdir()
        else:
            self.lock.release(remove=False)


@contextmanager
def refusals(subject: str, advice: str, *, usage: bool = True) -> Iterator[None]:
    """Raise what the system refuses as ConfigError; as Unwritable where the disk is full, or it is no mistake of usage.

    The message is `SUBJECT: cannot be written (REASON); ADVICE`.
    """
    try:
        yield
    except OSError as error:
        kind = ConfigError if usage and error.errno not in FULL else Unwritable
        raise kind(f"{subject}: cannot be written ({reason(error)}); {advice}") from None


def check_writable(folder: Path) -> None:
    """Raise OSError where nothing can be written into a folder."""
    if os.access(folder, os.W_OK | os.X_OK):
        return
    number = errno.EROFS if system.is_read_only(folder) else errno.EACCES
    raise OSError(number, os.strerror(number), str(folder))


@contextmanager
def output_folder(
    out: Path,
    command: str = "run",
    read: Collection[Path] = (),
    *,
    resume: bool = False,
    force: bool = False,
    recording: Path | None = None,
    durable: bool = False,
) -> Iterator[Path]:
    """Give a folder `OUT.partial` to write to, and rename it to `out` when all went well.

    When the run dies, what was written stays in `OUT.partial`.

    Parameters
    ----------
    out : Path
        As it was named; a link leads to the folder that is meant.
    command : str
        One of FILES.
    read : collection of Path
        Files that are needed and must not be inside.
    resume : bool
        Whether what an earlier run left in `.partial` stays there.
    force : bool
        Whether results may be replaced that cannot be computed again, or were edited.
    recording : Path or None
        The recording that a live run goes on with: results that stand on it may be replaced.
    durable : bool
        Whether the files reach the disk before they get their names.

    Raises
    ------
    ConfigError
        If `out` must not be replaced, or is being written.
    Unwritable
        If the disk is full, or the like.
    """
    held = Folder(out, command, read, resume=resume, force=force, recording=recording)
    done = False
    try:
        yield held.shown
        first = FILES[command][0]
        sign(held.partial, first, [n for n in os.listdir(held.partial) if n != first and not matches(n, WORKING)])
        if durable:
            for path in (*held.partial.iterdir(), held.partial):
                system.sync(path)
        held.publish()
        done = True
        if durable:
            system.sync(held.folder.parent)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise held.unwritable(error) from error
    finally:
        if not done:
            held.leave()


FILES = {  # of each command; the first says that all are there
    "run": ("summary.json", "estimates.h5", "report.html", "certificate.html", "certificate.json"),
    "allan": ("summary.json", "allan.json", "allan.svg", "report.html"),
    "compare": ("summary.json", "report.html"),
    "plan": ("plan.json", "setpoints.csv", "report.html", "segments.csv"),
    "vehicle": ("vehicle.json", "*.map.json", "vehicle.params", "vehicle.parm", "report.html"),
    "explain": ("loop.json", "explained.*", "declared.*", "candidate.*", "prediction.h5", "report.html"),
}
LOCK, BEFORE = "driftlab.lock", ".replaced"
WORKING = (LOCK, BEFORE, "checkpoint.npz", "*.new", "*.part")  # while a command is not done


def matches(name: str, patterns: Collection[str]) -> bool:
    """Return True if a name is one of the patterns."""
    return any(fnmatch(name, pattern) for pattern in patterns)


def remove(path: Path) -> None:
    """Remove a file, a link, or a folder with all that is in it."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def cannot_be_renamed(folder: Path) -> bool:
    """Return True if a folder is where a file system (or part of one) is mounted, or the working directory."""
    if os.path.ismount(folder) or folder == Path.cwd():
        return True
    try:
        mounts = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape").splitlines()
    except OSError:
        return False
    name = "".join(f"\\{ord(c):03o}" if c in " \t\n\\" else c for c in str(folder))
    return any(line.split()[4] == name for line in mounts)


def only_copy(folder: Path, recording: Path | None) -> str | None:
    """Return the reason why a folder's results cannot be computed again; None where they can, or there are none."""
    path = folder / "estimates.h5"
    if not path.is_file():
        return None
    try:
        with reading(path) as file:
            rows = len(file["t"]) if "t" in file else 0
            live, source = bool(attribute(path, file, "live")), str(attribute(path, file, "recording") or "")
    except UnreadableFile:
        return "has an estimates.h5 that cannot be read"
    if rows == 0 or (recording is not None and source == os.path.realpath(recording) and recording.exists()):
        return None
    if live:
        return "holds what a device measured (`driftlab live`)"
    if not source or Path(source).exists():
        return None
    if Path(source).name == "-":
        return "was computed from standard input"
    return f"was computed from {source}, which is not there any more"


class Lock:
    """A lock on a file that is there for nothing else.

    Parameters
    ----------
    path : Path
        Of the lock file; it is made where it is not there.
    what : str
        Name of the locked thing in messages.

    Raises
    ------
    ConfigError
        If another process (or another part of this one) holds it, or the file is of something else.
    OSError
        If the file cannot be made.
    """

    def __init__(self, path: Path, what: str) -> None:
        self.path = path
        self.left_over = path.exists()  # by a process that was killed, if this one gets the lock
        while True:
            number = os.open(path, os.O_RDWR | os.O_CREAT | system.PLAIN, 0o666)
            try:
                system.lock(number)
            except BlockingIOError:
                holder = _holder(system.read_owner(number))
                os.close(number)
                raise ConfigError(f"{what}: is being written by {holder}; wait for its end, or name another") from None
            except OSError:  # of a file system that knows no locks
                pass
            with suppress(FileNotFoundError):
                if os.path.samestat(os.stat(path), os.fstat(number)):
                    break
            os.close(number)  # the owner before has removed it meanwhile
        mark = system.read_owner(number)
        if mark and b'"program": "driftlab"' not in mark:
            os.close(number)
            raise ConfigError(f"{what}: {path} is in the way, and not of driftlab; move it, or name another")
        self._number: int | None = number

    def sign(self) -> None:
        """Write the lock's owner into the file; raises OSError."""
        mark = {
            "program": "driftlab",
            "command": " ".join([Path(sys.argv[0]).name, *map(_without_secrets, sys.argv[1:])])[:1000],
            "process": os.getpid(),
            "host": socket.gethostname(),
            "since": datetime.now().astimezone().isoformat(sep=" ", timespec="seconds"),
        }
        assert self._number is not None, "it is held"
        system.write_owner(self._number, json.dumps(mark).encode())

    def let_rename(self) -> None:
        """Give the lock back early on Windows, where nothing that holds an open file can be renamed."""
        if not system.has_posix_locks():
            self._close()

    def release(self, path: Path | None = None, *, remove: bool = True) -> None:
        """Give the lock back and remove its file, which may have moved to `path`."""
        if not system.has_posix_locks():
            self._close()
        with suppress(PermissionError):  # on Windows, where another one has opened it since
            if remove:
                (path or self.path).unlink(missing_ok=True)
        self._close()

    def _close(self) -> None:
        if self._number is not None:
            os.close(self._number)
            self._number = None


def _holder(mark: bytes) -> str:
    try:
        owner = json.loads(mark)
        return f"`{owner['command']}` (process {owner['process']} on {owner['host']}, since {owner['since']})"
    except (ValueError, KeyError, TypeError):
        return "another process"


def _without_secrets(argument: str) -> str:
    """Return an argument of the command line; a URL with a user, a password or options is cut short."""
    kind, sign, rest = argument.partition("://")
    return f"{kind}://***" if sign and {"@", "?"} & set(rest) else argument
