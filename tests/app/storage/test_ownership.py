"""Each file of each command: what somebody else wrote, or edited, is there afterwards, byte by byte.

A row a command and exporter, made once; each is then given again what it is to refuse, and what it is to replace. A
command or an exporter without a row fails.
"""

import hashlib
import json
import os
import shutil
import threading
from dataclasses import dataclass
from pathlib import Path

import fleets
import numpy as np
import pytest
import yaml
from bench import FRAMING, Device, frame, paced
from flying_units import fitted
from typer.testing import CliRunner
from ulog_writer import sensor, write_ulog
from units_at_rest import UNITS, unit_at_rest

from driftlab.cli import COMMANDS, app
from driftlab.production import units_pass
from driftlab.storage.ownership import foreign, sign, signed
from fusion_core.contracts import Exporter
from fusion_core.host.registry import registry

WRITE_NOTHING = {"check", "plugins", "schema"}
CHANNELS = {name: {"path": name} for name in UNITS}
WALK = {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}
MAP = {**WALK, "kind": "thermal_derivative", "map": {"kind": "polynomial", "order": 2, "min_swing": "0.5 K"}}
NETWORK = {**MAP, "map": {"kind": "onnx_network", "min_swing": "0.5 K", "starts": 1}}


@dataclass(frozen=True)
class Row:
    """A command line, where it writes, and the files beside that; `again`: it replaces what it wrote, unasked."""

    line: str
    out: str = "out"
    beside: tuple[str, ...] = ()
    again: bool = True

    @property
    def command(self):
        words = self.line.split()
        return " ".join(words[:2]) if words[0] == "export" else words[0]

    @property
    def args(self):
        return [*self.line.split(), "--out", self.out]

    def files(self, folder):
        """Every file that it wrote, but for those within the units of a fleet, which are moved out of the way."""
        inside = [p.relative_to(folder) for p in (folder / self.out).rglob("*") if p.is_file()]
        found = [str(path) for path in inside if "units" not in path.parts and path.name != "inputs.ndjson"]
        return sorted([*found, *(name for name in (self.out, *self.beside) if (folder / name).is_file())])


ROWS = {
    "run": Row("run {}/plain.yaml"),
    "allan": Row("allan {}/plain.yaml"),
    "compare": Row("compare {}/plain.yaml {}/other.yaml"),
    "plan": Row("plan {}/map.yaml --hours 4 --range 0..40degC --effects thermal_rate"),
    "explain": Row("explain {0}/map.yaml --calibration {0}/a.h5 --train {0}/b.h5 --holdout {0}/c.h5"),
    "fleet": Row("fleet {}/line/family.yaml --units {}/line/units.csv"),
    "fit-map": Row("fit-map {}/map.yaml", "map.json", ("map.report.html",)),
    "fit-map --select": Row("fit-map {}/network.yaml --select --neurons-max 2 --report why", "map.onnx",
                            ("why/report.html", "why/select.json", "why/select.svg")),
    "vehicle": Row("vehicle {}/soak.ulg --kind polynomial"),
    "simulate": Row("simulate {}/twin.yaml", "twin.h5"),
    "simulate CSV": Row("simulate {}/twin.yaml", "twin.csv"),
    "live": Row("live {}/live.yaml --record raw.h5 --fit-map map.json --kind polynomial --duration 4s", "out",
                ("raw.h5", "map.json"), again=False),
    "init": Row("init {}/a.h5", "unit.yaml", again=False),
    "import": Row("import mat {}/unit.mat", "map.json"),
    "px4": Row("export px4 {}/unit.json --set device_id=2490378", "unit.params", ("loss.json",)),
    "ardupilot": Row("export ardupilot {}/unit.json", "unit.parm", ("loss.json",)),
    "c": Row("export c {}/unit.json --set loss=5deg/h"),
    "kalibr": Row("export kalibr {}/plain.yaml --set rate=10Hz", "imu.yaml", ("loss.json",)),
    "openvins": Row("export openvins {}/plain.yaml --set rate=10Hz", "imu.yaml", ("loss.json",)),
    "mat": Row("export mat {}/unit.json", "unit.mat", ("loss.json",)),
    "csv_table": Row("export csv_table {}/unit.json", "unit.csv", ("loss.json",)),
}  # fmt: skip
EACH = ("run", "fleet", "fit-map", "simulate", "import", "csv_table", "c")  # way of writing, which the others share
MARKED = {
    ".json": b'{"schema": 2, "driftlab": "0.1.0", "driftlab_map": 1, "record": {}, "exports": {}, "complete": true, '
    b'"sha256": "driftlab fit-map 0.1.0, sha256:' + 64 * b"0" + b'", "written": {"estimates.h5": "0", "report.html": '
    b'"0", "allan.json": "0", "setpoints.csv": "0", "explained.yaml": "0"}}',
    ".html": b'<!doctype html><meta name="generator" content="driftlab 0.1.0"><!-- driftlab fit-map 0.1.0, sha256:'
    + 64 * b"0" + b" -->",
    ".csv": b"# driftlab simulate 0.1.0, sha256:" + 64 * b"0" + b"; to read it:\ntime [s],temperature [degC]\n0,1\n",
}  # fmt: skip


