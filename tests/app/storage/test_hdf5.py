"""A file that grows by few rows or many: all of them are there, and what was flushed also after a kill."""

import subprocess
import sys

import h5py
import numpy as np
import pytest
from like_windows import as_it_is_written

from driftlab.storage.hdf5 import ROWS, GrowingFile, continued, reading
from driftlab.storage.system import has_posix_locks

CHILD = """
import sys
from pathlib import Path
import numpy as np
from driftlab.storage.hdf5 import ROWS, GrowingFile
rng = np.random.default_rng(int(sys.argv[1]))
file, at = GrowingFile(Path("grown.h5"), {}, {}, settling=("used", "step")), 0
while True:
    N = int(rng.choice([1, 700, 16_384, ROWS + 5]))
    k = np.arange(at, at + N, dtype=float)
    file.append({"k": k, "x": k[:, None] + np.arange(12), "used": k % 2 == 0, "step": k // 9000})
    at += N
    if rng.random() < 0.2:
        file.flush()
        print(at, flush=True)
"""


def rows(at, N):
    k = np.arange(at, at + N, dtype=float)
    return {"k": k, "x": k[:, None] + np.arange(12), "used": k % 2 == 0, "step": k // 9000}


def check(file, whole):
    np.testing.assert_array_equal(file["k"][:whole], np.arange(whole))
    np.testing.assert_array_equal(file["x"][:whole], np.arange(whole)[:, None] + np.arange(12.0))
    np.testing.assert_array_equal(file["used"][:whole], np.arange(whole) % 2 == 0)
    np.testing.assert_array_equal(file["step"][:whole], np.arange(whole) // 9000)


@pytest.mark.parametrize("seed", range(3))
def test_rows_are_the_same_however_they_come(tmp_path, seed):
    rng = np.random.default_rng(seed)
    file, at = GrowingFile(tmp_path / "a.h5", {}, {}, settling=("used", "step")), 0
    for N in rng.choice([0, 1, 1365, 5000, 16_384, 2 * ROWS + 1], 40):
        file.append(rows(at, N))
        at += int(N)
        if rng.random() < 0.3:
            file.flush()
            assert file.rows == at
            with reading(as_it_is_written(tmp_path / "a.h5")) as reader:
                assert len(reader["k"]) == at
                if at:
                    assert reader["k"][-1] == at - 1
    file.close()
    with h5py.File(tmp_path / "a.h5") as done:
        assert {len(data) for data in done.values()} == {at}
        check(done, at)


def test_a_column_that_has_settled_takes_no_room(tmp_path):
    file = GrowingFile(tmp_path / "a.h5", {}, {}, single=("half",), settling=("sigma",))
    sigma = np.repeat([[1.0, 2.0]], 100_000, axis=0)
    sigma[:5000, 0] += np.arange(5000, 0, -1)
    half = np.arange(100_000) / 3
    file.append({"sigma": np.asfortranarray(sigma), "half": half})
    file.close()
    with h5py.File(tmp_path / "a.h5") as done:
        np.testing.assert_array_equal(done["sigma"][:], sigma)
        np.testing.assert_array_equal(done["half"][:], half.astype(np.float32))
        assert done["half"].dtype == np.float32
        assert done["sigma"].id.get_storage_size() < 0.2 * sigma.nbytes


def test_many_rows_do_not_wait_in_memory(tmp_path):
    file = GrowingFile(tmp_path / "a.h5", {}, {})
    for k in range(20):
        file.append(rows(k * 16_384, 16_384))
        assert file.rows == 0, "nothing is safe before the first flush"
    file.flush()
    path = as_it_is_written(tmp_path / "a.h5")
    before = path.stat().st_size
    for k in range(20, 40):
        file.append(rows(k * 16_384, 16_384))
    assert path.stat().st_size > 1.5 * before
    file.close()


@pytest.mark.skipif(not has_posix_locks(), reason="on Windows a file that is not closed has no name of its own")
@pytest.mark.parametrize("seed", range(5))
def test_what_was_flushed_is_there_after_a_kill_and_is_continued(tmp_path, seed):
    command = [sys.executable, "-c", CHILD, str(seed)]
    child = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True)
    said = [int(child.stdout.readline()) for _ in range(3 + seed)]
    child.kill()
    out, _ = child.communicate()
    said += [int(line) for line in out.splitlines(keepends=True) if line.endswith("\n")]
    with reading(tmp_path / "grown.h5") as file:
        whole = min(len(data) for data in file.values())
        assert whole >= said[-1]
        check(file, said[-1])
    file = continued(tmp_path / "grown.h5", said[-1], {}, {}, settling=("used", "step"))
    file.append(rows(file.rows, 3000))
    file.close()
    with h5py.File(tmp_path / "grown.h5") as file:
        assert len(file["k"]) == said[-1] + 3000
        check(file, len(file["k"]))


def test_after_a_write_that_failed_nothing_is_written_in_the_wrong_place(tmp_path, monkeypatch):
    file = GrowingFile(tmp_path / "a.h5", {}, {})
    file.append(rows(0, 1000))
    file.flush()
    put = GrowingFile._put

    def full(*args, **kwargs):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(GrowingFile, "_put", full)
    file.append(rows(1000, 500))
    with pytest.raises(OSError, match="No space"):
        file.flush()
    monkeypatch.setattr(GrowingFile, "_put", put)
    for attempt in (lambda: file.append(rows(1500, 2 * ROWS)), file.flush, file.close):
        with pytest.raises(OSError, match="No space"):
            attempt()
    assert file.rows == 1000
    with reading(tmp_path / "a.h5") as done:
        check(done, 1000)
