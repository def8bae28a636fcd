"""The folder of a fleet, opened again and again."""

import json

import pytest

from driftlab.errors import ConfigError
from driftlab.family.record import UnitRecord
from driftlab.production.store import fleet_folder


@pytest.mark.parametrize("name", ["6", "x", "0001", "a.b"])
def test_a_folder_is_opened_again_whatever_its_units_are_called(name, tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(key="k", unit=name, state="failed", error="none"), {"unit.npz": b"1"}, "stamp")
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.unit(name) / "unit.npz").read_bytes() == b"1"
        assert folder.stamps == {name: ("k", "stamp")}


def test_what_a_killed_command_left_is_finished(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        for name in "67":
            folder.put(UnitRecord(key="k", unit=name, state="failed", error="none"), {"unit.npz": b"1"}, "stamp")
        units = folder.path / "units"
    (units / "6").rename(units / ".6.old")  # taken away, and nothing put in its place
    (units / ".7.new").mkdir()  # half made
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.unit("6") / "unit.npz").read_bytes() == b"1"
    assert sorted(path.name for path in units.iterdir()) == ["6", "7"]


def test_what_others_put_beside_the_files_of_a_unit_stays(tmp_path):
    record = UnitRecord(key="k", unit="6", state="failed", error="none", map_file="map.json")
    files = {"map.json": b"1", "page/report.html": b"1", "explained/loop.json": b"1"}
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, files, "stamp")
        for name in ("map.png", "page/notes.txt", "explained/mine.py", "mine.txt"):
            (folder.unit("6") / name).write_text("mine")
        for _ in range(2):
            folder.put(record, {"map.json": b"2"}, "stamp")
        left = {str(p.relative_to(folder.unit("6"))): p.read_text() for p in folder.unit("6").rglob("*") if p.is_file()}
    mine = dict.fromkeys(("map.png", "page-notes.txt", "explained-mine.py", "mine.txt"), "mine")
    assert {name: text for name, text in left.items() if name != "unit.json"} == {"map.json": "2", **mine}


def test_a_table_of_a_fleet_that_was_edited_is_not_replaced(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.write("report.html", b"a")
        folder.write_mark({**json.loads((folder.path / "fleet.json").read_text()), "complete": True})
    with fleet_folder(tmp_path / "fleet"):
        pass
    (tmp_path / "fleet" / "report.html").write_text("b")
    with (
        pytest.raises(ConfigError, match=r"holds report.html, which driftlab did not write, or not so; move it away"),
        fleet_folder(tmp_path / "fleet"),
    ):
        pass


def test_a_file_of_a_unit_that_was_edited_goes_along_with_the_one_that_is_made_anew(tmp_path):
    record = UnitRecord(key="k", unit="6", state="failed", error="none", map_file="map.json")
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"map.json": b"1", "unit.npz": b"1"}, "stamp")
        folder.put_page("6", {"page/report.html": b"1", "page/map.report.html": b"1"})
    unit = tmp_path / "fleet" / "units" / "6"
    (unit / "map.json").write_bytes(b"edited")
    (unit / "page" / "report.html").write_bytes(b"edited")
    (unit / "unit.json").write_text((unit / "unit.json").read_text().replace('"none"', '"edited"'))
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"map.json": b"2", "unit.npz": b"2"}, "stamp")
    left = {path.name: path.read_bytes() for path in unit.iterdir()}
    assert left.pop("map.json") == left.pop("unit.npz") == b"2"
    assert b'"none"' in left.pop("unit.json")
    assert b'"edited"' in left.pop("unit.json.before-1")
    assert left == {"map.json.before-1": b"edited", "page-report.html": b"edited"}


def test_a_table_that_was_edited_while_its_fleet_was_not_complete_is_put_aside(tmp_path):
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.write("report.html", b"a")
        folder.write_mark({**json.loads((folder.path / "fleet.json").read_text()), "complete": True})
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(UnitRecord(key="k", unit="6", state="failed", error="none"), {}, "stamp")
    with fleet_folder(tmp_path / "fleet") as folder:
        assert not folder.mark["complete"]
        assert (folder.path / "report.html").read_bytes() == b"a"
    (tmp_path / "fleet" / "report.html").write_text("b")
    with fleet_folder(tmp_path / "fleet") as folder:
        assert (folder.path / "report.html.before-1").read_text() == "b"
        assert not (folder.path / "report.html").exists()


def test_what_others_call_as_a_folder_of_pages_stays(tmp_path):
    record = UnitRecord(key="k", unit="6", state="failed", error="none")
    with fleet_folder(tmp_path / "fleet") as folder:
        folder.put(record, {"explained/loop.json": b"1"}, "stamp")
        unit = folder.unit("6")
        (unit / "page").write_text("mine")
        (unit / "explained" / "page").mkdir()
        (unit / "explained" / "page" / "mine.txt").write_text("mine")
        folder.put_page("6", {"page/report.html": b"1"})
        assert (unit / "page.before-1").read_text() == "mine"
        folder.put(record, {}, "stamp")
        left = {str(p.relative_to(unit)): p.read_text() for p in unit.rglob("*") if p.is_file()}
    del left["unit.json"]
    assert left == {"page.before-1": "mine", "explained-page/mine.txt": "mine"}