def config(source, bias, **how):
    gyro = {"noise": "3.18 deg/h/sqrt(Hz)", "bias": bias}
    accel = {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}}
    sensors = {"align": "20 s", "gyro": gyro, "accel": accel, **how}
    return {"latitude": "40.9 deg", "source": source, "filter": sensors}


def write_config(path, content):
    path.write_text(yaml.safe_dump(content))


@pytest.fixture(scope="module")
def inputs(tmp_path_factory):
    """The files that the commands read."""
    folder = tmp_path_factory.mktemp("inputs")
    for seed, name in enumerate("abc"):
        unit_at_rest(seconds=300, rate=10, seed=seed, temperature=lambda t: 20 + t / 60).write(folder / f"{name}.h5")
    configs = {"plain": WALK, "other": {"kind": "constant"}, "map": MAP, "network": NETWORK}
    for name, bias in configs.items():
        write_config(folder / f"{name}.yaml", config({"kind": "hdf5", "path": "a.h5", "channels": CHANNELS}, bias))
    twin = {"kind": "synthetic", "duration": "1 min", "rate": "10 Hz"}
    write_config(folder / "twin.yaml", {"source": twin})
    fitted().save(folder / "unit.json")
    assert (
        CliRunner().invoke(app, ["export", "mat", f"{folder}/unit.json", "--out", f"{folder}/unit.mat"]).exit_code == 0
    )
    soak = unit_at_rest(seconds=400, rate=10, temperature=lambda t: 15 + t / 13)
    axes = (("gyro", soak.gyro, 2490378), ("accel", soak.accel, 2490386))
    topics = [sensor(f"sensor_{name}", 0, soak.t + 1, values, soak.temperature, at) for name, values, at in axes]
    write_ulog(folder / "soak.ulg", topics)
    (folder / "line").mkdir()
    fleets.write_fleet(folder / "line", 2)
    live = {"kind": "serial", "port": str(folder / "ttyDEVICE"), "interval": "1 s", "framing": FRAMING}
    write_config(folder / "live.yaml", config(live, WALK, accel=None, update_interval="1 s", align="60 s"))
    return folder


@pytest.fixture(scope="module", autouse=True)
def _in_one_process():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(units_pass, "Pool", lambda workers: fleets.Here())
        yield


@pytest.fixture(scope="module")
def given(inputs, tmp_path_factory):
    """Give a command in a folder, and return what it said."""

    def give(args, folder):
        before = Path.cwd()
        os.chdir(folder)
        try:
            return CliRunner().invoke(app, [arg.format(inputs) for arg in args])
        finally:
            os.chdir(before)

    return give


@pytest.fixture(scope="module")
def made(given, inputs, tmp_path_factory):
    """Return a folder in which a command of ROWS was given once."""
    done = {}

    def make(name):
        if name not in done:
            folder = tmp_path_factory.mktemp(name.replace(" ", "_"))
            device, stop = (Device(inputs) if name == "live" else None), threading.Event()
            if device is not None:
                unit = unit_at_rest(seconds=9000, rate=1, walk=1e-8, temperature=lambda t: 20 + 20 * np.sin(t / 600))
                frames = [frame(k, unit.gyro[k], unit.accel[k], unit.temperature[k]) for k in range(len(unit.t))]
                sender = paced(device, frames, 300, stop)
            said = given(ROWS[name].args, folder)
            if device is not None:
                stop.set()
                sender.join()
                device.close()
            assert said.exit_code == 0, (name, said.output, said.exception)
            done[name] = folder
        return done[name]

    return make


