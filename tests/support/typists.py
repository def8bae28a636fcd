"""A person at a terminal, who reads what a program writes there and types."""

import os
import select
import subprocess
import sys
import time

import pytest

SECONDS = 120  # on a machine that others keep busy
STOP, PAUSE = "\x03", 20.0  # Ctrl-C; how long a person waits for what it does (s)
# a shell has its background jobs ignore SIGINT
TAKE_THE_TERMINAL = """
import fcntl, os, signal, sys, termios
signal.signal(signal.SIGINT, signal.SIG_DFL)
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.executable, [sys.executable, "-m", "driftlab", *sys.argv[1:]])
"""


def at_a_terminal(*args, cwd, answers=(), **environment):
    """Run a command on a terminal; once it shows a text of `answers`, type the keys; return status and what it wrote.

    A command that waits for more is stopped, and an error. A Ctrl-C that nothing follows is typed again, as people do:
    Python misses one that comes between its last look for signals and its read.
    """
    pytest.importorskip("termios", reason="terminals are those of POSIX")
    ours, theirs = os.openpty()
    known = {"TERM": "xterm", "COLUMNS": "100", "LINES": "40", "PROMPT_TOOLKIT_NO_CPR": "1"}
    env = {**os.environ, **known, **environment}
    running = subprocess.Popen(
        [sys.executable, "-c", TAKE_THE_TERMINAL, *map(str, args)],
        stdout=theirs, stderr=theirs, stdin=theirs, env=env, cwd=cwd, start_new_session=True,
    )  # fmt: skip
    os.close(theirs)
    shown, passed, left, until = b"", 0, list(answers), time.monotonic() + SECONDS
    typed = ""
    while time.monotonic() < until:
        if not select.select([ours], [], [], PAUSE if typed == STOP else 1.0)[0]:
            if typed == STOP:
                os.write(ours, STOP.encode())
            continue
        try:
            shown += os.read(ours, 4096)
        except OSError:  # the other end is closed
            break
        while left and (at := shown.find(left[0][0].encode(), passed)) >= 0:
            passed = at + len(left[0][0].encode())
            typed = left.pop(0)[1]
            os.write(ours, typed.encode())
    os.close(ours)
    text = shown.decode(errors="replace")
    try:
        return running.wait(timeout=5), text
    except subprocess.TimeoutExpired:
        running.kill()
        running.wait()
        raise AssertionError(f"waits for more; shown is {text}") from None
