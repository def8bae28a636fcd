"""Signatures to be planted, of drawn hidden parameters, computed by hand and sharing nothing with driftlab."""

from __future__ import annotations

import numpy as np
from scipy.signal import lfilter

from loop_cases.case import Array


def log_uniform(rng: np.random.Generator, low: float, high: float) -> float:
    """Draw a number whose logarithm is uniform."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def late(x: Array, tau: float, dt: float = 1.0) -> Array:
    """Return x after a first-order lag that began at rest."""
    gain = 1 - np.exp(-dt / tau)
    return lfilter([gain], [1, gain - 1], x, zi=[x[0] * (1 - gain)])[0]


def dragged(T: Array, width: float) -> Array:
    """Return the position of an element with play that is dragged along by T from both ends."""
    out, at = np.empty_like(T), T[0]
    for k, value in enumerate(T.tolist()):
        at = min(max(at, value - width / 2), value + width / 2)
        out[k] = at
    return out


def switched(t: Array, rng: np.random.Generator, shortest: float, longest: float) -> Array:
    """Return 0 and 1 in turns, each for a time that is drawn."""
    edges, at = [], t[0]
    while at < t[-1]:
        at += log_uniform(rng, shortest, longest)
        edges.append(at)
    return (np.searchsorted(edges, t) + int(rng.integers(2))) % 2.0


def steps(t: Array, rng: np.random.Generator, shortest: float, longest: float) -> Array:
    """Return levels that are drawn, each for a time that is drawn."""
    edges, at = [], t[0]
    while at < t[-1]:
        at += log_uniform(rng, shortest, longest)
        edges.append(at)
    return rng.normal(size=len(edges) + 1)[np.searchsorted(edges, t)]


def wandering(n: int, rng: np.random.Generator, tau: float) -> Array:
    """Return noise with correlation time tau (samples) and unit variance."""
    keep = np.exp(-1 / tau)
    start = [keep * rng.normal()]  # it has been wandering all along
    return lfilter([np.sqrt(1 - keep**2)], [1, -keep], rng.normal(size=n), zi=start)[0]


def waving(t: Array, rng: np.random.Generator, period: float) -> Array:
    """Return a sine whose period itself is not steady."""
    jitter = wandering(len(t), rng, 4 * period) * 0.3
    return np.sin(2 * np.pi * np.cumsum(np.gradient(t) / period * np.exp(jitter)))


def drawn_channel(t: Array, rng: np.random.Generator, slow: float) -> Array:
    """Return a channel of unit variance that steps, wanders or waves, over times up to `slow` s."""
    kind = rng.integers(3)
    if kind == 0:
        found = steps(t, rng, slow / 10, slow)
    elif kind == 1:
        found = wandering(len(t), rng, log_uniform(rng, slow / 20, slow / 3))
    else:
        found = waving(t, rng, log_uniform(rng, slow / 5, slow))
    return (found - found.mean()) / found.std()


def flicker(n: int, rng: np.random.Generator) -> Array:
    """Return noise whose density falls as 1/f from 10 s to 10 h, of unit Allan deviation over these times."""
    taus = 10.0 * 3.0 ** np.arange(8)
    return sum(wandering(n, rng, tau) for tau in taus) / np.sqrt(0.5 * len(taus) / 2)
