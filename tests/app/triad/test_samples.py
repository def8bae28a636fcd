import numpy as np
import pytest
from turned_units import turntable

from driftlab.commands.inputs import config_with
from driftlab.errors import ConfigError, DataError
from driftlab.triad.samples import stimulus_of
from fusion_core.faults import Faults

RATE = np.deg2rad(100.0)
FILTER = {"gyro": {"noise": "0.3 deg/sqrt(h)", "bias": {"kind": "random_walk", "walk": "1e-4 deg/s/sqrt(s)"}}}


def gathered(stimulus, channels, recordings=(), **others):
    config = config_with({"filter": FILTER, "stimulus": stimulus, **others}, channels, None)
    return stimulus_of(config, list(recordings), Faults())


def test_a_table_gives_the_segments_of_a_turntable(tmp_path):
    t, y, T, table = turntable(0, [20.0, 40.0], hold=6.0)
    (tmp_path / "table.csv").write_text(table)
    channels = {"time": (t + 100.0, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    found = gathered({"kind": "rate_table", "segments": str(tmp_path / "table.csv")}, channels).stimulus
    expected = [sign * RATE * axis for _ in range(2) for axis in np.eye(3) for sign in (1, -1)]
    np.testing.assert_allclose(found.u, expected, atol=1e-10)
    np.testing.assert_allclose(found.temperatures, np.repeat([20.0, 40.0], 6))
    assert np.all(np.abs(found.y - found.u) < 0.06)  # bias and scale: nothing of a ramp

    north = {"kind": "rate_table", "segments": str(tmp_path / "table.csv")}
    turned = gathered(north, channels, latitude="90 deg").stimulus
    earth = turned.u - np.array(expected)
    np.testing.assert_allclose(earth, 7.292115e-5 * np.abs(np.sign(expected)), atol=1e-10)  # the axis points up


def test_a_channel_gives_the_steady_parts_of_a_turntable():
    hz = 10.0
    rate = np.deg2rad(np.concatenate([np.full(200, 50.0), np.linspace(50, -80, 100), np.full(200, -80.0)]))
    t = np.arange(len(rate)) / hz
    rng = np.random.default_rng(0)
    y = rate[:, None] * [0.0, 0.0, 1.01] + rng.normal(0, 1e-6, (len(t), 3))
    channels = {"time": (t, "s"), "gyro": (y, "rad/s"), "table": (rate, "rad/s"), "temperature": (20 + 0 * t, "degC")}
    found = gathered({"kind": "rate_table", "channel": "table", "axes": "z", "length": "5 s"}, channels).stimulus
    np.testing.assert_allclose(np.rad2deg(found.u), [[0, 0, w] for w in (*[50.0] * 4, *[-80.0] * 3)], atol=1e-9)
    np.testing.assert_allclose(found.y[:, 2], 1.01 * found.u[:, 2], rtol=1e-5)
    with pytest.raises(ConfigError, match="axes names 2 of 1 recordings; give one column, and one axis"):
        gathered({"kind": "rate_table", "channel": "table", "axes": ["z", "x"]}, channels)
    with pytest.raises(ConfigError, match="needs segments, a table, or channel, its rate; give one of them"):
        gathered({"kind": "rate_table"}, channels)


def test_a_segment_beyond_the_recording_is_refused(tmp_path):
    t, y, T, _ = turntable(0, [20.0], hold=3.0)
    (tmp_path / "table.csv").write_text("start [min],stop [min],axis,rate [deg/s]\n1,2,x,100\n")
    channels = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    with pytest.raises(DataError, match=r"from 62 to 120 s: the recording has 0 samples there, and lasts 29.9 s"):
        gathered({"kind": "rate_table", "segments": str(tmp_path / "table.csv")}, channels)
