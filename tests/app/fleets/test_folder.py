"""The folder of a fleet, opened again and again."""

import pytest

from driftlab.family.record import UnitRecord
from driftlab.fleets.folder import fleet_folder


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
