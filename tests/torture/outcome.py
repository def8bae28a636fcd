"""The outcome of a case, and the call of the program inside a worker."""

from __future__ import annotations

import gc
import io
import os
import re
import sys
import threading
import traceback
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from pathlib import Path

FAILURES = ("traceback", "hang", "nonsense", "lost")  # what a campaign must not have
KINDS = ("accepted", "clean", "undetectable", *FAILURES)
OURS = re.compile(r"/(driftlab|fusion_core|fusion_plugins|plugins)/([\w/]+)\.py$")


@dataclass(frozen=True)
class Outcome:
    """One of KINDS; `cause` is what failures are grouped by, `detail` what is written beside the case.

    `undetectable`: accepted, with data that differ from the true ones in a way that no reader could know of.
    """

    kind: str
    cause: str = ""
    detail: str = ""


@dataclass
class Said:
    """The output of a call of the program, its end, and the Python exception that escaped from it."""

    status: int
    out: str = ""
    err: str = ""
    cause: str = ""
    trace: str = ""
    notes: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.notes = re.findall(r"^note: (.*)$", self.out, re.MULTILINE)

    def refused(self) -> Outcome | None:
        """Return the outcome where the program did not end with 0: a clean error, or none at all."""
        if self.trace:
            return Outcome("traceback", self.cause, self.trace)
        if "Traceback (most recent call last)" in self.err:
            return Outcome("traceback", traceback_cause(self.err), self.err)
        if self.status == 0:
            return None
        if self.status < 0:
            return Outcome("traceback", f"ended by signal {-self.status}", self.err)
        if re.search(r"^(driftlab: .|Usage: )", self.err, re.MULTILINE):
            return Outcome("clean", detail=self.err)
        return Outcome("nonsense", f"exit status {self.status} without a message", self.out + self.err)


def traceback_cause(text: str) -> str:
    """Return `Error in file:function` of the last frame of the program in a printed traceback."""
    frames = re.findall(r'File "([^"]+)", line \d+, in (\S+)', text)
    raised = re.findall(r"^([A-Za-z_][\w.]*)(?=: |$)", text, re.MULTILINE)
    last = (raised or ["an exception"])[-1].rpartition(".")[2]
    ours = [(m[1] + "/" + m[2], name) for path, name in frames if (m := OURS.search(path))]
    return f"{last} in {':'.join(ours[-1])}" if ours else last


class _Ended(BaseException):
    """The exception that `os._exit` raises inside a worker."""

    def __init__(self, code: int) -> None:
        self.code = code


def _end(code: int) -> None:
    raise _Ended(code)


def program(*args: object) -> Said:
    """Run the command line inside this process, as a shell would: the arguments in, status and texts out."""
    from driftlab.cli import main

    out, err, status, trace = io.StringIO(), io.StringIO(), 0, ""
    before = sys.argv, os._exit, threading.excepthook, gc.freeze
    died: list[str] = []
    sys.argv, os._exit = ["driftlab", *map(str, args)], _end
    gc.freeze = lambda: None  # of a process that ends; thousands of calls would keep all garbage
    threading.excepthook = lambda hook: died.append("".join(traceback.format_exception(hook.exc_value)))
    try:
        with redirect_stdout(out), redirect_stderr(err):
            main()
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else int(end.code is not None)
        if isinstance(end.code, str):
            err.write(end.code)
    except _Ended as end:
        status = end.code
    except BaseException:
        status, trace = 1, traceback.format_exc()
    finally:
        sys.argv, os._exit, threading.excepthook, gc.freeze = before
    trace = trace or "".join(died)
    return Said(status, out.getvalue(), err.getvalue(), traceback_cause(trace) if trace else "", trace)


def clear(folder: Path) -> None:
    """Remove what is in a folder, whatever its rights."""
    import shutil

    for path in folder.iterdir():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
