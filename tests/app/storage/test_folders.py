"""Results in folders: replacement, the holder, and refusals before the work begins."""

# ruff: noqa: PT012, SIM117  # what is raised inside is the point
import json
import os
import re
import shutil
import subprocess
import sys

import h5py
import numpy as np
import pytest
from like_windows import as_it_is_written

from driftlab.storage.folders import LOCK, Lock, output_folder
from driftlab.storage.hdf5 import GrowingFile
from driftlab.storage.map_file import check_file, check_place, write_text
from driftlab.storage.ownership import sign
from driftlab.storage.recorder import RECORDED_MARK, Recorder, recording_file
from fusion_core.chunk import Chunk
from fusion_core.errors import ConfigError, UnreadableFile, Unwritable

HOLDER = """
import sys
from pathlib import Path
from driftlab.storage.folders import output_folder
with output_folder(Path("out")) as folder:
    (folder / "summary.json").write_text("kept")
    print("held", flush=True)
    sys.stdin.read()
"""

KILLED = """
import os
from pathlib import Path
import numpy as np
from driftlab.storage.hdf5 import GrowingFile
from driftlab.storage.recorder import Recorder
from fusion_core.chunk import Chunk
GrowingFile.settle = lambda self: os._exit(0)
Recorder(Path("raw.h5"), "", resume=False).add(Chunk(np.arange(70_000.0), {}))
"""


def results(folder, rows=5, **attributes):
    """Leave in a folder what a run leaves."""
    known = {"driftlab": "0", "recording": "", "live": False}
    file = GrowingFile(folder / "estimates.h5", {**known, **attributes}, {})
    file.append({"t": np.arange(float(rows))})
    file.close()
    (folder / "summary.json").write_text('{"schema": 1, "driftlab": "0"}')


def page(text):
    return f'<!doctype html>\n<meta name="generator" content="driftlab 0">\n{text}'


def write(out, text="new", **how):
    with output_folder(out, **how) as folder:
        results(folder)
        (folder / "report.html").write_text(page(text))


def names(folder):
    return sorted(os.listdir(folder))


def test_a_folder_appears_when_it_is_whole_and_is_replaced_by_the_same_command(tmp_path):
    out = tmp_path / "out"
    for text in ("one", "two"):
        write(out, text)
        assert names(out) == ["estimates.h5", "report.html", "summary.json"]
        assert (out / "report.html").read_text() == page(text)
        assert names(tmp_path) == ["out"]


@pytest.mark.parametrize(
    ("argument", "said"),
    [
        ("postgresql://anna:se@cr?et@host/line", "postgresql://***"),
        ("--to=sqlite:///line.db?password=secret", "--to=sqlite://***"),
        ("s3://line/units.csv", "s3://line/units.csv"),
    ],
)
def test_the_holder_s_command_is_said_without_a_password(tmp_path, monkeypatch, argument, said):
    monkeypatch.setattr(sys, "argv", ["driftlab", "fleet", argument])
    lock = Lock(tmp_path / LOCK, "--out out")
    lock.sign()
    assert json.loads((tmp_path / LOCK).read_bytes())["command"] == f"driftlab fleet {said}"
    lock.release()


