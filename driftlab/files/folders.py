"""Folders of results that are whole or not there, and whose they are.

A command writes to `OUT.partial`, which it locks, and renames it to OUT when all files are whole. Three rules:

- What driftlab did not write is never removed. A folder is replaced only if it holds files of the same command and
  nothing else; `OUT.partial` is used again only if its lock file says that driftlab made it.
- Results that cannot be computed again (from a device, or from a recording that is not there any more) are replaced
  only on demand.
- What would make the end fail is refused at the beginning.

Where OUT cannot be renamed (a mount point, the working directory), `OUT.partial` is inside it and its files are moved
one by one, the one that says that all are there last.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path

from driftlab.files.hdf5_stream import reason, sync
from driftlab.files.locks import Lock
from driftlab.files.replaceable import (
    BEFORE,
    FILES,
    LOCK,
    WORKING,
    cannot_be_renamed,
    foreign,
    is_ours,
    matches,
    only_copy,
    remove,
    sign,
)
from fusion_core.errors import ConfigError, Unwritable

FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO}  # not a mistake of usage


class Folder:
    """A folder of results and its `.partial`, held for one command.

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
        Whether results may be replaced that cannot be computed again.
    recording : Path or None
        The recording that a live run goes on with: results that stand on it may be replaced.
    """

    def __init__(
        self, out: Path, command: str, read: Collection[Path], *, resume: bool, force: bool, recording: Path | None
    ) -> None:
        self.out, self.command = out, command
        self.force, self.recording = force, recording if resume else None
        self.folder = Path(os.path.realpath(out))
        self.partial = self.folder.parent / f"{self.folder.name or 'results'}.partial"
        try:
            self.inside = self.folder.is_dir() and cannot_be_renamed(self.folder)
            home = self.folder if self.inside else self.folder.parent
            self.partial = home / self.partial.name
            if self.folder.is_symlink():
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
            self._check_files(read)
            self.check_target()
            home.mkdir(parents=True, exist_ok=True)
            self._check_rights(home)
            self.lock = self._take_partial(resume=resume)
        except OSError as error:
            kind = Unwritable if error.errno in FULL else ConfigError
            raise kind(f"--out {out}: cannot be written ({reason(error)}); name a folder that can be") from None

    @property
    def shown(self) -> Path:
        """`.partial` as messages call it: from where the user is, if `out` was named like that."""
        return self.partial if self.out.is_absolute() else Path(os.path.relpath(self.partial))

    def unwritable(self, error: OSError) -> Unwritable:
        """Return the error for what the system did not let happen on the way."""
        subject = f"--out {self.out}"
        if isinstance(error.filename, str | bytes):
            name = Path(os.fsdecode(error.filename))
            if not any(Path(os.path.realpath(name)).is_relative_to(place) for place in (self.folder, self.partial)):
                subject = str(name)
        where = f"what was written so far is in {self.shown}"
        return Unwritable(f"{subject}: cannot be written ({reason(error)}); make room or name another place, {where}")

    def _check_files(self, read: Collection[Path]) -> None:
        for path in read:
            found = Path(os.path.realpath(path))
            replaced = found.is_relative_to(self.folder) and (
                not self.inside or (found.parent == self.folder and matches(found.name, FILES[self.command]))
            )
            if replaced or found.is_relative_to(self.partial):
                raise ConfigError(f"--out {self.out}: holds {path}, which is used here; name another folder")

    def check_target(self) -> None:
        """Raise ConfigError where the folder must not be replaced."""
        if not self.folder.exists():
            return
        names = self._names() if self.folder.is_dir() else [self.folder.name]
        if names and not is_ours(self.folder / FILES[self.command][0]):
            raise ConfigError(f"--out {self.out}: exists and is not the output of an earlier run; name another folder")
        files = (*FILES[self.command], LOCK, BEFORE)
        others = sorted(name for name in names if not matches(name, files))
        if others:
            raise ConfigError(
                f"--out {self.out}: holds {', '.join(others[:5])} of another command, which would be lost; "
                "name another folder"
            )
        others = [] if self.force else foreign(self.folder, FILES[self.command][0], set(names) - {LOCK, BEFORE})
        if others:
            raise ConfigError(
                f"--out {self.out}: holds {', '.join(others[:5])}, which driftlab did not write, or not so; move it "
                "away, or name another folder"
            )
        self._check_can_be_computed_again(self.folder)

    def _names(self) -> list[str]:
        names = [name for name in os.listdir(self.folder) if name != self.partial.name]
        # what a file system brings along stays where it is
        return [name for name in names if name != "lost+found" and name[0] != "."] if self.inside else names

    def _check_can_be_computed_again(self, folder: Path) -> None:
        why = None if self.force else only_copy(folder, self.recording)
        if why is not None:
            live = "go on with --resume and the same --record, or " if folder == self.partial else ""
            force = ", or give --force to replace it" if self.command == "run" else ""
            raise ConfigError(f"--out {self.out}: {folder.name} {why}; {live}name another folder{force}")

    def _check_rights(self, home: Path) -> None:
        """Raise OSError where the rename at the end would fail."""
        for place in {home, self.folder} if self.folder.exists() else {home}:
            check_writable(place)
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
        lock = Lock(self.partial / LOCK, f"--out {self.out}")
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
            f"--out {self.out}: {self.shown} exists, and driftlab did not write {', '.join(sorted(names)[:5])} there; "
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
            return
        before = self.partial / BEFORE
        if self.folder.exists():
            os.rename(self.folder, before)
        try:
            os.rename(self.partial, self.folder)
        except OSError:
            if before.exists():
                os.rename(before, self.folder)
            raise
        shutil.rmtree(self.folder / BEFORE, ignore_errors=True)
        self.lock.release(self.folder / LOCK)

    def _move_in(self) -> None:
        first = FILES[self.command][0]
        remove(self.folder / first)
        for name in self._names():
            if matches(name, FILES[self.command]):
                remove(self.folder / name)
        names = set(os.listdir(self.partial)) - {LOCK, BEFORE}
        for name in sorted(names, key=lambda name: name == first):
            os.replace(self.partial / name, self.folder / name)
        self.lock.release()
        shutil.rmtree(self.partial, ignore_errors=True)

    def leave(self) -> None:
        """Give up: what was written stays in `.partial`, which goes if there is nothing."""
        if not self.partial.exists():  # the last step of all failed
            self.lock.release(self.folder / LOCK)
        elif set(os.listdir(self.partial)) <= {LOCK}:
            self.lock.release()
            self.partial.rmdir()
        else:
            self.lock.release(remove=False)


def check_writable(folder: Path) -> None:
    """Raise OSError where nothing can be written into a folder."""
    if os.access(folder, os.W_OK | os.X_OK):
        return
    number = errno.EROFS if os.statvfs(folder).f_flag & os.ST_RDONLY else errno.EACCES
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

    The arguments are those of `Folder`; with `durable` the files reach the disk before they get their names. When the
    run dies, what was written stays in `OUT.partial`.

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
        sign(held.partial, FILES[command][0])
        if durable:
            for path in (*held.partial.iterdir(), held.partial):
                sync(path)
        held.publish()
        done = True
        if durable:
            sync(held.folder.parent)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise held.unwritable(error) from error
    finally:
        if not done:
            held.leave()
