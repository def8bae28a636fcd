"""A real scheduler and its workers, each a process of its own: whoever is killed, all items come back."""

import os
import signal
import sys

import pytest
import unit_work
from clusters import said, scheduler, supervised, worker

from driftlab.errors import WorkersError
from driftlab.production import dask
from driftlab.production.dask import Scheduler


@pytest.fixture
def address(tmp_path):
    with scheduler(tmp_path) as (_, log):
        yield said(log, "Scheduler at:").split()[-1]


@pytest.fixture
def two(tmp_path, address):
    with worker(tmp_path, address) as (first, _), worker(tmp_path, address) as (second, _):
        yield first, second


def test_all_items_come_back_though_a_worker_is_killed(address, two):
    items, pids, back = [0.05 + 1e-6 * k for k in range(40)], set(), []
    with Scheduler(address) as workers:
        for item, pid in workers.map(unit_work.burn, iter(items)):
            back.append(item)
            pids.add(pid)
            if len(back) == 10:
                assert pids == {part.pid for part in two}
                os.kill(two[0].pid, signal.SIGKILL)
    assert sorted(back) == items


def test_an_item_that_kills_its_workers_is_lost_and_no_other(tmp_path, address):
    """One worker, begun again each time, so that others wait beside the item that kills it."""
    with supervised(tmp_path, address), Scheduler(address) as workers:
        found = dict(workers.map(unit_work.misbehave, ["a", "killed", "raise", "b", "c", "d"]))
    assert found.pop("killed").why.startswith("4 workers died one after the other while they had it")
    assert found.pop("raise").why.startswith("KeyError: 'heading' (support/unit_work.py, line")
    assert found == {name: name for name in "abcd"}


def test_an_item_that_is_blamed_beside_another_is_tried_alone(tmp_path, address):
    innocent, killer = str(tmp_path / "4 times"), str(tmp_path / "1000 times")
    with supervised(tmp_path, address), Scheduler(address) as workers:
        found = dict(workers.map(unit_work.killed_so_often, [innocent, killer]))
    assert found[innocent] == innocent
    assert found[killer].why.startswith("4 workers died one after the other while they had it")


def test_an_item_whose_worker_was_killed_once_comes_back(tmp_path, address, two):
    with Scheduler(address) as workers:
        assert [result for _, result in workers.map(unit_work.once_then_killed, [str(tmp_path / "met")])] == [
            "came back"
        ]


def test_few_items_are_in_flight(address, two):
    drawn = []

    def items():
        for k in range(60):
            drawn.append(k)
            yield k

    with Scheduler(address) as workers:
        for back, (item, result) in enumerate(workers.map(unit_work.large, items()), 1):
            assert result == unit_work.large(item)
            assert len(drawn) - back <= dask.AHEAD * 2
    assert back == 60


def test_nobody_at_the_address():
    with pytest.raises(WorkersError, match="no Dask scheduler answers there"), Scheduler("tcp://127.0.0.1:9", 0.5):
        pass
    with pytest.raises(WorkersError, match="no Dask scheduler answers there"), Scheduler("quic://127.0.0.1:9", 0.5):
        pass


def test_a_scheduler_without_workers(address):
    with Scheduler(address, patience=0.5) as workers, pytest.raises(WorkersError, match=r"no worker for 0\.5 s"):
        list(workers.map(unit_work.square, [1]))


def test_a_scheduler_that_is_killed(tmp_path):
    with scheduler(tmp_path) as (part, log):
        address = said(log, "Scheduler at:").split()[-1]
        with worker(tmp_path, address), Scheduler(address, patience=5.0) as workers:
            found = workers.map(unit_work.nap, [0.0, 1e3])
            assert next(found)[0] == 0.0
            part.kill()
            with pytest.raises(WorkersError, match="does not answer any more; start it and its workers again"):
                next(found)


@pytest.mark.parametrize("version", ["99.0", None])
def test_a_worker_of_another_version_is_given_nothing(version, tmp_path, address):
    (tmp_path / "sitecustomize.py").write_text(
        "from importlib import metadata\n"
        "def version(name, real=metadata.version):\n"
        "    if name != 'driftlab': return real(name)\n"
        f"    if {version!r} is None: raise metadata.PackageNotFoundError(name)\n"
        f"    return {version!r}\n"
        "metadata.version = version\n"
    )
    has = f"driftlab {version}" if version else "no driftlab"
    refused = pytest.raises(WorkersError, match=rf"the worker tcp://\S+ has Python 3\.\d+ and {has}, Python")
    with worker(tmp_path, address, before=[str(tmp_path)]), Scheduler(address) as workers, refused:
        list(workers.map(unit_work.square, [1]))


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(WorkersError, match=r"distributed is not installed.*; pip install 'driftlab\[dask\]'"):
        Scheduler("tcp://127.0.0.1:9").__enter__()
