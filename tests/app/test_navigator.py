"""The navigator of examples/04_navigator on short drives: as good as it says, and as the joint solution says."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from example_modules import importable
from scipy.stats import chi2

FOLDER = Path(__file__).parent.parent.parent / "examples" / "04_navigator"


@pytest.fixture(scope="module")
def example():
    with importable(FOLDER):
        import run
        import simulation

        yield run, simulation


@pytest.fixture(scope="module")
def fitted(example, tmp_path_factory):
    _, simulation = example
    return simulation.fit_map(tmp_path_factory.mktemp("map") / "map.json")


def test_the_samples_are_those_of_the_true_path(example):
    """Samples less what the truth's own path and biases make of them are white noise of the stated density."""
    _, simulation = example
    drive = simulation.simulate(3, cycles=1)
    truth, channels = drive.truth, drive.chunk.channels
    white = {"gyro": simulation.GYRO_NOISE, "accel": simulation.ACCEL_NOISE}
    deviations = []
    rise = np.diff(truth.v, axis=0) / simulation.DT - [0, 0, -9.80665]
    force = np.einsum("kji,kj->ki", truth.C[1:], rise)
    deviations.append((channels["accel"][1:] - force - truth.b_a[1:]) * np.sqrt(simulation.DT) / white["accel"])
    step = truth.C[:-1].transpose(0, 2, 1) @ truth.C[1:]
    skew = (step - step.transpose(0, 2, 1)) / 2  # sin(angle) of it, and the angle is below 0.01 rad
    rate = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1) / simulation.DT
    deviations.append((channels["gyro"][1:] - rate - truth.b_g[1:]) * np.sqrt(simulation.DT) / white["gyro"])
    for found in deviations:
        assert np.std(found) == pytest.approx(1.0, abs=0.03)
        assert np.abs(np.mean(found, axis=0)).max() < 5 / np.sqrt(len(found))


def test_the_last_error_and_its_covariance_are_those_of_the_joint_solution(example, fitted):
    run, simulation = example
    from joint_solution import joint_solution

    drive = simulation.simulate(0, cycles=1)
    x, P, x_joint, P_joint = joint_solution(run.navigator(drive, 1.0, fitted), drive.start)
    sigma = np.sqrt(np.diag(P))
    assert np.max(np.abs(x) / sigma) > 0.01  # there is something to compare
    np.testing.assert_allclose(x / sigma, x_joint / sigma, atol=1e-8)
    np.testing.assert_allclose(P / np.outer(sigma, sigma), P_joint / np.outer(sigma, sigma), atol=1e-8)


def test_errors_are_as_large_as_the_filter_says(example, fitted):
    run, simulation = example
    nees = []
    for seed in range(8):
        found, state = run.errors(simulation.simulate(seed, cycles=3), 1.0, fitted)
        nees.append(found[-1] @ np.linalg.solve(state.P, found[-1]))
    low, high = chi2.ppf([0.001, 0.999], 15 * len(nees))
    assert low < np.sum(nees) < high


def test_a_map_of_the_gyro_helps_a_vehicle_that_warms(example, fitted):
    run, simulation = example
    drives = [simulation.simulate(seed, cycles=8) for seed in range(4)]
    followed, walking = (
        np.array([run.errors(drive, *how)[0][-1] for drive in drives]) for how in ((1.0, fitted), (10.0, None))
    )
    assert run.rms(followed[:, 8]) < run.rms(walking[:, 8]) / 2  # heading
    assert run.rms(followed[:, :2]) < run.rms(walking[:, :2]) / 2  # position


def test_the_navigator_is_short():
    """Eighty lines of one's own, as its page says: neither blank nor comment."""
    lines = [line.strip() for line in (FOLDER / "navigator.py").read_text().splitlines()]
    assert sum(bool(line) and not line.startswith("#") for line in lines) <= 80


def test_the_script_prints_its_table_and_draws(tmp_path):
    code = f"import run; run.main(1, run.Path({str(tmp_path)!r}), cycles=1)"
    done = subprocess.run([sys.executable, "-c", code], cwd=FOLDER, capture_output=True, text=True, check=True)
    assert done.stdout.count("| random walk") == 2
    assert (tmp_path / "navigator.png").stat().st_size > 10_000
