"""Models, timing and the table of all benchmarks.

A benchmark is a function that returns rows. Ratios are measured side by side: both sides in one process, in turns,
the fastest of several turns each, so that what else the machine does falls on both.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.linalg import block_diag

from fusion_core.contracts import Transition
from fusion_core.model import Measurement, State


@dataclass(frozen=True)
class Row:
    """One line of the table: what was measured, its value, and what it should be."""

    what: str
    value: str
    target: str = ""
    met: bool | None = None


def best(*runs: Callable[[], object], turns: int = 5) -> list[float]:
    """Return the shortest time of each run in s, taken in turns."""
    times = [np.inf] * len(runs)
    for run in runs:
        run()  # compiles, warms caches
    for _ in range(turns):
        for k, run in enumerate(runs):
            gc.collect()
            begun = time.perf_counter()
            run()
            times[k] = min(times[k], time.perf_counter() - begun)
    return times


def ratio(what: str, ours: float, theirs: float, least: float | None = None, stretch: float | None = None) -> Row:
    """Return the row of a speed-up."""
    target = "" if least is None else f"≥ {least:g}" + (f" (stretch {stretch:g})" if stretch else "")
    measured = ours > 0 and np.isfinite(theirs)
    return Row(
        what, f"{theirs / ours:,.1f} x", target, theirs / ours >= least if measured and least is not None else None
    )


def limit(what: str, value: float, unit: str, most: float | None = None, stretch: float | None = None) -> Row:
    """Return the row of a figure that should be small."""
    target = "" if most is None else f"≤ {most:g} {unit}" + (f" (stretch {stretch:g})" if stretch else "")
    measured = 0 <= value < np.inf
    return Row(what, f"{value:.3g} {unit}", target, value <= most if measured and most is not None else None)


def largest_memory(channels: dict[str, dict[str, object]], path: Path, most: float) -> Row:
    """Return the row of the largest memory of `driftlab check` on a log that its kind of source reads, MB."""
    kind = {".ulg": "ulog", ".bin": "dataflash"}[path.suffix]
    config = path.with_suffix(".json")
    config.write_text(json.dumps({"source": {"kind": kind, "channels": channels}}))
    # of the process itself: what the system notes of a child begins with the memory of its parent
    code = """import sys
from driftlab.cli import main
try:
    main()
finally:
    print("VmHWM", open("/proc/self/status").read().split("VmHWM:")[1].split()[0])
