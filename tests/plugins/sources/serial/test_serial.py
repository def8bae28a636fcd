"""A device on a real pty pair, and everything that happens to it."""

import itertools
import os
import re
import socket
import threading
import time

import numpy as np
import pytest
from bench import FRAMING, SIZE, Device, frame, paced, some
from pydantic import ValidationError

from fusion_core.contracts import Source
from fusion_core.contracts.framing import DAMAGED, GARBAGE, REPEATED, Counter
from fusion_core.errors import UnreadableFile
from fusion_core.faults import LOST, RESTARTS, Faults, usable
from fusion_core.host.registry import registry
from fusion_plugins.sources.serial import Port
from fusion_plugins.sources.serial.clock import SampleClock


@pytest.fixture
def device(tmp_path):
    found = Device(tmp_path)
    yield found
    found.close()


def source(port, **config):
    kind = registry().classes(Source)["serial"]
    return kind.model_validate({"kind": "serial", "port": str(port), "framing": FRAMING, "interval": "10 ms", **config})


def started(source, size, faults):
    """Chunks of a source that has opened its port: what lay in it before is not of the measurement."""
    chunks = source.chunks(size, faults)
    assert len(next(chunks)) == 0  # nothing has come: an empty chunk, so that the reader can look up
    return chunks


def numbers(chunk):
    """The number of each sample by its time, where the device's clock counts 10 ms."""
    return np.rint(chunk.t / 0.01).astype(int)


def test_samples_come_as_they_were_sent(device):
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    device.send(b"".join(frame(k, gyro=(k, 0, -k)) for k in range(65530, 65545)))
    got = some(chunks, 15)
    chunks.close()
    np.testing.assert_array_equal(got["gyro"][:, 0], np.arange(65530, 65545))  # the counter wraps at 65536
    np.testing.assert_allclose(got.t, np.arange(15) * 0.01, atol=1e-12)
    np.testing.assert_array_equal(got["temperature"], 25.0)
    assert faults.found == {}


def test_torn_garbled_and_lost_frames_are_counted(device):
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    bad = bytearray(frame(4))
    bad[20] ^= 8
    stream = [frame(0)[9:], frame(1), b"garbage", frame(2), frame(3)[:30], bytes(bad), frame(5), frame(9)]
    device.send(b"".join(stream))
    got = some(chunks, 4)
    chunks.close()
    np.testing.assert_array_equal(numbers(got), [0, 1, 4, 8])
    counts = {what: fault.count for what, fault in faults.found.items()}
    assert counts == {GARBAGE: SIZE - 9 + 7 + 30 + SIZE, DAMAGED: 2, LOST: 2 + 3}


def test_unplugged_and_plugged_in_again(device):
    """The port is opened again, the pause is a gap in time, and no half frame is put together across it."""
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    device.send(b"".join(frame(k) for k in range(20)) + frame(20)[:25])
    before = some(chunks, 20)
    device.unplug()
    begun = time.monotonic()
    time.sleep(1.2)
    device.plug()
    paced(device, [frame(20)[25:], *(frame(k) for k in range(150, 250))], 100)
    after = some(chunks, 10)
    pause = time.monotonic() - begun
    chunks.close()
    assert 1.0 < after.t[0] - before.t[-1] < pause + 0.2
    np.testing.assert_allclose(np.diff(after.t), 0.01)
    assert faults.found["times that the connection was lost"].count == 1
    assert LOST in faults.found or RESTARTS in faults.found


def test_a_device_that_resets_goes_on(device):
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    device.send(b"".join(frame(k) for k in range(30000, 30020)))
    first = some(chunks, 20)
    time.sleep(0.5)
    device.send(b"".join(frame(k) for k in range(20)))
    second = some(chunks, 20)
    chunks.close()
    assert faults.found[RESTARTS].count == 1
    assert LOST not in faults.found
    assert 0.2 < second.t[0] - first.t[-1] < 2.0
    assert np.all(np.diff(second.t) > 0)


def test_frames_that_are_sent_twice_are_one_sample(device):
    """The counter and all are the same; a sample that shows what the one before it shows is another one."""
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    device.send(b"".join(frame(k) * (1 + (k >= 20)) for k in range(30)))
    got = some(chunks, 30)
    device.send(frame(29) + frame(30) + frame(31, gyro=(1, 2, 3)))
    np.testing.assert_array_equal(numbers(got), np.arange(30))
    np.testing.assert_array_equal(numbers(some(chunks, 2)), [30, 31])
    chunks.close()
    assert {what: fault.count for what, fault in faults.found.items()} == {REPEATED: 11}


def test_a_counter_that_jumps_and_one_that_passes_over_samples():
    """By the host's clock a step of 20,000 took no time, one of 301 took 3 s: these are lost, those are not."""
    faults = Faults()
    found = SampleClock(0.01, Counter(65536), "device", 60.0, faults)
    sent = np.concatenate([np.arange(1500), np.arange(1801, 2500), np.arange(22500, 23000), np.arange(18000, 18500)])
    passed = np.concatenate([np.arange(1500), np.arange(1801, 3500)])
    t = [found.stamp(1, np.array([n]), 7.0 + 0.01 * k) for n, k in zip(sent, passed, strict=True)]
    np.testing.assert_allclose(np.concatenate(t), 0.01 * passed, atol=0.011)
    assert {what: fault.count for what, fault in faults.found.items()} == {LOST: 301, RESTARTS: 2}


