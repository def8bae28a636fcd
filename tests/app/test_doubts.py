"""A recording that may not be what its config says passes no limit, nor does a run with a map of it."""

import numpy as np
import pytest

import driftlab
from driftlab.config import Limits
from driftlab.evaluation.limits import Measured, check_limits, outcome, verdict

DEG_H, N = np.deg2rad(1 / 3600), 5400
GYRO = {"noise": "10 deg/h/sqrt(Hz)", "bias": {"kind": "thermal_derivative", "walk": "0.1 deg/h/sqrt(s)"}}
LIMITS = {"residual": "60 deg/h", "swing": "400 deg/h", "coast": "60 deg/h"}


def recording(seed, *, copied):
    rng, t = np.random.default_rng(seed), np.arange(N, dtype=float)
    T = np.interp(t, [0, 300, 2600, 2800, N], [0, 0, 40, 40, 0]) + 0.01 * rng.normal(size=N)
    rates = (np.stack([T, 2 * T, -T], axis=1) + 10 * rng.normal(size=(N, 3))) * DEG_H
    if copied:
        rates[:, 1] = rates[:, 0]
    return {"time": (t, "s"), "gyro": (rates, "rad/s"), "temperature": (T, "degC")}


@pytest.mark.parametrize("copied", [False, True])
def test_no_limit_passes_on_a_copied_axis_or_with_a_map_of_one(tmp_path, copied):
    gyro = {**GYRO, "bias": {**GYRO["bias"], "map": {"kind": "polynomial", "path": str(tmp_path / "map.json")}}}
    config = {"filter": {"gyro": gyro, "accel": None}, "limits": LIMITS}
    fitted = driftlab.fit_map(config, recording(0, copied=copied), out=tmp_path / "map.json")
    decided = {row.name: row.decision for row in fitted.limits if row.measured}
    assert decided == dict.fromkeys(("residual", "swing"), "undecided" if copied else "pass")
    assert ("in doubt: gyro y shows what gyro x shows" in fitted.limits_verdict) is copied
    assert fitted.lines()[0].startswith("in doubt: gyro y shows what gyro x shows") is copied  # before any number
    found = driftlab.run(config, recording(1, copied=False))
    assert outcome(found.verdict) == ("undecided" if copied else "pass")
    assert ("in doubt: the soak of its map: gyro y shows" in found.verdict) is copied


def test_a_certificate_without_limits_says_a_doubt_in_its_frame(tmp_path):
    config = {"filter": {"gyro": GYRO | {"bias": {**GYRO["bias"], "map": {"kind": "polynomial"}}}, "accel": None}}
    for copied in (False, True):
        driftlab.fit_map(config, recording(0, copied=copied), out=tmp_path / f"{copied}.json", certificate=True)
        page = (tmp_path / f"{copied}.certificate.html").read_text()
        assert "no statement of conformity is made" in page
        assert ("is made. In doubt: gyro y shows what gyro x shows" in page) is copied


def test_a_limit_that_fails_fails_in_doubt_too():
    measured = {
        "swing": Measured(np.array([1.0]), ("x",), np.array([0.9]), np.array([1.1])),
        "coast": Measured(np.array([1.0]), ("x",), np.array([0.9]), np.array([1.1])),
    }
    rows = check_limits(Limits(swing=2.0, coast=0.5), measured, ["the thermometer is stuck"])
    assert {row.name: row.decision for row in rows} == {"swing": "undecided", "coast": "fail"}
    assert verdict(rows).endswith("in doubt: the thermometer is stuck")
