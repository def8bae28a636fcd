"""A sentence names each range that recordings do not show."""

import numpy as np
import pytest

from driftlab.identification.records import Evidence, Record, missing_excitation
from driftlab.units import RATE
from fusion_core.chunk import Chunk
from fusion_core.thermal.sweeps import ways


def evidence(*temperatures, **channels):
    records = []
    for T in temperatures:
        t = np.arange(len(T)) * 10.0
        own = {name: f(t, T) for name, f in channels.items()}
        chunk = Chunk(t, {"gyro": np.zeros((len(T), 3)), "temperature": T, **own})
        records.append(Record("day", True, True, chunk, np.arange(len(T))))
    return Evidence(tuple(records), "gyro", ("x", "y", "z"), RATE, 10.0, 60.0)


UP, DOWN = np.linspace(10, 40, 500), np.linspace(40, 10, 500)


def test_ways_go_from_turning_point_to_turning_point():
    wobble = 0.5 * np.sin(np.arange(500))
    assert ways([np.concatenate([UP, DOWN[:250], UP[250:]])]) == (
        pytest.approx(45, abs=0.2),
        pytest.approx(15, abs=0.2),
    )
    assert ways([UP + wobble]) == pytest.approx((30, 0), abs=1.1)
    assert ways([np.full(9, 20.0)]) == (0.0, 0.0)


@pytest.mark.parametrize(("T", "way"), [(UP, "warm up"), (DOWN, "cool down")])
def test_one_way_is_said(T, way):
    (line,) = missing_excitation(evidence(T, T + 1))
    assert f"only ever {way}" in line


def test_both_ways_are_fine():
    assert list(missing_excitation(evidence(UP, DOWN))) == []
    assert list(missing_excitation(evidence(np.concatenate([UP, DOWN])))) == []


def test_a_constant_temperature_and_none_at_all():
    (line,) = missing_excitation(evidence(np.full(100, 20.0) + 0.01 * np.arange(100)))
    assert "hardly move" in line
    assert list(missing_excitation(Evidence(evidence().records, "gyro", ("x",), RATE, 10.0, 60.0))) == []


def test_a_channel_that_moves_with_temperature_is_named():
    found = evidence(UP, DOWN, supply=lambda t, T: 5 - 0.01 * T, flow=lambda t, T: np.sin(t))
    (line,) = missing_excitation(found)
    assert "supply moves with temperature alone (correlation -1.00)" in line
