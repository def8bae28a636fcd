import numpy as np
import pytest

from driftlab.triad.fit import fit_triad
from fusion_core.chunk import Chunk
from fusion_core.contracts import Site, Stimulus, ThermalMap
from fusion_core.host.registry import registry

SPLINE = registry().classes(ThermalMap)["spline"].model_validate({"kind": "spline"})
POSITIONS = registry().classes(Stimulus)["positions"].model_validate({"rest": "1 s", "gravity": "9.81744 m/s^2"})

# imu_tk's own result on its own recordings, T and K with raw counts less b (README beside the data)
IMU_TK = {
    "accel": ([[1, -0.0033593, -0.00890639], [0, 1, -0.0213341], [0, 0, 1]],
              [0.00241278, 0.00242712, 0.00241168], [33124.2, 33275.2, 32364.4]),
    "gyro": ([[1, 0.00593634, 0.00111101], [0.00808812, 1, -0.0535569], [0.0253067, -0.0025513, 1]],
             [0.000209295, 0.000209899, 0.000209483], [32777.1, 32459.8, 32511.8]),
}  # fmt: skip
GRAVITY, NOMINAL = 9.81744, {"accel": 0.0024, "gyro": 2.1e-4}


def published(name):
    """Terms (12,) of y = (I + M) u + b for counts from 32768 on in the nominal scale."""
    alignment, scale, bias = (np.array(part) for part in IMU_TK[name])
    M = np.linalg.inv(alignment @ np.diag(scale)) * NOMINAL[name] - np.eye(3)
    return np.concatenate([(bias - 32768) * NOMINAL[name], M.ravel()])


@pytest.fixture(scope="module")
def xsens(recordings):
    folder = recordings / "data" / "imu_tk"
    accel, gyro = (np.loadtxt(folder / f"xsens_{name}.txt.gz") for name in ("acc", "gyro"))
    counts = {"accel": accel[:, 1:] - 32768, "gyro": gyro[:, 1:] - 32768}
    y = {name: values * NOMINAL[name] for name, values in counts.items()}
    chunk = Chunk(accel[:, 0], {**y, "temperature": np.full(len(accel), 25.0)})
    return chunk, POSITIONS._places(chunk, 0)


@pytest.mark.recordings
def test_hand_placements_agree_with_imu_tk(xsens):
    chunk, places = xsens
    assert len(places) == 38  # as imu_tk finds

    def cost(terms, samples=100):
        """imu_tk's: half the squares of |g| - |a| over 100 samples of each interval."""
        used = np.concatenate([chunk["accel"][a : a + samples] for a, _ in places])
        force = np.linalg.solve(np.eye(3) + terms[3:].reshape(3, 3), (used - terms[:3]).T)
        return 0.5 * np.sum((GRAVITY - np.linalg.norm(force, axis=0)) ** 2)

    stimulus = POSITIONS.inputs([chunk], "accel", Site(), (9.8, 0.01))
    fit = fit_triad(stimulus, SPLINE, 0.5)
    terms, sigma = fit.terms.at(np.array([25.0]))[0], fit.sigma(np.array([25.0]))[0]
    assert fit.observable.sum() == 9
    assert cost(terms) < 1.02 * cost(published("accel"))
    apart = np.abs(terms - published("accel"))[fit.observable] / sigma[fit.observable]
    assert np.all(apart < 3)
    assert np.median(apart) < 1.5

    force = np.linalg.solve(np.eye(3) + terms[3:].reshape(3, 3), (chunk["accel"] - terms[:3]).T).T
    turned = POSITIONS.inputs([chunk.having(accel=force)], "gyro", Site(), None)
    fit = fit_triad(turned, SPLINE, np.deg2rad(1.0))
    terms, sigma = fit.terms.at(np.array([25.0]))[0], fit.sigma(np.array([25.0]))[0]
    apart = (np.abs(terms - published("gyro")) / sigma)[3:]  # imu_tk's bias is that of the first rest alone
    assert fit.observable.all()
    assert np.all(apart < 2)
    assert np.all(sigma[3:] < 1.5e-3)
