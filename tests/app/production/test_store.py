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
