"""Worker processes that are used again and again, and a watchdog that ends the one that hangs.

A case hangs when its process has used LIMIT seconds of the processor for it, or four times as many have gone by: on a
machine with other work to do, the clock alone would find hangs where there are none.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import resource
import signal
import time
import traceback
import zlib
from collections.abc import Callable, Iterable
from contextlib import suppress
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np

from torture.outcome import Outcome, clear

MEMORY = 3 << 30  # bytes that a worker may take beyond what it has when it is ready
READY = 600.0  # s for a worker to begin, with the compiler's time on a fresh installation
TICKS = os.sysconf("SC_CLK_TCK")


def generator(seed: int, name: str, number: int) -> np.random.Generator:
    """Return the random numbers of a case; nothing else makes it what it is."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), number])


def serve(pipe: Connection, name: str, base: Path, own: Path, seed: int) -> None:
    """Work on cases by their numbers until there are no more."""
    os.setsid()
    log = os.open(own / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)
    case = own / "case"
    case.mkdir(exist_ok=True)
    module = importlib.import_module(f"torture.{name}")
    os.chdir(case)
    try:
        bench = module.Bench(base, case)
    except BaseException:
        pipe.send(traceback.format_exc())
        return
    if module.IN_PROCESS:
        with open("/proc/self/statm") as file:
            size = int(file.read().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
    pipe.send(None)
    while (number := pipe.recv()) is not None:
        clear(case)
        os.chdir(case)
        try:
            pipe.send(bench.case(number, generator(seed, name, number), case))
        except BaseException:
            pipe.send(Outcome("traceback", "of the harness itself", traceback.format_exc()))


class Worker:
    """One process, and the case that it works on."""

    def __init__(self, module: Any, base: Path, own: Path, seed: int) -> None:
        self.module, self.base, self.own, self.seed = module, base, own, seed
        own.mkdir(parents=True, exist_ok=True)
        self.begin()

    def begin(self) -> None:
        """Start the process, and wait until it is ready."""
        context = multiprocessing.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        name = self.module.__name__.rpartition(".")[2]
        self.process = context.Process(target=serve, args=(theirs, name, self.base, self.own, self.seed))
        self.process.start()
        theirs.close()
        self.number: int | None = None
        self.ready, self.since = False, time.monotonic()

    def take(self, number: int) -> None:
        """Begin a case."""
        self.number, self.since, self.used = number, time.monotonic(), self.cpu()
        self.pipe.send(number)

    def cpu(self) -> float:
        """Return the seconds of the processor that the process has used."""
        try:
            with open(f"/proc/{self.process.pid}/stat") as file:
                fields = file.read().rpartition(")")[2].split()
        except OSError:
            return 0.0
        return (int(fields[11]) + int(fields[12])) / TICKS

    def hangs(self) -> bool:
        """Tell if the case has taken too long."""
        gone, limit = time.monotonic() - self.since, self.module.LIMIT
        if not self.ready:
            return gone > READY
        return gone > 4 * limit or (self.module.IN_PROCESS and self.cpu() - self.used > limit)

    def end(self) -> None:
        """Kill the process and what it has started."""
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with suppress(ProcessLookupError):
            os.kill(self.process.pid, signal.SIGKILL)
        self.process.join()
        self.pipe.close()


def work(
    module: Any,
    numbers: Iterable[int],
    folder: Path,
    seed: int,
    done: Callable[[int, Outcome, Path], None],
    count: int | None = None,
) -> None:
    """Have all cases worked on, by `count` workers or the campaign's own.

    `done` gets the number of each, what it came to, and the folder of the case.

    Raises
    ------
    RuntimeError
        If the bench itself cannot be set up: a valid input was refused.
    """
    left = iter(numbers)
    base = folder / "base"
    base.mkdir(parents=True, exist_ok=True)
    module.prepare(base)
    workers = [Worker(module, base, folder / f"worker-{k}", seed) for k in range(count or module.WORKERS)]
    try:
        while workers:
            wait([worker.pipe for worker in workers], timeout=0.25)
            for worker in list(workers):
                outcome = _heard(worker)
                if outcome is not None and worker.number is not None:
                    done(worker.number, outcome, worker.own / "case")
                    worker.number = None
                if worker.ready and worker.number is None:
                    number = next(left, None)
                    if number is None:
                        worker.end()
                        workers.remove(worker)
                    else:
                        worker.take(number)
    finally:
        for worker in workers:
            worker.end()


def _heard(worker: Worker) -> Outcome | None:
    """Return the outcome of the worker's case, once there is one; a dead or hanging worker is begun again."""
    try:
        if not worker.pipe.poll():
            if not worker.hangs():
                return None
            outcome = Outcome("hang", "", f"after {time.monotonic() - worker.since:.1f} s")
        else:
            outcome = worker.pipe.recv()
            if worker.ready:
                return outcome
            if outcome is not None:
                raise RuntimeError(f"the bench cannot be set up:\n{outcome}")
            worker.ready = True
            return None
    except (EOFError, ConnectionResetError):
        worker.process.join(5)
        outcome = Outcome("traceback", f"the process died with status {worker.process.exitcode}")
    if not worker.ready:
        raise RuntimeError(f"a worker does not begin ({outcome}); its log is {worker.own / 'log.txt'}")
    number = worker.number
    worker.end()
    worker.begin()
    worker.number = number
    return outcome
