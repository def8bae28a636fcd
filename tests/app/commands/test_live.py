"""`driftlab live` on a device behind a pty: what it says, what it leaves, and what is left when it is killed."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import command_line
import h5py
import numpy as np
import pytest
import yaml
from bench import FRAMING, Device, paced, unit_frames

DRIFTLAB = Path(sys.executable).with_name("driftlab")
RATE = 200


@pytest.fixture
def bench(tmp_path):
    """A folder with a config, and the device that it names."""
    device = Device(tmp_path)
    write_config(tmp_path, device)
    yield tmp_path, device
    device.close()


def write_config(folder, device, **changes):
    lag = {"kind": "relaxation", "tau": "10 s", "coefficients": [1e-5, -1e-5, 0.0], "initial": [1e-5, 1e-5, 1e-5]}
    bias = {"kind": "thermal_derivative", "walk": "1.5e-4 deg/s/sqrt(s)", "repeatability": "1 deg/s", "effects": [lag]}
    content = {
        "latitude": "40.9 deg",
        "source": {"kind": "serial", "port": str(device.path), "interval": f"{1 / RATE} s", "framing": FRAMING},
        "filter": {
            "align": "2 s",
            "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias},
            "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
        },
    }
    (folder / "live.yaml").write_text(yaml.safe_dump(content | changes))


def begin(folder, *args):
    command = [DRIFTLAB, "live", "live.yaml", "--record", "raw.h5", "--out", "out", "--json", *args]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def driftlab(folder, *args):
    done = command_line.driftlab(*args, cwd=folder)
    assert done.returncode == 0, done.stderr


def same(a, b):
    """Both runs' estimates are equal: to 1e-12 of the values and of their deviation."""
    with h5py.File(a) as one, h5py.File(b) as two:
        assert set(one) == set(two)
        np.testing.assert_array_equal(one["t"][:], two["t"][:])
        np.testing.assert_array_equal(one["used"][:], two["used"][:])
        for name in ("bias", "bias_sigma", "coast", "x"):
            scale = 1e-12 * (np.nanmax(np.abs(two[name][:])) + np.nanmax(two["bias_sigma"][:]))
            np.testing.assert_allclose(one[name][:], two[name][:], rtol=0, atol=scale)


def until(run, wanted):
    while line := run.stdout.readline():
        if wanted(found := json.loads(line)):
            return found
    raise AssertionError("the run ended before")


def sending(device, seconds, seed=0):
    return paced(device, unit_frames(seconds, RATE, seed), RATE)


@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM])
def test_a_live_run_ends_cleanly_and_its_recording_gives_it_again(bench, end):
    folder, device = bench
    run = begin(folder)
    until(run, lambda line: line["state"] == "nothing came so far")  # the port is open
    sending(device, 60)
    lines = [json.loads(run.stdout.readline())]
    while not (lines[-1]["aligned"] and lines[-1]["t_s"] > 5):
        lines.append(json.loads(run.stdout.readline()))
    run.send_signal(end)
    out, errors = run.communicate(timeout=60)
    assert run.returncode == 0, errors
    last, summary = lines[-1], json.loads(out.splitlines()[-1])["summary"]
    assert 0.8 * RATE < last["samples_per_s"] < 1.2 * RATE
    assert last["lost"] == 0
    assert not last["moving"]
    assert last["temperature_degC"] == pytest.approx(25.0)
    assert len(last["bias_rad_s"]) == len(last["sigma_rad_s"]) == 3
    assert 0.2 < last["nis_per_component"] < 5
    assert summary["updates"]["used"] == summary["updates"]["count"] > 40
    assert {path.name for path in (folder / "out").iterdir()} == {"estimates.h5", "summary.json", "report.html"}
    driftlab(folder, "run", "live.yaml", "--input", "raw.h5", "--out", "again", "--detail")
    same(folder / "out" / "estimates.h5", folder / "again" / "estimates.h5")


