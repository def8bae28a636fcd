"""Windows' rules on this machine: what it lacks is hidden, names and open files are refused as it refuses them.

    python like_windows.py FOLDER COMMANDS    # a JSON list of argument lists; prints a list of [status, stderr]

`hide` alone is what `make hidden` has in all processes of the suite. HDF5 has its own calls of the system: its files
are known to be open all the same, by `/proc/self/fd`.
"""

import builtins
import io
import json
import os
import re
import shutil
import signal
import subprocess  # noqa: F401  # which takes the module `msvcrt` for Windows itself
import sys
import tempfile
import types
from importlib import import_module
from importlib.machinery import PathFinder, SourceFileLoader
from pathlib import Path

LIBRARIES = ("h5py", "numba.core.caching", "onnx", "onnxruntime", "pint", "polars", "rich.console", "scipy.special")
LACKS = ("fcntl", "termios", "tty", "pty", "resource", "pwd", "grp", "readline")
OURS = ("driftlab", "fusion_core", "fusion_plugins")
CALLS = ("pread", "pwrite", "geteuid", "getgid", "statvfs", "fork", "mkfifo", "killpg", "fchmod", "O_NOFOLLOW",
         "O_NONBLOCK", "ST_RDONLY", "posix_fallocate", "register_at_fork", "set_blocking", "mknod")  # fmt: skip
SIGNALS = ("SIGHUP", "SIGIO", "SIGALRM", "SIGUSR1", "pthread_sigmask", "setitimer")
RESERVED = re.compile(r"(?i)(con|prn|aux|nul|com\d|lpt\d)(\..*)?$|.*[<>:\"|?*\x00-\x1f]|.*[. ]$")


class Libraries:
    """A finder for libraries, which have other parts for Windows: here they take those of POSIX."""

    def __init__(self, real: dict[str, types.ModuleType]) -> None:
        self.real, self.depth = real, 0

    def find_spec(self, name, path=None, target=None):
        """Return the usual spec, of a library with a loader before which nothing is hidden."""
        spec = PathFinder.find_spec(name, path, target)
        if name.partition(".")[0] in OURS or not isinstance(getattr(spec, "loader", None), SourceFileLoader):
            return spec
        if "site-packages" in Path(spec.origin).parts:
            run = spec.loader.exec_module
            spec.loader.exec_module = lambda module: self.shown(run, module)
        return spec

    def shown(self, run, module):
        """Run the code of a module while nothing is hidden."""
        self.depth += 1
        sys.modules.update(self.real)
        try:
            run(module)
        finally:
            self.depth -= 1
            if not self.depth:
                sys.modules.update(dict.fromkeys(LACKS))


def hide() -> None:
    """Hide modules that Windows lacks, and have `msvcrt` lock files in the place of `fcntl`."""
    if "msvcrt" in sys.modules:
        return  # hidden already
    import fcntl

    sys.meta_path.insert(0, Libraries({name: import_module(name) for name in LACKS}))

    locks = types.ModuleType("msvcrt")
    locks.LK_NBLCK = 2

    def locking(number: int, mode: int, count: int) -> None:
        fcntl.flock(number, fcntl.LOCK_EX | fcntl.LOCK_NB)

    locks.locking = locking
    sys.modules.update(dict.fromkeys(LACKS))
    sys.modules["msvcrt"] = locks


def as_it_is_written(path: Path) -> Path:
    """Return the name of a file of rows that a program has open: its own only where open files can be renamed."""
    return path.with_name(path.name + ".new") if "msvcrt" in sys.modules else path


def begin() -> None:
    """Hide what Windows lacks, and have files behave as they do there."""
    import multiprocessing

    for name in LIBRARIES:  # which ask `os.name`, and then for what POSIX has
        import_module(name)
    hide()
    for name in CALLS:
        if hasattr(os, name):
            delattr(os, name)
    for name in SIGNALS:
        if hasattr(signal, name):
            delattr(signal, name)
    shutil._use_fd_functions = False
    tempfile.TemporaryFile = tempfile.NamedTemporaryFile
    multiprocessing.get_all_start_methods = lambda: ["spawn"]
    _files()


def _opened() -> list[str]:
    numbers = os.listdir("/proc/self/fd")
    found = []
    for number in numbers:
        try:
            found.append(os.readlink(f"/proc/self/fd/{number}"))
        except OSError:
            continue
    return found


def _refuse_open(path: object) -> None:
    real = os.path.realpath(os.fspath(path))
    for name in _opened():
        if name == real or name.startswith(real + os.sep):
            raise PermissionError(13, "The process cannot access the file because it is being used", str(path))


def _refuse_name(path: object) -> None:
    if isinstance(path, int) or str(path).startswith(("/proc", "/dev", "/sys")):
        return
    for part in os.fsdecode(os.fspath(path)).split(os.sep):
        if part not in ("", ".", "..") and RESERVED.match(part):
            raise OSError(22, "Invalid argument", str(path))


def _files() -> None:
    rename, replace, open_, mkdir = os.rename, os.replace, os.open, os.mkdir

    def renamed(src, dst, **kw):
        _refuse_name(dst)
        _refuse_open(src)
        if os.path.lexists(dst):
            raise FileExistsError(17, "Cannot create a file when that file already exists", str(dst))
        rename(src, dst, **kw)

    def replaced(src, dst, **kw):
        _refuse_name(dst)
        _refuse_open(src)
        _refuse_open(dst)
        if os.path.isdir(dst):
            raise PermissionError(13, "Access is denied", str(dst))
        replace(src, dst, **kw)

    def removed(call):
        def remove(path, **kw):
            _refuse_open(path)
            call(path, **kw)

        return remove

    def opened(path, flags, *args, **kw):
        _refuse_name(path)
        if os.path.isdir(path):
            raise PermissionError(13, "Permission denied", str(path))
        return open_(path, flags, *args, **kw)

    def made(path, *args, **kw):
        _refuse_name(path)
        mkdir(path, *args, **kw)

    def file(path, *args, call=io.open, **kw):
        if not isinstance(path, int):
            _refuse_name(path)
        return call(path, *args, **kw)

    os.rename, os.replace, os.open, os.mkdir = renamed, replaced, opened, made
    os.remove, os.unlink, os.rmdir = removed(os.remove), removed(os.unlink), removed(os.rmdir)
    io.open = builtins.open = file


def main(folder: str, commands: list[list[str]]) -> None:
    """Run commands one after the other, and print how each ended."""
    os.chdir(folder)
    sys.path.insert(0, os.path.dirname(__file__))
    begin()
    from command_line import status_of

    ended = []
    for command in commands:
        out, err = io.StringIO(), io.StringIO()
        ended.append([status_of(tuple(command), out, err), err.getvalue()])
    print(json.dumps(ended))


if __name__ == "__main__":
    main(sys.argv[1], json.loads(sys.argv[2]))
