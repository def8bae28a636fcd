"""Run a command of driftlab on CORES cores, and write what it compiles into FILE: CORES FILE COMMAND ...

Of an empty folder in the environment variable NUMBA_CACHE_DIR, on one core, that is all it needs, in its order.
"""

import os
import sys
from pathlib import Path

from numba.core import event

from driftlab.cli import main
from driftlab.commands.compilation import described

OURS = ("driftlab", "fusion_core", "fusion_plugins")


class Record(event.Listener):
    """The lines of what is compiled."""

    def __init__(self):
        self.lines = []

    def on_start(self, event):
        function = event.data["dispatcher"].py_func
        if function.__module__.partition(".")[0] in OURS:
            self.lines.append(described(function, event.data["args"]))

    def on_end(self, event):
        pass


cores, file, *command = sys.argv[1:]
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: int(cores)])
sys.argv[1:] = command
record = Record()
event.register("numba:compile", record)
main()
Path(file).write_text("".join(f"{line}\n" for line in record.lines))
