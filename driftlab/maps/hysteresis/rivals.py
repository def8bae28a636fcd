"""Rivals of a memory: what a bias does in time may be taken for what it remembers of temperature.

It may jump once, or have a tone, as of an air conditioning, a pump or a heater's limit cycle.

A tone of c cycles in the soak, whose amplitude and phase wander, is taken as so many lines side by side::

    sum over k < n of cos(pi k t / W) (a_k cos(2 pi c t / W) + b_k sin(2 pi c t / W)),    W the time of the soak

n = 1 is a steady tone; with more its frequency covers n / W, as of one that fades, starts, or is of a regulator. It
is no more than half of the tone's own: what is broader is one of the laws of the slow noise. A period at which the
temperature itself comes and goes is left to the memories: what goes with it goes with temperature. Coefficients are
N(0, g s^2 A^-1) where A are the lines' inner products (Zellner's g-prior), s free, as those of a memory's shapes in
`evidence`; the evidence is averaged over all noises, g, n and frequencies, so that what was tried is priced.

Source: G. L. Bretthorst, Bayesian Spectrum Analysis and Parameter Estimation, Springer (1988), chapters 3 and 6.
"""

from __future__ import annotations

import numpy as np

from driftlab.maps.hysteresis.contrasts import RANK, THIN, TINY, SoakContrasts, log_mean
from driftlab.maps.hysteresis.evidence import ShapeEvidence
from driftlab.soak.blocks import SoakSummary
from fusion_core.chunk import Array, Flags, Integers

LEAST = 2.0  # cycles of a soak: less is a slow noise
TURNS = 40.0  # cycles of the temperature, at most
LINES = (1, 2, 4, 8)  # side by side
BROAD = 0.5  # of a frequency
STEP = 0.5  # cycles, of each line
CLOSER = 8  # frequencies beside the likeliest
INSTANTS = 30  # of a jump, beside the likeliest
OWN = 0.5  # of the temperature's variance: a line of its own
STRENGTHS = 4.0 * 25.0 ** np.arange(5)  # g


def of_a_jump(contrasts: SoakContrasts) -> tuple[float, float]:
    """Return the log evidence of one jump of the bias, at an instant as likely as any other, and which is likeliest, s.

    It is looked for before every other block, and beside the likeliest of these before slots: a block in which the bias
    jumps is like none.
    """
    soak, places = contrasts.soak, contrasts.starts[1::2]
    each = _jumps(contrasts, places)
    k = int(np.argmax(each))
    start, stop = places[max(k - 1, 0)], places[min(k + 1, len(places) - 1)]
    near = np.arange(start, stop + 1, max(1, (stop - start) // INSTANTS))
    closer = _jumps(contrasts, near)
    share = np.log((stop - start) / len(soak.T))
    evidence = np.logaddexp(float(log_mean(each)), float(log_mean(closer)) + share)
    return float(evidence), float(soak.t[near[int(np.argmax(closer))]])


def _jumps(contrasts: SoakContrasts, slots: Integers) -> Array:
    """Return the log evidence (J,) of jumps of the bias at the beginnings of slots (J,)."""
    recording, d = contrasts.soak.recording, contrasts.u.shape[1]
    after = (np.arange(len(recording))[:, None] >= slots) & (recording[:, None] == recording[slots])
    z = np.repeat(contrasts.of(after.astype(np.float64))[:, :, None], d, axis=2)
    none = np.empty((2, len(contrasts.Q[::THIN]), 0, d))
    return ShapeEvidence(contrasts, z, ("jump",) * len(slots), none).of_shapes


def tone_of(contrasts: SoakContrasts) -> tuple[float, float, Array]:
    """Return the log evidence of a tone, the period of the likeliest, s, and its lines (S, 2 n) on the slots."""
    most, own = len(contrasts.blocks.T) / 2, _of_temperature(contrasts.soak)
    logs, best = [], (-np.inf, LEAST, 1)
    for n in LINES:
        cycles = np.arange(max(LEAST, n / BROAD), most, n * STEP)
        cycles = cycles[_apart(cycles, own)]
        if not len(cycles):
            continue
        each = evidence_of(contrasts, cycles, n)
        k = int(np.argmax(each))
        near = cycles[k] + n * STEP * np.linspace(-1, 1, CLOSER + 1)[1:-1]
        near = np.clip(near, cycles[0], most)
        near = near[_apart(near, own)]
        closer = evidence_of(contrasts, near, n)
        share = np.log(2 * n * STEP / (most - LEAST))
        logs += [log_mean(each) + np.log(len(cycles) * n * STEP / (most - LEAST)), log_mean(closer) + share]
        best = max(best, (float(closer.max()), float(near[int(np.argmax(closer))]), n))
    if not logs:
        return -np.inf, np.nan, np.empty((len(contrasts.soak.T), 0))
    evidence = np.logaddexp.reduce(logs) - np.log(len(LINES))
    _, c, n = best
    return float(evidence), _whole(contrasts.soak) / c, lines_of(contrasts.soak, np.array([c]), n)[:, 0]


def _of_temperature(soak: SoakSummary) -> Array:
    """Return the cycles (C,) of lines that have a half of the temperature's variance each."""
    cycles, T = np.arange(1.0, TURNS, STEP), soak.T - soak.T.mean()
    power = np.sum(np.einsum("sfq,s->fq", lines_of(soak, cycles, 1), T) ** 2, axis=1)
    return np.asarray(cycles[2 * power > OWN * len(T) * np.sum(T**2)])


def _apart(cycles: Array, own: Array) -> Flags:
    return np.asarray(np.all(np.abs(cycles[:, None] - own) >= STEP, axis=1))


def _whole(soak: SoakSummary) -> float:
    return float(np.ptp(soak.t) + np.median(soak.span))


def lines_of(soak: SoakSummary, cycles: Array, n: int) -> Array:
    """Return the lines (S, F, 2 n) of tones of so many cycles (F,) on the slots."""
    u = (soak.t - soak.t[0]) / _whole(soak)
    phase = 2 * np.pi * u[:, None] * cycles
    wander = np.cos(np.pi * u[:, None] * np.arange(n))
    both = np.stack([np.cos(phase), np.sin(phase)], axis=2)
    return np.asarray((both[:, :, None] * wander[:, None, :, None]).reshape(len(u), len(cycles), -1))


def evidence_of(contrasts: SoakContrasts, cycles: Array, n: int) -> Array:
    """Return the log evidence (F,) of tones of n lines, each axis with or without."""
    z = contrasts.of(lines_of(contrasts.soak, cycles, n))
    q, m = z.shape[2], len(z)
    gram, B, Q = contrasts.products(contrasts.u[:, None], z)  # (R', F, q, q), (R', F, q, d), (R', 1, d)
    size = np.einsum("rfqq->rf", gram)[..., None, None]
    t2 = np.sum(B * np.linalg.solve(gram + (RANK * size + TINY) * np.eye(q), B), axis=2)
    without, log_w = log_mean(contrasts.without[contrasts.thin]), contrasts.log_w[contrasts.thin, None, None]
    each = []
    for g in STRENGTHS:
        left = np.maximum(Q - g / (1 + g) * t2, 1e-9 * Q + TINY)
        each.append(log_mean(log_w - m / 2 * np.log(left)) - q / 2 * np.log1p(g))
    axes = np.logaddexp(0.0, log_mean(np.array(each)) - without) - np.log(2)
    return np.asarray(axes.sum(axis=1))
