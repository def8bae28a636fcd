"""The folder of a fleet, opened again and again."""

import errno
import os

import pytest

from driftlab.errors import ConfigError, Unwritable
from driftlab.family.record import UnitRecord
from driftlab.production import fleet_folder as folder_module
from driftlab.production import unit_folders
from driftlab.production.fleet_folder import fleet_folder
from driftlab.storage.folders import remove

FAILED = {"key": "k", "state": "failed", "error": "none"}


def complete(folder, report):
    folder.hidden("report.html").write_bytes(report)
    folder.publish(["report.html"])
    folder.write_mark({**folder.mark, "complete": True})


def texts(folder):
    return {str(path.relative_to(folder)): path.read_text() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", ["6", "x", "0001", "a.b"])
def test_a_folder_is_opened_again_whatever_its_units_are_called(name, tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(key="k", unit=name, state="failed", error="none"), {"unit.npz": b"1"}, "stamp")
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.place.unit(name) / "unit.npz").read_bytes() == b"1"
        assert folder.as_it_was(name, "stamp")
        assert not folder.as_it_was(name, "another")
        assert not folder.as_it_was("another", "stamp")


def test_notes_on_stamps_that_later_ones_replace_do_not_pile_up(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        for k in range(5):
            folder.stamp("6", "k", f"stamp {k}")
            folder.stamp("7", "k", "as it was")
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.path / "inputs.ndjson").read_text().count("\n") == 2
        assert folder.as_it_was("6", "stamp 4")
        assert folder.as_it_was("7", "as it was")
        assert not folder.as_it_was("6", "stamp 3")


def test_what_a_killed_command_left_is_finished(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        for name in "67":
            folder.put(UnitRecord(key="k", unit=name, state="failed", error="none"), {"unit.npz": b"1"}, "stamp")
        units = folder.path / "units"
    (units / "6").rename(units / ".6.old")  # taken away, and nothing put in its place
    (units / ".7.new").mkdir()  # half made
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.place.unit("6") / "unit.npz").read_bytes() == b"1"
    assert sorted(path.name for path in units.iterdir()) == ["6", "7"]


def test_what_others_put_beside_the_files_of_a_unit_stays(tmp_path):
    record = UnitRecord(key="k", unit="6", state="failed", error="none", map_file="map.json")
    files = {"map.json": b"1", "page/report.html": b"1", "explained/loop.json": b"1"}
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, files, "stamp")
        for name in ("map.png", "page/notes.txt", "explained/mine.py", "mine.txt"):
            (folder.place.unit("6") / name).write_text("mine")
        for _ in range(2):
            folder.put(record, {"map.json": b"2"}, "stamp")
        left = {
            str(p.relative_to(folder.place.unit("6"))): p.read_text()
            for p in folder.place.unit("6").rglob("*")
            if p.is_file()
        }
    mine = dict.fromkeys(("map.png", "page-notes.txt", "explained-mine.py", "mine.txt"), "mine")
    assert {name: text for name, text in left.items() if name != "unit.json"} == {"map.json": "2", **mine}


def test_a_table_of_a_fleet_that_was_edited_is_not_replaced(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        complete(folder, b"a")
    with fleet_folder(tmp_path / "fleet"):
        pass
    (tmp_path / "fleet" / "report.html").write_text("b")
    with (
        pytest.raises(ConfigError, match=r"holds report.html, which driftlab did not write, or not so; move it away"),
        fleet_folder(tmp_path / "fleet"),
    ):
        pass


def test_a_file_of_a_unit_that_was_edited_goes_along_with_the_one_that_is_made_anew(tmp_path):
    record = UnitRecord(unit="6", map_file="map.json", **FAILED)
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"map.json": b"1", "unit.npz": b"1"}, "stamp")
        folder.put_page("6", {"page/report.html": b"1", "page/map.report.html": b"1"})
    unit = tmp_path / "fleet" / "units" / "6"
    (unit / "map.json").write_bytes(b"edited")
    (unit / "page" / "report.html").write_bytes(b"edited")
    (unit / "unit.json").write_text((unit / "unit.json").read_text().replace('"none"', '"edited"'))
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"map.json": b"2", "unit.npz": b"2"}, "stamp")
    left = texts(unit)
    assert left.pop("map.json") == left.pop("unit.npz") == "2"
    assert '"none"' in left.pop("unit.json")
    assert '"edited"' in left.pop("unit.json.before-1")
    assert left == {"map.json.before-1": "edited", "page-report.html": "edited"}


def test_a_record_that_was_edited_is_put_aside_when_the_manifest_says_something_else(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")
        path = folder.place.unit("6") / "unit.json"
        path.write_text(path.read_text().replace('"none"', '"edited"'))
        for lot in "ab":
            folder.note(UnitRecord(unit="6", lot=lot, **FAILED))
    left = texts(path.parent)
    assert '"lot": "b"' in left.pop("unit.json")
    assert '"edited"' in left.pop("unit.json.before-1")
    assert not left


def test_what_others_call_as_a_folder_of_pages_stays(tmp_path):
    record = UnitRecord(unit="6", **FAILED)
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"explained/loop.json": b"1"}, "stamp")
        unit = folder.place.unit("6")
        (unit / "page").write_text("mine")
        (unit / "explained" / "page").mkdir()
        (unit / "explained" / "page" / "mine.txt").write_text("mine")
        folder.put_page("6", {"page/report.html": b"1"})
        assert (unit / "page.before-1").read_text() == "mine"
        folder.put(record, {}, "stamp")
        left = texts(unit)
        (unit / "explained").symlink_to(tmp_path)
        folder.put(record, {}, "stamp")
        assert (unit / "explained").is_symlink()
    del left["unit.json"]
    assert left == {"page.before-1": "mine", "explained-page/mine.txt": "mine"}


