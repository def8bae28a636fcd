"""Gain of a warming vehicle from the thermal derivative: `python run.py [SEEDS]`.

Five minutes for 20 drives; the figure is written to `demo_out/navigator/`.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent.parent))
import simulation
from joint_solution import joint_solution
from navigator import Navigator
from pictures import picture, save
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fusion_core import Array, BiasModel, State, registry

OUT = Path(__file__).parent.parent.parent / "demo_out" / "navigator"
WALKS = (1.0, 3.0, 10.0, 30.0)  # of the gyro's bias without the derivative, as multiples of its true one
TUNED_ON = 100  # seeds from here on choose among them


def bias_model(kind: str, unit: str, walk: float, sigma_0: float, **others: object) -> BiasModel:
    """Return an installed bias model; walk and sigma_0 in SI."""
    settings = {"kind": kind, "walk": f"{walk} {unit}/sqrt(s)", "sigma_0": f"{sigma_0} {unit}", **others}
    return registry().classes(BiasModel)[kind].model_validate(settings)


def navigator(drive: simulation.Drive, times: float, path: Path | None) -> Navigator:
    """Return the navigator of a drive, the gyro's walk so many times the true one; with a map, the derivative."""
    followed = {} if path is None else {"map": {**simulation.MAP, "path": str(path)}}
    gyro = bias_model(
        "random_walk" if path is None else "thermal_derivative",
        "rad/s", times * simulation.GYRO_WALK, simulation.GYRO_SIGMA, **followed,
    )  # fmt: skip
    accel = bias_model("random_walk", "m/s^2", simulation.ACCEL_WALK, simulation.ACCEL_SIGMA)
    noise = np.array([simulation.ACCEL_NOISE, simulation.GYRO_NOISE])
    return Navigator(drive.chunk, drive.used, {"accel_bias": accel, "gyro_bias": gyro}, noise, simulation.SIGMA)


def errors(drive: simulation.Drive, times: float, path: Path | None) -> tuple[Array, State]:
    """Return truth less nominal (J, 15) at each feedback, and the state of the error at the end."""
    found, _, state = navigator(drive, times, path).run(drive.start)
    rows = np.append(np.flatnonzero(drive.used), len(drive.used) - 1)[: len(found)]
    p, v, C, b_a, b_g = (np.array(values) for values in zip(*found, strict=True))
    truth = [values[rows] for values in drive.truth]
    psi = Rotation.from_matrix(truth[2] @ C.transpose(0, 2, 1)).as_rotvec()
    return np.hstack([truth[0] - p, truth[1] - v, psi, truth[3] - b_a, truth[4] - b_g]), state


def rms(values: Array) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def main(seeds: int, out: Path, cycles: int = simulation.CYCLES) -> None:
    """Print the tables and draw the figure."""
    out.mkdir(parents=True, exist_ok=True)
    path = simulation.fit_map(Path(tempfile.mkdtemp()) / "map.json")
    short = simulation.simulate(0, cycles=4)
    x, P, x_joint, P_joint = joint_solution(navigator(short, 1.0, path), short.start)
    sigma = np.sqrt(np.diag(P))
    print(f"against the joint solution of {int(short.used.sum())} stops' seconds: x differs by")
    print(f"{np.max(np.abs(x - x_joint) / sigma):.1e} sigma, P by {np.max(np.abs(P / P_joint - 1)):.1e} of itself\n")

    trials = [simulation.simulate(seed, cycles) for seed in range(TUNED_ON, TUNED_ON + max(seeds // 4, 2))]
    heading = {times: rms([errors(drive, times, None)[0][-1, 8] for drive in trials]) for times in WALKS}
    tuned = min(heading, key=heading.__getitem__)
    rows = {
        "thermal derivative": (1.0, path),
        "random walk, the same": (1.0, None),
        f"random walk, tuned ({tuned:g} times)": (tuned, None),
    }
    drives = [simulation.simulate(seed, cycles) for seed in range(seeds)]
    low, high = chi2.ppf([0.005, 0.995], 15 * seeds) / seeds
    minutes = round(drives[0].chunk.t[-1] / 60)
    print(f"after {minutes} minutes of warming, {seeds} drives, rms; NEES of 15: 99 % in {low:.1f} to {high:.1f}\n")
    print("| gyro bias | position, m | heading, deg | tilt, deg | gyro bias, deg/h | NEES |\n|---|---|---|---|---|---|")
    traces = {}
    for name, how in rows.items():
        found = [errors(drive, *how) for drive in drives]
        last = np.array([e[-1] for e, _ in found])
        nees = np.mean([e[-1] @ np.linalg.solve(state.P, e[-1]) for e, state in found])
        traces[name] = np.array([e for e, _ in found])
        print(
            f"| {name} | {rms(np.hypot(last[:, 0], last[:, 1])):.0f} | {np.degrees(rms(last[:, 8])):.2f} | "
            f"{np.degrees(rms(np.hypot(last[:, 6], last[:, 7]))):.3f} | {rms(last[:, 12:]) / simulation.DEG_H:.1f} | "
            f"{nees:.1f} |"
        )
    figure(out / "navigator.png", drives[0], traces)


def figure(path: Path, drive: simulation.Drive, traces: dict[str, Array]) -> None:
    """Draw temperature, and the rms errors of position and heading, against time."""
    e = {name: np.degrees(rms(trace[:, -1, 8])) for name, trace in traces.items()}
    with_map, tuned = e["thermal derivative"], min(value for name, value in e.items() if name.startswith("random"))
    title = f"A vehicle that warms: {with_map:.1f}° of heading error with the map's derivative, {tuned:.1f}° without"
    fig, axes = picture(title, rows=3, columns=1, height=5.4, sharex=True)
    axes[0].plot(drive.chunk.t[::100] / 60, drive.chunk["temperature"][::100], color="0.3", lw=1)
    axes[0].set_ylabel("temperature [°C]")
    t = drive.chunk.t[np.append(np.flatnonzero(drive.used), len(drive.used) - 1)] / 60
    for name, e in traces.items():
        horizontal = np.sqrt(np.mean(e[:, :, 0] ** 2 + e[:, :, 1] ** 2, axis=0))
        axes[1].semilogy(t[: len(horizontal)], horizontal, lw=1.2, label=name)
        axes[2].semilogy(t[: len(horizontal)], np.degrees(np.sqrt(np.mean(e[:, :, 8] ** 2, axis=0))), lw=1.2)
    axes[1].set_ylabel("position error [m]")
    axes[2].set_ylabel("heading error [°]")
    axes[2].set_xlabel("time [min]")
    axes[1].legend(frameon=False, fontsize=8)
    save(fig, path)


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20, OUT)
