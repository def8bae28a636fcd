"""Recordings to try effects on, and what they show."""

import numpy as np

from fusion_core.chunk import Chunk


def record(effect=None, N=120, steps="irregular"):
    """A recording with a wandering temperature and whatever the effect reads besides, one repeated stamp in it."""
    rng = np.random.default_rng(11)
    dt = rng.uniform(0.1, 20.0, N) if steps == "irregular" else np.full(N, 2.5)
    if steps == "irregular":
        dt[N // 2] = 0.0
    t = 1e4 + np.cumsum(dt)
    walk = lambda: 20 + np.cumsum(rng.normal(size=N))  # noqa: E731
    channels = {"temperature": walk(), "accel": rng.normal(size=(N, 3)), "residual": rng.normal(size=(N, 3))}
    for name in ("voltage", "temperature_case", *(effect.requires if effect else ())):
        channels.setdefault(name, walk())
    return Chunk(t, channels)


def on_one_axis(effect, chunk):
    """Return what an effect shows on x (N, q); its other axes must show the same."""
    signature, _ = effect.signature(chunk, None)
    q = signature.shape[2] // len(effect.axes)
    x = signature[:, 0, :q]
    for k in range(len(effect.axes)):
        np.testing.assert_array_equal(signature[:, k, k * q : (k + 1) * q], x)
    assert np.count_nonzero(signature) == len(effect.axes) * np.count_nonzero(x)
    return x


def at_temperature(t, T, **channels):
    return Chunk(t, {"temperature": T, **channels})