@pytest.mark.parametrize("step", range(5))
def test_a_certificate_that_a_kill_stops_is_replaced_by_the_next(tmp_path, monkeypatch, step):
    def sheet(issue):
        return {"identification": issue}, {"certificate.html": issue.encode(), "certificate.json": b'{"%d": 1}' % step}

    class Killed(BaseException):
        pass

    left = [step]

    def killed(call):
        def counted(*args):
            if not left[0]:
                raise Killed
            left[0] -= 1
            return call(*args)

        return counted

    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")
        folder.put_certificate("6", *sheet("a"))
        with monkeypatch.context() as patched:
            patched.setattr(os, "replace", killed(os.replace))
            patched.setattr(unit_folders, "remove", killed(remove))
            with pytest.raises(Killed):
                folder.put_certificate("6", *sheet("b"))
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put_certificate("6", *sheet("c"))
        names = {path.name: path for path in folder.place.unit("6").iterdir()}
        assert names.keys() == {"unit.json", "certificate.html", "certificate.json"}
        assert names["certificate.html"].read_text() == "c"


def test_a_report_that_was_edited_while_its_fleet_was_not_complete_is_put_aside(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        complete(folder, b"a")
        folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")
    path = tmp_path / "fleet" / "report.html"
    with fleet_folder(tmp_path / "fleet") as folder:
        complete(folder, b"b")
        folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")
        assert path.read_text() == "b"
    path.write_text("mine")
    with fleet_folder(tmp_path / "fleet") as folder:
        complete(folder, b"c")
    assert path.read_text() == "c"
    assert path.with_name("report.html.before-1").read_text() == "mine"


def test_a_report_that_was_edited_before_its_fleet_was_marked_as_complete_is_not_replaced(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.hidden("report.html").write_bytes(b"a")
        folder.publish(["report.html"])
        (folder.path / "report.html").write_text("mine")
        folder.write_mark({**folder.mark, "complete": True})
    with pytest.raises(ConfigError, match=r"holds report\.html"), fleet_folder(tmp_path / "fleet"):
        pass


def test_a_fleet_is_looked_at_once_its_lock_is_held(tmp_path, monkeypatch):
    """Between the first look and the lock another command ends, and somebody edits its report."""
    with fleet_folder(tmp_path / "fleet") as folder:
        complete(folder, b"a")
        folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")

    class Late(folder_module.Lock):
        def __init__(self, path, what):
            monkeypatch.undo()
            with fleet_folder(tmp_path / "fleet") as folder:
                complete(folder, b"b")
            (tmp_path / "fleet" / "report.html").write_text("mine")
            super().__init__(path, what)

    monkeypatch.setattr(folder_module, "Lock", Late)
    with pytest.raises(ConfigError, match=r"holds report\.html"), fleet_folder(tmp_path / "fleet"):
        pass
    assert not (tmp_path / "fleet" / "driftlab.lock").exists()


def test_a_fleet_whose_disk_was_full_at_its_first_file_is_made_anew(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        with pytest.raises(Unwritable), fleet_folder(tmp_path / "fleet"):
            pass
    with fleet_folder(tmp_path / "fleet") as folder:
        assert folder.mark["program"] == "driftlab fleet"


def test_a_fleet_of_a_version_without_digests_says_so(tmp_path):
    (tmp_path / "fleet.json").write_text('{"schema": 1, "complete": true}')
    message = "exists and is not the output of an earlier fleet; move it away, or name another folder"
    with pytest.raises(ConfigError, match=message), fleet_folder(tmp_path):
        pass


def test_a_mark_that_is_edited_while_the_fleet_goes_on_is_put_aside(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        (folder.path / "fleet.json").write_text("mine")
        complete(folder, b"a")
    assert (tmp_path / "fleet" / "fleet.json.before-1").read_text() == "mine"
    with fleet_folder(tmp_path / "fleet") as folder:
        assert folder.mark["complete"]


def test_a_link_in_the_place_of_a_unit_goes_along_each_time_that_the_unit_is_made_anew(tmp_path):
    (tmp_path / "moved").mkdir()
    with fleet_folder(tmp_path / "fleet") as folder:
        for _ in range(2):
            folder.place.unit("6").symlink_to(tmp_path / "moved")
            folder.put(UnitRecord(unit="6", **FAILED), {}, "stamp")
            assert (folder.place.unit("6") / "6").is_symlink()
            remove(folder.place.unit("6"))


def test_a_unit_called_new_is_found_again_after_a_kill(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(unit="6", **FAILED), {"map.json": b"6"}, "stamp")
        folder.put(UnitRecord(unit="6.new", **FAILED), {"map.json": b"6.new"}, "stamp")
        folder.place.unit("6.new").rename(folder.place.unit(".6.new.old"))
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.place.unit("6.new") / "map.json").read_bytes() == b"6.new"
        assert (folder.place.unit("6") / "map.json").read_bytes() == b"6"
