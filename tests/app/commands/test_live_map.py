"""A thermal map that is fitted while the device still measures: `driftlab live --fit-map`."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
import yaml
from bench import FRAMING, Device, frame, paced
from command_line import driftlab
from units_at_rest import unit_at_rest

from driftlab.config import load_config, with_recording
from driftlab.live.growing_map import GrowingMap, GrowingMapStatus, with_coverage
from driftlab.maps.fit import fit_map
from fusion_core.chunk import Chunk
from fusion_core.contracts import ThermalMap
from fusion_core.faults import Faults
from fusion_core.host.registry import registry

DRIFTLAB = Path(sys.executable).with_name("driftlab")
RATE = 1  # of the device's own time; it sends 400 times as fast
LOW, HIGH = 0.0, 40.0
DEG_H = np.degrees(1) * 3600


@pytest.fixture
def bench(tmp_path):
    """A folder with a config without a map, and the device that it names."""
    device = Device(tmp_path)
    walk = {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}
    source = {"kind": "serial", "port": str(device.path), "interval": f"{1 / RATE} s", "framing": FRAMING}
    gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": walk}
    content = {
        "latitude": "40.9 deg",
        "heading": "0 deg",
        "source": source,
        "filter": {"update_interval": "1 s", "align": "60 s", "accel": None, "gyro": gyro},
    }
    (tmp_path / "live.yaml").write_text(yaml.safe_dump(content))
    yield tmp_path, device
    device.close()


def soak_frames(seconds):
    """Frames of a soak up and down again."""
    unit = unit_at_rest(
        seconds=seconds, rate=RATE, walk=1e-8, temperature=lambda t: HIGH - (HIGH - LOW) * np.abs(2 * t / seconds - 1)
    )
    return [frame(k, unit.gyro[k], unit.accel[k], unit.temperature[k]) for k in range(len(unit.t))]


def begin(folder, *args):
    command = [DRIFTLAB, "live", "live.yaml", "--record", "raw.h5", "--out", "out", "--json", *args]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def listening(run):
    """The lines until the device is listened to."""
    lines = []
    while not lines or lines[-1]["state"] == "getting ready":
        line = run.stdout.readline()
        assert line, run.stderr.read()
        lines.append(json.loads(line))
    return lines


def written(path):
    return registry().classes(ThermalMap)["spline"].model_validate({"path": str(path)}).load()


def of_the_recording(folder):
    """The map that `fit-map` fits to what was recorded."""
    config = with_recording(load_config(folder / "live.yaml"), str(folder / "raw.h5"))
    return fit_map(config, [], "spline", Faults())


def test_the_run_ends_when_sigma_is_reached_and_its_map_is_that_of_the_recording(bench):
    folder, device = bench
    wanted = ["--sigma", "3 deg/h", "--range", "5..35 degC", "--until-reached"]
    run = begin(folder, "--fit-map", "live.json", "--kind", "spline", *wanted)
    lines = listening(run)
    paced(device, soak_frames(6000), 400)
    out, errors = run.communicate(timeout=120)
    assert run.returncode == 0, errors
    lines += [json.loads(line) for line in out.splitlines()]
    assert "summary" in lines[-1]
    assert lines[-1]["map"]["reached"] is True
    maps = [line["map"] for line in lines if "map" in line]
    missing = [found["missing_degC"] for found in maps if found["curve"] and not found["reached"]]
    assert missing[0][-1][1] == 35.0, "the soak begins cold: what is missing is the warm end"
    not_yet = [found for found in maps if found["curve"] and not found["reached"]]
    all_seen = [found for found in not_yet if found["sigma_worst_rad_s"] <= 3 / DEG_H and found["samples"] >= 2626]
    assert len({found["sigma_worst_rad_s"] for found in all_seen}) <= 1, "of the fit before; the next one says reached"
    assert maps[-1]["samples"] > 1500, "35 degC is reached after 2,625 s"
    T = np.linspace(5, 35, 100)
    live, again = written(folder / "live.json"), of_the_recording(folder)
    assert live.record.samples == again.record.samples
    assert live.domain == pytest.approx(again.domain, abs=0.02)  # K; live, the temperature is that of blocks
    assert np.max(live.sigma(T)) <= 3.3 / DEG_H
    sigma = np.sqrt(np.mean(again.sigma(T) ** 2, axis=0))
    assert np.all(np.sqrt(np.mean((live.bias(T) - again.bias(T)) ** 2, axis=0)) < 0.3 * sigma)
    ratio = np.sqrt(np.mean(live.sigma(T) ** 2, axis=0)) / sigma  # one way up hardly tells a walk from a curve
    assert np.all((ratio > 0.5) & (ratio < 2)), ratio
    np.testing.assert_allclose(live.record.residual, again.record.residual, rtol=1e-3)


@pytest.mark.parametrize(("args", "message"), [
    (["--sigma", "3 deg/h"], "--sigma: is of a map that is fitted meanwhile; add --fit-map MAP"),
    (["--fit-map", "m.json"], "no thermal map is named in the config; add one under filter.gyro, or give --kind ("),
    (["--fit-map", "m.json", "--kind", "spline", "--until-reached"],
     "--until-reached: has no target, a sigma over a range was expected; give --sigma and --range"),
    (["--fit-map", "m.json", "--kind", "spline", "--sigma", "0 deg/h"],
     "--sigma '0 deg/h': is not above zero; write one like '3 deg/h'"),
    (["--fit-map", "m.json", "--kind", "spline", "--range", "35..5 degC"],
     "--range 35..5 degC: is no range; write the lower temperature first"),
    (["--fit-map", "m.json", "--kind", "spline", "--range", "5 to 35 degC"],
     "--range 5 to 35 degC: is no range of temperature; write e.g. --range '-20..50 degC'"),
    (["--fit-map", "live.yaml", "--kind", "spline"], "map live.yaml: is read here, and would be lost"),
])  # fmt: skip
def test_mistakes_are_named(bench, args, message):
    folder, _ = bench
    done = driftlab("live", "live.yaml", *args, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith(f"driftlab: {message}")


def test_what_is_missing_is_the_ends_and_the_holes():
    """Within 1 % of the range an end is reached; a hole is 5 % of it."""
    asked = GrowingMapStatus("spline", asked=(0.0, 50.0))
    T = np.concatenate([np.arange(10, 20, 0.1), np.arange(30, 49.6, 0.1)])
    found = with_coverage(asked, T, (10.0, 49.6), 300)
    assert [tuple(np.round(part, 6)) for part in found.missing] == [(0, 10), (19.9, 30)]
    assert found.coverage == pytest.approx(1 - 20.1 / 50)
    whole = with_coverage(asked, np.arange(-1, 51, 0.5), (-1.0, 51.0), 300)
    assert whole.missing == ()
    assert whole.coverage == 1
    assert with_coverage(asked, np.array([60.0, 61.0]), (60.0, 61.0), 2).coverage == 0


class Breaks(registry().classes(ThermalMap)["spline"]):
    """A map whose author made a mistake."""

    def fit(self, *_):
        raise ZeroDivisionError("a mistake")


def test_a_map_that_breaks_leaves_the_filter_alone_and_is_told_at_the_end(bench):
    folder, _ = bench
    growing = GrowingMap(load_config(folder / "live.yaml"), Breaks(), folder / "m.json")
    chunk = Chunk(np.arange(3.0), {})
    stream = growing.through([chunk] * 3)
    assert next(stream) is chunk
    growing._thread.join(timeout=60)
    assert list(stream) == [chunk, chunk]
    assert growing._came.qsize() <= 2, "what nobody takes is not kept"
    assert growing.status.why == "a mistake"
    with pytest.raises(ZeroDivisionError, match="a mistake"):
        growing.finish()
    assert not growing.path.exists()


class Counts(registry().classes(ThermalMap)["spline"]):
    """A map that counts how often it is fitted, and takes its time."""

    made: ClassVar[list[int]] = []

    def fit(self, T, bias, provenance):
        self.made.append(len(T))
        time.sleep(0.05)
        return super().fit(T, bias, provenance)


def test_once_the_device_is_let_go_the_map_is_fitted_once(bench, monkeypatch):
    """Rows that wait then, be they many, are gathered and not fitted again and again."""
    folder, _ = bench
    monkeypatch.setattr("driftlab.live.growing_map.PAUSE", (0.0, 0.0))
    monkeypatch.setattr("driftlab.live.growing_map.SHARE", 0)
    unit = unit_at_rest(seconds=3000, rate=RATE, walk=1e-8, temperature=lambda t: 20 + 20 * np.abs(t / 1500 - 1))
    whole = Chunk(
        unit.t, {"gyro": unit.gyro, "accel": unit.accel, "temperature": unit.temperature, "tau": np.ones(3000)}
    )
    growing = GrowingMap(load_config(folder / "live.yaml"), Counts(), folder / "m.json")
    for _ in growing.through(whole.part(k, k + 60) for k in range(0, 3000, 60)):
        pass
    begun = len(Counts.made)
    assert growing.finish().record.samples == 3000
    assert len(Counts.made) <= begun + 2, "one may have begun before"
    assert growing.path.exists()


def test_a_shell_that_has_ctrl_c_ignored_is_told_what_ends_the_run(bench):
    folder, device = bench
    command = [DRIFTLAB, "live", "live.yaml", "--out", "out", "--json", "--fit-map", "m.json", "--kind", "spline"]
    code = "import os, signal, sys; signal.signal(signal.SIGINT, signal.SIG_IGN); os.execv(sys.argv[1], sys.argv[1:])"
    run = subprocess.Popen(
        [sys.executable, "-c", code, *command], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    listening(run)
    sender = paced(device, soak_frames(1200), 400)
    while json.loads(run.stdout.readline())["samples"] < 600:
        pass
    run.send_signal(signal.SIGINT)
    sender.join()
    time.sleep(1)
    assert run.poll() is None
    run.send_signal(signal.SIGTERM)
    _, errors = run.communicate(timeout=60)
    assert run.returncode == 0, errors
    assert errors == f"Ctrl-C (SIGINT) is ignored here, as a shell's background job; end it with: kill {run.pid}\n"
    assert written(folder / "m.json").record.samples > 600
