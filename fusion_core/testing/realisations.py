"""Signals of `fusion_core.contracts.effect`, evaluated in double precision over a whole recording."""

from __future__ import annotations

import numpy as np

from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import effect as made_of


def evaluate(signal: made_of.Signal, chunk: Chunk) -> Array:
    """Return a signal (N,) over a recording, memories begun in equilibrium at its first sample."""
    from fusion_core.recursions import lag, play

    match signal:
        case made_of.Reading():
            return np.asarray(chunk[signal.channel].reshape(len(chunk), -1)[:, signal.column])
        case made_of.Elapsed():
            return np.asarray(chunk.t - chunk.t[0])
        case made_of.Fading():
            return np.asarray(np.exp(-(chunk.t - chunk.t[0]) / signal.tau))
        case made_of.Behind():
            u = np.ascontiguousarray(evaluate(signal.of, chunk))
            dt = np.ascontiguousarray(np.broadcast_to(chunk.dt, u.shape))
            return np.asarray(u - lag(dt, u, signal.tau, u[0], u[0]))
        case made_of.PlayState():
            u = evaluate(signal.of, chunk)
            return np.asarray(play(u, signal.width, u[0]) - u)
        case made_of.Weighted():
            return np.asarray(sum(w * evaluate(part, chunk) for w, part in signal.terms) + signal.offset)
        case made_of.Product():
            return np.asarray(evaluate(signal.a, chunk) * evaluate(signal.b, chunk))
        case made_of.Limited():
            return np.clip(evaluate(signal.of, chunk), signal.low, signal.high)
        case made_of.Function():
            return signal.at(evaluate(signal.of, chunk))
