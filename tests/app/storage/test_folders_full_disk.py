"""No room, no right, no reader: one sentence, an exit status, and what was flushed can be read. Real processes."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import h5py
import pytest
from units_at_rest import unit_at_rest

from driftlab.storage.folders import output_folder

DRIFTLAB = Path(sys.executable).with_name("driftlab")
CONFIG = """
extends: mems_crs05
latitude: 40.9 deg
source:
  kind: hdf5
  channels:
    time:        {path: time, unit: s}
    gyro:        {path: gyro, unit: rad/s}
    accel:       {path: accel, unit: m/s^2}
    temperature: {path: temperature, unit: degC}
filter:
  gyro:
    bias: {kind: thermal_derivative, walk: 1e-4 deg/s/sqrt(s), map: {kind: polynomial, order: 3, path: map.json}}
"""
TWIN = "latitude: 40.9 deg\nsource: {kind: synthetic, rate: 100 Hz, duration: 900 s, latitude: 40.9 deg}\n"
COMMANDS = {
    "run": ("run", "plain.yaml", "--input", "soak.h5", "--out", "disk/out"),
    "allan": ("allan", "unit.yaml", "--input", "soak.h5", "--out", "disk/out"),
    "compare": ("compare", "plain.yaml", "other.yaml", "--input", "soak.h5", "--out", "disk/out"),
    "explain": ("explain", "unit.yaml", "--calibration", "soak.h5", "--train", "soak.h5", "--holdout", "day.h5",
                "--out", "disk/out"),
    "fit-map": ("fit-map", "unit.yaml", "--input", "soak.h5", "--out", "disk/map.json"),
    "simulate": ("simulate", "twin.yaml", "--out", "disk/twin.h5"),
    "simulate csv": ("simulate", "twin.yaml", "--out", "disk/twin.csv"),
}  # fmt: skip
ROOM = {"run": 200, "simulate": 200, "simulate csv": 200}  # KiB; of the others not even a page


def driftlab(*args, cwd, **how):
    return subprocess.run([DRIFTLAB, *args], cwd=cwd, capture_output=True, text=True, timeout=60, **how)


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    folder = tmp_path_factory.mktemp("bench")
    (folder / "unit.yaml").write_text(CONFIG)
    plain = CONFIG.replace("thermal_derivative", "random_walk").replace(
        ", map: {kind: polynomial, order: 3, path: map.json}", ""
    )
    (folder / "plain.yaml").write_text(plain)
    (folder / "other.yaml").write_text(plain.replace("1e-4", "2e-4"))
    (folder / "twin.yaml").write_text(TWIN)
    for name, seed in (("soak.h5", 0), ("day.h5", 1)):
        unit_at_rest(seconds=600, temperature=lambda t: 20 + t / 60, seed=seed).write(folder / name)
    (folder / "disk").mkdir()
    return folder


def limited(kib):
    """Limit the size of every file that a command writes."""
    resource = pytest.importorskip("resource", reason="limits of a process are those of POSIX")
    return {"preexec_fn": lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (kib << 10, kib << 10))}


@pytest.fixture
def disk(bench):
    """Mount a disk of so many KiB on `disk`; where that is not allowed, limit the size of every file instead."""
    made = []

    def of(kib):
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={max(kib, 4)}k", "tmpfs", bench / "disk"], check=False
        )
        if done.returncode:
            return limited(kib)
        made.append(bench / "disk")
        if kib == 0:
            (bench / "disk" / "full").write_bytes(bytes(4096))
        return {}

    yield of
    for place in made:
        subprocess.run(["umount", place], check=True)
    subprocess.run(["find", bench / "disk", "-mindepth", "1", "-delete"], check=True)


def said(done, code=1):
    assert done.returncode == code, (done.returncode, done.stderr)
    assert done.stderr.startswith("driftlab: ")
    assert done.stderr.count("\n") == 1, done.stderr
    return done.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_a_full_disk_is_said_in_one_sentence(bench, disk, name):
    done = driftlab(*COMMANDS[name], cwd=bench, **disk(ROOM.get(name, 0)))
    message = said(done)
    assert "cannot be written (" in message
    assert "No space left on device" in message or "File too large" in message
    if name == "run":
        with h5py.File(bench / "disk" / "out.partial" / "estimates.h5", "r", swmr=False) as file:
            assert set(file) >= {"t", "bias"}
    assert not (bench / "disk" / "out").exists()


@pytest.mark.parametrize("name", ["run", "simulate"])
def test_a_limit_of_a_files_size_too(bench, name):
    done = driftlab(*COMMANDS[name], cwd=bench, **limited(200))
    assert "cannot be written (File too large); make room" in said(done)
    subprocess.run(["find", bench / "disk", "-mindepth", "1", "-delete"], check=True)


def test_a_read_only_place_is_refused_before_the_work(bench, disk):
    if disk(200):
        pytest.skip("nothing can be mounted here")
    subprocess.run(["mount", "-o", "remount,ro", bench / "disk"], check=True)
    for name in ("run", "fit-map"):
        begun = time.monotonic()
        assert "cannot be written (Read-only file system)" in said(driftlab(*COMMANDS[name], cwd=bench))
        assert time.monotonic() - begun < 20


def test_a_mount_point_is_written_to(bench, disk):
    if disk(2000):
        pytest.skip("nothing can be mounted here")
    (bench / "disk" / "lost+found").mkdir()
    for text in ("one", "two"):
        text = f'<!doctype html><meta name="generator" content="driftlab 0">{text}'
        with output_folder(bench / "disk", "compare") as folder:
            (folder / "summary.json").write_text('{"schema": 1, "driftlab": "0"}')
            (folder / "report.html").write_text(text)
        assert sorted(os.listdir(bench / "disk")) == ["lost+found", "report.html", "summary.json"]
        assert (bench / "disk" / "report.html").read_text() == text


@pytest.mark.parametrize(("redirect", "message"), [
    (" | true", "standard output was closed before everything was printed"),
    (" > /dev/full", "standard output: cannot be read or written (No space left on device)"),
])  # fmt: skip
def test_no_one_reads_what_is_printed(bench, redirect, message):
    command = f"{DRIFTLAB} check plain.yaml --json {redirect}; exit ${{PIPESTATUS[0]}}"
    done = subprocess.run(["bash", "-c", command], cwd=bench, capture_output=True, text=True, timeout=60)
    assert message in said(done)


def test_after_a_defect_the_process_ends(bench):
    """Also where a thread is in the middle of HDF5 then, for whose lock h5py would wait at the end."""
    code = """
