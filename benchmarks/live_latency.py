"""From the last byte of a frame to the estimate that it makes possible, at 1 kHz through a pty.

    python benchmarks/live_latency.py [SECONDS]
    python benchmarks/live_latency.py --page [SECONDS]    # without and with a page that is looked at, in turn
    python benchmarks/live_latency.py --map [SECONDS]     # without and with a map that is fitted meanwhile, in turn

A process of its own sends frames of a unit at rest, each with the host's time just before it is written. A frame is
done when the pipeline (port, framing, clock, checks, epochs, filter) asks for the next bytes: every estimate that the
frame makes possible is out by then.

For the map the temperature of the frames goes up and down by 20 K a minute.

The page's history is full, as after hours; three tabs ask for it as browsers do, a fourth never reads its answer.
"""

from __future__ import annotations

import gc
import os
import socket
import struct
import subprocess
import sys
import time
import tty
import zlib
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.live.growing_map import GrowingMap
from driftlab.live.history import LiveHistory
from driftlab.live.server import Server, serving
from driftlab.live.status import Status
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import ROWS, read
from fusion_core.contracts import ThermalMap
from fusion_core.faults import LOST, Faults
from fusion_core.host.registry import registry
from fusion_core.kalman import estimate

RATE = 1000
G = 9.80206
SOURCE = {
    "kind": "serial",
    "interval": "1 ms",
    "framing": {
        "kind": "binary",
        "sync": "A5 5A",
        "fields": [
            {"name": "sequence", "type": "uint16"},
            {"name": "gyro", "type": "float32", "count": 3, "unit": "rad/s"},
            {"name": "accel", "type": "float32", "count": 3, "unit": "m/s^2"},
            {"name": "temperature", "type": "float32", "unit": "degC"},
            {"name": "sent", "type": "float64"},
        ],
        "checksum": {"kind": "CRC-32/ISO-HDLC"},
        "counter": {"field": "sequence", "modulo": 65536},
    },
}
FILTER = {
    "align": "2 s",
    "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
    "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
}


def send(master: int, seconds: float) -> None:
    rng = np.random.default_rng(0)
    gyro = rng.normal(size=(1000, 3)) * 1.54e-5 * np.sqrt(RATE)
    accel = [0, 0, G] + rng.normal(size=(1000, 3)) * 8.3e-4 * np.sqrt(RATE)
    begun = time.monotonic()
    for k in range(int(seconds * RATE)):
        time.sleep(max(0.0, begun + k / RATE - time.monotonic()))
        T = 25.0 + 10 * abs(2 * (k / RATE / 60 % 1) - 1)
        numbers = (*gyro[k % 1000], *accel[k % 1000], T, time.monotonic())
        body = b"\xa5\x5a" + struct.pack("<H7fd", k % 65536, *numbers)
        os.write(master, body + struct.pack("<I", zlib.crc32(body)))


# what three tabs ask, once a second; without the imports of this file, whose load would be measured
LOOK = """
import struct, sys, time
from urllib.request import urlopen
known = {tab: (0, 0) for tab in range(3)}
while True:
    for tab, (generation, rows) in known.items():
        urlopen(f"{sys.argv[1]}status.json?tab={tab}").read()
        found = urlopen(f"{sys.argv[1]}history?of=whole&generation={generation}&rows={rows}&tab={tab}").read()
        generation, at, columns = (int(v) for v in struct.unpack("<3d", found[:24]))
        known[tab] = generation, at + (len(found) // 8 - 4) // columns
    time.sleep(1.0)
"""


def watched(open: ExitStack) -> LiveHistory:
    """Return the status of a page that is served to, and read by, other processes."""
    watch = LiveHistory("xyz")
    for history in watch.histories.values():
        t = -np.arange(history.capacity, 0.0, -1.0) * history.width
        history.add(np.column_stack([t, np.ones((len(t), len(history.names) - 1))]))
    server = open.enter_context(serving(Server(0, "", watch)))
    open.callback(server.tabs.clear)
    process = subprocess.Popen([sys.executable, "-I", "-c", LOOK, server.url], stderr=subprocess.DEVNULL)
    open.callback(process.kill)
    deaf = open.enter_context(socket.create_connection(server.server_address))
    deaf.sendall(b"GET /history HTTP/1.0\r\nHost: localhost\r\n\r\n")
    return watch


def measure(
    interval: str, seconds: float, page: bool = False, growing: bool = False
) -> tuple[np.ndarray, Run, int, int]:
    """Return the latency of each frame after the alignment in s, the run, and how many frames came and were lost."""
    with ExitStack() as open:
        return _measure(interval, seconds, watched(open) if page else None, growing)


