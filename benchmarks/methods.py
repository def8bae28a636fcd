"""The two compiled methods of the filter beside filterpy (interpreted), statsmodels (compiled) and Eigen (C++)."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
from common import Row, best, filterpy_run, limit, problem, ratio, show, statsmodels_run

from driftlab.storage.system import keep_freed_memory
from fusion_core.contracts import Transition
from fusion_core.feedback import feed_back
from fusion_core.kalman import correct, estimate, predict
from fusion_core.model import Measurement, State

HERE = Path(__file__).parent
Joseph = Callable[[State, Transition, Measurement], np.ndarray]


def eigen(folder: Path) -> Joseph | str:
    """Return Eigen's filter, compiled now, or why there is none."""
    if shutil.which("g++") is None:
        return "skipped: no g++"
    if not Path("/usr/include/eigen3/Eigen/Dense").exists():
        return "skipped: no libeigen3-dev"
    library = folder / "joseph.so"
    flags = ["-w", "-O3", "-march=native", "-DNDEBUG", "-shared", "-fPIC", "-I/usr/include/eigen3"]
    subprocess.run(["g++", *flags, "-o", library, HERE / "eigen_joseph.cpp"], check=True)
    functions = ctypes.CDLL(str(library))

    def run(state: State, transition: Transition, measurement: Measurement) -> np.ndarray:
        N, m = measurement.z.shape
        n = len(state.x)
        out = np.empty((N, n)), np.empty((N, n))
        arrays = (state.x.copy(), state.P.copy(), transition.F, transition.Q, transition.u, measurement.z,
                  measurement.H, measurement.R, *out)  # fmt: skip
        arrays = tuple(np.ascontiguousarray(a) for a in arrays)
        function = getattr(functions, f"joseph_{n}_{m}")
        function(ctypes.c_long(N), *(ctypes.c_void_p(a.ctypes.data) for a in arrays))
        return arrays[-2][-1]

    return run


def recursive(joseph: Joseph | str) -> list[Row]:
    rows = []
    for order, dense, least in ((2, False, 50), (4, False, 10), (2, True, None), (4, True, None)):
        n = 6 * order
        few, many = (problem(order, N, varying=True, dense=dense) for N in (300, 4000))
        runs = [
            lambda many=many: estimate(*many, method="recursive"),
            lambda few=few: filterpy_run(*few),
            lambda many=many: statsmodels_run(*many),
        ]
        x = estimate(*many, method="recursive").x[-1]
        assert np.allclose(x, statsmodels_run(*many), rtol=1e-6, atol=1e-9)
        if not isinstance(joseph, str):
            runs.append(lambda many=many: joseph(*many))
            assert np.allclose(x, joseph(*many), rtol=1e-6, atol=1e-9)
        steps = (4000, 300, 4000, 4000)
        ours, theirs, compiled, *eigens = (t / N for t, N in zip(best(*runs, turns=10), steps, strict=False))
        name = f"recursive, n = {n}, m = 6, {'no structure' if dense else 'two triads'}"
        rows.append(limit(name, ours * 1e9, "ns a step"))
        rows.append(ratio(f"{name}: filterpy", ours, theirs, least))
        rows.append(ratio(f"{name}: statsmodels", ours, compiled))
        floor = 2.5 if n == 12 and not dense else None
        rows += [ratio(f"{name}: Eigen, dense Joseph", ours, t, floor) for t in eigens]
        if not eigens and not dense:
            rows.append(Row(f"{name}: Eigen, dense Joseph", str(joseph)))
    return rows


def steady() -> list[Row]:
    few, many, slow = problem(2, 300), problem(2, 1_000_000), problem(2, 1_000_000, step=0.01, slow=353.0)

    def run(given: tuple[State, Transition, Measurement]) -> None:  # in stretches, as `driftlab run` does
        state, transition, measurement = given
        for k in range(0, 1_000_000, 16_384):
            rows = slice(k, k + 16_384)
            steps = Transition(transition.F, transition.Q, transition.u[rows])
            seen = Measurement(measurement.z[rows], measurement.H, measurement.R, measurement.used[rows])
            state = estimate(state, steps, seen, method="steady").state

    some = problem(2, 20_000)
    runs = (lambda: run(many), lambda: run(slow), lambda: filterpy_run(*few), lambda: statsmodels_run(*some))
    steps = (1e6, 1e6, 300, 20_000)
    ours, long, theirs, compiled = (t / N for t, N in zip(best(*runs, turns=3), steps, strict=True))
    return [
        limit("steady, n = 12, m = 6, every output", ours * 1e9, "ns a step"),
        ratio("steady: filterpy", ours, theirs, 1000, 2000),
        ratio("steady: statsmodels", ours, compiled),
        limit("steady, slowest mode 353 s at 100 Hz: half of it transient", long * 1e9, "ns a step"),
        ratio("steady, slowest mode 353 s at 100 Hz: filterpy", long, theirs),
        ratio("steady, slowest mode 353 s at 100 Hz: statsmodels", long, compiled),
    ]


def error_state(n: int = 15, m: int = 3, N: int = 500) -> list[Row]:
    """An error that is fed back at every sample, with an H of its own, beside `predict` and `correct` as written."""
    rng = np.random.default_rng(0)
    F, H = 0.98 * (np.eye(n) + 0.01 * rng.normal(size=(N, n, n))), rng.normal(size=(N, m, n))
    Q, R, u, z = 1e-4 * np.eye(n), 0.1 * np.eye(m), np.zeros(n), rng.normal(size=(N, m))
    begin, ends, one = State(np.zeros(n), np.eye(n)), np.ones(N, dtype=bool), np.ones(1, dtype=bool)

    def propagate(nominal: np.ndarray, rows: slice) -> tuple[np.ndarray, Transition, Measurement]:
        k = rows.start
        return nominal, Transition(F[k], Q, u), Measurement(z[rows] - nominal @ H[k].T, H[k], R, one)

    def fed_back() -> np.ndarray:
        return list(feed_back(begin, np.zeros(n), ends, propagate, lambda nominal, x: nominal + x))[-1].state.P

    def written_out() -> np.ndarray:
        state, nominal = begin, np.zeros(n)
        for k in range(N):
            state = correct(predict(state, F[k], Q, u), z[k] - H[k] @ nominal, H[k], R)[0]
            nominal, state = nominal + state.x, State(np.zeros(n), state.P)
        return state.P

    assert np.allclose(fed_back(), written_out(), rtol=1e-9, atol=1e-12)
    ours, theirs = (t / N for t in best(fed_back, written_out, turns=20))
    name = f"error state fed back at every sample, n = {n}, m = {m}"
    return [limit(name, ours * 1e6, "µs a sample"), ratio(f"{name}: NumPy, predict and correct", ours, theirs, 1)]


def main() -> None:
    keep_freed_memory()  # as `driftlab run` does
    show("Steady gains", steady())
    show("Error state", error_state())
    with tempfile.TemporaryDirectory() as folder:
        show("Recursion", recursive(eigen(Path(folder))))


if __name__ == "__main__":
    main()