def test_a_silent_device_is_reported_once(device):
    faults = Faults()
    chunks = started(source(device.path, silent_after="0.5 s"), 1000, faults)
    device.send(frame(0) + frame(1))
    some(chunks, 2)
    for chunk in itertools.islice(chunks, 3):
        assert len(chunk) == 0
    chunks.close()
    assert faults.found["times that the device was silent for more than 0.5 s"].count == 2  # before, and after


@pytest.mark.parametrize("rate", [60, 160])
def test_a_device_slower_or_faster_than_declared(device, rate):
    faults = Faults()
    chunks = started(source(device.path), 1000, faults)
    stop = threading.Event()
    sender = paced(device, (frame(k) for k in itertools.count()), rate, stop)
    some(chunks, 6 * rate)
    stop.set()
    sender.join(timeout=10)
    chunks.close()
    assert len(faults.found) == 1
    assert next(iter(faults.found)).startswith("rate not as declared: samples are ")


@pytest.mark.parametrize("clock", ["device", "host"])
@pytest.mark.parametrize("rate", [80.0, 125.0])
def test_a_rate_that_is_not_as_declared(rate, clock):
    """Declared 100 Hz: reported with the measured interval; the host's clock follows what really comes."""
    faults = Faults()
    found = SampleClock(0.01, Counter(256), clock, 60.0, faults)
    rng = np.random.default_rng(0)
    t, sent = [], np.arange(3000)
    for k in range(0, 3000, 10):
        at = 1000.0 + (k + 9) / rate + rng.exponential(1e-3)
        t.append(found.stamp(10, sent[k : k + 10] % 256, at))
    t = np.concatenate(t)
    message = next(iter(faults.found))
    assert len(faults.found) == 1
    measured = re.match(
        r"rate not as declared: samples are ([\d.]+) ms and not 10 ms apart by the host's clock", message
    )
    assert float(measured[1]) == pytest.approx(1e3 / rate, rel=0.01)
    if clock == "host":
        late = np.diff(t[2000:])
        np.testing.assert_allclose(late.mean(), 1 / rate, rtol=2e-3)
    else:
        np.testing.assert_allclose(np.diff(t), 0.01)


@pytest.mark.parametrize("clock", ["device", "host"])
def test_a_backlog_at_the_start_is_no_other_rate(clock):
    """Samples of 7 s wait for a program that reads them within 2 s, then they come as declared."""
    faults, seen = Faults(), []
    found = SampleClock(0.01, Counter(256), clock, 60.0, faults)
    sent = np.arange(4000)
    for k in range(0, 4000, 10):
        measured = (k + 9) * 0.01
        found.stamp(10, sent[k : k + 10] % 256, 1000.0 + max(measured, 5.0 + 2.0 * min(measured, 7.0) / 7.0))
        seen.append(len(faults.found))
    assert not [what for what in faults.found if what.startswith("rate not as declared")], faults.found
    assert seen[-1] == 0 or not any("source.interval" in what for what in faults.found)
    assert RESTARTS not in faults.found  # no sample is missing


def test_advice_on_the_rate_is_taken_back_when_it_is_no_longer_so():
    faults, at = Faults(), 1000.0
    found = SampleClock(0.01, None, "host", 60.0, faults)
    for k in range(0, 3000, 10):
        at += 0.08 if k < 1200 else 0.1
        found.stamp(10, None, at)
        if k == 1190:
            (advice,) = faults.found
            assert advice.startswith("rate not as declared: samples are 8 ms and not 10 ms apart")
    assert not faults.found


def test_jitter_is_removed_from_the_hosts_clock():
    """Arrivals that are late by 0 to 16 ms, as through a USB bridge: the steps stay even, and time never goes back."""
    rng = np.random.default_rng(1)
    found = SampleClock(0.01, None, "host", 60.0, Faults())
    arrivals = np.maximum.accumulate(50.0 + 0.010003 * np.arange(12000) + rng.uniform(0, 0.016, 12000))
    t = np.concatenate([found.stamp(1, None, at) for at in arrivals])
    assert np.all(np.diff(t) > 0)
    late = slice(6000, None)
    assert np.std(np.diff(t)[late]) < 0.02 * np.std(np.diff(arrivals)[late])
    # the clock is right but for the mean delay, and its rate is the device's
    assert abs(np.mean(np.diff(t)[late]) - 0.010003) < 2e-6
    np.testing.assert_allclose(t[late] - t[6000], 0.010003 * np.arange(6000), atol=2e-3)


def test_wraps_of_a_short_counter_across_a_gap_are_read_off_the_host():
    faults = Faults()
    found = SampleClock(0.01, Counter(128), "device", 60.0, faults)
    sent = np.concatenate([np.arange(500), np.arange(1700, 2000)])
    t = [found.stamp(1, np.array([n % 128]), 7.0 + 0.01 * n + 2e-3 * (n % 3)) for n in sent]
    np.testing.assert_allclose(np.concatenate(t), sent * 0.01)
    assert faults.found[LOST].count == 1200


