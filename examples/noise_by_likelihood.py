"""Noise and walk from the recording itself: the scales of Q and R that make the innovations most likely.

The filter's noise has two parts, what is white on the measured rates (with the shake of the reference, R) and what
drives the biases. With the scales a and b of their variances, and S proportional to a for a given b / a::

    Q = a Q_white + b Q_bias,    R = a R_0
    a = mean(nis at a = 1),      log L = -N/2 (log a + 1 + log 2 pi) - 1/2 sum log det S(1, b/a)

so that one search over b / a is left for every group of states that have nothing to do with one another (an axis of a
sensor, for the models that come with driftlab). R. K. Mehra, IEEE Trans. Automatic Control 15 (1970) 175.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, RunSegment
from fusion_core.chunk import Array, Chunk
from fusion_core.contracts import Transition
from fusion_core.errors import SingularFit
from fusion_core.fast.groups import find_groups
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State

Index = NDArray[np.intp]
Fit = tuple[float, float, float, float]
SPAN = (-12.0, 12.0)  # of log(b / a): the declared noise may be wrong by e^6 in deviation


@dataclass(frozen=True)
class NoiseFit:
    """Noise of one sensor by maximum likelihood.

    Attributes
    ----------
    white : (d,) array
        Factor on the declared white-noise density, one an axis.
    walk : (d,) array
        Factor on the declared deviation of what drives the bias (its walk).
    log_likelihood, declared : (d,) arrays
        At the maximum, and as declared.
    """

    white: Array
    walk: Array
    log_likelihood: Array
    declared: Array


def fit_noise(config: Config, stream: Iterable[Chunk] | None = None) -> dict[str, NoiseFit]:
    """Estimate the noise of each sensor, by channel, from a recording at rest.

    Parameters
    ----------
    config : Config
        The declared model; its source is read where no `stream` is given.
    stream : iterable of Chunk, optional
        Epochs of the recording (`driftlab.recordings.epochs`).

    Raises
    ------
    SingularFit
        If fewer than 30 epochs are at rest.
    """
    run = Run(config, RunLog(), keep_model=True)
    stretches = [s for s in (run if stream is None else run.over(stream)) if s.model is not None]
    N = sum(len(s.epochs) for s in stretches)
    if N < 30:
        raise SingularFit(
            f"noise by likelihood: only {N} updates at rest, at least 30 are needed; use a longer recording"
        )
    groups = _groups(stretches)
    found = {tuple(group.tolist()): _fit_group(run, stretches, group) for group in groups}
    fits = {}
    for channel in (sensor.channel for sensor in run.model.sensors):
        rows = [
            _of_component(found, stretches[0], k) for k, one in enumerate(run.model.components) if one[0] == channel
        ]
        fits[channel] = NoiseFit(*(np.array(column) for column in zip(*rows, strict=True)))
    return fits


def _of_component(found: dict[tuple[int, ...], Fit], stretch: RunSegment, k: int) -> Fit:
    """Return the fit of the group of states that a measured component is of."""
    assert stretch.model is not None
    H = stretch.model[1].H
    seen = set(np.flatnonzero(np.any(H.reshape(-1, *H.shape[-2:])[:, k] != 0, axis=0)).tolist())
    return next(fit for group, fit in found.items() if seen & set(group))


def _groups(stretches: list[RunSegment]) -> list[Index]:
    """Return the states of each group that neither F, nor Q, nor a measured component couples to the others."""
    models = [stretch.model for stretch in stretches if stretch.model is not None]

    def seen(arrays: Iterable[Array]) -> Array:
        """Return 1 where any of matrices (..., k, n) is not zero, as (stretches, k, n)."""
        return np.stack([np.any(a.reshape(-1, *a.shape[-2:]) != 0, axis=0) for a in arrays]).astype(np.float64)

    F, Q, H = seen(m[0].F for m in models), seen(m[0].Q for m in models), seen(m[1].H for m in models)
    n = F.shape[-1]
    return [group[group < n] for group in find_groups(F, Q, H, np.zeros((n, n))).states]


def _fit_group(run: Run, stretches: list[RunSegment], group: Index) -> Fit:
    """Return the factors on the deviations of white noise and walk, and the log-likelihood there and as declared."""
    from scipy.optimize import minimize_scalar

    pieces = [_part(run, stretch, group) for stretch in stretches]
    skip = len(group) + 1  # epochs that settle a diffuse prior

    def at(log_ratio: float) -> tuple[float, float, float]:
        """Return a, and the log-likelihood at the best a and at a = 1."""
        state: State | None = None
        nis, log_det, settle = [], [], 0
        for stretch, (transition, white, measurement) in zip(stretches, pieces, strict=True):
            if stretch.began is not None:
                state = State(stretch.began.x[group], stretch.began.P[np.ix_(group, group)])
                settle = skip
            assert state is not None, "the first stretch begins with a prior"
            Q = white + np.exp(log_ratio) * (transition.Q - white)
            steps = Transition(transition.F, Q, transition.u)
            found = estimate(state, steps, measurement, reset=run.model.restarting[group])
            state = found.state
            nis.append(found.nis[found.used][settle:])
            log_det.append(found.log_det[found.used][settle:])
            settle = max(0, settle - int(np.sum(found.used)))
        values, determinants = np.concatenate(nis), np.concatenate(log_det)
        m = pieces[0][2].z.shape[1]
        count = len(values) * m
        a = float(np.sum(values)) / count
        constant = -0.5 * float(np.sum(determinants)) - 0.5 * count * np.log(2 * np.pi)
        return a, constant - 0.5 * count * (np.log(a) + 1), constant - 0.5 * float(np.sum(values))

    best = minimize_scalar(lambda v: -at(float(v))[1], bounds=SPAN, method="bounded", options={"xatol": 1e-3})
    a, likelihood, _ = at(float(best.x))
    return float(np.sqrt(a)), float(np.sqrt(a * np.exp(best.x))), likelihood, at(0.0)[2]


def _part(run: Run, stretch: RunSegment, group: Index) -> tuple[Transition, Array, Measurement]:
    """Return the steps of a group's states, the white part of their Q, and their measurements."""
    assert stretch.model is not None
    transition, measurement = stretch.model
    rows, columns = np.ix_(group, group)
    u = np.broadcast_to(transition.u, (len(stretch.epochs), run.model.n))[:, group]
    part = Transition(transition.F[..., rows, columns], transition.Q[..., rows, columns], np.ascontiguousarray(u))
    white = run.model.white(stretch.epochs)[..., rows, columns]
    H = measurement.H[..., group]
    seen = np.flatnonzero(np.any(H.reshape(-1, *H.shape[-2:]) != 0, axis=(0, 2)))
    H, R = H[..., seen, :], measurement.R[..., seen[:, None], seen]
    return part, white, Measurement(measurement.z[:, seen], H, R, stretch.estimates.used)
