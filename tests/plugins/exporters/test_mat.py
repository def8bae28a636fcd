"""A .mat file: Octave loads it and draws the same map."""

from dataclasses import replace

import numpy as np
import pytest
from octaves import octave

from driftlab.errors import ConfigError, UnreadableFile
from fusion_core.testing.exporters import HIGH, LOW, unit
from fusion_plugins.effects.thermal_rate import ThermalRate
from fusion_plugins.exporters.mat import Mat


def numbers(script, folder):
    """Return what Octave prints of a script, as numbers."""
    return np.array(octave(script, folder).split(), dtype=np.float64)


@pytest.mark.parametrize("method", ["linear", "spline"])
def test_octave_draws_the_same_map(method, tmp_path):
    what = unit("gyro", "accel")
    loss = Mat(method=method).export(what, tmp_path / "unit.mat")
    T = np.linspace(LOW, HIGH, 1997)
    (tmp_path / "T.txt").write_text("\n".join(map(repr, T.tolist())))
    for lost in loss.sensors:
        name = lost.sensor.channel
        script = (
            f"load unit.mat; T = load('T.txt'); b = interp1({name}.temperature, {name}.bias, T, '{method}');"
            "printf('%.17g ', b);"
        )
        drawn = numbers(script, tmp_path).reshape(3, -1).T
        expected = what.sensor(name).fitted.bias(T)
        error = np.max(np.abs(drawn - expected), axis=0)
        assert np.all(error <= 1.001 * lost.domain.largest + 1e-15)
        rounding = 1e-14 * np.max(np.abs(expected))  # a spline of these curves loses next to nothing
        assert np.all(error >= 0.5 * lost.domain.largest - rounding)


def test_octave_finds_what_is_known_of_a_sensor(tmp_path):
    what = unit("gyro")
    effect = ThermalRate(coefficients=(1e-6, 2e-6, 3e-6))
    what = replace(what, sensors=(replace(what.sensors[0], effects=(effect,)),))
    Mat().export(what, tmp_path / "unit.mat")
    script = (
        "load unit.mat; assert(gyro.units.bias, 'rad/s'); assert(gyro.channel, 'gyro'); assert(driftlab.serial, '17');"
        "assert(gyro.axes{2}, 'y'); assert(gyro.effects{1}.kind, 'thermal_rate');"
        "s = gyro.slope(:, 3); printf('%.17g ', gyro.effects{1}.coefficients, gyro.noise, gyro.walk, gyro.domain, s);"
    )
    found = numbers(script, tmp_path)
    gyro = what.sensor("gyro")
    np.testing.assert_allclose(found[:11], [1e-6, 2e-6, 3e-6, *gyro.noise, *gyro.walk, LOW, HIGH], rtol=1e-12)
    T = np.linspace(LOW, HIGH, len(found) - 11)
    np.testing.assert_allclose(found[11:], gyro.fitted.slope(T)[:, 2], rtol=1e-12)


def test_half_the_step_loses_a_quarter_by_straight_lines_and_far_less_by_a_spline(tmp_path):
    lost = {}
    for method in ("linear", "spline"):
        for step in (4.0, 2.0):
            exporter = Mat.model_validate({"step": f"{step} K", "method": method})
            (found,) = exporter.export(unit("gyro"), tmp_path / "unit.mat").sensors
            lost[method, step] = found.domain.largest
    np.testing.assert_allclose(lost["linear", 4.0][1:] / lost["linear", 2.0][1:], 4, rtol=0.1)
    assert np.all(lost["spline", 4.0][2] < lost["linear", 4.0][2] / 50)


def test_a_lost_lag_is_no_part_of_the_table(tmp_path):
    what = unit("gyro")
    effect = ThermalRate(coefficients=(1e-2, 2e-2, 3e-2))
    what = replace(what, sensors=(replace(what.sensors[0], effects=(effect,)),))
    loss = Mat().export(what, tmp_path / "unit.mat")
    assert any(line.startswith("gyro: thermal_rate of temperature, ") for line in loss.left_out)


def test_what_is_no_table_is_refused(tmp_path):
    from scipy.io import savemat

    other = tmp_path / "other.mat"
    savemat(other, {"gyro": {"T": [1.0, 2.0]}})
    with pytest.raises(ConfigError, match="has no struct with temperature and bias; name one that has"):
        Mat().read(other)
    (tmp_path / "text.mat").write_text("no numbers\n")
    with pytest.raises(UnreadableFile, match=r"is no \.mat file of version 5"):
        Mat().read(tmp_path / "text.mat")


@pytest.mark.parametrize("axes", [np.array(["x", "y", "z"], dtype=object), ["x", "y", "z"]])
def test_a_table_that_somebody_made_is_read(axes, tmp_path):
    """Axes in a cell array or as a matrix of characters, and nothing said of how to go between the rows."""
    from scipy.io import savemat

    T = np.linspace(0, 40, 21)
    table = {"channel": "gyro", "axes": axes, "temperature": T[:, None], "bias": np.outer(T, [1.0, 2.0, 3.0])}
    savemat(tmp_path / "made.mat", {"gyro": {**table, "units": {"bias": "rad/s"}}, "driftlab": {"serial": "1"}})
    (found,) = Mat().read(tmp_path / "made.mat")
    assert found.axes == ("x", "y", "z")
    np.testing.assert_allclose(found.bias(np.array([5.0])), [[5, 10, 15]])
