"""Servers on this machine, each a process of its own that may be killed: a Dask scheduler, its workers, and S3."""

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
    """Start a module as a server, with its words in a file."""
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
    pytest.importorskip("resource", reason="Dask needs on this system what POSIX has")
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
    """Start a worker that Dask begins again when it is killed, as it does unless asked not to.

    Dask's nanny ends where its worker is killed before it has seen it running, some milliseconds after it has come.
    """
    from distributed import Client
    from unit_work import status

    with started(
        tmp_path, "distributed.cli.dask_worker", address, "--nanny", "--no-dashboard", "--nthreads", "1",
    ) as (part, log):  # fmt: skip
        with Client(address, set_as_default=False) as client:
            client.wait_for_workers(1, timeout=60)
            wait_until(lambda: [*client.run(status, nanny=True).values()] == ["running"])
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


def wait_until(holds, patience=30.0):
    """Wait until a condition holds."""
    end = time.monotonic() + patience
    while not holds():
        assert time.monotonic() < end, "it does not come to hold"
        time.sleep(0.005)


@contextmanager
def s3(tmp_path):
    """Give the file system of a server that has the API of S3, by the environment, which workers have too."""
    s3fs = pytest.importorskip("s3fs")
    pytest.importorskip("moto.server")
    given = {"ACCESS_KEY_ID": "a", "SECRET_ACCESS_KEY": "b", "DEFAULT_REGION": "us-east-1"}
    with (
        started(tmp_path, "moto.server", "-H", "127.0.0.1", "-p", "0") as (_, log),
        pytest.MonkeyPatch.context() as patch,
    ):
        given["ENDPOINT_URL"] = said(log, "Running on", patience=120.0).split()[-1]
        for name, value in given.items():
            patch.setenv(f"AWS_{name}", value)
        s3fs.S3FileSystem.clear_instance_cache()  # of another server
        yield s3fs.S3FileSystem()
        s3fs.S3FileSystem.clear_instance_cache()
