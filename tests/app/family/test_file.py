"""A family's file: what is written is read, and what is no family of the sensor is refused."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import other_families as made
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from driftlab.family.file import load_family, save_family
from driftlab.family.mixed_model import Family, fit_family
from fusion_core.errors import MapError, Unwritable


@pytest.fixture(scope="module")
def family() -> Family:
    units = made.deal("together", 24, 3, d=2, lots=3, size=1e-4)
    return fit_family([(unit.soaked(3, ("x", "y")), unit.lot) for unit in units])


@pytest.fixture
def path(family: Family, tmp_path: Path) -> Path:
    save_family(tmp_path / "family.json", family, map_kind="spline", config="latitude: 45 deg\n")
    return tmp_path / "family.json"


def test_what_follows_for_a_unit_is_the_same(family: Family, path: Path) -> None:
    read = load_family(path, channel="gyro", bias_unit="rad/s", axes=("x", "y"))
    for name in ("mu", "mu_covariance", "Sigma", "Lambda", "steps", "moved"):
        assert_array_equal(getattr(read, name), getattr(family, name))
    assert (read.knots, read.axes, read.units, read.sampled) == (family.knots, ("x", "y"), 24, 24)
    own = made.deal("together", 1, 4, d=2, size=1e-4)[0].soaked(4, ("x", "y"))
    for lot in ("L1", "new"):
        assert_allclose(read.posterior(own, lot).c, family.posterior(own, lot).c, rtol=1e-6, atol=1e-10)
    kept = json.loads(path.read_text())
    assert (kept["map_kind"], kept["config"]) == ("spline", "latitude: 45 deg\n")
    assert_allclose(np.square(kept["mu_sigma"]), np.diagonal(family.mu_covariance, axis1=1, axis2=2))


@pytest.mark.parametrize(
    ("wanted", "said"),
    [
        ({"channel": "accel"}, "has the channel gyro, the config accel"),
        ({"bias_unit": "1"}, "has the unit rad/s, the config 1"),
        ({"axes": ("x", "y", "z")}, "has the axes x y, the config x y z"),
    ],
)
def test_a_family_of_another_sensor_is_refused(path: Path, wanted: dict[str, Any], said: str) -> None:
    with pytest.raises(MapError, match=said):
        load_family(path, **wanted)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"schema": 2}, "schema"),
        ({"mu": [[0.0]]}, "does not fit 2 axes"),
        ({"intervals": 0}, "no width"),
        ({"extra": 1}, "extra"),
    ],
)
def test_a_damaged_file_is_refused(path: Path, change: dict[str, Any], said: str) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | change))
    with pytest.raises(MapError, match=rf"family .*family\.json is damaged.*{said}"):
        load_family(path)


def test_a_covariance_that_is_none_is_refused(path: Path) -> None:
    content = json.loads(path.read_text())
    content["Sigma"][0][0] = -1.0
    path.write_text(json.dumps(content))
    with pytest.raises(MapError, match="Sigma is no covariance"):
        load_family(path)


def test_half_a_file_and_none_are_refused(path: Path, family: Family) -> None:
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(MapError, match="is damaged or no family's file"):
        load_family(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(MapError, match="it is no text"):
        load_family(path)
    with pytest.raises(MapError, match="No such file"):
        load_family(path.parent / "none.json")
    with pytest.raises(Unwritable, match="name a file in a folder"):
        save_family(path.parent / "none" / "family.json", family)
