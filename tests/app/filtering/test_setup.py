import numpy as np

from driftlab.filtering.setup import subtracted
from fusion_core.chunk import Chunk
from fusion_core.contracts import CurveError, MatrixCurve, ThermalMap
from fusion_core.host.registry import registry

T = np.linspace(0.0, 50.0, 100)
G = np.array([[1.2, -0.4, 0.3], [0.5, -2.6, 0.8], [-0.2, 0.6, 1.8]]) * 1e-4
LINE = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})


def test_the_strain_of_a_gyro_goes_by_accelerometers_that_are_right():
    """Readings of accelerometers are off by a bias of half a g: what strains the gyro is the force itself."""
    error = CurveError(T=(0.0, 50.0), modes=(((0.0,) * 9,) * 2,), bend=(0.0,) * 9)
    rows = (tuple(G.ravel().tolist()),) * 2
    held = MatrixCurve(T=(0.0, 50.0), values=rows, slopes=((0.0,) * 9,) * 2, kinds=("constant",) * 9, told=(True,) * 9,
                       error=error)  # fmt: skip
    gyro = LINE.fit(T, np.outer(T, [1e-4, 2e-4, 3e-4]), {}).noting(sensitivity=held)
    accel = LINE.fit(T, 5.0 + np.outer(T, [1e-3, 0.0, 0.0]), {})
    force = np.random.default_rng(0).normal(0, 9.0, (100, 3))
    readings = {"gyro": np.zeros((100, 3)), "accel": force + accel.bias(T), "temperature": T}
    chunk = Chunk(np.arange(100.0), readings)
    for calibrations, followed in (({"gyro": gyro, "accel": accel}, {}), ({"accel": accel}, {"gyro": gyro})):
        part = subtracted(chunk, calibrations, followed)["gyro"]
        bias = gyro.bias(T) if "gyro" in calibrations else 0.0
        np.testing.assert_allclose(part, bias + force @ G.T, rtol=0, atol=1e-14)
    alone = Chunk(chunk.t, {name: chunk[name] for name in ("gyro", "temperature")})
    np.testing.assert_array_equal(subtracted(alone, {"gyro": gyro})["gyro"], gyro.bias(T))
