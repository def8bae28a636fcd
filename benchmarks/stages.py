"""Time of a run by stage: `python stages.py CONFIG RECORDING OUT` prints processor seconds of each stage as JSON.

The functions of each stage are wrapped; what one calls of another stage counts there and not here.
"""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

spent: dict[str, float] = defaultdict(float)


class Clock(threading.local):
    """The stage that a thread is in, and since when; each thread counts the time that it has the processor."""

    def __init__(self) -> None:
        self.stack, self.mark = ["rest"], time.thread_time()

    def switch(self) -> None:
        now = time.thread_time()
        spent[self.stack[-1]] += now - self.mark
        self.mark = now


clock = Clock()


@contextmanager
def stage(name: str) -> Iterator[None]:
    clock.switch()
    clock.stack.append(name)
    try:
        yield
    finally:
        clock.switch()
        clock.stack.pop()


def timed(owner: Any, attribute: str, name: str) -> None:
    """Count what a function does as a stage."""
    function: Callable[..., Any] = getattr(owner, attribute)

    def wrapper(*args: Any, **kwargs: Any) -> Any:
        with stage(name):
            return function(*args, **kwargs)

    setattr(owner, attribute, wrapper)


def timed_iterator(owner: Any, attribute: str, name: str) -> None:
    """Count what a generator does as a stage, each time that it is asked for more."""
    function: Callable[..., Any] = getattr(owner, attribute)

    def wrapper(*args: Any, **kwargs: Any) -> Iterator[Any]:
        with stage(name):
            inner = iter(function(*args, **kwargs))
        while True:
            with stage(name):
                try:
                    item = next(inner)
                except StopIteration:
                    return
            yield item

    setattr(owner, attribute, wrapper)


def main() -> None:
    config, recording, out = sys.argv[1:]
    with stage("start"):
        import driftlab.commands.run as filtering
        import driftlab.evaluation.overview as overview
        import driftlab.filtering.run as run
        import driftlab.filtering.tracker as tracker
        import driftlab.storage.ownership as ownership
        from driftlab.config import load_config
        from driftlab.storage.hdf5 import GrowingFile
        from driftlab.storage.system import keep_freed_memory

        loaded = load_config(Path(config), recording)
    timed_iterator(type(loaded.source), "chunks", "read")
    timed_iterator(run, "read", "condition")
    timed_iterator(run, "epochs", "condition")
    timed(run, "with_rate", "temperature rate")
    timed(tracker, "bias_steps", "map")
    timed_iterator(tracker.Tracker, "advance", "filter")
    timed(tracker.Segments, "segment", "deviations")
    for name in ("append", "flush", "close", "_put_all"):
        timed(GrowingFile, name, "write")
    for owner, names in (
        (overview.OverviewAccumulator, ("add", "read", "overview")),
        (filtering, ("summarise",)),
        (filtering.RunResult, ("_write",)),
    ):
        for name in names:
            timed(owner, name, "report")
    timed(ownership, "digest", "digest")
    keep_freed_memory()
    begun = time.perf_counter()
    filtering.run(loaded, out=Path(out))
    clock.switch()
    print(json.dumps({**spent, "wall": time.perf_counter() - begun}))


if __name__ == "__main__":
    main()
