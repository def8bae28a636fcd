"""MAT files that declare, inflate to, or nest more than a reader may take."""

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest

from fusion_core.errors import FusionError, UnreadableFile
from fusion_core.faults import Faults
from fusion_plugins import mat_elements
from fusion_plugins.sources.mat import Mat

sys.path.append(str(Path(__file__).parents[1]))
from torture import bombs_of_arrays as bombs

CHANNELS = {"time": {"path": "time", "unit": "s"}, "gyro": {"path": "gyro", "unit": "rad/s"}}


def element(kind, content, size=None):
    return struct.pack("<II", kind, len(content) if size is None else size) + content + bytes(-len(content) % 8)


def head(name, kind, shape):
    flags = element(6, struct.pack("<II", kind, 0))
    return flags + element(5, struct.pack(f"<{len(shape)}i", *shape)) + element(1, name.encode())


def file_of(path, *elements):
    path.write_bytes(b"MATLAB 5.0 MAT-file".ljust(124) + b"\0\1IM" + b"".join(elements))
    return Mat(path=path, channels=CHANNELS)


def packed(content):
    stream = zlib.compress(content)
    return struct.pack("<II", 15, len(stream)) + stream


def test_what_tells_a_variable_is_read_without_its_numbers(tmp_path, monkeypatch):
    """Both are listed, though one inflates to gigabytes; the numbers of the one that is named are inflated."""
    monkeypatch.setattr(mat_elements, "PIECE", 2_000_000)
    large = head("gyro", 6, (200_000, 3)) + struct.pack("<II", 9, 4_800_000) + bytes(4_800_000)
    small = head("time", 6, (200_000, 1)) + element(9, np.arange(200_000.0).tobytes())
    both = [packed(struct.pack("<II", 14, len(body)) + body) for body in (large, small)]
    source = file_of(tmp_path / "r.mat", *both)
    with source.open(source.path, Faults()) as table:
        assert list(table.names) == ["gyro", "time"]
        (block,) = table.blocks(["time"], 200_000)
        np.testing.assert_array_equal(block.read("time").ravel(), np.arange(200_000.0))
        with pytest.raises(UnreadableFile, match=r"an array in compressed form takes 4.8 MB, at most 2 MB are read at"):
            list(table.blocks(["time", "gyro"], 100))


def test_an_array_that_is_not_compressed_is_read_in_blocks(tmp_path, monkeypatch):
    monkeypatch.setattr(mat_elements, "PIECE", 1000)
    values = np.random.default_rng(0).normal(size=(500, 3))
    t = head("time", 6, (1, 500)) + element(9, np.arange(500.0).tobytes())
    g = head("gyro", 6, (500, 3)) + element(9, values.tobytes(order="F"))
    source = file_of(tmp_path / "r.mat", element(14, t), element(14, g))
    chunks = list(source.chunks(64, Faults()))
    assert len(chunks) == 8
    np.testing.assert_array_equal(np.concatenate([chunk["gyro"] for chunk in chunks]), values)


def test_structs_without_end(tmp_path):
    body = b""
    for _ in range(40):
        outer = head("", 2, (1, 1)) + element(5, struct.pack("<i", 8)) + element(1, b"a".ljust(8, b"\0"))
        body = element(14, outer + body)
    source = file_of(tmp_path / "r.mat", packed(body))
    with pytest.raises(UnreadableFile, match=r"structs are within one another more than 32 deep"):
        list(source.chunks(100, Faults()))


def test_a_compressed_variable_with_a_wrong_checksum(tmp_path):
    body = head("time", 6, (5, 1)) + element(9, np.arange(5.0).tobytes())
    stream = packed(struct.pack("<II", 14, len(body)) + body)
    source = file_of(tmp_path / "r.mat", stream[:-1] + bytes([stream[-1] ^ 1]))
    with pytest.raises(UnreadableFile, match="is cut short or damaged"), source.open(source.path, Faults()) as table:
        list(table.blocks(["time"], 100))


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("make", [bombs.declared, bombs.nested])
def test_bombs(tmp_path, make, seed):
    make(np.random.default_rng(seed), tmp_path / "r.mat")
    source = Mat(path=tmp_path / "r.mat", channels=CHANNELS)
    with pytest.raises(FusionError):
        list(source.chunks(1000, Faults()))
