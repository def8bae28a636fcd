"""Configs, maps and parameters in and out as functions: what the commands write, and nothing that nobody asked for."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from units_at_rest import unit_at_rest

import driftlab
from driftlab.errors import ConfigError

UNITS = {"time": "s", "gyro": "rad/s", "accel": "m/s^2", "temperature": "degC"}
MAP = {"kind": "polynomial", "order": 2, "path": "map.json", "outside": "clamp"}
CONFIG = {"extends": "mems_crs05", "latitude": "40.9 deg", "filter": {"gyro": {"calibration": MAP}}}


@pytest.fixture(scope="module")
def unit():
    return unit_at_rest(seconds=400.0, temperature=lambda t: 20 + t / 40)


@pytest.fixture
def data(unit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return {"time": (unit.t, "s"), **{name: (v, UNITS[name]) for name, v in unit.channels().items()}}


def test_a_map_goes_to_a_vehicle_and_back(data):
    fitted = driftlab.fit_map(CONFIG, data)
    loss = driftlab.export("px4", fitted, "gyro.params", settings={"device_id": 2490378})
    assert json.loads(Path("loss.json").read_text())["exports"]["gyro.params"]["loss"] == loss.as_json()["loss"]
    assert loss.lines()[0] in Path("gyro.params").read_text()
    found = driftlab.import_map("px4", "gyro.params", "vehicle.json", settings={"instance": 0})
    T = np.linspace(*found.map.domain, 50)
    largest = np.array(loss.sensors[0].domain.largest) + np.array(found.apart)
    assert np.all(np.abs(found.map.bias(T) - fitted.map.bias(np.clip(T, *fitted.map.domain))) <= largest + 1e-12)


def test_a_file_of_a_map_its_result_and_a_config_export_the_same(data):
    driftlab.fit_map(CONFIG, data, out="map.json")
    fitted = driftlab.fit_map(CONFIG, data)
    for name, what in (("file", "map.json"), ("result", fitted), ("config", CONFIG)):
        driftlab.export("csv_table", what, f"{name}.csv")
    rows = {
        name: [line for line in Path(f"{name}.csv").read_text().splitlines() if line[0] != "#"]
        for name in ("file", "result", "config")
    }
    assert rows["file"] == rows["result"] == rows["config"]
    with pytest.raises(ConfigError, match=r"map.json: is read here, and would be lost"):
        driftlab.export("csv_table", "map.json", "map.json", force=True)


def test_a_first_config_is_guessed_and_written_where_that_is_asked_for(data):
    with h5py.File("rest.h5", "w") as file:
        for name, (values, unit) in data.items():
            file[name] = values
            file[name].attrs["unit"] = unit
    found = driftlab.init("rest.h5")
    assert found.path is None
    assert not Path("rest.yaml").exists()
    written = driftlab.init("rest.h5", out="rest.yaml")
    assert written.path == Path("rest.yaml")
    assert written.path.read_text() == written.text == found.text
    assert driftlab.check("rest.yaml").config.filter is not None


def test_an_effect_that_is_to_be_left_out_is_one(data):
    with pytest.raises(ConfigError, match=r"chanel: is no installed effect; did you mean channel"):
        driftlab.explain(CONFIG, data, data, data, without=["chanel"])


def test_a_channel_is_tracked_as_the_option_says(data):
    config = {"extends": "mems_crs05", "filter": {"accel": {"calibration": {"kind": "polynomial", "order": 1}}}}
    fitted = driftlab.fit_map(config, data, channel="accel")
    assert (fitted.map.record.channel, fitted.map.record.unit) == ("accel", "m/s^2")
    with pytest.raises(ConfigError, match=r"has no sensor 'acel', it has accel, gyro; did you mean 'accel'"):
        driftlab.run(config, data, channel="acel")