def test_a_time_stamp_that_wraps():
    """A clock of 32 bits and 1 us wraps after 71.6 minutes; the loss is counted in samples."""
    faults = Faults()
    found = SampleClock(0.01, Counter(2**32, 1e-6), "device", 60.0, faults)
    sent = 2**32 - 50_000 + 10_000 * np.array([0, 1, 2, 3, 7, 8, 9])
    t = found.stamp(len(sent), sent % 2**32, 5.0)
    np.testing.assert_allclose(t, [0, 0.01, 0.02, 0.03, 0.07, 0.08, 0.09], atol=1e-9)
    assert faults.found[LOST].count == 3


def test_a_slow_reader_loses_the_oldest_and_knows_it(device):
    """Nothing is taken while the device sends 40 times what is kept: memory stays bounded, the newest is there."""
    faults = Faults()
    chunks = started(source(device.path, buffer=4096), 100_000, faults)
    device.send(frame(0))
    some(chunks, 1)
    total = 40 * 4096 // SIZE
    sender = threading.Thread(target=lambda: device.send(b"".join(frame(k) for k in range(1, total))), daemon=True)
    sender.start()
    sender.join(timeout=30)
    assert not sender.is_alive(), "the port is read whether the samples are taken or not"
    time.sleep(0.3)
    got = some(chunks, 1)
    chunks.close()
    assert len(got) * SIZE <= 4096 + 65_536
    dropped = faults.found["bytes dropped because the program was slower than the device"].count
    assert dropped > 30 * 4096 - 65_536
    assert abs(dropped + len(got) * SIZE - (total - 1) * SIZE) < 2 * SIZE


def test_the_buffer_never_holds_more_than_it_may(device):
    with Port(str(device.path), 115200, 4096) as port:
        for _ in range(50):
            device.send(bytes(2000))
        until = time.monotonic() + 20
        while port.dropped + 4096 + 4095 <= 50 * 2000 and time.monotonic() < until:
            time.sleep(0.05)  # a busy machine reads late
        assert port.take(1.0).fresh
        assert port.dropped + 4096 + 4095 > 50 * 2000


def test_what_comes_late_in_a_chunk_is_cut_to_size(device):
    chunks = started(source(device.path), 7, Faults())
    device.send(b"".join(frame(k) for k in range(40)))
    sizes = []
    while sum(sizes) < 40:
        sizes.append(len(next(chunks)))
    chunks.close()
    assert max(sizes) <= 7


class Peer:
    def __init__(self, server):
        self.socket, _ = server.accept()

    def send(self, data, wait=True):
        self.socket.sendall(data)


def test_over_a_socket_and_its_end():
    """A socket:// port; the far end closes, listens again, and the samples go on."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        faults, stop, parts = Faults(), threading.Event(), []
        chunks = source(f"socket://127.0.0.1:{server.getsockname()[1]}").chunks(100, faults)
        for first in (0, 1000):
            reader = threading.Thread(target=lambda: parts.append(some(chunks, 20)))
            reader.start()
            peer = Peer(server)
            sender = paced(peer, [frame(k) for k in range(first, first + 100)], 100, stop)
            reader.join(timeout=20)
            peer.socket.close()
            sender.join(timeout=10)
        chunks.close()
    assert len(parts) == 2
    assert parts[1].t[0] > parts[0].t[-1]
    assert faults.found["times that the connection was lost"].count >= 1


def test_loop_opens_and_is_silent():
    chunks = source("loop://").chunks(10, Faults())
    assert len(next(chunks)) == 0
    chunks.close()


def test_a_port_that_is_not_there(tmp_path):
    with pytest.raises(
        UnreadableFile, match=r"cannot be opened .*; check that the device is plugged in, and the rights"
    ):
        next(source(tmp_path / "ttyNONE").chunks(10, Faults()))
    with pytest.raises(UnreadableFile, match="cannot be opened"):
        next(source("sockett://nowhere").chunks(10, Faults()))


def test_a_device_clock_needs_a_counter():
    plain = {key: value for key, value in FRAMING.items() if key != "counter"}
    with pytest.raises(
        ValidationError, match="the framing knows no counter of the device; write counter: under framing"
    ):
        source("loop://", framing=plain, clock="device")


def test_time_runs_forward_whatever_happens(device):
    """Time that runs backwards, which the core refuses, does not come from a device, also with the host's clock."""
    faults, stop = Faults(), threading.Event()
    live = source(device.path, clock="host")
    sender = paced(device, (frame(k) for k in itertools.count() if k % 10), 200, stop)
    parts = list(itertools.islice(usable((c for c in live.chunks(50, faults) if len(c)), faults, "x"), 60))
    stop.set()
    sender.join(timeout=10)
    t = np.concatenate([part.t for part in parts])
    assert np.all(np.diff(t) > 0)
    assert os.isatty(device.master)
