import io
import os
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from threading import Thread

import numpy as np
import pytest

from fusion_core.budget import TimeBudget, arrays_in, check_all, next_array, of_all, read_whole, rows_at_once
from fusion_core.contracts import Block, Channel, FileSource, head
from fusion_core.errors import ConfigError, UnreadableFile
from fusion_core.faults import Faults
from fusion_core.host.document import parse


def test_pipes_and_devices_are_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        for call in (read_whole, lambda path: head(path), lambda path: parse(path)):
            with pytest.raises((OSError, UnreadableFile, ConfigError), match="it is a pipe or a device, not a file"):
                call(tmp_path / name)


def test_a_file_that_is_too_large_is_not_read(tmp_path):
    with (tmp_path / "map.json").open("wb") as file:
        file.truncate(3_000_000_000)
    with pytest.raises(OSError, match="it has 3 GB, at most 16 MB are read"):
        read_whole(tmp_path / "map.json")


def test_rows_that_are_wide_are_read_fewer_at_once(tmp_path):
    assert rows_at_once(tmp_path, "v", 1000, 8) == 1000
    assert rows_at_once(tmp_path, "v", 1000, 5_120_000) == 100
    with pytest.raises(UnreadableFile, match="one row of v takes 1 GB, at most 512 MB"):
        rows_at_once(tmp_path, "v", 1000, 1e9)


def test_archives_of_arrays_hold_what_they_declare():
    file = io.BytesIO()
    given = {
        "a": np.arange(3), "text": np.array("a name"), "0/t": np.zeros((0, 3)), "flags": np.array([True, False]),
        "by columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)), "axes": np.array(["x", "yy"]),
    }  # fmt: skip
    np.savez(file, **given)
    for _ in range(2):  # headers are known by then
        found = arrays_in(file.getvalue())
        assert found.keys() == given.keys()
        for name, array in given.items():
            assert found[name].dtype == array.dtype
            assert np.array_equal(found[name], array)
            assert found[name].flags.writeable
    packed = io.BytesIO()
    np.savez_compressed(packed, a=np.zeros(1000))
    declared = io.BytesIO()
    with zipfile.ZipFile(declared, "w") as archive:
        content = io.BytesIO()
        np.lib.format.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
        archive.writestr("a.npy", content.getvalue())
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    for wrong in (packed, declared):
        with pytest.raises(ValueError, match="declares more than it holds"):
            arrays_in(wrong.getvalue())
    objects = io.BytesIO()
    np.savez(objects, a=np.array([{}], dtype=object))
    with pytest.raises(ValueError, match="holds objects"):
        arrays_in(objects.getvalue())
    damaged = bytearray(file.getvalue())
    damaged[damaged.index(b"\x01\x00\x00\x00\x00\x00\x00\x00\x02")] = 7
    for wrong in (single.getvalue(), bytes(damaged)):
        with pytest.raises(zipfile.BadZipFile):
            arrays_in(wrong)


def test_attempts_at_one_file_have_one_clock(tmp_path):
    with of_all(tmp_path, "finding out what it holds", seconds=0.05):
        for _ in range(2):  # the time of all is over, whatever each may take itself
            begun = time.process_time()
            with pytest.raises(UnreadableFile, match="finding out what it holds took more than 0 s"):
                all(TimeBudget(tmp_path, "a step", 9.0).check() is None for _ in range(10**7))
            assert time.process_time() - begun < 1
        with pytest.raises(UnreadableFile, match="finding out"):
            check_all()
    TimeBudget(tmp_path, "a step", 9.0).check()
    check_all()


def spend(seconds):
    begun = time.process_time()
    while time.process_time() - begun < seconds:
        pass


class Slow(FileSource):
    """A source that opens, and looks for rows in vain, for less than each may take."""

    kind: str = "slow"

    @contextmanager
    def open(self, path, faults):
        with TimeBudget(path, "opening", 0.3):
            spend(0.2)
        yield self

    def has(self, path):
        return True

    def unit(self, path):
        return "s"

    def blocks(self, paths, size):
        for _ in range(2):
            with TimeBudget(self.path, "looking", 0.3):
                spend(0.2)
        yield Block(1, lambda path: np.zeros(1))


def test_the_steps_of_a_reading_have_one_clock(tmp_path, monkeypatch):
    source = Slow.model_construct(path=tmp_path, channels={"time": Channel(path="t", unit="s")})
    assert sum(map(len, source.chunks(10, Faults()))) == 1
    monkeypatch.setattr("fusion_core.budget.TimeBudget.__init__.__defaults__", (0.3, 0.0))
    with pytest.raises(UnreadableFile, match="what yields no row took more than 0 s"):
        list(source.chunks(10, Faults()))


def test_what_is_done_with_rows_takes_no_time_of_their_reader(tmp_path):
    clock = TimeBudget(tmp_path, "reading", 0.2, row=0.0)
    for _ in clock.over(range(3)):
        spend(0.1)
    clock = TimeBudget(tmp_path, "reading", 0.05)
    with pytest.raises(UnreadableFile, match="reading took"):
        list(clock.over(spend(0.1) or k for k in range(3)))
    clock = TimeBudget(tmp_path, "reading", 0.05)
    assert len(list(clock.over(check_all(10_000_000) or spend(0.1) or k for k in range(3)))) == 3


def test_what_other_threads_do_while_a_pipe_is_waited_for_takes_no_time_of_the_reader(tmp_path):
    def waited() -> Iterator[int]:
        busy = Thread(target=spend, args=(0.3,))
        busy.start()
        busy.join()
        yield 1

    assert list(TimeBudget(tmp_path, "reading", 0.2, row=0.0).over(waited())) == [1]


def test_an_array_that_declares_more_than_its_file_holds_makes_no_room(tmp_path):
    path = tmp_path / "a"
    with path.open("wb") as file:
        np.save(file, np.arange(3.0))
        np.lib.format.write_array_header_1_0(file, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
    with path.open("rb") as file:
        assert next_array(file).tolist() == [0, 1, 2]
        with pytest.raises(ValueError, match="declares more than it holds"):
            next_array(file)
