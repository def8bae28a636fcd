"""What a first command compiles: it is announced, it is listed, and a second process compiles the end of the list."""

import functools
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from time import monotonic, sleep

import h5py
import joblib
import numpy as np
import pytest
import units_with_effects as maker
from command_line import driftlab
from numba.core import event, types

from driftlab.commands import compilation
from driftlab.filtering import coasting

LISTS = {name: Path(compilation.__file__).with_name(f"{name}.txt") for name in ("run", "explain")}
COMPILING = "numba:compile", {"dispatcher": coasting._unless_tiny, "args": (types.float64,)}
SCRIPT = Path(maker.__file__).with_name("compiled_first.py")


def test_compiling_is_not_announced_where_nobody_asks(monkeypatch, capsys):
    monkeypatch.setattr(compilation, "COMPILED", float("inf"))  # as the other tests have it
    compilation.note_compiling()
    with event.trigger_event(*COMPILING), event.trigger_event(*COMPILING):
        sleep(0.1)  # a failure in a thread fails the test
    assert capsys.readouterr().err == ""


def test_compiling_is_announced_once_on_standard_error(monkeypatch, capsys):
    monkeypatch.setattr(compilation, "COMPILED", 0.5)
    for _ in range(2):  # as two commands of one process do
        compilation.note_compiling()
    with event.trigger_event(*COMPILING):
        pass
    assert capsys.readouterr().err == ""  # of a moment nobody needs to know
    for _ in range(2):
        with event.trigger_event(*COMPILING), event.trigger_event(*COMPILING):
            sleep(0.8)
    printed = capsys.readouterr()
    assert printed.err.startswith("compiling the filter for this processor")
    assert printed.err.count("compiling the filter") == 1
    assert printed.out == ""


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    """A function that makes a command on so many cores, `run` in an empty cache, `explain` in that of `run`.

    It returns the lines of what was compiled, and the folder.
    """
    unit = tmp_path_factory.mktemp("unit")
    maker.make_unit(unit, 7, ("hysteresis",), ("voltage",), hours=(1.0, 0.5, 0.5))
    assert driftlab("fit-map", "declared.yaml", "--input", "soak.h5", "--out", "map.json", cwd=unit).returncode == 0
    given = {
        "run": ["--input", "holdout.h5", "--set", "filter.gyro.bias.map.path=map.json"],
        "explain": ["--calibration", "soak.h5", "--train", "train.h5", "--holdout", "holdout.h5"],
    }

    @functools.cache
    def made(command, cores, again=False):
        cache, out = unit / f"cache{cores}", unit / f"{command}{cores}{again}"
        words = [SCRIPT, cores, f"{out}.txt", command, "declared.yaml", *given[command], "--out", out, "-q"]
        environment = os.environ | {"NUMBA_CACHE_DIR": str(cache)}
        done = subprocess.run(
            [sys.executable, *map(str, words)], cwd=unit, env=environment, capture_output=True, text=True
        )
        assert done.returncode == 0, done.stderr
        return Path(f"{out}.txt").read_text().splitlines(), out

    return made


def test_the_lists_are_what_the_commands_compile(first):
    """The list of `explain` has that of `run` in it, which then need not be compiled once more here."""
    run, explain = (set(path.read_text().splitlines()) for path in LISTS.values())
    lines, out = first("run", 1)
    assert set(lines) == run, f"cp {out}.txt {LISTS['run']}"
    lines, _ = first("explain", 1)
    assert set(lines) == explain - run, f"begin {LISTS['explain']} with {LISTS['run']}, and go on with {sorted(lines)}"
    assert run < explain


@pytest.mark.skipif(joblib.cpu_count() < 2, reason="there is one core only")
def test_a_second_process_compiles_the_end_of_the_list_and_a_second_run_compiles_nothing(first):
    lines, shared = first("run", 2)
    assert LISTS["run"].read_text().splitlines()[-1] not in lines
    assert first("run", 2, again=True)[0] == []
    alone = first("run", 1)[1]
    with h5py.File(shared / "estimates.h5") as one, h5py.File(alone / "estimates.h5") as other:
        for name in ("x", "sigma", "coast_sigma"):
            np.testing.assert_array_equal(one[name], other[name])


def compile_something_listed():
    compilation.share(LISTS["run"])
    with event.trigger_event(*COMPILING):
        pass


@pytest.mark.parametrize("program", ["/nowhere/python", shutil.which("false")])
def test_a_second_process_that_fails_is_not_missed(monkeypatch, capfd, program):
    monkeypatch.setattr(sys, "executable", program)
    compile_something_listed()
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("cores", [1, 2])
def test_there_is_a_second_process_where_there_is_a_second_core(monkeypatch, cores):
    started = []
    monkeypatch.setattr(joblib, "cpu_count", lambda: cores)
    monkeypatch.setattr(compilation, "_started", started.append)
    compile_something_listed()
    assert started == [LISTS["run"]] * (cores - 1)


def test_the_second_process_ends_with_the_first_however_that_ends(tmp_path):
    code = f"""
import os, signal
from pathlib import Path
from driftlab.commands import compilation
print(compilation._started(Path({str(LISTS["explain"])!r})).pid, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    assert done.returncode == -signal.SIGKILL
    status, end = Path("/proc", done.stdout.strip(), "stat"), monotonic() + 60
    while status.exists() and status.read_text().rpartition(")")[2].split()[0] != "Z":
        assert monotonic() < end
        sleep(0.1)
    assert not list(tmp_path.rglob("*.nbi"))  # it has not come to the end of its list: nor to its first function
