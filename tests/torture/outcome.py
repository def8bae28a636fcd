"""The outcome of a case, and the call of the program inside a worker."""

from __future__ import annotations

import io
import re
import threading
import traceback
from dataclasses import dataclass, field
from pathlib import Path

from command_line import status_of

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


def program(*args: object) -> Said:
    """Run the command line inside this process, as a shell would: the arguments in, status and texts out."""
    out, err, status, trace = io.StringIO(), io.StringIO(), 1, ""
    before, died = threading.excepthook, list[str]()
    threading.excepthook = lambda hook: died.append("".join(traceback.format_exception(hook.exc_value)))
    try:
        status = status_of(args, out, err)
    except BaseException:
        trace = traceback.format_exc()
    finally:
        threading.excepthook = before
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
