"""The record of a map says what a record can say, whoever wrote it."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from fusion_core.contracts import MapRecord
from fusion_core.errors import MapError
from fusion_core.thermal.record_texts import parse_json, recorded
from fusion_plugins.thermal_maps.polynomial import Polynomial
from fusion_plugins.thermal_maps.spline import Spline

GOOD = {"kind": "line", "domain": (-10.0, 50.0), "residual": (1e-6,) * 3, "axes": ("x", "y", "z")}


@pytest.mark.parametrize(
    "update",
    [
        {"channel": "gyro\nARMING_CHECK,0\n#"}, {"channel": "=cmd|calc!A1"}, {"channel": ""}, {"channel": "a" * 65},
        {"channel": "gyro*/"}, {"kind": "a\x1b[31m"}, {"unit": "bogus"}, {"unit": "rad/s\n"},
        {"axes": ("x", "y", "z\n")}, {"axes": ("x", "x", "y")}, {"axes": ("x,=1", "y", "z")},
        {"domain": (-300.0, 20.0)}, {"domain": (0.0, 6000.0)}, {"domain": (20.0, 20.0)}, {"domain": (np.nan, 20.0)},
        {"residual": (-1.0, 1.0, 1.0)}, {"residual": (np.nan, 1.0, 1.0)},
        {"averaged_residual": (1.0,)}, {"averaged_bounds": ((0.0, 1.0),)}, {"provenance": {"a": "b\nc"}},
        {"provenance": {"a\u2028": "b"}}, {"provenance": {"a": "b" * 200_000}},
        {"provenance": {str(k): "" for k in range(200)}}, {"memory": {"why": ["a\x1b"]}},
        {"error": {"T": (0.0, 1.0), "modes": (), "bend": (1.0,)}},
    ],
    ids=str,
)  # fmt: skip
def test_a_record_refuses_what_no_map_says(update):
    assert MapRecord(**GOOD).channel == "gyro"
    with pytest.raises(ValidationError):
        MapRecord(**{**GOOD, **update})
    with pytest.raises(ValidationError):
        MapRecord(**GOOD).model_copy(update=update)


@pytest.mark.parametrize("channel", ["gyro", "temperature_case", "probe 2", "imu/gyro", "R1 (oven)", "Fühler"])
def test_names_that_are_taken(channel):
    assert MapRecord(**GOOD, channel=channel).channel == channel


def test_what_a_fit_was_given_is_told_by_codes():
    assert recorded({"recordings": "a\u202eb.h5"}) == {"recordings": r"a\u202eb.h5"}


@pytest.mark.parametrize("text", ['{"a": 1, "a": 2}', "[NaN]", "[1e31]", "[1" + "0" * 31 + "]", "{", "[Infinity]"])
def test_json_that_is_refused(text):
    with pytest.raises(ValueError, match=r"\w"):
        parse_json(text)


def saved(kind, path):
    T = np.linspace(-10.0, 50.0, 400)
    kind.fit(T, np.stack([T, T**2], axis=1) * 1e-6, {}).save(path)
    return json.loads(path.read_text())


def test_a_covariance_is_one(tmp_path):
    path = tmp_path / "map.json"
    content = saved(Polynomial(), path)
    assert Polynomial(path=path).load().record.d == 2
    for change in (lambda C: -C, lambda C: C + np.triu(C, 1), lambda C: C - 2 * np.diag(np.diag(C))):
        other = np.array(content["covariance"])
        other[1] = change(other[1])
        path.write_text(json.dumps({**content, "covariance": other.tolist()}))
        with pytest.raises(MapError, match="covariance is no covariance"):
            Polynomial(path=path).load()


def test_the_deviation_of_a_spline_is_one(tmp_path):
    path = tmp_path / "map.json"
    content = saved(Spline(), path)
    content["spread"][0][0] = -1.0
    path.write_text(json.dumps(content))
    with pytest.raises(MapError, match="spread"):
        Spline(path=path).load()


def test_a_key_is_there_once(tmp_path):
    path = tmp_path / "map.json"
    saved(Polynomial(), path)
    path.write_text(path.read_text().replace('"record"', '"record": {}, "record"', 1))
    with pytest.raises(MapError, match="the key 'record' is there twice"):
        Polynomial(path=path).load()


@pytest.mark.parametrize("text", ["[" + "0," * 1_000_001 + "0]", b"[" + b"{}," * 1_000_001 + b"{}]"])
def test_values_in_great_number_are_refused_before_they_are_read(text):
    with pytest.raises(ValueError, match="more than 1,000,000 values"):
        parse_json(text)