def test_of_two_at_once_the_second_ends_at_once_and_says_who_holds_the_folder(tmp_path):
    command = [sys.executable, "-c", HOLDER]
    first = subprocess.Popen(command, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert first.stdout.readline() == "held\n"
    message = rf"is being written by `-c` \(process {first.pid} on \S+, since 20.*\); wait for its end, or name another"
    for resume in (False, True):
        with pytest.raises(ConfigError, match=message), output_folder(tmp_path / "out", resume=resume):
            pass
    assert (tmp_path / "out.partial" / "summary.json").read_text() == "kept"
    first.kill()
    first.communicate()
    write(tmp_path / "out")  # the lock went with the process, its folder was driftlab's
    assert names(tmp_path) == ["out"]


@pytest.mark.parametrize(
    "make",
    [
        lambda p: (p.mkdir(), (p / "thesis.txt").write_text("mine")),
        lambda p: (p.mkdir(), (p / LOCK).touch(), (p / "thesis.txt").write_text("mine")),
        lambda p: (p.mkdir(), (p / LOCK).write_text("not of driftlab")),
        lambda p: p.write_text("mine"),
        lambda p: p.symlink_to(p.parent),
    ],
    ids=["a folder", "a file in our folder", "a lock of others", "a file", "a link"],
)
def test_what_driftlab_did_not_write_is_not_removed(tmp_path, make):
    partial = tmp_path / "out.partial"
    make(partial)
    before = names(partial) if partial.is_dir() else partial.read_text()
    with pytest.raises(ConfigError, match=r"driftlab did not write|not of driftlab"):
        write(tmp_path / "out", force=True)
    assert before == (names(partial) if partial.is_dir() else partial.read_text())


@pytest.mark.parametrize("there", ["notes.txt", "allan.json", "summary.json"])
def test_other_folders_are_refused_before_the_work(tmp_path, there):
    out = tmp_path / "out"
    write(out)
    (out / there).write_text("{}")
    with pytest.raises(ConfigError, match=r"of another command, which would be lost|not the output of an earlier run"):
        with output_folder(out, force=True):
            pytest.fail("the work has begun")
    with pytest.raises(ConfigError, match="exists and is not the output of an earlier run"):
        with output_folder(out / there):
            pytest.fail("the work has begun")
    assert (out / there).exists()
    assert names(tmp_path) == ["out"]


def test_files_that_are_read_must_not_be_inside(tmp_path):
    write(tmp_path / "out")
    with pytest.raises(ConfigError, match=r"holds .*estimates.h5, which is used here; name another folder"):
        write(tmp_path / "out", read=[tmp_path / "out" / "estimates.h5"])


def test_a_file_that_comes_into_the_folder_meanwhile_stays(tmp_path):
    write(tmp_path / "out")
    with pytest.raises(ConfigError, match=r"notes.txt of another command.*the new results are in .*out.partial"):
        with output_folder(tmp_path / "out") as folder:
            results(folder)
            (tmp_path / "out" / "notes.txt").write_text("mine")
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    assert "estimates.h5" in names(tmp_path / "out.partial")


@pytest.mark.parametrize("text", ["one", "two"])
def test_a_link_leads_to_the_folder_that_is_meant(tmp_path, text):
    (tmp_path / "disk").mkdir()
    (tmp_path / "out").symlink_to("disk/results")
    for _ in range(2):
        write(tmp_path / "out", text)
    assert (tmp_path / "out").is_symlink()
    assert names(tmp_path / "disk") == ["results"]
    assert (tmp_path / "disk" / "results" / "report.html").read_text() == page(text)
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(ConfigError, match=r"loop: cannot be written \(Too many levels of symbolic links\)"):
        write(tmp_path / "loop")


def test_a_folder_that_cannot_be_renamed_is_written_to(tmp_path, monkeypatch):
    """The working directory here, a mount point in `test_full_disk.py`."""
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    (tmp_path / "out" / ".hidden").write_text("stays")
    for text in ("one", "two"):
        with output_folder(tmp_path / "out") as folder:
            assert folder.parent == tmp_path / "out"
            results(folder)
            (folder / "report.html").write_text(page(text))
        assert names(tmp_path / "out") == [".hidden", "estimates.h5", "report.html", "summary.json"]
    (tmp_path / "out" / "notes.txt").write_text("mine")
    with pytest.raises(ConfigError, match=r"holds notes\.txt"):
        write(tmp_path / "out")


@pytest.mark.parametrize("before", [False, True], ids=["new", "replaced"])
@pytest.mark.parametrize("resume", [False, True])
def test_a_kill_while_files_are_moved_in_one_by_one_is_made_up_for(tmp_path, monkeypatch, before, resume):
    """Before each change of a name: what is there then is refused to nobody but who edited it."""
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    if before:
        write(tmp_path / "out", "one")
    states = []

    def spied(old, new, function=os.replace):
        states.append(shutil.copytree(tmp_path / "out", tmp_path / f"state{len(states)}" / "out"))
        function(old, new)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", spied)
        write(tmp_path / "out", "two")
    assert len(states) >= 3
    for state in states:
        edited = state.parent / "edited" / "out"
        shutil.copytree(state, edited)
        if (edited / "report.html").exists():
            (edited / "report.html").write_text("mine")
            monkeypatch.chdir(edited)
            with pytest.raises(ConfigError, match=r"holds report.html, which driftlab did not write"):
                write(edited)
            assert (edited / "report.html").read_text() == "mine"
        monkeypatch.chdir(state)
        write(state, "three", resume=resume)
        assert names(state) == ["estimates.h5", "report.html", "summary.json"]
        assert (state / "report.html").read_text() == page("three")


def test_a_folder_that_a_command_works_in_is_not_taken_from_under_it(tmp_path, monkeypatch):
    """One command has `--out .`, so its `out.partial` is in that folder; another one has `--out ../out`."""
    write(tmp_path / "out")
    monkeypatch.chdir(tmp_path / "out")
    with output_folder(tmp_path / "out") as folder:
        results(folder)
        (folder / "report.html").write_text("under way")
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ConfigError, match=r"holds out.partial of another command"):
            write(tmp_path / "out")
        assert (folder / "report.html").read_text() == "under way"
        monkeypatch.chdir(tmp_path / "out")


