"""Processes of this machine: whatever one of them does, its item alone is lost, and none outlives the one who asked."""

import ast
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import unit_work
from clusters import wait_until

from driftlab.errors import WorkersError
from driftlab.production import workers
from driftlab.production.workers import Pool, WorkerLost, available
from driftlab.storage.system import has_posix_locks

WHY = {
    "killed": "its worker was killed (SIGKILL), as the system does where memory runs out",
    "segfault": "its worker crashed (SIGSEGV)",
    "exit": "its worker ended with exit status 3",
    "memory": "its worker had not enough memory; use fewer workers",
    "raise": "KeyError: 'heading' (support/unit_work.py, line",
    "unpicklable": "AttributeError: Can't",
}
# on Windows the system ends no process with another; a thread does, which code in C may keep waiting
WORK = "burn_in_c" if has_posix_locks() else "burn"
SCRIPT = """
import sys, unit_work
from driftlab.production.workers import Pool
print("main", flush=True)
with Pool(2) as pool:
    for item, result in pool.map(unit_work.{work}, [0, 0, {last}]):
        print(result, flush=True)
"""


def gone(pid):
    """Tell if a process has ended; one that nobody has waited for yet is a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return True


def script(tmp_path, last):
    """Start a script with two workers, as a user writes it, without a guard; return it and their process ids."""
    path = tmp_path / "line.py"
    path.write_text(SCRIPT.format(work=WORK, last=last))
    support = str(Path(unit_work.__file__).parent)
    paths = os.pathsep.join([support, *filter(None, sys.path)])
    started = subprocess.Popen([sys.executable, path], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
                               env={**os.environ, "PYTHONPATH": paths})  # fmt: skip
    assert started.stdout.readline() == "main\n"
    return started, [int(started.stdout.readline()) for _ in range(2)]


def test_each_item_comes_back_once_with_its_result():
    with Pool(2) as pool:
        found = list(pool.map(unit_work.large, range(100)))
    assert sorted(item for item, _ in found) == list(range(100))
    assert all(result == unit_work.large(item) for item, result in found)


def test_what_is_done_first_comes_first():
    with Pool(2) as pool:
        assert [item for item, _ in pool.map(unit_work.nap, [0.5, 0.01, 0.02, 0.03])] == [0.01, 0.02, 0.03, 0.5]


@pytest.mark.parametrize("how", WHY)
def test_a_worker_that_dies_loses_its_item_and_no_other(how):
    items = ["a", how, "b", "c", how, "d", "e", "f"]
    with Pool(2) as pool:
        found = list(pool.map(unit_work.misbehave, items))
    assert sorted(item for item, _ in found) == sorted(items)
    for item, result in found:
        if item == how:
            assert isinstance(result, WorkerLost)
            assert result.why.startswith(WHY[how])
        else:
            assert result == item


def test_a_worker_that_is_killed_while_it_waits_is_replaced():
    with Pool(1) as pool:
        [(_, pid)] = pool.map(unit_work.nap, [0.0])
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: gone(pid))
        [(_, other)] = pool.map(unit_work.nap, [0.0])
    assert isinstance(other, int)
    assert other != pid


def test_items_are_drawn_as_they_are_needed():
    drawn = []

    def items():
        for k in range(50):
            drawn.append(k)
            yield k

    with Pool(3) as pool:
        for back, _ in enumerate(pool.map(unit_work.square, items()), 1):
            assert len(drawn) - back <= 2 * 3  # each worker: one in work, and one that is done and not yet seen
    assert back == 50


def test_a_pool_without_items_starts_nothing():
    with Pool(2) as pool:
        assert list(pool.map(unit_work.square, [])) == []
        assert pool._idle == []


def test_what_the_items_raise_is_raised_and_nobody_works_on():
    def items():
        yield 0.0
        raise OSError("the manifest is gone")

    with Pool(2) as pool:
        with pytest.raises(OSError, match="manifest is gone"):
            list(pool.map(unit_work.nap, items()))
        assert [item for item, _ in pool.map(unit_work.nap, [0.01])] == [0.01]


def test_a_caller_who_has_seen_enough_ends_the_work_at_once():
    with Pool(2) as pool:
        found = pool.map(unit_work.nap, [0.0, 1e6, 1e6])
        next(found)
        begun = time.monotonic()
        found.close()
        assert time.monotonic() - begun < 100
        assert [item for item, _ in pool.map(unit_work.nap, [0.01])] == [0.01]


def test_the_same_processes_work_on_what_comes_next():
    with Pool(2) as pool:
        first = {pid for _, pid in pool.map(unit_work.nap, [0.1, 0.1])}
        assert first == {pid for _, pid in pool.map(unit_work.nap, [0.1, 0.1])}
    wait_until(lambda: all(map(gone, first)))


@pytest.mark.parametrize(("how", "status"), [(signal.SIGINT, None), (signal.SIGTERM, -15), (signal.SIGKILL, -9)])
def test_workers_end_with_the_one_who_began_them(how, status, tmp_path):
    started, pids = script(tmp_path, 10**15)
    try:
        assert not any(map(gone, set(pids)))
        started.send_signal(how)
        _, said = started.communicate(timeout=20)
    finally:
        started.kill()
    assert status is None or started.returncode == status
    assert status is not None or "KeyboardInterrupt" in said
    wait_until(lambda: all(map(gone, pids)))


def test_a_script_that_is_not_written_for_it_is_run_once(tmp_path):
    started, _ = script(tmp_path, 0)
    said, errors = started.communicate(timeout=20)
    assert "main" not in said
    assert errors == ""
    assert started.returncode == 0


def test_a_worker_has_one_thread():
    before = dict(os.environ)
    with Pool(1) as pool:
        [(_, (libraries, numba, polars))] = pool.map(unit_work.threads, [0])
    assert libraries
    assert set(libraries) == {numba} == {polars} == {1}
    assert dict(os.environ) == before


def test_workers_that_cannot_begin_are_said(monkeypatch):
    monkeypatch.setattr(workers, "_serve", unit_work.gone)
    with Pool(2) as pool, pytest.raises(WorkersError, match="3 worker processes in a row ended before they began"):
        list(pool.map(unit_work.square, range(5)))


def test_workers_that_end_at_once_before_they_begin_are_said(monkeypatch):
    monkeypatch.setattr(workers, "_serve", unit_work.gone)
    monkeypatch.setattr(workers, "_ended", lambda busy: [worker for worker in busy if worker.hear()])  # of all
    with Pool(4) as pool, pytest.raises(WorkersError, match="3 worker processes in a row ended before they began"):
        list(pool.map(unit_work.square, range(5)))


def test_processors_are_those_that_may_be_used():
    code = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    code += "from driftlab.production.workers import *; "
    done = subprocess.run([sys.executable, "-c", code + "print(available())"], capture_output=True, text=True)
    assert done.stdout == "1\n"
    assert 1 <= available() <= len(os.sched_getaffinity(0))


@pytest.mark.parametrize("module", ["workers", "dask", "remote"])
def test_every_message_is_listed(module):
    """Each piece of a text that is raised, or is the reason of a loss, stands in the reference."""
    root = Path(__file__).parents[3]
    listed = (root / "docs" / "reference" / "errors.md").read_text()
    calls = {"WorkersError", "ConfigError", "UnreadableFile", "DataError", "WorkerLost"}
    tree = ast.parse(Path(workers.__file__).with_name(f"{module}.py").read_text())
    said = [
        piece.value.strip()
        for call in ast.walk(tree)
        if isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id in calls
        for piece in ast.walk(call.args[0])
        if isinstance(piece, ast.Constant) and isinstance(piece.value, str) and len(piece.value) > 2
    ]
    assert said
    assert [text for text in said if text not in listed] == []
