import numpy as np
import pytest

from driftlab.filtering.setup import shown_by_soak, subtracted
from driftlab.units import BiasUnit
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


SETTLES = "up and down differ as where the bias settles: whether it remembers is not known; go again"
CURVE = LINE.fit(T, np.outer(T, [1e-5, 2e-5, 3e-5]), {})
DEG_H = np.deg2rad(1) / 3600


@pytest.mark.parametrize(("answer", "evidence", "said"), [
    ("seen", 50.0, "showed a hysteresis: up and down differ by up to 8 deg/h, y"),
    ("undecided", 50.0, "showed that up and down differ by up to 8 deg/h, y (as where the bias settles)"),
    ("undecided", 2.0, ""),  # no more than noise makes now and then
    ("undecided", None, ""),  # it was not looked for
    ("none", -2.0, ""),
])  # fmt: skip
def test_what_a_soak_showed_is_said_where_no_sigma_has_it(answer, evidence, said):
    size = None if evidence is None else [3 * DEG_H, -8 * DEG_H, None]
    memory = {"answer": answer, "log_evidence": evidence, "size": size, "kinds": ["hysteresis"], "why": SETTLES}
    unit = BiasUnit("rad/s", "deg/h")
    assert shown_by_soak(CURVE.noting(memory=memory), "xyz", unit) == said
    assert shown_by_soak(CURVE, "xyz", unit) == ""


@pytest.mark.parametrize("memory", [
    {"answer": "seen", "size": "abc"}, {"answer": "seen", "size": [1.0, 2.0, 3.0, 4.0], "kinds": 5},
    {"answer": "undecided", "size": [1.0, 2.0, 3.0], "log_evidence": "a"}, {"answer": "seen"}, {"answer": 7},
])  # fmt: skip
def test_a_file_that_somebody_has_changed_says_nothing(memory):
    assert shown_by_soak(CURVE.noting(memory=memory), "xyz", BiasUnit("rad/s", "deg/h")) == ""
