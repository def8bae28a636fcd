"""A map is used only for the channel that it was fitted on."""

import json

import numpy as np
import pytest

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from fusion_core.contracts import ThermalMap
from fusion_core.errors import MapError
from fusion_core.host.registry import registry


@pytest.fixture
def path(tmp_path):
    T = np.linspace(-10, 50, 500)
    kind = registry().classes(ThermalMap)["polynomial"]
    kind().fit(T, np.outer(T, [1e-6, 2e-6, 3e-6]), {}).save(tmp_path / "map.json")
    return tmp_path / "map.json"


def config(path, channel, where):
    walk = {"gyro": "1e-5 deg/s/sqrt(s)", "accel": "1e-6 m/s^2/sqrt(s)"}
    noise = {"gyro": "3 deg/h/sqrt(Hz)", "accel": "1e-3 m/s^2/sqrt(Hz)"}
    sections = {name: {"noise": noise[name], "bias": {"kind": "random_walk", "walk": walk[name]}} for name in walk}
    settings = {"kind": "polynomial", "path": str(path)}
    if where == "calibration":
        sections[channel]["calibration"] = settings
    else:
        sections[channel]["bias"] = {"kind": "thermal_derivative", "walk": walk[channel], "map": settings}
    return Config.model_validate({"filter": sections})


@pytest.mark.parametrize("where", ["calibration", "bias"])
@pytest.mark.parametrize(("key", "value"), [("unit", "deg/h"), ("unit", "banana"), ("channel", "accel")])
def test_a_map_of_another_unit_or_channel_is_refused(path, where, key, value):
    Run(config(path, "gyro", where), RunLog())
    content = json.loads(path.read_text())
    content["record"][key] = value
    path.write_text(json.dumps(content))
    known = rf"filter.gyro: the map .* {value} .*gyro in rad/s with 3 was expected"
    with pytest.raises(MapError, match="the unit 'banana' is not known" if value == "banana" else known):
        Run(config(path, "gyro", where), RunLog())


def test_a_gyros_map_is_refused_for_the_accelerometers(path):
    with pytest.raises(MapError, match=r"filter.accel: the map .* gyro in rad/s .* accel in m/s"):
        Run(config(path, "accel", "bias"), RunLog())


def test_a_map_of_one_axis_is_refused_for_three(path):
    T = np.linspace(-10, 50, 500)
    registry().classes(ThermalMap)["polynomial"]().fit(T, T[:, None] * 1e-6, {}).save(path)
    with pytest.raises(MapError, match="with 1 axes, gyro in rad/s with 3 was expected"):
        Run(config(path, "gyro", "bias"), RunLog())