def contents(folder):
    """Every file and link below a folder; of a link where it leads."""
    paths = [p for p in folder.rglob("*") if p.is_symlink() or p.is_file()]
    return {str(p.relative_to(folder)): os.readlink(p) if p.is_symlink() else p.read_bytes() for p in paths}


def copied(folder, place):
    shutil.rmtree(place, ignore_errors=True)
    return shutil.copytree(folder, place, symlinks=True)


def refused(given, row, folder, args=None):
    """Nothing, or what a command did where it was to refuse."""
    before = contents(folder)
    said = given(args or row.args, folder)
    after = contents(folder)
    lost = [name for name, data in before.items() if after.get(name) != data]
    if lost or said.exit_code == 0:
        return f"exit status {said.exit_code}, lost {lost}, {said.output[-200:]}"
    return f"{said.exception!r}" if not hasattr(said.exception, "args") or "; " not in str(said.exception) else None


def test_every_command_and_exporter_has_a_row():
    titles = {command.title or command.name.replace("_", "-") for command in COMMANDS}
    assert {row.line.split()[0] for row in ROWS.values()} | WRITE_NOTHING == titles
    kinds = {row.line.split()[1] for row in ROWS.values() if row.line.startswith("export ")}
    assert kinds == set(registry().classes(Exporter))


@pytest.mark.parametrize("name", ROWS)
def test_what_others_wrote_or_edited_is_not_replaced(name, made, given, tmp_path):
    row, wrong = ROWS[name], {}
    files = row.files(made(name))
    assert files
    for file in files:
        suffix = Path(file).suffix
        whole = (made(name) / file).read_bytes()
        middle, half = len(whole) // 2, bytes([whole[len(whole) // 2] ^ 1])
        texts = {"of somebody": b"mine\n", "with a byte changed": whole[:middle] + half + whole[middle + 1 :]}
        if name in EACH:
            texts |= {"that has our marks": MARKED.get(suffix, MARKED[".json"]), "with a byte more": whole + b"\n"}
        for what, text in texts.items():
            folder = copied(made(name), tmp_path / "there")
            (folder / file).write_bytes(text)
            wrong[file, what] = refused(given, row, folder)
        if name not in EACH:
            continue
        folder = copied(made(name), tmp_path / "there")
        (folder / "mine").write_bytes(b"mine\n")
        (folder / file).unlink()
        (folder / file).symlink_to(os.path.relpath(folder / "mine", (folder / file).parent))
        wrong[file, "that is a link"] = refused(given, row, folder)
        (folder / file).unlink()
        (folder / file).mkdir()
        (folder / file / "mine").write_bytes(b"mine\n")
        wrong[file, "that is a folder"] = refused(given, row, folder)
        if "/" not in file:
            folder = tmp_path / "alone"
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
            (folder / file).write_bytes(b"mine\n")
            wrong[file, "that is there alone"] = refused(given, row, folder)
    assert [f"{key}: {why}" for key, why in wrong.items() if why] == []


