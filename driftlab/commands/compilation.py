"""Compilation of the functions that a command needs: announced to people, and half of it done by a second process.

The first command of an installation compiles for seconds, one function after the other as they are called, and numba
lets no two threads of a process compile at once. `run.txt` and `explain.txt` list what these commands compile, in the
order of its need. The second process takes a list from its end and fills numba's cache, in which the first looks before
it compiles: they meet halfway. What the second does wrong, or not in time, the first does itself.
"""

from __future__ import annotations

import gc
import os
import re
import sys
import time
from contextlib import suppress
from functools import cache, partial
from importlib import import_module
from pathlib import Path
from threading import TIMEOUT_MAX, Thread, Timer
from typing import TYPE_CHECKING, Any

from driftlab.commands.console import terminal
from fusion_core.fast import WITH_NUMBA

if TYPE_CHECKING:
    import subprocess

COMPILED = 1.0  # s of compiling, after which it is announced
ARRAY = re.compile(r"Array\((\w+), (\d), 'C', False, aligned=True\)")


def watch(command: str) -> None:
    """Let what a command compiles be announced, and shared with a second process."""
    WITH_NUMBA[:] = [note_compiling, partial(share, Path(__file__).with_name(f"{command}.txt"))]


@cache
def note_compiling() -> None:
    """Announce once in a process, on standard error, that loops are compiled for an installation or a processor."""
    from numba.core import event

    class Notice(event.Listener):  # type: ignore[misc]
        """Waits for COMPILED seconds of compiling in all; what is compiled compiles what it calls."""

        seconds, since, depth, announced = 0.0, 0.0, 0, False
        timer: Timer | None = None

        def on_start(self, event: Any) -> None:
            self.depth += 1
            if self.depth == 1 and not self.announced and COMPILED < TIMEOUT_MAX:
                self.since = time.monotonic()
                self.timer = Timer(max(COMPILED - self.seconds, 0.0), self.announce)
                self.timer.daemon = True
                self.timer.start()

        def on_end(self, event: Any) -> None:
            self.depth -= 1
            if self.depth == 0 and self.timer is not None:
                self.timer.cancel()
                self.timer = None
                self.seconds += time.monotonic() - self.since

        def announce(self) -> None:
            self.announced = True
            text = "compiling the filter for this processor, up to some minutes; it is kept for the next time"
            with suppress(OSError, ValueError):  # standard error is closed
                terminal(stderr=True).print(text, soft_wrap=True)

    event.register("numba:compile", Notice())


def described(function: Any, types: tuple[Any, ...]) -> str:
    """Return the line of a list: the name of a function and the types of its arguments, as numba reads them."""
    text = ARRAY.sub(lambda found: f"{found[1]}[{':, ' * (int(found[2]) - 1)}::1]", str(types))
    return f"{function.__module__}.{function.__qualname__} {text}"


def share(listed: Path) -> None:
    """Let a second process compile what is listed, from when this one first compiles something of it.

    Not where there is one core: both would take as long.
    """
    from numba.core import event

    lines = frozenset(listed.read_text().splitlines()) if listed.is_file() else frozenset()

    class First(event.Listener):  # type: ignore[misc]
        """Waits for a function that is listed."""

        second: subprocess.Popen[bytes] | None = None
        waits = bool(lines)

        def on_start(self, event: Any) -> None:
            if self.waits and described(event.data["dispatcher"].py_func, event.data["args"]) in lines:
                from joblib import cpu_count  # type: ignore[import-untyped]

                self.waits = False
                with suppress(OSError):
                    self.second = _started(listed) if cpu_count() > 1 else None

        def on_end(self, event: Any) -> None:
            """Leave the second process alone: it ends where its list or this process does."""

    event.register("numba:compile", First())


def _started(listed: Path) -> subprocess.Popen[bytes]:
    """Start the second process: with the paths of this one, and its input open for as long as this one lives."""
    import subprocess

    silent, environment = subprocess.DEVNULL, os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-P", "-m", __name__, str(listed)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=silent, stderr=silent, env=environment)


def _end_with_the_first() -> None:
    os.read(0, 1)  # nothing is ever written
    os._exit(0)


def main() -> None:
    """Compile what is listed, from the end on, until the list or the process that began ends."""
    from numba.core import sigutils

    gc.disable()  # a tenth of the time; what is made in so short a life is kept anyway
    Thread(target=_end_with_the_first, daemon=True).start()
    for line in reversed(Path(sys.argv[1]).read_text().splitlines()):
        name, types = line.split(" ", 1)
        module, _, function = name.rpartition(".")
        with suppress(Exception):  # of some types, as named tuples, numba reads no text
            made = getattr(import_module(module), function)
            getattr(made, "together", made).compile(sigutils.normalize_signature(types)[0])


if __name__ == "__main__":
    main()