import sys, threading, time
import h5py
from h5py._objects import phil
from driftlab.commands import run as filtering
from driftlab.cli import main
def defect(*args, **how):
    file = h5py.File("soak.h5")
    data = file["gyro"]
    def busy():
        with phil:
            time.sleep(1e6)
    threading.Thread(target=busy, daemon=True).start()
    time.sleep(0.5)
    raise ZeroDivisionError("a defect")
filtering.run = defect
sys.argv = ["driftlab", "run", "plain.yaml", "--input", "soak.h5", "--out", "defect"]
main()
"""
    done = subprocess.run([sys.executable, "-c", code], cwd=bench, capture_output=True, text=True, timeout=60)
    assert done.returncode == 1
    assert done.stderr.startswith("Traceback")
    assert "ZeroDivisionError: a defect" in done.stderr


def test_an_interrupt_ends_with_130(bench):
    command = [DRIFTLAB, "explain", *COMMANDS["explain"][1:-1], "interrupted"]
    run = subprocess.Popen(command, cwd=bench, stderr=subprocess.PIPE, text=True)
    while not (bench / "interrupted.partial").exists():
        time.sleep(0.05)
    for _ in range(60):  # one that arrives within a callback of a library is lost, as it is for a person
        run.send_signal(signal.SIGINT)
        with suppress(subprocess.TimeoutExpired):
            run.wait(timeout=1)
            break
    errors = run.communicate(timeout=60)[1]
    assert run.returncode == 130
    assert "driftlab: interrupted; what was written so far is in the folder with the suffix .partial" in errors


def test_fit_map_does_not_write_onto_what_it_reads_or_a_device(bench):
    before = (bench / "soak.h5").read_bytes()
    done = driftlab("fit-map", "unit.yaml", "--input", "soak.h5", "--out", "soak.h5", cwd=bench)
    assert "is read here, and would be lost" in said(done, 2)
    done = driftlab("fit-map", "unit.yaml", "--input", "soak.h5", "--out", "/dev/null", cwd=bench)
    assert "exists, and nothing in it says" in said(done, 2)
    assert (bench / "soak.h5").read_bytes() == before
    assert Path("/dev/null").is_char_device()