def test_a_pulled_cable_is_predicted_across(bench):
    folder, device = bench
    run = begin(folder)
    until(run, lambda line: line["state"] == "nothing came so far")  # the port is open
    stop, frames = threading.Event(), unit_frames(120, RATE)
    sender = paced(device, frames, RATE, stop)
    until(run, lambda line: line["state"] == "at rest" and line["t_s"] > 3)
    stop.set()
    sender.join()
    device.unplug()
    unplugged = re.compile(rf"no data for \d+ s: unplugged, waiting for {device.path}")
    until(run, lambda line: unplugged.fullmatch(line["state"]) and line["level"] == "bad")
    device.plug()
    paced(device, frames[len(frames) // 2 :], RATE)  # its counter says nothing of how long it was away
    back = until(run, lambda line: line["state"] == "at rest" and not line["no_data_s"])
    until(run, lambda line: line["t_s"] > back["t_s"] + 4)
    run.send_signal(signal.SIGINT)
    out, errors = run.communicate(timeout=60)
    assert run.returncode == 0, errors
    summary = json.loads(out.splitlines()[-1])["summary"]
    assert summary["faults"]["times that the connection was lost"]["count"] == 1
    with h5py.File(folder / "out" / "estimates.h5") as file:
        t, sigma, used = file["t"][:], file["bias_sigma"][:], file["used"][:]
    gap = int(np.argmax(np.diff(t)))
    assert t[gap + 1] - t[gap] > 2.0
    assert len(t) - gap > 20  # it goes on
    assert np.all(used)
    assert np.all(sigma[-1] < sigma[gap])


def test_what_was_flushed_is_readable_after_kill_and_the_run_goes_on(bench):
    """kill -9 three times at random moments, the device sending on; each time with --resume."""
    folder, device = bench
    rng = np.random.default_rng(int(time.time()))
    stop = threading.Event()
    sender = paced(device, unit_frames(90, RATE), RATE, stop)
    kept = 0
    for k in range(3):
        run = begin(folder, *(["--resume"] if k else []))
        while (line := run.stdout.readline()) and json.loads(line)["recorded"] <= kept:
            pass
        time.sleep(rng.uniform(0, 1.5))
        run.send_signal(signal.SIGKILL)
        out, _ = run.communicate()
        known = [json.loads(one)["recorded"] for one in out.splitlines() if one.endswith("}")]
        driftlab(folder, "check", "live.yaml", "--input", "raw.h5")
        with h5py.File(folder / "raw.h5", "r", swmr=True) as file:
            rows = min(len(data) for data in file.values())
            assert np.all(np.diff(file["time"][:rows]) > 0)
        assert rows >= max([kept, *known])
        kept = rows
    run = begin(folder, "--resume", "--duration", "4 s")
    _, errors = run.communicate(timeout=60)
    stop.set()
    sender.join(timeout=10)
    assert run.returncode == 0, errors
    driftlab(folder, "run", "live.yaml", "--input", "raw.h5", "--out", "again", "--detail")
    same(folder / "out" / "estimates.h5", folder / "again" / "estimates.h5")


@pytest.mark.parametrize(("args", "message"), [
    (["live", "file.yaml"], "source: a live one is needed and this is csv; use kind: serial, or `driftlab run`"),
    (["run", "live.yaml"], "source: kind serial is live; use `driftlab live`, or name a recording with --input"),
    (["live", "live.yaml", "--resume"], "--resume: a live run can only go on with its recording; add --record FILE"),
    (["live", "live.yaml", "--record", "live.yaml"], "--record live.yaml: is there already; name another file"),
    (["live", "live.yaml", "--duration", "10"], "'10' has no unit"),
])  # fmt: skip
def test_mistakes_are_named(bench, args, message):
    folder, device = bench
    write_config(folder, device)
    content = yaml.safe_load((folder / "live.yaml").read_text())
    content["source"] = {"kind": "csv", "channels": {"time": {"path": "t", "unit": "s"}}}
    (folder / "file.yaml").write_text(yaml.safe_dump(content))
    done = command_line.driftlab(*args, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith(f"driftlab: {message}")
    assert os.listdir(folder)
