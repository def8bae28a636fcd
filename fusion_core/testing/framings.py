"""The laws of framings, on a stream of whole frames and on what is none."""

from __future__ import annotations

import pickle
from collections import Counter
from collections.abc import Iterable

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Frames, Framing

MAX_MEMORY = 1 << 18  # bytes of a memory that is small
GARBAGE = {
    "random bytes": np.random.default_rng(0).bytes(5000),
    "zeros": bytes(5000),
    "ones": b"\xff" * 5000,
    "text": b"a,b,c\n1,2\n,,,\n\n1,2,x\nnan,inf,1e999\n" * 50,
    "one long line": b"1,2,3," * 1000,
}


def samples_have_their_shapes(framing: Framing, stream: bytes) -> None:
    """Every channel has N rows, and so has the counter where there is one; there is a sample in the stream."""
    frames, _ = framing.decode(stream, None)
    assert frames.N or not stream, "no sample is found in the stream of the example"
    for name, values in frames.channels.items():
        assert len(values) == frames.N, f"{name} has {len(values)} of {frames.N} rows"
    if framing.device_counter is not None:
        assert frames.count is not None and len(frames.count) == frames.N, "the counter has not N values"  # noqa: PT018


def any_split_gives_the_same_samples(framing: Framing, stream: bytes) -> None:
    """Cut anywhere, also byte by byte, the samples and the counts of what was rejected are the same."""
    noisy = stream[: len(stream) // 3] + GARBAGE["random bytes"][:200] + stream + GARBAGE["text"][:100] + stream
    rng = np.random.default_rng(0)
    whole = _decoded(framing, [noisy])
    for sizes in (iter(lambda: 1, 0), iter(lambda: 7, 0), iter(lambda: int(rng.integers(1, 400)), 0)):
        _same(_decoded(framing, _cut(noisy, sizes)), whole)


def a_stream_may_begin_anywhere(framing: Framing, stream: bytes) -> None:
    """From the middle of a frame on, the samples are the last of those of the whole stream: none is made of a part."""
    whole, _ = _decoded(framing, [stream])
    steps = max(1, len(stream) // 200)
    for k in range(1, len(stream), steps):
        part, _ = _decoded(framing, [stream[k:]])
        n = len(next(iter(part.values()), ()))
        for name, values in part.items():
            last = whole[name][len(whole[name]) - n :]
            np.testing.assert_array_equal(values, last, err_msg=f"{name}, from byte {k} on: a sample of a torn frame")


def what_is_no_frame_is_passed_over(framing: Framing, stream: bytes) -> None:
    """Bytes that are no frames raise nothing, and the frames after them are found."""
    n = framing.decode(stream + stream, None)[0].N
    for what, garbage in GARBAGE.items():
        for data in (garbage, stream + garbage + b"\n" + stream + stream):
            try:
                count = framing.decode(data, None)[0].N
            except Exception as error:
                raise AssertionError(f"{what}: {type(error).__name__}: {error}") from error
        assert not n or count >= n // 2, f"after {what}, {count} of {n} samples are found"


def what_is_encoded_is_decoded(framing: Framing, stream: bytes) -> None:
    """Encoded samples are decoded as they were, where a framing can encode; the first may be lost as torn."""
    frames, _ = framing.decode(stream, None)
    if type(framing).encode is Framing.encode or not frames.N:
        return
    t = frames.channels.get("time", np.arange(frames.N, dtype=np.float64))
    samples = Chunk(t, frames.channels)
    encoded = b"".join(framing.encode(samples.part(k, min(k + 7, frames.N)), k) for k in range(0, frames.N, 7))
    again, _ = framing.decode(encoded, None)
    lost = frames.N - again.N
    assert lost in (0, 1), f"{again.N} of {frames.N} encoded samples are found"
    for name, values in frames.channels.items():
        np.testing.assert_allclose(again.channels[name], values[lost:], rtol=1e-6, atol=1e-12, err_msg=name)
    if (counter := framing.device_counter) is not None and again.count is not None:
        step = 1.0 if counter.tick is None else np.diff(t[lost:]) / counter.tick
        np.testing.assert_allclose(np.diff(again.count) % counter.modulo, step % counter.modulo, atol=1, rtol=0)


def the_memory_stays_small(framing: Framing, stream: bytes) -> None:
    """The memory does not grow with the bytes that come."""
    for what, garbage in {**GARBAGE, "frames": stream}.items():
        memory = None
        for _ in range(200 if garbage else 0):
            _, memory = framing.decode(garbage, memory)
        size = len(pickle.dumps(memory))
        assert size < MAX_MEMORY, (
            f"after {200 * len(garbage)} bytes ({what}) the memory has {size}, less than {MAX_MEMORY} expected"
        )


def _cut(stream: bytes, sizes: Iterable[int]) -> list[bytes]:
    parts, at = [], 0
    for size in sizes:
        if at >= len(stream):
            break
        parts.append(stream[at : at + size])
        at += size
    return parts


def _decoded(framing: Framing, parts: Iterable[bytes]) -> tuple[dict[str, Array], Counter[str]]:
    memory, frames_of_parts, rejected = None, list[Frames](), Counter[str]()
    for part in parts:
        frames, memory = framing.decode(part, memory)
        frames_of_parts.append(frames)
        rejected.update(frames.rejected)
    arrays = [{**f.channels, **({} if f.count is None else {"count": f.count})} for f in frames_of_parts]
    return {
        name: np.concatenate([arrays_of_part[name] for arrays_of_part in arrays]) for name in arrays[0]
    } if arrays else {}, +rejected


def _same(got: tuple[dict[str, Array], Counter[str]], expected: tuple[dict[str, Array], Counter[str]]) -> None:
    assert got[1] == expected[1], f"rejected are {dict(got[1])} and {dict(expected[1])} in one piece"
    for name, values in expected[0].items():
        np.testing.assert_array_equal(got[0][name], values, err_msg=name)
