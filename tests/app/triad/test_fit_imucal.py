"""Terms of a session by Ferraris as imucal has them: y = K R u + b + K_ga f, so that I + M = K R and G = K_ga."""

import numpy as np
import pytest
from turned_units import AXES, bias_of, ferraris_session, matrix_of, sensitivity_of

from driftlab.triad.fit import fit_triad
from fusion_core.contracts import KnownRates, ThermalMap
from fusion_core.host.registry import registry

G, T = 9.80665, np.array([20.0])
POLYNOMIAL = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 3})


def inputs(sections, of, turn):
    """The input of the sections as a turntable knows it: mean rates and forces, of one of the two triads."""
    names = list(sections)
    force = np.array([{"a": -1, "p": 1, "rot": 1}[n[2:]] * G * AXES["xyz".index(n[0])] for n in names])
    rate = np.array([(n[2:] == "rot") * turn * AXES["xyz".index(n[0])] for n in names])
    y = np.stack([sections[n][of].mean(axis=0) for n in names])
    at, times = np.full(len(names), T[0]), 60.0 * np.arange(len(names))
    return KnownRates(rate, y, at, times, force) if of else KnownRates(force, y, at, times)


@pytest.mark.parametrize("seed", range(3))
def test_both_triads_agree_with_imucal(seed):
    imucal = pytest.importorskip("imucal", reason="imucal is not installed; pip install imucal compares with it")
    sections = ferraris_session(seed)
    regions = {f"acc_{n}": accel for n, (accel, _) in sections.items()}
    regions |= {f"gyr_{n}": np.rad2deg(gyro) for n, (_, gyro) in sections.items()}
    other = imucal.FerrarisCalibration(grav=G).compute(
        imucal.FerrarisSignalRegions(**regions), 50.0, from_acc_unit="m/s^2", from_gyr_unit="deg/s"
    )
    gyro = fit_triad(inputs(sections, 1, -2 * np.pi / 5.0), POLYNOMIAL, 0.02, np.ones(21, dtype=bool), walk=1e-6)
    accel = fit_triad(inputs(sections, 0, 0.0), POLYNOMIAL, 0.5, walk=1e-6)
    sigma = gyro.sigma(T)[0], accel.sigma(T)[0]
    pairs = (
        (gyro.terms.matrix(T)[0], other.K_g @ other.R_g - np.eye(3), sigma[0][3:12], matrix_of(20.0)),
        (gyro.terms.sensitivity(T)[0], np.deg2rad(other.K_ga), sigma[0][12:], sensitivity_of(20.0)),
        (gyro.terms.at(T)[0, :3], np.deg2rad(other.b_g), sigma[0][:3], bias_of(20.0, np.deg2rad(1.0))),
        (accel.terms.matrix(T)[0], other.K_a @ other.R_a - np.eye(3), sigma[1][3:12], matrix_of(20.0)),
    )
    for ours, theirs, own, truth in pairs:
        assert np.max(np.abs(ours - theirs).ravel() / own) < 2  # imucal weighs all alike, without a walk
        assert np.max(np.abs(ours - truth).ravel() / own) < 4
