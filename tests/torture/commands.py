"""The program as a process of its own: begun, killed, or left to end."""

from __future__ import annotations

import resource
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from torture.outcome import Outcome, Said

MAIN = "from driftlab.cli import main; main()"
# many small chunks with a pause after each, and a checkpoint after nearly every one: there is much to be killed in
SLOWLY = """
import time
from driftlab.commands import estimates as estimating
from driftlab.filtering import run
estimating.PERIOD = 0.05
read = run.read
def slowly(*args, **more):
    for chunk in read(*args, **{**more, "rows": 500}):
        time.sleep(0.02)
        yield chunk
run.read = slowly
"""
TIMEOUT = 40.0  # s after which a command hangs


def begin(folder: Path, *args: object, slowly: bool = False, largest: int | None = None) -> subprocess.Popen[str]:
    """Start the program; `largest` is the size in bytes beyond which it cannot write a file."""
    command = [sys.executable, "-c", (SLOWLY if slowly else "") + MAIN, *map(str, args)]
    limit: Callable[[], None] | None = None
    if largest is not None:
        limit = lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (largest, largest))  # noqa: E731
    pipe = subprocess.PIPE
    return subprocess.Popen(
        command, cwd=folder, stdout=pipe, stderr=pipe, text=True, errors="replace", preexec_fn=limit
    )


def ended(process: subprocess.Popen[str], patience: float = TIMEOUT) -> Said | Outcome:
    """Wait for the end; an outcome where there is none. What is not a pipe says nothing."""
    try:
        out, err = (text or "" for text in process.communicate(timeout=patience))
    except subprocess.TimeoutExpired:
        process.kill()
        out, err = (text or "" for text in process.communicate())
        return Outcome("hang", f"`{' '.join(process.args[3:5])}`", out[-2000:] + err[-2000:])  # type: ignore[index]
    return Said(process.returncode, out, err)


def call(folder: Path, *args: object, largest: int | None = None) -> Said | Outcome:
    """Run a command to its end."""
    return ended(begin(folder, *args, largest=largest))


def kill(process: subprocess.Popen[str]) -> str:
    """End a process as a power cut does, and return what it had printed."""
    process.send_signal(signal.SIGKILL)
    return process.communicate()[0]
