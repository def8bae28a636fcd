"""What keeps recordings from telling explanations apart, in sentences that one understands at the bench."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from driftlab.loop.evidence import Evidence
from driftlab.samples.turning import rise_and_fall
from fusion_core.chunk import DERIVED, Array

TURN = 0.1  # of the whole swing: a smaller way back is no turning point
ONE_WAY = 0.1  # of the way up (or down) that the other way must have at least
STILL = 2.0  # K; a smaller swing shows nothing of temperature
TOGETHER = 0.97  # correlation beyond which two channels are one


def lacking(evidence: Evidence) -> Iterator[str]:
    """Yield what the recordings do not show: a temperature that goes one way, a channel that moves with it."""
    chunks = [chunk for chunk in evidence.chunks if "temperature" in chunk.channels]
    if not chunks:
        return
    T = [np.asarray(chunk["temperature"], dtype=np.float64) for chunk in chunks]
    up, down = ways(T)
    swing = float(max(map(np.max, T)) - min(map(np.min, T)))
    if swing < STILL:
        yield f"your recordings hardly move in temperature ({swing:.2g} K); record a soak"
    elif way := one_way(T):
        way, other = ("warm up", "cooling down") if way == "warms up" else ("cool down", "warming up")
        yield (
            f"your recordings only ever {way} ({max(up, down):.3g} K in all, {min(up, down):.2g} K the other way): a "
            f"lag, a hysteresis, a drift and the map itself look alike on them; record {other} too"
        )
    names = set.intersection(*(set(chunk.channels) for chunk in chunks)) - DERIVED - {"temperature", evidence.channel}
    level: Array = np.concatenate(T)
    for name in sorted(name for name in names if all(chunk[name].ndim == 1 for chunk in chunks)):
        r = _correlation(level, np.concatenate([chunk[name] for chunk in chunks]))
        if abs(r) > TOGETHER:
            yield (
                f"in your recordings {name} moves with temperature alone (correlation {r:.2f}): what one does cannot "
                "be told from what the other does; move one of them by itself"
            )


def _correlation(one: Array, other: Array) -> float:
    one, other = one - np.mean(one), other - np.mean(other)
    size = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(one @ other) / size if size > 0 else 0.0


def ways(recordings: Sequence[Array]) -> tuple[float, float]:
    """Return by how much temperatures (N,) rise in all, and by how much they fall, between their turning points."""
    least = TURN * (max(map(np.max, recordings)) - min(map(np.min, recordings)))
    each = [rise_and_fall(T, least) for T in recordings]
    return sum(up for up, _ in each), sum(down for _, down in each)


def one_way(recordings: Sequence[Array]) -> str:
    """Return what temperatures (N,) do where they hardly ever come back: `warms up` or `cools down`; else nothing."""
    up, down = ways(recordings)
    if min(up, down) >= ONE_WAY * max(up, down):
        return ""
    return "warms up" if up > down else "cools down"
