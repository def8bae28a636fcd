"""The command line as a shell sees it, without the second that a process takes to begin: in this one, or another."""

from __future__ import annotations

import gc
import io
import json
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


class Elsewhere:
    """The command line in a process with an environment, and so plugins, of its own: begun once and asked often."""

    def __init__(self, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            [sys.executable, __file__], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def __enter__(self) -> Elsewhere:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.stdin.close()
        self.process.stdout.close()
        self.process.wait(timeout=60)

    def driftlab(self, *args: object, cwd: Path, **environment: str) -> subprocess.CompletedProcess[str]:
        """Run a command in a folder there, and return what `subprocess.run` would."""
        self.process.stdin.write(json.dumps([list(map(str, args)), str(cwd), environment]) + "\n")
        self.process.stdin.flush()
        return subprocess.CompletedProcess(args, *json.loads(self.process.stdout.readline()))


def _answer() -> None:
    """Run the commands that standard input names, and write what each came to; what libraries print goes elsewhere."""
    answers, sys.stdout = sys.stdout, sys.stderr
    for line in sys.stdin:
        args, cwd, environment = json.loads(line)
        with patch.dict(os.environ, environment):
            done = driftlab(*args, cwd=Path(cwd))
        answers.write(json.dumps([done.returncode, done.stdout, done.stderr]) + "\n")
        answers.flush()


if __name__ == "__main__":
    _answer()
