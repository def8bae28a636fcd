"""Scale factors as states, tracked while a turntable turns and warms: `python examples/11_turntable/run.py`.

The filter is the measurement model `driven`; a joint least-squares solution of all epochs says whether it is right.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from scipy.linalg import lstsq

sys.path.insert(0, str(Path(__file__).parent.parent))
from pictures import BLUE, DARK, picture, save

import driftlab

OUT = Path(__file__).parent.parent.parent / "demo_out" / "turntable"
NOISE, BIAS_WALK, SCALE_WALK, SIGMA, EPOCH = 8e-5, 1e-6, 3e-5, 0.01, 10.0  # rad/s/sqrt(Hz), rad/s/sqrt(s), 1/sqrt(s)
FILTER = {
    "kind": "driven", "channel": "gyro", "reference": "table", "update_interval": f"{EPOCH} s", "align": "600 s",
    "noise": f"{NOISE} rad/s/sqrt(Hz)",
    "bias": {"kind": "random_walk", "walk": f"{BIAS_WALK} rad/s/sqrt(s)", "sigma_0": f"{SIGMA} rad/s"},
    "matrix": {"misalignment": False, "sigma_0": str(SIGMA), "walk": f"{SCALE_WALK} 1/sqrt(s)"},
}  # fmt: skip


def turned(seed: int = 0, epochs: int = 270) -> tuple[dict[str, object], np.ndarray]:
    """Return a recording of a gyro that is turned about x, y, z, both ways, and its scale factors (N, 3)."""
    rng, hz = np.random.default_rng(seed), 10.0
    N = round(epochs * EPOCH * hz)
    t = np.arange(N + 1) / hz  # the first sample only opens the first epoch
    step = ((t - 0.5 / hz) // (2 * EPOCH)).astype(int)
    rate = np.deg2rad(60.0) * np.eye(3)[step % 3] * np.where(step // 3 % 2, -1.0, 1.0)[:, None]
    T = 20.0 + 40.0 * (1 - np.exp(-t / 700.0))
    scale = np.outer(T - 20.0, [6e-5, -1e-4, 3e-5]) + np.array([0.004, -0.002, 0.001])
    bias = 5e-3 + np.cumsum(rng.normal(0, BIAS_WALK / np.sqrt(hz), (N + 1, 3)), axis=0)
    gyro = rate * (1 + scale) + bias + rng.normal(0, NOISE * np.sqrt(hz), (N + 1, 3))
    return {"time": (t, "s"), "gyro": (gyro, "rad/s"), "table": (rate, "rad/s"), "temperature": (T, "degC")}, scale


def joint_solution(data: dict[str, object]) -> np.ndarray:
    """Return scale and bias (6,) after the last epoch, axis by axis from all epochs at once: no filter is in it."""
    y, u = (np.asarray(data[name][0])[1:].reshape(-1, 100, 3).mean(axis=1) for name in ("gyro", "table"))
    N, x = len(y), []
    walks = np.array([SCALE_WALK, BIAS_WALK]) * np.sqrt(EPOCH)
    for axis in range(3):
        steps = np.kron(np.eye(N, k=1)[:-1] - np.eye(N)[:-1], np.diag(1 / walks))
        seen = np.zeros((N, 2 * N))
        seen[np.arange(N), 2 * np.arange(N)], seen[np.arange(N), 2 * np.arange(N) + 1] = u[:, axis], 1.0
        begin = np.eye(2, 2 * N) / np.hypot(SIGMA, walks)[:, None]
        A = np.vstack([begin, steps, seen / (NOISE / np.sqrt(EPOCH))])
        z = np.concatenate([np.zeros(2 * N), (y - u)[:, axis] / (NOISE / np.sqrt(EPOCH))])
        x.append(lstsq(A, z)[0][-2:])
    return np.array(x).T.ravel()


def main(out: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Track, compare and draw; return the last states and those of the joint solution, and how far off scale is."""
    data, scale = turned()
    run = driftlab.run({"filter": FILTER}, data)
    joint = joint_solution(data)
    print(f"scale and bias at the end: {np.array2string(run.x[-1], precision=6)}")
    print(f"less those of the joint solution, sigma: {np.max(np.abs(run.x[-1] - joint) / run.sigma[-1]):.1e} at most")
    true, shown = scale[np.searchsorted(data["time"][0], run.t - 1e-6)] * 1e6, run.x[:, :3] * 1e6
    error = np.std((shown - true)[len(run.t) // 10 :])
    title = f"Scale factors while the table turns and warms by 40 K: known to {error:.0f} ppm rms"
    figure, (panel,) = picture(title, columns=1)
    for k, name in enumerate("xyz"):
        band = 2e6 * run.sigma[:, k]
        panel.fill_between(run.t / 60, shown[:, k] - band, shown[:, k] + band, color=BLUE, alpha=0.2, lw=0)
        panel.plot(run.t / 60, shown[:, k], color=BLUE, lw=1.2, label="tracked, ± 2 sigma" if k == 0 else None)
        panel.plot(run.t / 60, true[:, k], "--", color=DARK, lw=1, label="true" if k == 0 else None)
        panel.annotate(name, (run.t[-1] / 60, true[-1, k]), xytext=(4, 0), textcoords="offset points", va="center")
    panel.set(xlabel="time [min]", ylabel="scale factor error [ppm]", ylim=(-8000, 9000))
    panel.legend(frameon=False, fontsize=9)
    save(figure, out / "turntable.png")
    return run.x[-1], joint, run.sigma[-1], (shown - true) / (1e6 * run.sigma[:, :3])


if __name__ == "__main__":
    main(OUT)
