"""Configs that a user writes, and the errors that answer."""

import numpy as np
import pytest
from written_configs import GOOD, load

from driftlab.config import Config, products
from fusion_core.contracts import BiasModel
from fusion_core.errors import ConfigError
from fusion_core.host.config import read_document, validate
from fusion_core.host.registry import registry


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (": 3.18 deg/h/sqrt(Hz)", ": 3.18", r":4: filter\.gyro\.noise: 3\.18 has no unit; write e\.g\. '3\.18 deg/h/"),
        ("noise: 3.18 deg/h/sqrt(Hz)", "noise: -1 deg/h/sqrt(Hz)", "must be greater than zero"),
        ("latitude: 40.9 deg", "latitude: 40.9", r":2: latitude: 40\.9 has no unit; write e\.g\. '40\.9 deg'"),
        ("latitude", "latitud", r":2: latitud: unknown key; did you mean 'latitude'\?"),
        (", walk", ", wlak", r":4: filter\.gyro\.bias\.wlak: unknown key; did you mean 'walk'\?"),
        ("kind: random_walk", "kind: random_wlk", r"kind 'random_wlk' is not installed; did you mean random_walk\?"),
        ("kind: random_walk, ", "", r"gyro\.bias: needs a `kind:`; `driftlab plugins` lists those known$"),
        ("noise: 3.18 deg/h/sqrt(Hz), ", "", r"filter\.gyro\.noise: is required and missing"),
        ("5e-4 deg/s/sqrt(s)", "5e-4 m/s^2/sqrt(s)", r"bias\.walk: '5e-4 m/s\^2/sqrt\(s\)' cannot be converted"),
        ("filter:", "filter: [", r"config\.yaml:\d: is not YAML \(expected"),
        ("5e-4 deg/s/sqrt(s)", "-5e-4 deg/s/sqrt(s)", "must be at least 0"),
        ("40.9 deg", "95 deg", "latitude is 95 deg; write one from -90 deg to 90 deg"),
        ("latitude: 40.9 deg", "heading: 3 deg", "heading is given and latitude is not"),
        ("filter:", "filter:\n  rest: {false_alarm: 0}", r"filter\.rest\.false_alarm: Input should be greater than 0"),
        ("kind: random_walk", "axes: [a], kind: random_walk", r"filter\.gyro: bias\.axes has 'a', a triad has x"),
        ("kind: random_walk", "axes: [x y], kind: random_walk", r"axes: 'x y' is no name of an axis; write up"),
        ("latitude", "extends: mems_crs5\nlatitude", r"did you mean mems_crs05\?"),
        ("latitude", "latitude: 1 deg\nlatitude", "key 'latitude' is written twice"),
    ],
)  # fmt: skip
def test_config_errors_say_where_and_what_to_do(tmp_path, old, new, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, GOOD.replace(old, new, 1))


def test_every_mistake_is_reported_at_once(tmp_path):
    text = GOOD.replace("40.9 deg", "40.9").replace("walk:", "wlak:")
    with pytest.raises(ConfigError) as error:
        load(tmp_path, text)
    assert len(str(error.value).splitlines()) == 2


def test_a_missing_file_and_a_circle(tmp_path):
    with pytest.raises(ConfigError, match="cannot be read"):
        read_document(tmp_path / "none.yaml")
    (tmp_path / "a.yaml").write_text("extends: b.yaml")
    (tmp_path / "b.yaml").write_text("extends: a.yaml")
    with pytest.raises(ConfigError, match="extends itself"):
        read_document(tmp_path / "a.yaml")


def test_extends_merges_and_own_keys_win(tmp_path):
    config = load(tmp_path, "extends: mems_crs05\nfilter: {align: 30 s, accel: null}")
    assert config.filter.align == 30.0
    assert config.filter.accel is None
    assert config.filter.gyro.noise == pytest.approx(np.deg2rad(3.18) / 3600)


def test_another_kind_replaces_the_whole_mapping(tmp_path):
    text = "extends: mems_crs05\nfilter: {gyro: {bias: {kind: gauss_markov, sigma: 10 deg/h, tau: 5 min}}}"
    assert load(tmp_path, text).filter.gyro.bias.tau == 300.0


def test_an_error_in_a_parent_names_the_parents_line(tmp_path):
    (tmp_path / "parent.yaml").write_text(GOOD.replace("40.9 deg", "40.9"))
    with pytest.raises(ConfigError, match=r"parent\.yaml:2: latitude"):
        load(tmp_path, "extends: parent.yaml")


def test_a_correction_cannot_be_applied_twice(tmp_path):
    text = """
    filter:
      gyro:
        noise: 1 deg/h/sqrt(Hz)
        calibration: {kind: polynomial, path: map.json}
        bias: {kind: thermal_derivative, walk: 1 deg/h/sqrt(s), map: {kind: polynomial, path: map.json}}
    """
    with pytest.raises(ConfigError, match="the correction would be applied twice"):
        load(tmp_path, text)


@pytest.mark.parametrize("name", sorted(products()))
def test_every_product_is_a_valid_config(tmp_path, name):
    of_device = "framing" in products()[name].read_text()  # whose bytes come from a port or from a file
    config = load(tmp_path, f"extends: {name}" + "\nsource: {kind: binary_log}" * of_device)
    assert config.filter.gyro.noise > 0


def test_fog_walk_follows_from_its_allan_floor(tmp_path):
    """walk = sqrt(3)/2 floor^2 / noise, of the data sheet's 0.05 deg/h and 0.012 deg/sqrt(h)."""
    gyro = load(tmp_path, "extends: fog_kvh_p1775").filter.gyro
    floor = np.deg2rad(0.05) / 3600
    assert gyro.bias.walk == pytest.approx(np.sqrt(3) / 2 * floor**2 / gyro.noise, rel=0.02)


def test_a_broken_plugin_that_is_asked_for_says_so(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text(GOOD.replace("kind: random_walk", "kind: theirs"))
    with pytest.raises(ConfigError, match=r"kind 'theirs' is installed but broken \(ImportError: no licence\)"):
        validate(Config, read_document(path), lambda: {"theirs": "ImportError: no licence"})


def test_schema_knows_every_installed_plugin():
    definitions = Config.model_json_schema()["$defs"]
    assert {"RandomWalk", "ThermalDerivative", "Polynomial", "Hdf5"} <= set(definitions)


def test_the_schema_describes_every_field_of_every_plugin():
    for cls in [Config, *(entry.plugin for entry in registry().entries if entry.plugin)]:
        schema = cls.model_json_schema()
        defs = schema.get("$defs", {})
        for name, part in {cls.__name__: schema, **defs}.items():
            for field, own in part.get("properties", {}).items():
                named = defs.get(own.get("$ref", "").rpartition("/")[2], {})  # pydantic writes the same text once
                assert own.get("description") or named.get("description"), f"{name}.{field}"
    tau = registry().classes(BiasModel)["gauss_markov"].model_json_schema()["properties"]["tau"]
    assert tau["description"] == "Correlation time of the correlated part."
    assert (tau["x-unit"], tau["x-dimension"], tau["examples"]) == ("s", "[time]", ["300 s"])


def test_a_channel_of_null_takes_that_of_the_base_away(tmp_path):
    text = "extends: px4_log\nsource: {channels: {temperature: null}}"
    assert sorted(load(tmp_path, text).source.channels) == ["accel", "gyro", "time"]
