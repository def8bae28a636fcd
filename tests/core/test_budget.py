import io
import os
import zipfile

import numpy as np
import pytest

from fusion_core.budget import opened, read_whole, rows_at_once
from fusion_core.contracts import head
from fusion_core.errors import ConfigError, UnreadableFile
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
    np.savez(file, a=np.arange(3))
    with opened(file.getvalue()) as archive:
        assert archive["a"].tolist() == [0, 1, 2]
    packed = io.BytesIO()
    np.savez_compressed(packed, a=np.zeros(1000))
    declared = io.BytesIO()
    with zipfile.ZipFile(declared, "w") as archive:
        content = io.BytesIO()
        np.lib.format.write_array_header_1_0(content, {"descr": "<f8", "fortran_order": False, "shape": (10**12,)})
        archive.writestr("a.npy", content.getvalue())
    single = io.BytesIO()
    np.save(single, np.zeros(3))
    for wrong in (packed, declared, single):
        with pytest.raises(ValueError, match=r"declares more than it holds|no archive"):
            opened(wrong.getvalue())