def _measure(
    interval: str, seconds: float, watch: LiveHistory | None, growing: bool
) -> tuple[np.ndarray, Run, int, int]:
    master, slave = os.openpty()
    tty.setraw(slave)
    source = SOURCE | {"port": os.ttyname(slave)}
    config = Config.model_validate({"source": source, "filter": FILTER | {"update_interval": interval}})
    latencies: list[np.ndarray] = []
    faults, journal = Faults(), RunLog()
    sender, status = None, Status(faults=faults, axes=tuple("xyz"))
    status.listen()

    def tapped():
        nonlocal sender
        for chunk in config.source.chunks(ROWS, faults):
            if sender is None:
                sender = subprocess.Popen(
                    [sys.executable, __file__, "--send", str(master), str(seconds)], pass_fds=[master]
                )
            status.came(chunk)
            yield chunk
            if watch is not None:
                watch.report(status)
            if len(chunk) and chunk.t[-1] > 4.0:
                latencies.append(time.monotonic() - chunk["sent"])
            if sender.poll() is not None:
                return

    run = Run(config, journal, keep_model=True)
    status.sensor, status.m = run.model.tracked, run.model.m
    stream = epochs(read(config, journal.faults, stream=tapped()), run.model.update_interval)
    if growing:
        spline = registry().classes(ThermalMap)["spline"].model_validate({})
        stream = GrowingMap(config, spline, Path("unused.json")).through(stream)
    for stretch in run.over(stream):
        last = stretch
        status.updated(stretch)
        if watch is not None:
            watch.seen(stretch)
    run.last = last
    os.close(master)
    os.close(slave)
    lost = faults.found[LOST].count if LOST in faults.found else 0
    found = np.concatenate(latencies)
    return found, run, len(found), lost


def step_cost(run: Run) -> tuple[float, float]:
    """Return the cost of a filter step in s: within an array, and asked for alone."""
    from fusion_core.contracts import Transition
    from fusion_core.model import Measurement

    transition, measurement = run.last.model
    state = run.last.estimates.state
    costs = []
    for N, calls in ((20_000, 5), (1, 500)):
        F, Q = (a if a.ndim == 2 else a[0] for a in (transition.F, transition.Q))
        u = np.zeros((N, len(state.x)))
        z = np.zeros((N, measurement.z.shape[1]))
        arguments = (state, Transition(F, Q, u), Measurement(z, measurement.H, measurement.R, np.ones(N, dtype=bool)))
        estimate(*arguments, method="recursive")
        begun = time.perf_counter()
        for _ in range(calls):
            estimate(*arguments, method="recursive")
        costs.append((time.perf_counter() - begun) / calls / N)
    return costs[0], costs[1]


def compare(seconds: float, what: str, pairs: int = 5) -> None:
    """Without and with a page or a growing map, in turn: each pair sees the same other load on the machine."""
    names = ("p50 [ms]", "p99 [ms]", "p99.9 [ms]", "worst [ms]", "run [ms/s]", "process [ms/s]")
    table = Table(what, "frames", "lost", *names, title="1 kHz, 10 ms; latency, and CPU time of its thread and of all")
    measure("10 ms", 6.0)  # what is compiled is compiled here
    found: dict[bool, list[np.ndarray]] = {False: [], True: []}
    for k in range(pairs):
        for page in (False, True) if k % 2 else (True, False):
            before = np.array([time.thread_time(), time.process_time()])
            latencies, _, frames, lost = measure("10 ms", seconds, page and what == "page", page and what == "map")
            used = (np.array([time.thread_time(), time.process_time()]) - before) / seconds
            found[page].append(np.concatenate([np.percentile(latencies, (50, 99, 99.9, 100)), used]) * 1e3)
            cells = (f"{value:.2f}" for value in found[page][-1])
            table.add_row("yes" if page else "none", f"{frames:,}", str(lost), *cells)
    Console().print(table)
    differences = np.median(np.array(found[True]) - np.array(found[False]), axis=0)
    Console().print("median of the differences [ms]: " + ", ".join(f"{value:+.2f}" for value in differences))


def main(seconds: float) -> None:
    gc.collect()
    gc.freeze()  # as `driftlab live` does
    table = Table("update interval", "frames", "lost", "p50 [ms]", "p99 [ms]", "worst [ms]", title="Latency at 1 kHz")
    for interval in ("100 ms", "10 ms", "1 ms"):
        found, run, frames, lost = measure(interval, seconds)
        cells = (f"{np.percentile(found, q) * 1e3:.2f}" for q in (50, 99, 100))
        table.add_row(interval, f"{frames:,}", str(lost), *cells)
    inside, alone = step_cost(run)
    console = Console()
    console.print(table)
    console.print(
        f"filter step, {run.model.n} states: {inside * 1e6:.2f} us in an array, {alone * 1e6:.0f} us called alone"
    )


if __name__ == "__main__":
    if sys.argv[1:2] == ["--send"]:
        send(int(sys.argv[2]), float(sys.argv[3]))
    elif sys.argv[1:2] in (["--page"], ["--map"]):
        gc.collect()
        gc.freeze()
        compare(float(sys.argv[2]) if len(sys.argv) > 2 else 20.0, sys.argv[1].strip("-"))
    else:
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 30.0)
