"""`driftlab live` when nothing that it can use comes, when it is killed, and when no one reads what it says."""

import json
import os
import re
import select
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import h5py
import pytest
from bench import live_bench, paced, unit_frames
from command_line import driftlab

from driftlab.commands.live import Live, _reporting
from driftlab.config import load_config
from driftlab.live.status import Status

DRIFTLAB = Path(sys.executable).with_name("driftlab")
RATE = 100


@pytest.fixture
def bench(tmp_path):
    with live_bench(tmp_path, RATE) as found:
        yield found


def begin(folder, *args, **how):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | how
    return subprocess.Popen([DRIFTLAB, "live", "live.yaml", "--out", "out", *args], cwd=folder, **pipes)


def noise(device, stop):
    """Send what a wrong baud rate looks like."""

    def run():
        while not stop.wait(0.02):
            device.send(os.urandom(40).replace(b"\xa5", b"\x00"), wait=False)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_noise_is_spoken_of_and_the_run_ends(bench):
    folder, device = bench
    stop = threading.Event()
    sender = noise(device, stop)
    run = begin(folder, "--json", "--record", "raw.h5", "--duration", "4 s")
    first = json.loads(run.stdout.readline())
    assert first["state"] == "getting ready", "before anything is compiled or read"
    out, errors = run.communicate(timeout=60)
    stop.set()
    sender.join()
    assert run.returncode == 1
    last = json.loads(out.splitlines()[-1])
    state = re.fullmatch(r"no data for \d+ s: ([\d,]+) bytes, no frame; check baudrate and sync", last["state"])
    assert int(state[1].replace(",", "")) > 1000
    assert last["level"] == "bad"
    assert errors.count("\n") == 1
    assert errors.startswith(f"driftlab: {device.path}: not one sample came in ")
    assert "bytes, no frame); check that the device is on, and source.baudrate and source.framing" in errors
    assert {path.name for path in folder.iterdir()} == {"live.yaml", "ttyDEVICE"}, "nothing came and nothing is left"


def test_silence_is_spoken_of_on_the_terminal_too_and_ctrl_c_ends_it(bench):
    folder, _ = bench
    pytest.importorskip("pty", reason="terminals are those of POSIX")
    master, slave = os.openpty()
    run = begin(folder, stdout=slave)
    os.close(slave)
    seen, begun = b"", time.monotonic()
    while b"nothing came so far" not in seen and time.monotonic() - begun < 30:
        if select.select([master], [], [], 0.1)[0]:
            seen += os.read(master, 65_536)
    assert b"nothing came so far" in seen
    while not re.search(rb"no data for [3-9] s", seen) and time.monotonic() - begun < 30:
        if select.select([master], [], [], 0.1)[0]:
            seen += os.read(master, 65_536)
    assert re.search(rb"no data for [3-9] s: nothing came so far", seen), "the screen goes on while nothing comes"
    run.send_signal(signal.SIGINT)
    threading.Thread(target=drain, args=(master,), daemon=True).start()
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 1
    assert "not one sample came in" in errors
    assert "(nothing came so far); check that the device is on" in errors


def drain(number):
    try:
        while os.read(number, 65_536):
            pass
    except OSError:
        pass


def until(run, wanted):
    while True:
        line = json.loads(run.stdout.readline())
        if wanted(line):
            return line


def refused(folder, *args):
    done = driftlab(*args, cwd=folder)
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_what_was_measured_outlives_kill_and_other_commands(bench):
    folder, device = bench
    stop = threading.Event()
    sender = paced(device, unit_frames(120, RATE), RATE, stop)
    run = begin(folder, "--json", "--record", "raw.h5")
    until(run, lambda line: line["aligned"] and line["t_s"] > 4)
    message = refused(folder, "run", "live.yaml", "--input", "raw.h5", "--out", "out")
    holder = f"`driftlab live live.yaml --out out --json --record raw.h5` (process {run.pid} on "
    assert f"--out out: is being written by {holder}" in message
    run.kill()
    run.communicate()
    for args in (("live", "live.yaml"), ("run", "live.yaml", "--input", "raw.h5")):
        message = refused(folder, *args, "--out", "out")
        assert "out.partial holds what a device measured (`driftlab live`); go on with --resume" in message
    with h5py.File(folder / "out.partial" / "estimates.h5", "r", swmr=True) as file:
        rows = len(file["t"])
    assert rows > 10
    # nobody reads on: the run ends as with Ctrl-C, and its results are whole
    run = begin(folder, "--json", "--record", "raw.h5", "--resume")
    until(run, lambda line: line["aligned"])
    run.stdout.close()
    errors = run.stderr.read()
    run.stderr.close()
    assert run.wait(timeout=60) == 1
    stop.set()
    sender.join(timeout=10)
    assert errors.startswith("driftlab: standard output was closed before everything was printed; files are written")
    with h5py.File(folder / "out" / "estimates.h5") as file:
        assert len(file["t"]) > rows
        assert file.attrs["live"]
    message = refused(folder, "run", "live.yaml", "--input", "raw.h5", "--out", "out")
    assert "out holds what a device measured (`driftlab live`); name another folder, or give --force" in message


def test_a_disk_that_fills_up_ends_the_run_and_keeps_what_was_flushed(bench):
    resource = pytest.importorskip("resource", reason="limits of a process are those of POSIX")
    folder, device = bench
    stop = threading.Event()
    sender = paced(device, unit_frames(60, RATE), RATE, stop)
    limit = {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (700_000, 700_000))}
    run = begin(folder, "--json", "--record", "raw.h5", **limit)
    out, errors = run.communicate(timeout=60)
    stop.set()
    sender.join(timeout=10)
    assert run.returncode == 1
    assert errors.count("\n") == 1
    assert (
        "cannot be written (File too large); make room or name another place, what was written so far is in" in errors
    )
    recorded = json.loads(out.splitlines()[-1])["recorded"]
    with h5py.File(folder / "raw.h5", "r") as file:
        assert min(len(data) for data in file.values()) >= recorded


def test_at_the_end_each_note_is_said_once(bench):
    """Reports of the source are then among the notes of the run, which are shown until all is written."""
    folder, device = bench
    frames = unit_frames(60, RATE)
    run = Live(load_config(folder / "live.yaml"), duration=5.0)
    paced(device, [one for k, one in enumerate(frames) if k % 50], RATE)
    result = run.to_folder(folder / "out")
    assert len(run.status.lines()) == len(set(run.status.lines())) > 0
    assert set(run.status.lines()) <= set(result.lines())


def test_what_follows_the_last_screen_in_a_file_begins_a_line(capsys):
    run = SimpleNamespace(report=None)
    with _reporting(run, False, None):
        run.report(Status())
    print("next")
    assert capsys.readouterr().out.splitlines()[-1] == "next"