@pytest.mark.parametrize("name", ROWS)
def test_what_another_command_wrote_is_not_replaced(name, made, given, tmp_path):
    row, wrong = ROWS[name], {}
    for other, theirs in ROWS.items():
        if theirs.command == row.command:
            continue
        folder = copied(made(other), tmp_path / "there")
        if theirs.out != row.out:
            (folder / row.out).unlink(missing_ok=True)
            (folder / theirs.out).rename(folder / row.out)
        if name != "c":  # which writes beside what is there
            wrong[other, "in its place"] = refused(given, row, folder)
        if theirs.line.startswith("export ") and row.line.startswith("export "):
            folder = copied(made(other), tmp_path / "there")
            wrong[other, "under its name"] = refused(given, row, folder, [*row.line.split(), "--out", theirs.out])
        for file in row.files(made(name)) if other in EACH else ():
            same = next((f for f in theirs.files(made(other)) if Path(f).suffix == Path(file).suffix), None)
            if same is not None and not (file == "loss.json" and theirs.beside == row.beside):
                folder = copied(made(name), tmp_path / "there")
                shutil.copy(made(other) / same, folder / file)
                wrong[other, file] = refused(given, row, folder)
    assert [f"{key}: {why}" for key, why in wrong.items() if why] == []


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.out == "out" and row.again])
def test_what_others_put_into_a_folder_stays(name, made, given, tmp_path):
    for file in ("notes.txt", "declared.txt", "unit.txt"):
        folder = copied(made(name), tmp_path / "there")
        (folder / "out" / file).write_text("mine")
        said = given(ROWS[name].args, folder)
        assert (folder / "out" / file).read_text() == "mine"
        assert said.exit_code == (0 if name in ("fleet", "c") else 1), said.output  # which grow in place


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.again])
def test_what_a_command_wrote_it_writes_again_also_after_a_crash(name, made, given, tmp_path, monkeypatch):
    """The states of the disk before each change of a name are those in which SIGKILL leaves it."""
    row, folder, states = ROWS[name], copied(made(name), tmp_path / "there"), []

    def spied(function):
        def spy(path, *args, **more):
            if folder in [Path.cwd(), *Path.cwd().parents]:
                states.append(copied(folder, tmp_path / f"state{len(states)}"))
            return function(path, *args, **more)

        return spy

    with monkeypatch.context() as patch:
        for change in ("replace", "rename"):
            patch.setattr(os, change, spied(getattr(os, change)))
        said = given(row.args, folder)
    assert said.exit_code == 0, (said.output, said.exception)
    assert set(row.files(folder)) == set(row.files(made(name)))
    assert states
    for state in states[:: max(1, len(states) // 3)] if name in EACH else ():
        said = given(row.args, state)
        assert said.exit_code == 0, (state.name, said.output, said.exception)
        assert set(row.files(state)) >= set(row.files(made(name)))


def test_two_exports_into_a_folder_have_both_their_losses(made, given, tmp_path):
    folder = copied(made("csv_table"), tmp_path / "there")
    for _ in range(2):
        assert given(ROWS["px4"].args, folder).exit_code == 0
        assert given(ROWS["csv_table"].args, folder).exit_code == 0
    known = yaml.safe_load((folder / "loss.json").read_text())
    assert {name: entry["kind"] for name, entry in known["exports"].items()} == {
        "unit.csv": "csv_table", "unit.params": "px4",
    }  # fmt: skip
    assert set(known["written"]) == {"unit.csv", "unit.params", "loss.json"}


@pytest.mark.parametrize("at", [None, 0, (1 << 18) - 1, 9_000_001, 17_000_000])
def test_any_edited_byte_of_a_large_file_shows(tmp_path, at):
    content = bytearray(np.random.default_rng(0).bytes(17_000_001))
    (tmp_path / "summary.json").write_text('{"schema": 1}')
    (tmp_path / "estimates.h5").write_bytes(content)
    sign(tmp_path, "summary.json", ["estimates.h5"])
    assert json.loads((tmp_path / "summary.json").read_text())["written"]["estimates.h5"].startswith("sums:")
    if at is not None:
        content[at] ^= 0x80
        (tmp_path / "estimates.h5").write_bytes(content)
    edited = [] if at is None else ["estimates.h5"]
    assert foreign(tmp_path, "summary.json", ["summary.json", "estimates.h5"]) == edited


def test_values_of_a_large_file_that_were_negated_show(tmp_path):
    values = np.random.default_rng(0).standard_normal(3_000_000)
    (tmp_path / "summary.json").write_text('{"schema": 1}')
    for edit in (slice(100, 2001, 1900), slice(None)):
        (tmp_path / "estimates.h5").write_bytes(values.tobytes())
        sign(tmp_path, "summary.json", ["estimates.h5"])
        other = values.copy()
        other[edit] *= -1
        (tmp_path / "estimates.h5").write_bytes(other.tobytes())
        assert foreign(tmp_path, "summary.json", ["estimates.h5"]) == ["estimates.h5"]


def test_a_large_file_that_an_earlier_version_hashed_whole_is_known(tmp_path):
    content = bytes(17_000_001)
    (tmp_path / "estimates.h5").write_bytes(content)
    whole = {"estimates.h5": hashlib.sha256(content).hexdigest()}
    (tmp_path / "summary.json").write_text(signed({"schema": 1}, "summary.json", whole))
    assert foreign(tmp_path, "summary.json", ["summary.json", "estimates.h5"]) == []