def test_a_run_that_fails_leaves_what_it_wrote_and_nothing_else(tmp_path):
    with pytest.raises(KeyError), output_folder(tmp_path / "out"):
        raise KeyError
    assert names(tmp_path) == []
    with pytest.raises(KeyError), output_folder(tmp_path / "out") as folder:
        (folder / "report.html").write_text("")
        raise KeyError
    assert names(tmp_path / "out.partial") == [LOCK, "report.html"]
    with pytest.raises(Unwritable, match=r"--out .*out: cannot be written \(No space left.*\); make room.*out.partial"):
        with output_folder(tmp_path / "out") as folder:
            (folder / "report.html").write_text("")
            raise OSError(28, "No space left on device")


@pytest.mark.parametrize("where", ["out", "out.partial"])
def test_what_a_device_measured_is_replaced_on_demand_only(tmp_path, where):
    out = tmp_path / "out"
    with pytest.raises(KeyError), output_folder(out) as folder:
        results(folder, live=True, recording=str(tmp_path / "raw.h5"))
        raise KeyError
    if where == "out":
        (tmp_path / "out.partial").rename(out)
        (out / LOCK).unlink()
        sign(out, "summary.json", ["estimates.h5"])
    message = rf"{where} holds what a device measured \(`driftlab live`\); .*name another folder, or give --force"
    for how in ({}, {"resume": True}, {"resume": True, "recording": tmp_path / "raw.h5"}):  # which is not there
        with pytest.raises(ConfigError, match=message), output_folder(out, **how):
            pytest.fail("the work has begun")
    with pytest.raises(ConfigError):
        write(out, command="allan", force=False)
    (tmp_path / "raw.h5").touch()
    with pytest.raises(KeyError), output_folder(out, resume=True, recording=tmp_path / "raw.h5"):
        raise KeyError  # the recording is gone on with
    with h5py.File(tmp_path / where / "estimates.h5") as file:
        assert len(file["t"]) == 5
    write(out, force=True)
    assert names(tmp_path) == ["out", "raw.h5"]


def test_results_of_a_recording_that_is_gone_are_replaced_on_demand_only(tmp_path):
    out, recording = tmp_path / "out", tmp_path / "day.h5"
    recording.touch()
    with output_folder(out) as folder:
        results(folder, recording=str(recording))
    write(out)
    with output_folder(out) as folder:
        results(folder, recording=str(recording))
    recording.unlink()
    with pytest.raises(ConfigError, match=r"was computed from .*day.h5, which is not there any more; name another"):
        write(out)
    write(out, force=True)


def test_a_kill_between_the_renames_loses_nothing(tmp_path):
    """The new results are whole in `.partial`, with the folder that was to be replaced."""
    write(tmp_path / "out")
    with pytest.raises(KeyError), output_folder(tmp_path / "out") as folder:
        results(folder)
        (tmp_path / "out").rename(folder / ".replaced")
        raise KeyError
    write(tmp_path / "out")
    assert names(tmp_path / "out") == ["estimates.h5", "report.html", "summary.json"]


