"""A kind of map on the public base alone, and a map whose residual nobody knows."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from pydantic import FiniteFloat, ValidationError

from driftlab.maps.fit import map_lines
from fusion_core.chunk import Array
from fusion_core.contracts import (
    FittedMap,
    MapFile,
    MapRecord,
    ThermalMap,
    check_samples,
    check_swing,
    read_map,
    record_of,
    write_map,
)
from fusion_core.errors import MapError


class LineFile(MapFile):
    gain: tuple[tuple[FiniteFloat, ...], ...]


@dataclass(frozen=True, eq=False)
class LineMap(FittedMap):
    gain: Array  # (2, d)

    def save(self, path: Path) -> None:
        write_map(path, LineFile(record=self.record, gain=self.gain.tolist()))

    def _bias(self, T: Array) -> Array:
        return self.gain[0] + T[:, None] * self.gain[1]

    def _slope(self, T: Array) -> Array:
        return np.broadcast_to(self.gain[1], (len(T), self.record.d))


class Line(ThermalMap):
    kind: Literal["line"] = "line"

    def fit(self, T: Array, bias: Array, provenance: Mapping[str, str]) -> LineMap:
        T, bias = check_samples(self.kind, T, bias)
        check_swing(self.kind, T, self.min_swing, 2, "a line", "wait for more")
        gain = np.linalg.lstsq(np.stack([np.ones_like(T), T], axis=1), bias)[0]
        record = record_of(self.kind, T, bias, lambda T: gain[0] + T[:, None] * gain[1], provenance)
        return LineMap(record, gain, outside=self.outside)

    def read(self, path: Path) -> LineMap:
        content = read_map(self.kind, path, LineFile)
        return LineMap(content.record, np.array(content.gain), outside=self.outside)


def soak():
    rng = np.random.default_rng(0)
    T = np.linspace(-10.0, 50.0, 4000)
    return T, np.stack([1 + 2 * T, 3 - T], axis=1) + rng.normal(size=(4000, 2)) * [0.1, 0.2]


def test_a_kind_of_map_in_forty_lines(tmp_path):
    fitted = Line().fit(*soak(), {"recordings": "soak.h5"})
    np.testing.assert_allclose(fitted.gain, [[1, 3], [2, -1]], atol=0.02)
    np.testing.assert_allclose(fitted.record.residual, [0.1, 0.2], rtol=0.05)
    assert fitted.record.domain == (-10.0, 50.0)
    fitted.save(tmp_path / "map.json")
    again = Line(path=tmp_path / "map.json").load()
    assert again.record == fitted.record
    np.testing.assert_array_equal(again.gain, fitted.gain)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text[:-9], "is damaged or not JSON"),
        (
            lambda text: text.replace('"line"', '"spline"'),
            "holds a map of kind 'spline', expected 'line'; set kind: spline",
        ),
        (lambda text: text.replace("driftlab_map", "map"), "has no key 'driftlab_map'"),
        (lambda text: text.replace('"driftlab_map": 1', '"driftlab_map": 2'), "is of version 2, expected version 1"),
        (lambda text: text.replace('"gain"', '"gian"'), "is damaged at gain"),
        (lambda text: text.replace("50.0", "1e31"), "is damaged or not JSON .*beyond 1e[+]30"),
        (
            lambda text: text.replace("50.0", "-50.0"),
            r"is damaged at record \(Value error, has the domain \(-10.0, -50.0\) and 2 axes, expected a range",
        ),
    ],
)
def test_a_damaged_file_is_refused(tmp_path, damage, message):
    path = tmp_path / "map.json"
    Line().fit(*soak(), {}).save(path)
    path.write_text(damage(path.read_text()))
    with pytest.raises(MapError, match=f"^line: map file .*map.json {message}"):
        Line(path=path).load()


def test_a_map_whose_residual_is_not_known(tmp_path):
    """One that was imported: it says so, has axes by name, and no deviation is invented for it."""
    record = MapRecord(kind="line", domain=(0.0, 40.0), axes=("x", "y", "z"), residual=None)
    fitted = LineMap(record, np.arange(6.0).reshape(2, 3))
    fitted.save(tmp_path / "map.json")
    assert json.loads((tmp_path / "map.json").read_text())["record"]["residual"] is None
    again = Line(path=tmp_path / "map.json", outside="clamp").load()
    assert (again.record.d, again.record.samples) == (3, 0)
    T = np.array([-5.0, 20.0])
    assert again.bias(T).shape == again.slope(T).shape == (2, 3)
    np.testing.assert_array_equal(again.sigma(T), np.zeros((2, 3)))
    assert (
        map_lines(again, None)[1]
        == "map line: does not say how sure its curve is, and has no residual; no deviation reckons with it"
    )


def test_a_record_knows_its_axes():
    with pytest.raises(ValidationError, match="neither axes nor residual are given"):
        MapRecord(kind="line", domain=(0.0, 1.0), residual=None)
    with pytest.raises(ValidationError, match="3 axes and 1 residuals"):
        MapRecord(kind="line", domain=(0.0, 1.0), axes=("x", "y", "z"), residual=(1.0,))
