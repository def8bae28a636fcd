"""Consistency of a stimulus with the recording, by what no terms of a triad explain.

A segment or placement has one input, so its first quarter and the rest leave the same of the fitted terms, up to white
noise s, of the mean of a segment, and the walk q of the bias over the time dt between the middles of the two::

    r_1 - r_2 ~ N(0, 16/3 s^2 + 2/3 q^2 dt)

Student's t for as many equations as the fit has left over. A few segments that are not steady make s large, so FAR
times the deviation of r_1 - r_2 by its median is enough. What the temperature does within a segment is in the terms.
And its input is what the triad reads, up to errors that are small beside it. S segments or placements.
"""

from __future__ import annotations

import numpy as np

from driftlab.triad.estimate import TINY, TriadFit
from driftlab.triad.model import AXES, SCALE
from fusion_core.chunk import Array
from fusion_core.contracts import KnownRates, TriadInput

FALSE_ALARM = 1e-4  # probability, of a stimulus that is steady
HALF = 0.5  # of the fastest rate: no scale factor and no mounting is off by so much
SPREAD = 3  # times a usual bias, by which that may differ over temperature
FAR = 3  # times the scatter of most segments
EXCESS, CONTRADICTED = 3, 10  # times the noise within a segment: worth a word, and a doubt
ALIKE = 0.05  # of a rate: others within are the same
NORMAL = 0.6745  # median of the size of a normal variable of deviation one
NAMED = 5  # segments that are listed
RADIAN = 180 / np.pi


def unsteady(fit: TriadFit, unit: str) -> list[str]:
    """Return a doubt where a segment or placement is not steady, with axis, time and remedy; empty where all are."""
    from scipy.special import stdtrit

    if fit.stimulus.parts is None:
        return []
    difference, t = _differences(fit, fit.stimulus.parts)
    used = sum(curve.q for curve, seen in zip(fit.terms.curves, fit.observable, strict=True) if seen)
    freedom = max(len(fit.stimulus.equations(fit.terms.at(fit.stimulus.T)).left) - used, 1)
    sigma = np.sqrt(16 / 3 * fit.noise[0] ** 2 + 2 / 3 * fit.walk**2 * (t[:, 1] - t[:, 0]))[:, None]
    scatter = np.median(np.abs(difference), axis=0) / NORMAL  # of most of them, where few spoil the fit's noise
    allowed = np.minimum(sigma, FAR * scatter) * stdtrit(freedom, 1 - FALSE_ALARM / (2 * difference.size))
    off = np.any(np.abs(difference) > allowed, axis=1)
    if not np.any(off):
        return []
    k, i = np.unravel_index(int(np.argmax(np.abs(difference) / allowed)), difference.shape)
    factor, shown = (RADIAN, "deg/s") if unit == "rad/s" else (1.0, unit)
    axis, middle = f"axis {AXES[i]}" if difference.shape[1] > 1 else "the length of the input", t[k] @ [0.25, 0.75]
    return [
        f"{_listed(off)} not steady: in the first quarter of {k + 1} (middle at {middle:.1f} s) {axis} differs "
        f"from the rest by {difference[k, i] * factor:.3g} {shown}, and noise, walk and temperature allow "
        f"{allowed[k, i] * factor:.2g}; give a larger stimulus.settle, or correct start and stop of the segments"
    ]


def excess(fit: TriadFit) -> tuple[list[str], list[str]]:
    """Return doubts, and sentences, where segments differ from one another by far more than each within itself."""
    if fit.stimulus.parts is None:
        return [], []
    within = float(np.median(np.abs(_differences(fit, fit.stimulus.parts)[0]))) / NORMAL / np.sqrt(16 / 3)
    times = fit.noise[0] / max(within, TINY)
    said = (
        f"the terms leave {times:.0f} times as much of the segments or placements as noise within them makes: they "
        "contradict one another, which sigma counts as if it were noise, so that it may be too small; see that the "
        "unit has the temperature of its thermometer when each begins (wait for longer), and that no term jumps between"
    )
    return [said] if times > CONTRADICTED else [], [said] if EXCESS < times <= CONTRADICTED else []


def untested(fit: TriadFit) -> list[str]:
    """Return a sentence where one rate alone shows the scale factor, of which a change with the rate is not seen."""
    if not isinstance(fit.stimulus, KnownRates) or not np.any(fit.observable[list(SCALE)]):
        return []
    rates = np.linalg.norm(fit.stimulus.u, axis=1)
    turning = rates[rates > HALF * rates.max()]
    slower = rates[(rates > ALIKE * rates.max()) & (rates <= HALF * rates.max())]
    if len(slower) or np.ptp(turning) > ALIKE * rates.max():
        return []
    return [
        f"scale factor is that at {turning.max() * RADIAN:.4g} deg/s: whether it is the same at other rates is not "
        "tested; turn at half of it too"
    ]


def _differences(fit: TriadFit, parts: TriadInput) -> tuple[Array, Array]:
    """Return the residuals of each first quarter less those of the rest (S, d), and the middles of both (S, 2)."""
    e, S = parts.equations(fit.terms.at(parts.T)), len(parts.T) // 2
    left, t = e.left.reshape(S, 2, -1), e.t.reshape(S, 2, -1)[:, :, 0]
    return left[:, 0] - left[:, 1], t


def contradictions(stimulus: TriadInput, usual_bias: float) -> list[str]:
    """Return a doubt where known rates are not those that the gyro shows, with the likely cause; empty where they are.

    A scale factor, a mounting and a bias do not make so much of it.
    """
    if not isinstance(stimulus, KnownRates):
        return []
    u, y = stimulus.u, stimulus.y - np.median(stimulus.y - stimulus.u, axis=0)
    away = np.linalg.norm(y - u, axis=1)
    fastest = float(np.max(np.linalg.norm(u, axis=1)))
    off = away > HALF * fastest + SPREAD * usual_bias
    if not np.any(off):
        return []
    k = int(np.argmax(away))
    said, read = (f"({', '.join(f'{v:.4g}' for v in np.round(w[k] * RADIAN, 2) + 0.0)})" for w in (u, y))
    return [
        f"{_listed(off)} not as the table says: {k + 1} (middle at {stimulus.times[k]:.1f} s) is {said} deg/s there, "
        f"and the gyro reads {read} less its bias; {_cause(u[k], y[k])}"
    ]


def _listed(off: Array) -> str:
    """Return those that are off (S,) as text: `3 of 36 segments (5, 6, 7) are`."""
    numbers = [str(k + 1) for k in np.flatnonzero(off)]
    more = ["..."] * (len(numbers) > NAMED)
    verb = "is" if len(numbers) == 1 else "are"
    return f"{len(numbers)} of {len(off)} segments or placements ({', '.join([*numbers[:NAMED], *more])}) {verb}"


def _cause(u: Array, y: Array) -> str:
    """Return the likely cause that an input u (3,) is read as y (3,), and the remedy."""
    size, reading = (float(np.linalg.norm(w)) + TINY for w in (u, y))
    ratio, along = reading / size, float(u @ y) / (reading * size)
    if any(abs(ratio / by - 1) < 0.2 for by in (RADIAN, 1 / RADIAN)):
        return "correct the unit of the rate, deg/s or rad/s"
    if abs(ratio - 1) < HALF and along < -HALF:
        return "correct the sign of its rate or axis"
    if abs(ratio - 1) < HALF and along < HALF:
        return f"correct its axis: it turns about {AXES[int(np.argmax(np.abs(y)))]}"
    return "correct its rate, start and stop"