def chunk(start=0.0):
    return Chunk(start + np.arange(5.0), {"gyro": np.zeros((5, 3))})


def recorded(path, **how):
    recorder = Recorder(path, "", resume=how.get("resume", False), force=how.get("force", False))
    recorder.add(chunk())
    recorder.flush()
    return recorder


def test_a_recording_is_locked_and_is_never_replaced_unasked(tmp_path):
    path = tmp_path / "raw.h5"
    recorder = recorded(path)
    with h5py.File(as_it_is_written(path), "r", swmr=True) as file:
        assert len(file["time"]) == 5
    with pytest.raises(ConfigError, match=r"--record .*raw.h5: is being written by"):
        Recorder(path, "", resume=True)
    recorder.close()
    assert names(tmp_path) == ["raw.h5"]
    with pytest.raises(ConfigError, match=r"is there already; name another file, or go on with it with --resume"):
        recorded(path)
    recorder = recorded(path, resume=True)
    assert recorder.rows == 10
    recorder.close()
    recorder = Recorder(path, "", resume=False, force=True)
    with h5py.File(path) as file:
        assert len(file["time"]) == 10, "there until the first sample comes"
    recorder.close()
    recorded(path, force=True).close()
    with h5py.File(path) as file:
        assert len(file["time"]) == 5


def test_a_file_that_comes_before_the_first_sample_stays(tmp_path):
    recorder = Recorder(tmp_path / "raw.h5", "", resume=False, force=True)
    (tmp_path / "raw.h5").write_text("mine")
    with pytest.raises(ConfigError, match="is there already; name another file"):
        recorder.add(chunk())
    recorder.close()
    assert (tmp_path / "raw.h5").read_text() == "mine"
    assert names(tmp_path) == ["raw.h5"]


@pytest.mark.parametrize("content", [b"", b"\x89HDF\r\n\x1a\n", b"\x89HDF\r\n\x1a\n\x03\x08\x08" + bytes(90)])
def test_a_recording_that_was_killed_before_its_first_row_is_taken_up(tmp_path, content):
    path = tmp_path / "raw.h5"
    path.write_bytes(content)
    for k in range(2):
        recorder = recorded(path, resume=True)
        assert recorder.rows == 5 * (k + 1)
        recorder.close()
    assert names(tmp_path) == ["raw.h5", "raw.h5.unreadable-1"]
    assert (tmp_path / "raw.h5.unreadable-1").read_bytes() == content


def test_a_recording_is_called_so_only_when_it_can_be_read(tmp_path):
    subprocess.run([sys.executable, "-c", KILLED], cwd=tmp_path, check=True)
    assert names(tmp_path) == ["raw.h5.lock", "raw.h5.new"]
    recorded(tmp_path / "raw.h5", resume=True).close()
    assert names(tmp_path) == ["raw.h5"]


def test_a_recording_goes_to_no_other_file(tmp_path):
    (tmp_path / "notes.h5").write_text("mine")
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["gyro"] = [1.0]
    for name in ("notes.h5", "other.h5"):
        for how in ({"resume": True}, {"force": True}):
            with pytest.raises(UnreadableFile, match=rf"{name}: (was not {RECORDED_MARK}|cannot be read)"):
                recorded(tmp_path / name, **how)
    for name in ("/dev/null", tmp_path):
        with pytest.raises(ConfigError, match="is no file; name another"):
            recorded(name, force=True)
    (tmp_path / "raw.h5.new").write_text("mine")
    with pytest.raises(ConfigError, match=r"raw.h5.new is in the way; move it, or name another file"):
        recorded(tmp_path / "raw.h5")
    assert names(tmp_path) == ["notes.h5", "other.h5", "raw.h5.new"]


def test_a_lock_of_others_is_left_alone(tmp_path):
    (tmp_path / "a.lock").write_text("poetry")
    with pytest.raises(ConfigError, match=r"a\.lock is in the way, and not of driftlab"):
        Lock(tmp_path / "a.lock", "a")
    assert (tmp_path / "a.lock").read_text() == "poetry"


FOREIGN = {
    "report.html": "<!doctype html><p>made with driftlab",
    "estimates.h5": "mine",
    "summary.json": '{"schema": 1, "made with": "driftlab"}',
}


