"""The JSON schema that `driftlab schema` prints, as an editor uses it."""

import json
from pathlib import Path

import jsonschema
import pytest
from typer.testing import CliRunner
from yaml12 import read

from driftlab.cli import app
from driftlab.config import products

ROOT = Path(__file__).parents[3]
OF_ANOTHER_PLUGIN = {"plugin_template"}  # which is not installed here
CONFIGS = [
    path for path in sorted((ROOT / "examples").rglob("*.yaml")) if path.parent.name not in OF_ANOTHER_PLUGIN
] + list(products().values())


@pytest.fixture(scope="module")
def validator():
    done = CliRunner().invoke(app, ["schema"])
    assert done.exit_code == 0
    schema = json.loads(done.stdout)
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_every_config_of_ours_is_valid(validator, path):
    validator.validate(read(path.read_text(encoding="utf-8")))


WALK = "{kind: random_walk, walk: 1 deg/h/sqrt(s)}"
NOISE = "noise: 3 deg/h/sqrt(Hz)"


@pytest.mark.parametrize(
    "text",
    [
        "extends: mems_crs05",
        "{extends: mems_crs05, filter: {gyro: {bias: {walk: 1e-5 deg/s/sqrt(s)}}}}",  # of the product's kind
        "{extends: mems_crs05, filter: {gyro: {bias: {kind: thermal_derivative, map: {kind: spline}}}}}",
        "{extends: unit.yaml, source: {channels: {gyro: {unit: deg/s}}}}",
        "{extends: mems_crs05, filter: {accel: null}}",
        "{extends: mems_crs05, serial: 42}",
        "{extends: mems_crs05, serial: SN-0042, limits: {noise: 4 deg/h/sqrt(Hz)}}",
        f"filter: {{gyro: {{{NOISE}, bias: {WALK}}}}}",
    ],
)
def test_a_config_that_extends_another_need_not_be_whole(validator, text):
    validator.validate(read(text))


@pytest.mark.parametrize(
    "text",
    [
        f"filter: {{gyro: {{bias: {WALK}}}}}",  # no noise, and nothing that brings it
        "{extends: mems_crs05, filter: {gyro: {noize: 3 deg/h/sqrt(Hz)}}}",
        f"filter: {{gyro: {{{NOISE}, bias: {WALK}, noize: 1}}}}",
        "{extends: mems_crs05, latitude: 40.9}",
        "{extends: mems_crs05, filter: {gyro: {bias: {kind: random_wolk}}}}",
        "{extends: 5}",
        # a list is not merged: what it holds is whole
        "{extends: bench.yaml, source: {kind: serial, framing: {kind: binary, fields: [{name: gyro}]}}}",
        "{extends: mems_crs05, source: {kind: csv, channels: {time: {path: 5}}}}",
    ],
)
def test_what_is_wrong_is_seen_in_both(validator, text):
    assert not validator.is_valid(read(text))
