"""The cost of an HDF5 file: chunks are decoded once, and nothing is read that the file does not hold."""

import h5py
import numpy as np
import pytest

from fusion_core import data_sets
from fusion_core.data_sets import DataSetRows, attribute, check_rows, names_of
from fusion_core.errors import UnreadableFile

N = 1000
PIPELINES = [
    {"compression": "gzip"},
    {"compression": "gzip", "shuffle": True, "fletcher32": True},
    {"fletcher32": True},
    {"compression": "lzf"},
    {"scaleoffset": 0},
    {},
]


def written(path, values, **options):
    with h5py.File(path, "w") as file:
        file.create_dataset("v", data=values, **options)
    return h5py.File(path)


@pytest.mark.parametrize("options", PIPELINES)
@pytest.mark.parametrize("chunks", [(N, 3), (N // 3, 2), (16, 3)])
@pytest.mark.parametrize("own", [False, True])
def test_rows_are_those_of_h5py(tmp_path, monkeypatch, options, chunks, own):
    """Whoever decodes, in blocks of any size, forwards and back."""
    monkeypatch.setattr(data_sets, "CACHE", 0)
    if own and options.get("compression") == "gzip":
        monkeypatch.setattr(data_sets, "RATIO", {**data_sets.RATIO, data_sets.DEFLATE: 1e9})
    values = np.random.default_rng(0).integers(-999, 999, (N, 3)).astype(np.int32)
    for turned in (False, True):
        shape = chunks[::-1] if turned else chunks
        with written(tmp_path / "r.h5", values.T if turned else values, chunks=shape, **options) as file:
            rows = DataSetRows(tmp_path / "r.h5", file["v"], int(turned))
            assert rows.written == N
            for size in (7, 400, 2 * N):
                found = [rows[k : k + size] for k in range(0, N, size)]
                whole = np.concatenate([part.T if turned else part for part in found])
                np.testing.assert_array_equal(whole, values)


def test_a_chunk_is_decoded_once(tmp_path, monkeypatch):
    """As MATLAB writes it: all rows in one chunk; the cache of HDF5 is too small for it."""
    asked = []
    real = DataSetRows._decoded
    monkeypatch.setattr(DataSetRows, "_decoded", lambda self, *rows: asked.append(rows) or real(self, *rows))
    values = np.random.default_rng(0).normal(size=200_000)
    with written(tmp_path / "r.h5", values, chunks=values.shape, compression="gzip") as file:
        rows = DataSetRows(tmp_path / "r.h5", file["v"])
        found = np.concatenate([rows[k : k + 1000] for k in range(0, len(values), 1000)])
    np.testing.assert_array_equal(found, values)
    assert asked == [(0, 200_000)]
    asked.clear()
    with written(tmp_path / "r.h5", values, chunks=(1000,), compression="gzip") as file:
        assert len(DataSetRows(tmp_path / "r.h5", file["v"])[0:1000]) == 1000
    assert not asked  # which HDF5 caches as ever


def test_a_chunk_that_inflates_to_more_than_it_declares(tmp_path, monkeypatch):
    import zlib

    monkeypatch.setattr(data_sets, "PIECE", 1 << 16)
    with h5py.File(tmp_path / "r.h5", "w") as file:
        data = file.create_dataset("v", (100,), np.float64, chunks=(100,), compression="gzip")
        data.id.write_direct_chunk((0,), zlib.compress(bytes(1 << 17)))
    with (
        h5py.File(tmp_path / "r.h5") as file,
        pytest.raises(OSError, match="a chunk inflates to more than the 8"),
    ):
        DataSetRows(tmp_path / "r.h5", file["v"])[0:100]


def test_a_chunk_beyond_the_budget(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.create_dataset("v", (100_000_000,), np.float64, chunks=(100_000_000,), compression="gzip")
        with pytest.raises(UnreadableFile, match=r"a chunk of data set 'v' takes 800 MB, at most 512 MB are read at"):
            DataSetRows(tmp_path / "r.h5", file["v"])


@pytest.mark.parametrize("options", [{}, {"chunks": (1000,)}, {"chunks": (1000,), "compression": "gzip"}])
def test_rows_that_were_never_written(tmp_path, options):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        data = file.create_dataset("v", (10**11,), np.float64, **options)
        if options:
            data[:1500] = 1
        rows = DataSetRows(tmp_path / "r.h5", data)
        with pytest.raises(
            UnreadableFile, match=rf"declares 1e\+11 rows, {2000 if options else 0} of them were ever written"
        ):
            check_rows(tmp_path / "r.h5", [rows])
        few = DataSetRows(tmp_path / "r.h5", file.create_dataset("few", (1000,), np.float64))
        check_rows(tmp_path / "r.h5", [few])  # as ever: zeros


def test_values_that_are_elsewhere(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file.create_dataset("external", (9,), np.float64, external=[("/dev/zero", 0, h5py.h5f.UNLIMITED)])
        layout = h5py.VirtualLayout((9,), np.float64)
        layout[:] = h5py.VirtualSource("other.h5", "v", (9,))
        file.create_virtual_dataset("virtual", layout)
        for name, message in (("external", "in another file"), ("virtual", "is virtual")):
            with pytest.raises(UnreadableFile, match=message):
                DataSetRows(tmp_path / "r.h5", file[name])


def test_links_lead_nowhere_else_and_circles_end(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        file["a/v"] = np.zeros(3)
        file["a/again"], file["a/v2"] = file["a"], file["a/v"]
        file["soft"], file["out"] = h5py.SoftLink("/soft"), h5py.ExternalLink("/dev/stdin", "v")
        assert names_of(tmp_path / "r.h5", file) == [b"a/v"]


def test_groups_without_end(tmp_path):
    with h5py.File(tmp_path / "r.h5", "w") as file:
        here = file
        for _ in range(40):
            here = here.create_group("g")
        with pytest.raises(UnreadableFile, match="has groups within one another more than 32 deep, which is the limit"):
            names_of(tmp_path / "r.h5", file)


@pytest.mark.parametrize("value", [np.zeros(10_000), np.array(["s"] * 1000, dtype=h5py.string_dtype())])
def test_large_attributes(tmp_path, value):
    with h5py.File(tmp_path / "r.h5", "w", libver="latest") as file:
        file["v"] = np.zeros(3)
        file["v"].attrs["unit"] = value
        with pytest.raises(
            UnreadableFile, match=r"the attribute 'unit' of '/v' (takes 80 kB|has 1000 values), at most"
        ):
            attribute(tmp_path / "r.h5", file["v"], "unit")
        assert attribute(tmp_path / "r.h5", file["v"], "units") is None
