"""The filter beside other packages, each on its own ground (`pip install .[peers]`, several gigabytes: torch).

The models are constant, the peers' results are held against ours first. Of a batch the peers do one time step of all
series at once; ours are one series after the other.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version

import numpy as np
from common import Row, best, filterpy_run, limit, ratio, show, statsmodels_run

from fusion_core.contracts import Transition
from fusion_core.kalman import estimate
from fusion_core.model import Measurement, State

Problem = tuple[State, Transition, Measurement]


def problem(n: int, m: int, N: int, seed: int = 0) -> Problem:
    """Return a start, one model of n states and m components without structure, and N measurements."""
    rng = np.random.default_rng(seed)
    F = 0.995 * np.linalg.qr(rng.normal(size=(n, n)))[0]
    H, R = rng.normal(size=(m, n)), np.diag(rng.uniform(0.5, 2.0, m))
    z = np.cumsum(rng.normal(size=(N, m)), axis=0)
    return (
        State(np.zeros(n), np.eye(n)),
        Transition(F, 0.01 * np.eye(n), np.zeros((N, n))),
        Measurement(z, H, R, np.ones(N, dtype=bool)),
    )


def kalman_py(state: State, step: Transition, seen: Measurement) -> np.ndarray:
    """Run kalman-py on JAX in double precision; return the last x."""
    import jax
    from kalman_py import KalmanFilter

    jax.config.update("jax_enable_x64", True)
    theirs = KalmanFilter(step.F, seen.H, step.Q, seen.R, state.x, state.P)
    return np.asarray(theirs.filter(seen.z, backend="jax").means)[-1]


def fast_kalman(state: State, step: Transition, seen: Measurement) -> np.ndarray:
    """Run fast-kalman, whose loop is C++; return the last x."""
    import kalman

    theirs = kalman.LinearKalmanFilter(len(state.x), seen.z.shape[1])
    theirs.x = state.x.tolist()
    theirs.P, theirs.F, theirs.Q = (a.ravel().tolist() for a in (state.P, step.F, step.Q))
    theirs.H, theirs.R = seen.H.ravel().tolist(), seen.R.ravel().tolist()
    theirs.update_many(seen.z)
    return np.array(theirs.x)


def simdkalman(state: State, step: Transition, seen: Measurement, z: np.ndarray) -> np.ndarray:
    """Run simdkalman over series z (B, N, m); return the last x (B, n)."""
    from simdkalman import KalmanFilter

    theirs = KalmanFilter(step.F, step.Q, seen.H, seen.R)
    first = step.F @ state.x, step.F @ state.P @ step.F.T + step.Q  # theirs begins with a measurement
    found = theirs.compute(z, 0, *first, smoothed=False, filtered=True, observations=False)
    return np.asarray(found.filtered.states.mean)[:, -1]


def torch_kf(state: State, step: Transition, seen: Measurement, z: np.ndarray) -> np.ndarray:
    """Run torch-kf in double precision over series z (B, N, m); return the last x (B, n)."""
    import torch
    from torch_kf import GaussianState, KalmanFilter

    F, Q, H, R = (torch.tensor(a) for a in (step.F, step.Q, seen.H, seen.R))
    begin = GaussianState(
        torch.tensor(state.x)[None, :, None].repeat(len(z), 1, 1), torch.tensor(state.P)[None].repeat(len(z), 1, 1)
    )
    series = torch.tensor(np.ascontiguousarray(z.transpose(1, 0, 2)))[..., None]
    found = KalmanFilter(F, H, Q, R, joseph_update=True).filter(begin, series, update_first=False, return_all=True)
    return found.mean[-1, :, :, 0].numpy()


def beside(
    package: str, what: str, ours: Callable[[], np.ndarray], theirs: Callable[[], np.ndarray], each: int
) -> list[Row]:
    """Return the time of ours over so many steps, and the ratio of a package's, which must give the same."""
    try:
        name = f"{what}: {package} {version(package)}"
        np.testing.assert_allclose(theirs(), ours(), rtol=1e-6, atol=1e-9)
    except (PackageNotFoundError, ImportError):
        return [Row(f"{what}: {package}", "not installed; pip install '.[peers]'")]
    mine, other = best(ours, theirs, turns=5)
    return [limit(what, mine / each * 1e9, "ns a step"), ratio(name, mine, other)]


def one_series() -> list[Row]:
    rows = []
    for n, m, N, package, theirs in (
        (12, 6, 500, "filterpy", filterpy_run),
        (12, 6, 20_000, "statsmodels", statsmodels_run),
        (15, 6, 20_000, "kalman-py", kalman_py),
        (8, 3, 20_000, "fast-kalman", fast_kalman),
    ):
        given = problem(n, m, N)
        rows += beside(
            package, f"one series of {N:,} samples, n = {n}, m = {m}",
            lambda given=given: estimate(*given).x[-1], lambda given=given, theirs=theirs: theirs(*given), N,
        )  # fmt: skip
    return rows


def batch(series: int = 1000, N: int = 200, n: int = 4, m: int = 2) -> list[Row]:
    state, step, seen = problem(n, m, N)
    z = np.cumsum(np.random.default_rng(1).normal(size=(series, N, m)), axis=1)

    def ours() -> np.ndarray:
        return np.array([estimate(state, step, Measurement(one, seen.H, seen.R, seen.used)).x[-1] for one in z])

    rows = []
    for package, theirs in (("simdkalman", simdkalman), ("torch-kf", torch_kf)):
        what = f"{series:,} series of {N} samples, n = {n}, m = {m}"
        rows += beside(package, what, ours, lambda theirs=theirs: theirs(state, step, seen, z), series * N)
    return rows


def main() -> None:
    show("Other packages", [*one_series(), *batch()])


if __name__ == "__main__":
    main()