"""
    command = [sys.executable, "-c", code, "check", str(config), "--input", str(path)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    size, largest = path.stat().st_size / 1e6, int(said.rsplit("VmHWM ", 1)[1]) / 1024
    return limit(f"`driftlab check` of a log of {size:.0f} MB: largest memory", largest, "MB", most)


def show(title: str, rows: list[Row]) -> None:
    """Print rows as a table in Markdown."""
    print(f"\n### {title}\n")
    print("| what | measured | target | |\n|---|---|---|---|")
    for row in rows:
        mark = {None: "", True: "met", False: "**missed**"}[row.met]
        print(f"| {row.what} | {row.value} | {row.target} | {mark} |", flush=True)


def machine() -> str:
    """Return the machine of the measurements, in a line."""
    with open("/proc/cpuinfo", encoding="utf-8") as file:
        text = file.read()
    flags = next((line.split() for line in text.splitlines() if line.startswith("flags")), [])
    vector = "AVX-512" if "avx512f" in flags else "AVX2" if "avx2" in flags else "no AVX2"
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{os.cpu_count()} cores (x86-64, virtual, {vector}), {memory:.0f} GB of memory, NumPy {np.__version__}"


def triads(order: int, dt: float, d: int = 6, walk: float = 8.7e-6) -> tuple[np.ndarray, ...]:
    """Return F, Q, H, R of d axes: the integral of each, a bias that walks, and `order` - 2 Markov biases.

    The zero-velocity model of two triads for order 2 (n = 12) and of richer bias models for order 4 (n = 24).
    """
    one, white, rest = np.eye(d), 1.54e-5, 1e-6
    F, Q = np.eye(order * d), np.zeros((order * d, order * d))
    Q[:d, :d] = white**2 * dt * one
    for k in range(1, order):
        b, keep = slice(k * d, (k + 1) * d), 1.0 if k == 1 else np.exp(-dt / (100.0 * k))
        q = walk**2 * dt / k
        F[b, b], F[:d, b] = keep * one, -dt / 2 * (1 + keep) * one
        Q[b, b], Q[:d, b], Q[b, :d] = q * one, -dt / 2 * q * one, -dt / 2 * q * one
        Q[:d, :d] += dt**2 / 3 * q * one
    return F, Q, np.eye(d, order * d), rest**2 * one


def problem(
    order: int,
    N: int,
    *,
    varying: bool = False,
    dense: bool = False,
    seed: int = 0,
    step: float = 0.1,
    slow: float = 1.8,
) -> tuple[State, Transition, Measurement]:
    """Return a start, N steps and N measurements; `varying` has F and Q of its own for each step.

    `dense` mixes the states by a rotation: the same filter in coordinates that know no structure. A step lasts
    `step` s, the slowest mode `slow` s: white noise over walk.
    """
    rng = np.random.default_rng(seed)
    dt = step * (1 + 0.2 * rng.random(N)) if varying else np.array([step])
    models = [triads(order, one, walk=1.54e-5 / slow) for one in dt]
    F, Q = (np.stack([model[k] for model in models]) for k in range(2))
    H, R = models[0][2:]
    n, m = len(F[0]), len(H)
    P = block_diag(np.zeros((m, m)), 1e-8 * np.eye(n - m))
    if dense:
        T = np.linalg.qr(rng.normal(size=(n, n)))[0]
        F, Q, H, P = T @ F @ T.T, T @ Q @ T.T, H @ T.T, T @ P @ T.T
        Q, P = (Q + Q.transpose(0, 2, 1)) / 2, (P + P.T) / 2
    u = rng.normal(size=(N, n)) * 1e-7
    z = np.cumsum(rng.normal(size=(N, m)), axis=0) * 1e-7
    F, Q = (F, Q) if varying else (F[0], Q[0])
    return State(np.zeros(n), P), Transition(F, Q, u), Measurement(z, H, R, np.ones(N, dtype=bool))


def filterpy_run(state: State, transition: Transition, measurement: Measurement) -> np.ndarray:
    """Run filterpy's KalmanFilter over the same steps; return the last x."""
    from filterpy.kalman import KalmanFilter

    N, m = measurement.z.shape
    n = len(state.x)
    theirs = KalmanFilter(dim_x=n, dim_z=m, dim_u=n)
    theirs.x, theirs.P, theirs.H, theirs.R = state.x[:, None].copy(), state.P.copy(), measurement.H, measurement.R
    one = np.eye(n)
    F, Q = (np.broadcast_to(a, (N, n, n)) for a in (transition.F, transition.Q))
    for k in range(N):
        theirs.predict(u=transition.u[k][:, None], B=one, F=F[k], Q=Q[k])
        theirs.update(measurement.z[k][:, None])
    return theirs.x[:, 0]


def statsmodels_run(state: State, transition: Transition, measurement: Measurement) -> np.ndarray:
    """Run statsmodels' compiled KalmanFilter over the same steps, every output kept; return the last x."""
    from statsmodels.tsa.statespace.kalman_filter import KalmanFilter

    n, m = len(state.x), measurement.z.shape[1]
    theirs = KalmanFilter(k_endog=m, k_states=n, selection=np.eye(n))
    theirs.bind(np.ascontiguousarray(measurement.z))
    theirs["design"], theirs["obs_cov"] = measurement.H, measurement.R
    F, Q = transition.F, transition.Q
    F_0, Q_0 = (F, Q) if F.ndim == 2 else (F[0], Q[0])
    if F.ndim == 2:
        theirs["transition"], theirs["state_cov"] = F, Q
    else:  # its step k leads away from sample k
        theirs["transition"] = np.asfortranarray(np.concatenate([F[1:], F[-1:]]).transpose(1, 2, 0))
        theirs["state_cov"] = np.asfortranarray(np.concatenate([Q[1:], Q[-1:]]).transpose(1, 2, 0))
    theirs["state_intercept"] = np.asfortranarray(np.concatenate([transition.u[1:], transition.u[-1:]]).T)
    theirs.initialize_known(F_0 @ state.x + transition.u[0], F_0 @ state.P @ F_0.T + Q_0)
    return np.asarray(theirs.filter().filtered_state[:, -1])
