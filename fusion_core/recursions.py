"""Recursions, compiled: a play (backlash), a lag, causal rates of a coarse signal, the mean of a state.

A first-order lag tau dT/dt = u - T behind a chain of straight lines, u = u_i + s_i (t - t_i) on piece i, has the closed
form (`LaggedLines`)

::

    T(t) = u(t) - s_i tau + c_i exp(-(t - t_i) / tau),    c_i = T(t_i) - u_i + s_i tau

so it needs neither a step nor a memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np

from fusion_core.chunk import Array
from fusion_core.fast import compiled

PASSED = 0.01  # K/s at which a thermometer goes through its steps, at least


@compiled
def play(x: Array, width: float, y: float) -> Array:
    """Return the play operator's output (N,): it follows x (N,) once x has crossed the width; y is its last output.

    M. A. Krasnosel'skii and A. V. Pokrovskii, Systems with Hysteresis, Springer (1989), chapter 1.
    """
    out = np.empty_like(x)
    for k in range(len(x)):
        y = min(max(y, x[k] - width / 2), x[k] + width / 2)
        out[k] = y
    return out


@compiled
def lag(dt: Array, x: Array, tau: float, before: float, y: float) -> Array:
    """Return x (N,) through y' = (x - y) / tau, exactly for an x that is straight between its samples.

    dt (N,) are the steps in s, `before` and y the sample and the output just before the first step.
    """
    out = np.empty_like(x)
    for k in range(len(x)):
        if dt[k] > 0:
            decay = np.exp(-dt[k] / tau)
            behind = (x[k] - before) / dt[k] * tau  # what a steady ramp trails by
            y = x[k] - behind + (y - before + behind) * decay
        before = x[k]
        out[k] = y
    return out


@compiled
def drift(x: Array, F: Array, u: Array, out: Array) -> None:
    """Write x_k = F_k x_{k-1} + u_k (N, n): what is expected with no measurement."""
    N, n = len(u), len(x)
    for k in range(N):
        F_k = F[min(k, len(F) - 1)]
        before = x if k == 0 else out[k - 1]
        for i in range(n):
            total = u[k, i]
            for j in range(n):
                total += F_k[i, j] * before[j]
            out[k, i] = total


def lag_fading(dt: Array, N: int, tau: float, begun: bool) -> Array:
    """Return the factors (N,) by which a lag forgets what it began at: exp(-dt / tau), and 1 at the very first sample.

    dt is 0-d or (N,), in s; `begun` says whether there were samples before.
    """
    factor = np.broadcast_to(np.exp(-dt / tau), (N,))
    return factor if begun or N == 0 else np.concatenate([np.ones(1), factor[1:]])


@compiled
def regression_rate(dt: Array, T: Array, memory: Array, tau: float, smooth: Array, rate: Array) -> None:
    """Write values (N,) and their rates (N,) of a straight line whose weights fade by tau s; `memory` goes on."""
    # weighted sums with time counted from the current sample and T from the first one
    T_0, w, wt, wtt, wT, wtT, pull = memory
    usual, keep = -1.0, 0.0  # what was worked out last
    for k in range(len(T)):
        wtt, wt, wtT = wtt + dt[k] * (dt[k] * w - 2 * wt), wt - dt[k] * w, wtT - dt[k] * wT
        if dt[k] != usual:
            usual, keep = dt[k], np.exp(-dt[k] / tau)
        w, wt, wtt, wT, wtT = keep * w + 1, keep * wt, keep * wtt, keep * wT + T[k] - T_0, keep * wtT
        pull = keep * pull if pull > 1e-200 else 0.0  # a processor takes long over numbers next to zero
        spread = wtt - wt * wt / w + pull
        rate[k] = (wtT - wt * wT / w) / spread if spread > 1e-9 * tau * tau else 0.0
        smooth[k] = T_0 + (wT - rate[k] * wt) / w
    memory[1], memory[2], memory[3], memory[4], memory[5], memory[6] = w, wt, wtt, wT, wtT, pull


@compiled
def regression_value(
    dt: Array, T: Array, rate: Array, steps: Array, known: tuple[float, ...], memory: Array, longest: float,
    walk: float, smooth: Array, windows: Array,
) -> None:  # fmt: skip
    """Write values (N,) of a straight line and its windows (N,) in s, the noisier T, the longer; `memory` goes on.

    A rate that is a random walk of the density `walk`, seen through noise of a density n, is followed in sqrt(n / walk)
    s. n^2 is that of T itself, by its second differences, and of what the thermometer's steps q leave: q^2 / 12, or
    less with noise before the rounding, that lasts for a sixth of the time of a step, which T goes through at `rate`
    (N,). `steps` (N,) are those seen so far, `known` a larger one and the variance that it leaves in means.
    """
    T_0, w, wt, wtt, wT, wtT, one, two, count, noise = memory
    worked, usual, keep = -1.0, -1.0, 0.0  # what was worked out last
    for k in range(len(T)):
        h = dt[k]
        if count >= 2:
            noise += ((T[k] - 2 * one + two) ** 2 / 6 - noise) / min(count - 1, 6000.0)
        one, two, count = T[k], one, count + 1
        q = max(steps[k], known[0])
        density = np.sqrt((known[1] if q == known[0] else q**2 / 12) * q / (6 * max(abs(rate[k]), PASSED)))
        tau = min(longest / 2, np.sqrt(np.sqrt(density**2 + noise * h) / walk))
        wtt += h * (h * w - 2 * wt)
        wt -= h * w
        wtT -= h * wT
        if tau != worked or h != usual:
            worked, usual, keep = tau, h, np.exp(-h / tau) if tau > 0 else 0.0
        w, wt, wtt, wT, wtT = keep * w + 1, keep * wt, keep * wtt, keep * wT + T[k] - T_0, keep * wtT
        # two samples do not make a rate: while it is young the slope is drawn towards zero
        spread = wtt - wt * wt / w + tau * tau * max(1 - (count - 1) * h / max(2 * tau, h), 0.0)
        slope = (wtT - wt * wT / w) / spread if spread > 1e-9 * tau * tau else 0.0
        smooth[k], windows[k] = T_0 + (wT - slope * wt) / w, 2 * tau
    memory[1], memory[2], memory[3], memory[4], memory[5] = w, wt, wtt, wT, wtT
    memory[6], memory[7], memory[8], memory[9] = one, two, count, noise


@compiled
def kalman_rate(dt: Array, T: Array, memory: Array, r: float, q: float, smooth: Array, rate: Array) -> None:
    """Write values (N,) and their rates (N,) of a two-state filter with variances r and q dt; `memory` goes on."""
    x, v, xx, xv, vv = memory
    for k in range(len(T)):
        h = dt[k]
        x += h * v
        xx += h * (2 * xv + h * vv) + q * h**3 / 3
        xv += h * vv + q * h**2 / 2
        vv += q * h
        s = xx + r
        y = T[k] - x
        x += xx / s * y
        v += xv / s * y
        vv -= xv * xv / s
        xv -= xv * xx / s
        xx -= xx * xx / s
        smooth[k], rate[k] = x, v
    memory[0], memory[1], memory[2], memory[3], memory[4] = x, v, xx, xv, vv


@compiled
def steps_and_variance(T: Array, memory: Array, largest: float, steps: Array, variances: Array) -> None:
    """Write the step (N,) of which all changes of T (N,) are multiples (Euclid), and its variance (N,) so far.

    `memory` is changed: the last two and how many there were, the step, the variance.
    """
    one, two, count, step, variance = memory
    for k in range(len(T)):
        change, same = abs(T[k] - one), 1e-6 * max(abs(T[k]), 5.0)
        if count >= 1 and change > same:
            if step == 0.0:
                step = change
            while True:
                rest = abs(change - np.rint(change / step) * step)
                if rest <= same:
                    break
                change, step = step, rest
        if count >= 2:
            variance += ((T[k] - 2 * one + two) ** 2 / 6 - variance) / min(count - 1, 60_000.0)
        one, two, count = T[k], one, count + 1
        steps[k] = step if step <= largest else 0.0
        variances[k] = variance
    memory[0], memory[1], memory[2], memory[3], memory[4] = one, two, count, step, variance


@dataclass(frozen=True)
class LaggedLines:
    """A chain of straight lines and the lag behind it, in S pieces; the last one lasts for ever.

    Attributes
    ----------
    t, u, s, c : (S,) arrays
        Beginning of each piece in s; the line there and its slope a second; the transient of the lag there.
    tau : float
        The lag in s.
    """

    t: Array
    u: Array
    s: Array
    c: Array
    tau: float

    @classmethod
    def behind(cls, t: Array, u: Array, tau: float) -> Self:
        """Return the lag behind the points t, u (S,), in balance at the first; the last is held."""
        s, c = np.append(np.diff(u) / np.diff(t), 0.0), np.empty(len(t))
        T = u[0]
        for i, length in enumerate(np.append(np.diff(t), 0.0)):
            c[i] = T - u[i] + s[i] * tau
            T = u[i] + s[i] * (length - tau) + (c[i] * np.exp(-length / tau) if tau else 0.0)
        return cls(t, u, s, c, tau)

    def piece(self, t: Array) -> np.ndarray[tuple[int], np.dtype[np.intp]]:
        """Return the index (N,) of the piece that holds each time t (N,) in s; before the first, that of the first."""
        return np.maximum(np.searchsorted(self.t, t, side="right") - 1, 0)

    def line(self, t: Array) -> Array:
        """Return the lines (N,) at t (N,) in s."""
        i = self.piece(t)
        return np.asarray(self.u[i] + self.s[i] * (t - self.t[i]))

    def lagged(self, t: Array) -> Array:
        """Return the lag (N,) at t (N,) in s."""
        i, line = self.piece(t), self.line(t)
        if self.tau == 0:
            return line
        return np.asarray(line - self.s[i] * self.tau + self.c[i] * np.exp(-(t - self.t[i]) / self.tau))
