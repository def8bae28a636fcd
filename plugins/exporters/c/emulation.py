"""The C code's arithmetic in NumPy and numba: single precision, operation by operation in the same order.

`Program` is the computation, `c99/bias.c.jinja` its code; each function here is the twin of one there. N samples.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusion_core.chunk import Array
from fusion_core.contracts.effect import Behind, Elapsed, Fading, Limited, PlayState, Product, Reading, Signal, Weighted
from fusion_core.fast import compiled
from fusion_plugins.exporters.c.program import LookupTable, Program, Single

LONGEST = np.float32(1e6)  # s: of a step
UPDATES = np.float32(4096)  # of a lag in its time constant, at most: a shorter step is too small for single precision
_0, _HALF, _1, _2, _FAR = (np.float32(value) for value in (0.0, 0.5, 1.0, 2.0, 32.0))


def look_up(table: LookupTable, u: Single) -> Single:
    """Return a table's values (N, d) at u (N,)."""
    inside = np.where(u > table.lowest, np.where(u < table.highest, u, table.highest), table.lowest)
    at = (inside - table.lowest) * table.per_unit
    k = np.minimum(at.astype(np.uint32), np.uint32(len(table.knots) - 2))
    share = (at - k.astype(np.float32))[:, None]
    first, second = table.knots[k], table.knots[k + 1]  # as integers too their differences are exact
    values = first + share * (second - first)
    return np.asarray(table.offset + table.scale * values if table.whole else values, dtype=np.float32)


def at_rest(program: Program, T: Single) -> Single:
    """Return the bias (N, d) in steady temperatures T (N,)."""
    bias, *others = (look_up(table, T) for table in program.resting)
    for other in others:
        bias = bias + other
    return bias


def gain(program: Program, T: Array) -> Array:
    """Return the matrices (N, 3, 3) by which readings less their bias are multiplied at T (N,)."""
    assert program.matrix is not None
    return np.eye(3) + look_up(program.matrix, T.astype(np.float32)).reshape(-1, 3, 3)


def inputs(program: Program, T: Single, bias: Single, reading: Single) -> Single:
    """Return the inputs (N, 3) of readings (N, 3) with a bias (N, 3) at temperatures T (N,)."""
    assert program.matrix is not None
    terms, less = look_up(program.matrix, T), reading - bias
    out = less
    for k in range(3):
        out = out + terms[:, k::3] * less[:, k, None]
    return out


def run(program: Program, dt: Single, channels: Mapping[str, Single]) -> Single:
    """Return the bias (N, d) over a sequence; at its first sample the state is begun, and dt (N,) is zero there.

    channels are (N,), or (N, columns).
    """
    passed = durations(dt)
    results: dict[Signal, Single] = {}
    for node in program.nodes:
        results[node] = _value(program, node, results, passed, channels)
    bias = np.zeros((len(dt), program.d), dtype=np.float32)
    for k, table in enumerate(program.tables):
        values = look_up(table, results[table.of])
        bias = values if k == 0 else bias + values
    for signal, weights in zip(program.signals, program.weights.T, strict=True):
        bias = bias + weights * results[signal][:, None]
    return bias


def _value(
    program: Program, node: Signal, results: Mapping[Signal, Single], dt: Single, channels: Mapping[str, Single]
) -> Single:
    match node:
        case Reading():
            read = np.ascontiguousarray(channels[node.channel].reshape(len(dt), -1)[:, node.column])
            value = finite_readings(read, *program.limits(node))
        case Elapsed():
            value = ticking(dt)
        case Fading():
            value = lagging(dt, np.zeros_like(dt), np.float32(node.tau), _1)
        case Behind():
            value = lagging(dt, results[node.of], np.float32(node.tau), _0)
        case PlayState():
            value = playing(results[node.of], np.float32(node.width / 2))
        case Product():
            value = results[node.a] * results[node.b]
        case Limited():
            value = np.clip(results[node.of], np.float32(node.low), np.float32(node.high))
        case Weighted():
            (weight, part), *others = node.terms
            value = np.float32(weight) * results[part]
            for weight, part in others:
                value = value + np.float32(weight) * results[part]
            value = value + np.float32(node.offset) if node.offset else value
        case _:
            raise NotImplementedError(f"{type(node).__name__} inside of a signal")
    return np.asarray(value, dtype=np.float32)


def durations(dt: Single) -> Single:
    """Return steps (N,) in s as the code takes them: not finite or negative is 0."""
    known = np.where(np.isfinite(dt) & (dt > 0), dt, _0)
    return np.asarray(np.minimum(known, LONGEST), dtype=np.float32)


@compiled
def finite_readings(u: Single, last: np.float32, lowest: np.float32, highest: np.float32) -> Single:
    """Return u (N,) between two limits; a value that is not finite is the one before, `last` at first."""
    out = np.empty_like(u)
    for k in range(len(u)):
        if np.isfinite(u[k]):
            last = min(max(u[k], lowest), highest)
        out[k] = last
    return out


@compiled
def share_gone(h: np.float32) -> np.float32:
    """Return 1 - exp(-h)."""
    if not h < _FAR:
        return _1
    part, halvings = h, 0
    while part > _HALF:
        part = part * _HALF
        halvings += 1
    series = _1
    for k in range(8, 1, -1):
        series = _1 - part / np.float32(k) * series
    gone = part * series
    for _ in range(halvings):
        gone = gone * (_2 - gone)
    return gone


@compiled
def lagging(dt: Single, u: Single, tau: np.float32, behind: np.float32) -> Single:
    """Return the part of u (N,) that a lag has not followed yet, `behind` at first."""
    out = np.empty_like(u)
    before, pending = u[0], _0
    for k in range(len(u)):
        moved = u[k] - before
        pending = pending + dt[k]
        if pending * UPDATES >= tau:
            h = pending / tau
            gone = share_gone(h)
            remainder = behind - gone * behind
            behind = remainder + gone / h * moved
            before, pending = u[k], _0
            out[k] = behind
        else:
            out[k] = behind + moved
    return out


@compiled
def playing(u: Single, half: np.float32) -> Single:
    """Return the place of a play of twice the half width in its loop, from the middle."""
    out = np.empty_like(u)
    y = u[0]
    for k in range(len(u)):
        low, high = u[k] - half, u[k] + half
        if y < low:
            y = low
        if y > high:
            y = high
        out[k] = y - u[k]
    return out


@compiled
def ticking(dt: Single) -> Single:
    """Return the time since the first sample: whole seconds, and what is left of them."""
    out = np.empty_like(dt)
    whole, fraction = 0, _0
    for k in range(len(dt)):
        fraction = fraction + dt[k]
        seconds = int(fraction)
        whole += seconds
        fraction = fraction - np.float32(seconds)
        out[k] = np.float32(whole) + fraction
    return out
