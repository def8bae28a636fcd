"""Work for workers in tests: functions that can be imported where they work."""

import ctypes
import os
import signal
import time
from pathlib import Path


def burn(seconds):
    """Use the processor for so long; return where."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass
    return os.getpid()


def nap(seconds):
    time.sleep(seconds)
    return os.getpid()


def burn_in_c(steps):
    """Use the processor without letting another thread of the process have a turn; return where."""
    sum(range(steps))
    return os.getpid()


def misbehave(how):
    """Do what the item says, and return it if that can be survived."""
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    elif how == "segfault":
        ctypes.string_at(0)
    elif how == "exit":
        os._exit(3)
    elif how == "memory":
        bytearray(1 << 60)
    elif how == "raise":
        raise KeyError("heading")
    elif how == "unpicklable":
        return lambda: None
    elif how == "hang":
        time.sleep(1e6)
    return how


def killed_so_often(path):
    """Count in a file whose name begins with a number, kill the process so often, and then return the path."""
    with Path(path).open("a") as file:
        file.write("x")
    if len(Path(path).read_text()) <= int(Path(path).name.split()[0]):
        os.kill(os.getpid(), signal.SIGKILL)
    return path


def status(dask_worker):
    """Return the status of the part of Dask that this is asked of, as a word."""
    return dask_worker.status.name


def square(number):
    return number * number


def large(number):
    """Return as much as a unit's files hold."""
    return number, bytes([number % 256]) * 100_000


def threads(_):
    """Return how many threads each library of this process has for linear algebra, and numba's and polars'."""
    import numba
    import numpy  # noqa: F401
    import polars
    import scipy.linalg  # noqa: F401
    from threadpoolctl import threadpool_info

    return (
        [pool["num_threads"] for pool in threadpool_info()],
        numba.config.NUMBA_NUM_THREADS,
        polars.thread_pool_size(),
    )


def once_then_killed(path):
    """Kill the process that meets the file first; return what the second one says."""
    try:
        os.close(os.open(path, os.O_CREAT | os.O_EXCL))
    except FileExistsError:
        return "came back"
    os.kill(os.getpid(), signal.SIGKILL)
    return None


def gone(_):
    os._exit(7)


def information(part):
    """Return what the soaks of units say of their first axis, and the last letter of their lots."""
    return [[*soaked.h[0], float(lot[-1])] for soaked, lot in part.read()]


def count(units):
    """Return the number of units, each of them read."""
    return sum(1 for _ in units)
