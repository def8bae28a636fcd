"""The command line inside this process: what a shell would see, without the second that a process takes to begin."""

from __future__ import annotations

import gc
import io
import os
import signal
import subprocess
import sys
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path
from unittest.mock import patch


class _Ended(BaseException):
    """The exception that `os._exit` raises here."""

    def __init__(self, code: int) -> None:
        self.code = code


def _end(code: int) -> None:
    raise _Ended(code)


def status_of(args: tuple[object, ...], out: io.StringIO, err: io.StringIO) -> int:
    """Run a command as a shell would, and return its exit status; an exception that no user may see is raised."""
    from driftlab.cli import main

    before, handler = gc.get_threshold(), signal.getsignal(signal.SIGTERM)
    try:
        with (
            patch.object(sys, "argv", ["driftlab", *map(str, args)]),
            patch.object(os, "_exit", _end),
            patch.object(gc, "freeze", lambda: None),  # of a process that ends; calls after it would keep all garbage
            patch.dict(os.environ),
            redirect_stdout(out),
            redirect_stderr(err),
        ):
            main()
    except SystemExit as end:
        if isinstance(end.code, str):
            err.write(end.code)
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except _Ended as end:
        return end.code
    finally:
        gc.set_threshold(*before)
        signal.signal(signal.SIGTERM, handler)
    return 0


def driftlab(*args: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    """Run a command in a folder, and return what `subprocess.run` would."""
    out, err = io.StringIO(), io.StringIO()
    with chdir(cwd):
        status = status_of(args, out, err)
    return subprocess.CompletedProcess(args, status, out.getvalue(), err.getvalue())
