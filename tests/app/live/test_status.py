"""The status of a live run when nothing comes: how long, why, and when that is no more than usual."""

import numpy as np
import pytest

from driftlab.live import status as live_status
from driftlab.live.status import Status
from fusion_core.chunk import Chunk
from fusion_core.faults import NO_FRAME


@pytest.fixture
def clock(monkeypatch):
    """The host's clock, in a list of one number."""
    now = [1000.0]
    monkeypatch.setattr(live_status.time, "monotonic", lambda: now[0])
    return now


def fed(clock, spacing=0.01, count=10):
    status = Status()
    status.listen()
    for k in range(count):
        clock[0] += spacing
        status.came(Chunk(np.array([k * spacing])))
    status.waiting = None
    return status


def test_what_does_not_listen_yet_misses_nothing(clock):
    status = Status()
    clock[0] += 60.0
    assert (status.state, status.level, status.no_data) == ("getting ready", "waiting", 0.0)
    status.listen()
    assert (status.state, status.level) == ("nothing came so far", "waiting")
    clock[0] += 12.0
    assert (status.state, status.level) == ("no data for 12 s: nothing came so far", "bad")


def test_silence_is_told_by_its_length_and_ends_with_the_next_sample(clock):
    status = fed(clock)
    clock[0] += 1.9
    assert (status.state, status.level) == ("at rest", "good")
    clock[0] += 10.1
    assert (status.state, status.level) == ("no data for 12 s", "bad")
    assert status.as_json()["no_data_s"] == pytest.approx(12.0)
    status.came(Chunk(np.array([12.1])))
    assert (status.state, status.as_json()["no_data_s"]) == ("at rest", 0.0)


def test_a_sensor_that_is_read_seldom_is_not_silent_between_two_readings(clock):
    status = fed(clock, spacing=10.0)
    clock[0] += 29.0
    assert status.state == "at rest"
    clock[0] += 2.0
    assert status.state == "no data for 31 s"


def test_the_cause_is_told_as_long_as_it_lasts(clock):
    status = fed(clock)
    status.faults.add(NO_FRAME, 40, "before")
    status.came(Chunk(np.array([1.0])))
    status.faults.unavailable = "unplugged, waiting for /dev/ttyUSB0"
    assert (status.state, status.level) == ("unplugged, waiting for /dev/ttyUSB0", "bad")
    clock[0] += 3600.0
    assert status.state == "no data for 3,600 s: unplugged, waiting for /dev/ttyUSB0"
    status.faults.unavailable = ""
    status.faults.add(NO_FRAME, 1200, "after")
    assert status.state == "no data for 3,600 s: 1,200 bytes, no frame; check baudrate and sync"
    status.came(Chunk(np.array([3601.0])))
    assert status.state == "at rest"
