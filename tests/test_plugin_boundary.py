"""Plugins cannot hurt: distributions that are installed beside driftlab, good ones and bad ones, all at once."""

import json
import os
import re
import subprocess
import sys
import threading
from contextlib import suppress
from pathlib import Path

import h5py
import numpy as np
import pytest
import third_party
import yaml
from bench import Device
from command_line import Elsewhere
from units_at_rest import unit_at_rest
from wheels import install, wheel

from driftlab.filtering.checkpoint import write_checkpoint

DRIFTLAB = Path(sys.executable).with_name("driftlab")
BAD = {  # distribution: source of its only module
    "aaa-displacing": third_party.DISPLACING,
    "aaa-exiting": third_party.EXITING,
    "aaa-exiting-hook": third_party.EXITING_HOOK,
    "aaa-field": third_party.BAD_FIELD,
    "aaa-later": third_party.OTHER_CONTRACT,
    "aaa-taps": third_party.TAPS,
    "driftlab-acme": third_party.WRONG,
}
ACME = r"\(driftlab-acme 6\.6\.6\)"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("boundary")
    wheels = []
    for name, source in BAD.items():
        module = name.replace("-", "_")
        wheels.append(wheel(folder, name, "6.6.6", {f"{module}.py": source}, {module: module}))
    files = {"acme_whole.py": third_party.WHOLE, "acme_x1.yaml": third_party.PRODUCT}
    wheels.append(wheel(folder, "zzz-whole", "1.2.3", files, {"whole": "acme_whole"}))
    install(folder / "site", wheels)
    return folder / "site"


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Two minutes at rest, the temperature moving."""
    path = tmp_path_factory.mktemp("recording") / "rest.h5"
    unit = unit_at_rest(seconds=120, walk=1e-9, temperature=lambda t: 25 + t / 20)
    with h5py.File(path, "w") as file:
        file["time"], file["temperature"] = unit.t, unit.temperature
        file["gyro"], file["accel"] = np.rad2deg(unit.gyro), unit.accel / 9.80665
    return path


@pytest.fixture(scope="module")
def environment(site):
    beside = os.environ.get("PYTHONPATH")
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *([beside] if beside else [])])}


@pytest.fixture(scope="module")
def beside(environment):
    """The process in which the distributions are installed."""
    with Elsewhere(environment) as found:
        yield found


@pytest.fixture
def driftlab(environment, beside, tmp_path):
    def call(*args, status=0, **more):
        if args[0] == "live":  # whose threads end with a process of its own
            how = {"env": environment, "cwd": tmp_path, "capture_output": True, "text": True, "timeout": 120}
            done = subprocess.run([DRIFTLAB, *map(str, args)], **how)
        else:
            done = beside.driftlab(*args, cwd=tmp_path, **more)
        assert done.returncode == status, done.stderr
        return done.stdout if status == 0 else done.stderr

    return call


def config(folder, recording, bias=None, source=None, **gyro):
    channels = {
        "time": {"path": "time", "unit": "s"},
        "gyro": {"path": "gyro", "unit": "deg/s"},
        "temperature": {"path": "temperature", "unit": "degC"},
    }
    walk = {"kind": "random_walk", "walk": "1e-4 deg/s/sqrt(s)"}
    settings = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias or walk, **gyro}
    content = {
        "source": source or {"kind": "hdf5", "path": str(recording), "channels": channels},
        "filter": {"align": "10 s", "gyro": settings, "accel": None},
    }
    (folder / "a.yaml").write_text(yaml.safe_dump(content))


def is_one_line(stderr, pattern):
    """Assert that a message is one line that begins so, names its plugin and says what to do."""
    assert "Traceback" not in stderr
    (line,) = stderr.splitlines()
    assert re.match(f"driftlab: {pattern}", line), line
    assert "; " in line


# what loading finds


@pytest.fixture(scope="module")
def rows(beside, site):
    return json.loads(beside.driftlab("plugins", "--json", cwd=site).stdout)


def of(rows, **wanted):
    return [row for row in rows if all(row[key] == value for key, value in wanted.items())]


def test_a_kind_that_is_taken_is_refused_by_who_came_second(rows, driftlab, recording, tmp_path):
    (ours,) = of(rows, kind="random_walk", error=None)
    assert ours["distribution"] == "driftlab"
    (theirs,) = of(rows, kind="random_walk", distribution="aaa-displacing")
    assert theirs["error"].startswith(
        "PluginError: kind 'random_walk' is taken by fusion_plugins.bias_models.random_walk"
    )
    assert "aaa-displacing 6.6.6 came second" in theirs["error"]
    (product,) = of(rows, kind="mems_crs05", distribution="aaa-displacing")
    assert "is taken by driftlab.products" in product["error"]
    config(tmp_path, recording)
    summary = json.loads(driftlab("run", "a.yaml", "--json"))
    assert all(item["distribution"] == "driftlab" for item in summary["plugins"])


def test_an_end_of_the_program_is_an_error_of_one_plugin(rows):
    (at_import,) = of(rows, distribution="aaa-exiting")
    assert at_import["error"].startswith("SystemExit")
    (in_hook,) = of(rows, distribution="aaa-exiting-hook")
    assert in_hook["error"] == "SystemExit: no licence"


@pytest.mark.parametrize("kind", ["acme_socket", "acme_undefined", "acme_unwritable"])
def test_a_field_that_no_config_can_hold_is_found_when_loading(rows, driftlab, kind, tmp_path, recording):
    (row,) = of(rows, kind=kind)
    assert "no config can hold it" in row["error"]
    assert json.loads(driftlab("schema"))["properties"]
    config(tmp_path, recording, source={"kind": kind})
    message = driftlab("check", "a.yaml", status=2)
    assert f"kind '{kind}' is installed but broken" in message


def test_another_version_of_the_contract_is_refused_with_both_numbers(rows):
    (row,) = of(rows, distribution="aaa-later")
    assert "was written for version 7 of the contract Source, version 1 is spoken here" in row["error"]
    (old,) = of(rows, kind="old")  # who states none speaks the first
    assert "was written for version 1 of the contract Tap, version 2 is spoken here" in old["error"]


# what plugins do


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("transition raises", "transition: ZeroDivisionError: division by zero; mend or remove the plugin"),
        ("transition exits", "transition: SystemExit; mend or remove"),
        ("transition exits with 0", "transition: SystemExit: 0; mend or remove"),
        ("gyro is written", "transition: ValueError: assignment destination is read-only; what a plugin is given"),
        ("time is written", "transition: ValueError: assignment destination is read-only"),
        ("a channel is replaced", "transition: TypeError: 'mappingproxy' object does not support item assignment"),
        ("the one before is written", "transition: ValueError: assignment destination is read-only"),
        ("memory is written", "transition: ValueError: assignment destination is read-only"),
        ("Q is indefinite", "Q is not a covariance"),
        ("F is too wide", r"F has shape \(4, 4\), its 3 labels ask for \(3, 3\)"),
        ("u is too short", "the drift u has shape"),
        ("u is NaN", "the drift u is not finite"),
        ("F is a list", "F is a list, an array of numbers was expected"),
        ("no memory", "transition answers a Transition, a pair"),
        ("six states without C", r"has 6 labels for 3 axes and no C; a C \(3, 6\) says"),
        ("prior raises", "prior: KeyError: 'prior'"),
        ("prior is NaN", "prior x is not finite"),
        ("prior is lopsided", "prior P is not a covariance"),
        ("prior is too short", r"prior x has shape \(2,\)"),
        ("requires raises", "requires: AttributeError: requires what"),
    ],
)
def test_a_bias_model_that_goes_wrong_is_named(driftlab, tmp_path, recording, how, message):
    config(tmp_path, recording, {"kind": "acme_bias", "how": how})
    is_one_line(driftlab("run", "a.yaml", status=1), f"acme_bias {ACME}: {message}")
    assert not (tmp_path / "driftlab_out").exists()


def test_the_traceback_is_there_for_who_asks(driftlab, tmp_path, recording):
    config(tmp_path, recording, {"kind": "acme_bias", "how": "transition raises"})
    for shown in (
        driftlab("run", "a.yaml", "--debug", status=1),
        driftlab("run", "a.yaml", status=1, DRIFTLAB_DEBUG="1"),
    ):
        assert "driftlab_acme.py" in shown
        assert shown.splitlines()[-1].startswith("driftlab: acme_bias (driftlab-acme 6.6.6): transition")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("prior is none", "prior is a NoneType, a State was expected"),
        ("equations are none", "equations answers a NoneType, a pair of the steps and the measurement was expected"),
        ("H is too large", r"H has shape \(4, 7\), its 1 states, 1 components and \d+ epochs ask for \(1, 1\) or"),
        ("R is negative", "R is not a covariance"),
        ("z is short", r"z has shape \(\d+, 1\)"),
    ],
)
def test_a_measurement_model_that_goes_wrong_is_named(driftlab, tmp_path, recording, how, message):
    config(tmp_path, recording)
    content = yaml.safe_load((tmp_path / "a.yaml").read_text())
    walk = {"kind": "random_walk", "walk": "1e-4 K/sqrt(s)", "axes": ["probe"]}
    rig = {"kind": "acme_rig", "how": how, "channel": "probe", "align": "10 s", "noise": "1 mK/sqrt(Hz)", "bias": walk}
    channels = content["source"]["channels"]
    channels["probe"] = channels["temperature"]
    (tmp_path / "a.yaml").write_text(yaml.safe_dump({"source": content["source"], "filter": rig}))
    is_one_line(driftlab("run", "a.yaml", status=1), f"acme_rig {ACME}: {message}")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("fit raises", r"fit: ValueError: two\\x0alines; mend or remove the plugin"),
        ("fit exits", "fit: SystemExit: 3; mend"),
        ("fit writes T", "fit: ValueError: output array is read-only; what a plugin is given is shared"),
        ("fit writes bias", "fit: ValueError: assignment destination is read-only"),
        ("fit gives nothing", "the fitted map is a NoneType, a FittedMap was expected"),
    ],
)
def test_a_map_that_cannot_be_fitted_is_named(driftlab, tmp_path, recording, how, message):
    config(tmp_path, recording, calibration={"kind": "acme_map", "how": how})
    is_one_line(driftlab("fit-map", "a.yaml", "--out", "map.json", status=1), f"acme_map {ACME}: {message}")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("read raises", "read: KeyError: 'knots'; mend or remove the plugin"),
        ("curve is NaN", "its curve is not finite"),
        ("curve is flat", r"its curve has shape \(\d+,\)"),
        ("curve raises", "bias: RuntimeError: no licence"),
        ("curve writes", "bias: ValueError: assignment destination is read-only"),
    ],
)
def test_a_map_that_cannot_be_evaluated_is_named(driftlab, tmp_path, recording, how, message):
    (tmp_path / "how").write_text("")
    config(tmp_path, recording, calibration={"kind": "acme_map", "path": "map.json"})
    driftlab("fit-map", "a.yaml", "--out", "map.json")
    (tmp_path / "how").write_text(how)
    config(tmp_path, recording, calibration={"kind": "acme_map", "path": "map.json", "how": how})
    is_one_line(driftlab("run", "a.yaml", status=1), f"acme_map {ACME}: {message}")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("source raises", "chunks: ConnectionError: gone"),
        ("source exits", "chunks: SystemExit"),
        ("channel is short", r"channel 'gyro' has shape \(3999, 3\), expected \(4000, 3\)"),
        ("axes vanish", r"channel 'gyro' has shape \(4000, 2\), expected \(4000, 3\)"),
        ("channel is text", "channel 'gyro' is an array of <U"),
        ("not a chunk", "what it yields is a dict, a Chunk was expected"),
    ],
)
def test_a_source_that_goes_wrong_is_named(driftlab, tmp_path, recording, how, message):
    config(tmp_path, recording, source={"kind": "acme_source", "how": how})
    is_one_line(driftlab("run", "a.yaml", status=1), f"acme_source {ACME}: {message}")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("signature raises", "signature: IndexError: out of range"),
        ("signature is NaN", "signature is not finite"),
        ("signature is flat", r"signature has shape \(\d+, 3\), its 3 labels ask for \(\d+, 3, 3\)"),
        ("input is short", r"the map's input has shape \(\d+,\)"),
    ],
)
def test_an_effect_that_goes_wrong_is_named_and_not_the_model_that_asked_it(
    driftlab, tmp_path, recording, how, message
):
    effect = {"kind": "acme_effect", "how": how, "coefficients": [0, 0, 0]}
    bias = {"kind": "thermal_derivative", "walk": "1e-4 deg/s/sqrt(s)", "effects": [effect]}
    config(tmp_path, recording, bias)
    is_one_line(driftlab("run", "a.yaml", status=1), f"acme_effect {ACME}: {message}")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("decode raises", "decode: IndexError: index out of range"),
        ("frames are short", r"channel 'gyro' has shape \(2, 3\) in 3 frames"),
    ],
)
def test_a_framing_that_goes_wrong_is_named(driftlab, tmp_path, recording, how, message):
    device, stop = Device(tmp_path), threading.Event()

    def send():
        while not stop.wait(0.1):
            with suppress(BlockingIOError):  # what is sent before the port is open is lost
                os.write(device.master, b"x" * 64)

    sender = threading.Thread(target=send)
    framing = {"kind": "acme_framing", "how": how}
    source = {"kind": "serial", "port": str(device.path), "interval": "0.01 s", "framing": framing}
    config(tmp_path, recording, source=source)
    sender.start()
    try:
        stderr = driftlab("live", "a.yaml", "--duration", "60 s", "--out", "out", status=1)
    finally:
        stop.set()
        sender.join()
        device.close()
    is_one_line(stderr, f"acme_framing {ACME}: {message}")


# what they may bring


def test_a_family_of_a_third_party_has_plugins_from_another(driftlab, rows, tmp_path, recording):
    (noise,) = of(rows, kind="noise")
    assert (noise["family"], noise["distribution"], noise["error"]) == ("taps", "aaa-taps", None)
    config(tmp_path, recording, source={"kind": "acme_taps", "tap": {"kind": "noise"}})
    summary = json.loads(driftlab("run", "a.yaml", "--json"))
    used = {(item["family"], item["kind"]): item for item in summary["plugins"]}
    assert used["taps", "noise"] == {
        "family": "taps", "kind": "noise", "distribution": "aaa-taps", "version": "6.6.6"
    }  # fmt: skip
    assert used["sources", "acme_taps"]["version"] == "1.2.3"
    # its plugins are held to the same boundary
    config(tmp_path, recording, source={"kind": "acme_taps", "tap": {"kind": "leak"}})
    message = driftlab("run", "a.yaml", "--out", "other", status=1)
    is_one_line(message, r"leak \(aaa-taps 6\.6\.6\): take: ValueError: assignment destination is read-only")
    config(tmp_path, recording, source={"kind": "acme_taps", "tap": {"kind": "nose"}})
    assert "kind 'nose' is not installed; did you mean noise?" in driftlab("check", "a.yaml", status=2)


def test_a_product_of_a_third_party_is_extended_by_name(driftlab, rows, tmp_path):
    (row,) = of(rows, kind="acme_x1")
    assert (row["family"], row["distribution"]) == ("products", "zzz-whole")
    (tmp_path / "mine.yaml").write_text("extends: acme_x1\n")
    understood = yaml.safe_load(driftlab("check", "mine.yaml"))
    assert understood["filter"]["gyro"]["bias"]["walk"] == "7e-4 deg/s/sqrt(s)"
    (tmp_path / "mine.yaml").write_text("extends: acme_x2\n")
    assert "did you mean acme_x1?" in driftlab("check", "mine.yaml", status=2)


def test_an_exporter_of_a_third_party_is_a_command(driftlab, tmp_path, recording):
    config(tmp_path, recording, calibration={"kind": "polynomial", "order": 1})
    driftlab("fit-map", "a.yaml", "--out", "map.json")
    out = driftlab("export", "acme_bits", "map.json", "--out", "map.bits", "--set", "bits=4", "--json")
    assert (tmp_path / "map.bits").read_text() == "4 bits of polynomial"
    loss = json.loads(out)
    (of_gyro,) = loss["loss"]
    assert of_gyro["unit"] == "deg/h"
    assert of_gyro["domain"]["largest"] == pytest.approx([np.rad2deg(0.0625) * 3600] * 3)
    assert json.loads((tmp_path / "loss.json").read_text())["exports"] == {"map.bits": loss}
    assert loss["left_out"] == ["the slope"]
    assert loss["plugins"][0]["distribution"] == "zzz-whole"
    again = ("export", "acme_bits", "map.json", "--out", "map.bits", "--force", "--set")
    message = driftlab(*again, "bits=13", status=1)
    is_one_line(message, r"acme_bits \(zzz-whole 1\.2\.3\): export: ArithmeticError: unlucky")
    is_one_line(driftlab(*again, "bits=0", status=1), "acme_bits .*: what it says is lost is a NoneType")
    assert (tmp_path / "map.bits").read_text() == "4 bits of polynomial"  # whole, or as it was


def test_sections_of_a_third_party_stand_in_the_report(driftlab, tmp_path, recording):
    config(tmp_path, recording)
    summary = json.loads(driftlab("run", "a.yaml", "--json"))
    page = (tmp_path / "driftlab_out" / "report.html").read_text()
    assert "<h2>Acme&#39;s page</h2>" in page
    assert "<p>First &lt;1 &amp; last&gt;</p>" in page
    assert f"<b>{summary['bias_rad_s']['end'][0]}</b>" in page
    assert "<svg id='acme'></svg>" in page
    assert "acme_torn (zzz-whole 1.2.3): section: ValueError: assignment destination is read-only" in page
    assert "acme_exiting (zzz-whole 1.2.3): section: SystemExit: no printer" in page
    assert summary["states"]  # nobody can clear it


# what results say of them


def test_results_name_the_plugins_that_took_part(driftlab, tmp_path, recording):
    config(tmp_path, recording, calibration={"kind": "polynomial", "order": 1, "path": "map.json"})
    driftlab("fit-map", "a.yaml", "--out", "map.json")
    made_by = json.loads((tmp_path / "map.json").read_text())["record"]["provenance"]["plugins"]
    assert made_by.startswith("polynomial (driftlab ")
    summary = json.loads(driftlab("run", "a.yaml", "--json"))
    assert {item["kind"] for item in summary["plugins"]} == {"hdf5", "polynomial", "random_walk", "zupt"}
    allan = json.loads(driftlab("allan", "a.yaml", "--json"))
    assert [item["kind"] for item in allan["plugins"]] == ["hdf5"]


def test_a_run_does_not_go_on_with_an_upgraded_plugin(driftlab, tmp_path, recording):
    """The checkpoint is of 6.6.5, and 6.6.6 is installed."""
    config(tmp_path, recording, {"kind": "acme_bias"})
    driftlab("run", "a.yaml", "--out", "whole")
    summary = json.loads((tmp_path / "whole" / "summary.json").read_text())
    (mine,) = [item for item in summary["plugins"] if item["kind"] == "acme_bias"]
    assert mine["version"] == "6.6.6"

    started = tmp_path / "out.partial"
    started.mkdir()
    (started / "driftlab.lock").touch()
    with h5py.File(tmp_path / "whole" / "estimates.h5") as file:
        text, version = file.attrs["config"], file.attrs["driftlab"]
    before = [{**item, "version": "6.6.5"} if item["kind"] == "acme_bias" else item for item in summary["plugins"]]
    write_checkpoint(started / "checkpoint.npz", {"driftlab": version, "config": text, "plugins": before, "rows": 0})
    message = driftlab("run", "a.yaml", "--out", "out", "--resume", status=2)
    is_one_line(message, r"--resume: .* \(acme_bias was of driftlab-acme 6.6.5 and is of driftlab-acme 6.6.6")