@pytest.mark.parametrize("name", FOREIGN)
def test_a_file_of_somebody_else_under_a_name_of_ours_is_not_replaced(tmp_path, name):
    """Also one that speaks of driftlab: the mark of each kind of file stands at a place of its own."""
    write(tmp_path / "out")
    (tmp_path / "out" / name).write_text(FOREIGN[name])
    with pytest.raises(ConfigError, match=r"driftlab did not write|is not the output of an earlier run"):
        write(tmp_path / "out")
    assert (tmp_path / "out" / name).read_text() == FOREIGN[name]


@pytest.mark.parametrize("name", ["loop.json", "explained.yaml", "report.html", "prediction.h5"])
def test_results_that_were_edited_since_are_not_replaced(tmp_path, name):
    out = tmp_path / "out"
    for _ in range(2):  # as it was written it can be made again
        with output_folder(out, "explain") as folder:
            results(folder)
            (folder / "estimates.h5").rename(folder / "prediction.h5")
            (folder / "summary.json").rename(folder / "loop.json")
            (folder / "explained.yaml").write_text("a: 1\n")
            (folder / "report.html").write_text(page("one"))
    if name == "prediction.h5":
        with h5py.File(out / name, "r+") as file:
            file["t"][0] = 7
    else:
        old, new = {"loop.json": ('"0"', '"3"'), "explained.yaml": ("1", "2"), "report.html": ("one", "mine")}[name]
        (out / name).write_text((out / name).read_text().replace(old, new, 1))
    edited = (out / name).read_bytes()
    with pytest.raises(ConfigError, match=rf"holds {re.escape(name)}, which driftlab did not write, or not so; move"):
        with output_folder(out, "explain"):
            pass
    assert (out / name).read_bytes() == edited


def test_a_map_is_written_in_the_place_of_a_map_only(tmp_path):
    (tmp_path / "soak.csv").write_text("t,gx\n")
    (tmp_path / "map.json").write_text(json.dumps({"driftlab_map": 1, "record": {}}))
    check_place(tmp_path / "new" / "map.json", [], "fit-map")
    for name in ("soak.csv", "/dev/null", "new", "map.json"):
        with pytest.raises(
            ConfigError, match=r"exists, and nothing in it says .*; move it away, or name another file with"
        ):
            check_place(tmp_path / name, [], "fit-map")
    (tmp_path / "link.csv").symlink_to("soak.csv")
    with pytest.raises(ConfigError, match="is read here, and would be lost; name another file with --out"):
        check_place(tmp_path / "link.csv", [tmp_path / "soak.csv"], "fit-map")
    with pytest.raises(ConfigError, match=r"soak.csv.m.json: cannot be written \(File exists\); name a folder"):
        check_place(tmp_path / "soak.csv" / "m.json", [], "fit-map")


def test_a_file_that_is_edited_while_it_is_made_anew_stays(tmp_path):
    path = tmp_path / "map.svg"
    write_text(path, "<svg/>", "fit-map")
    check_file(path, "fit-map", str(path), "name another")
    path.write_text("mine")
    message = r"map.svg: exists, and nothing in it says .*; move it away, or name .*; the new one is .*map.svg"
    for number in ("", ".before-1"):
        with pytest.raises(ConfigError, match=rf"{message}.partial{number}$"):
            write_text(path, "<svg></svg>", "fit-map")
        assert (tmp_path / f"map.svg.partial{number}").read_text().startswith("<svg></svg>")
    assert path.read_text() == "mine"


def test_a_recording_that_is_edited_while_it_is_simulated_anew_stays(tmp_path):
    path = tmp_path / "twin.csv"
    with recording_file(path, "{}") as file:
        file.append(chunk())
    with pytest.raises(ConfigError, match=r"was changed since .*; the new one is .*twin.csv.partial"):
        with recording_file(path, "{}") as file:
            file.append(chunk())
            edited = path.read_bytes().replace(b"0.0", b"0.1")
            path.write_bytes(edited)
    assert path.read_bytes() == edited
    assert b"0.0" in (tmp_path / "twin.csv.partial").read_bytes()
