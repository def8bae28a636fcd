"""A Dask cluster on this machine: a scheduler and workers, each a process of its own that may be killed."""

import os
import subprocess
import sys
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

SUPPORT = str(Path(__file__).parent)


@contextmanager
def started(tmp_path, *args, **environment):
    """Start a part of a cluster, with its words in a file."""
    pytest.importorskip("resource", reason="Dask needs on this system what POSIX has")
    paths = os.pathsep.join([*environment.pop("before", ()), SUPPORT, *filter(None, sys.path)])
    log = tmp_path / f"{len(list(tmp_path.iterdir()))}.log"
    with log.open("w") as file:
        part = subprocess.Popen([sys.executable, "-m", *args], stdout=file, stderr=file, cwd=tmp_path,
                                env={**os.environ, "PYTHONPATH": paths, **environment})  # fmt: skip
    try:
        yield part, log
    finally:
        part.kill()
        part.wait()


def scheduler(tmp_path, **environment):
    return started(
        tmp_path, "distributed.cli.dask_scheduler", "--port", "0", "--no-dashboard", "--host", "127.0.0.1",
        "--scheduler-file", "scheduler.json", **environment,
    )  # fmt: skip


def worker(tmp_path, address, **environment):
    return started(
        tmp_path, "distributed.cli.dask_worker", address, "--no-nanny", "--no-dashboard", "--nthreads", "1",
        "--death-timeout", "30", **environment,
    )  # fmt: skip


@contextmanager
def supervised(tmp_path, address):
    """Start a worker that Dask begins again when it is killed, as it does unless asked not to."""
    with started(
        tmp_path, "distributed.cli.dask_worker", address, "--nanny", "--no-dashboard", "--nthreads", "1",
    ) as (part, log):  # fmt: skip
        yield part, log
        part.terminate()  # it ends its worker, which would outlive it
        part.wait(20)


def said(path, text, patience=30.0):
    """Return the line of a file that has the text, as soon as there is one."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        for line in path.read_text().splitlines() if path.is_file() else ():
            if text in line:
                return line
        time.sleep(0.02)
    raise AssertionError(f"{path} has no {text}: {path.read_text()}")
