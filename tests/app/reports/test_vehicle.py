"""The page of a vehicle says first what its firmware makes of the maps."""

from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.reports.vehicle import SensorReport, page_of


def sensor(title, lost, good):
    """Return a sensor whose firmware is off by `lost`, and its map good to `good`, deg/h, of the worse axis."""
    verdict = SimpleNamespace(good=np.array([good / 2, good]), fitted=SimpleNamespace(domain=(0.0, 50.0)))
    loss = SimpleNamespace(
        domain=SimpleNamespace(rms=np.array([lost, lost / 9])), warm_up=SimpleNamespace(rms=np.zeros(2)), causes={}
    )
    return SensorReport(title, (), verdict, SimpleNamespace(factor=1.0, shown="deg/h"), loss)


@pytest.mark.parametrize(
    ("second", "said"),
    [
        (sensor("gyro 1", 24.4, 5.87), "; the firmware is off its map by 24.4 deg/h on gyro 1, which is good to 5.87"),
        (sensor("gyro 1", 4.0, 5.87), ""),
    ],
)
def test_a_loss_beyond_the_sigma_of_a_map_is_in_the_first_sentence(second, said, monkeypatch):
    monkeypatch.setattr("driftlab.reports.vehicle.chart", lambda verdict, unit: None)
    page = page_of("mems", ["a.ulg"], [sensor("gyro 0", 1.0, 5.0), second], None, None, "")
    (sentence,) = (line for line in page.splitlines() if "sensors have a map" in line)
    assert f"2 of 2 sensors have a map, 2 are in the parameter file{said}<" in sentence
