"""The laws of sources. A live one is only held to those of its settings."""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Chunk, concatenate
from fusion_core.contracts import FileSource, Source
from fusion_core.faults import Faults


def any_size_gives_the_same_rows(source: Source) -> None:
    """Chunks have at most `size` rows, and joined they are the same recording, each time that it is read."""
    if source.live:
        return
    whole = _read(source, 1 << 20)
    assert len(whole), "the example has no row"
    for size in (len(whole) // 3 + 1, 64, 7) if len(whole) > 2000 else (len(whole), 7, 1):
        _same(_read(source, size), whole, f"in chunks of {size}")


def channels_have_rows(source: Source) -> None:
    """Every channel is (N,) or (N, d) in float64, and no chunk that is not live is empty."""
    for chunk in () if source.live else source.chunks(64, Faults()):
        assert len(chunk), "a chunk is empty"
        for name, values in {"t": chunk.t, **chunk.channels}.items():
            assert values.dtype == np.float64, f"{name} is of {values.dtype}, float64 was expected"
            assert values.ndim in (1, 2), f"{name} has shape {values.shape}, (N,) or (N, d) was expected"
            assert len(values) == len(chunk), f"{name} has {len(values)} of {len(chunk)} rows"


def ranges_share_no_row_and_miss_none(source: Source) -> None:
    """START:STOP of a file takes the rows from START up to STOP, in seconds from the first."""
    if not isinstance(source, FileSource):
        return
    source = source.model_copy(update={"start": None, "stop": None})
    whole = _read(source, 64)
    middle = float(np.median(whole.t - whole.t[0]))
    parts = [_read(source.model_copy(update=part), 64) for part in ({"stop": middle}, {"start": middle})]
    _same(concatenate(parts), whole, f"cut at {middle:g} s")
    assert parts[1].t[0] - whole.t[0] >= middle, "a range begins before START"


def _read(source: Source, size: int) -> Chunk:
    chunks = list(source.chunks(size, Faults()))
    assert all(len(chunk) <= size for chunk in chunks), f"a chunk has more than {size} rows"
    return concatenate(chunks)


def _same(got: Chunk, expected: Chunk, what: str) -> None:
    np.testing.assert_array_equal(got.t, expected.t, err_msg=f"t, {what}")
    assert got.channels.keys() == expected.channels.keys(), f"the channels differ, {what}"
    for name, values in expected.channels.items():
        np.testing.assert_array_equal(got[name], values, err_msg=f"{name}, {what}")
