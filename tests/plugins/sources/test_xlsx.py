"""Workbooks of Excel: sheets, dates, and what is too large or none."""

import io
import zipfile

import numpy as np
import pytest
from logger_files import xlsx
from recordings_on_disk import read

from fusion_core.errors import ConfigError, MissingChannel, UnreadableFile
from fusion_plugins.sources import xlsx as module
from fusion_plugins.sources.xlsx import Xlsx

CHANNELS = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "g", "unit": "deg/s"}}
ROWS = [["t", "g", "note"], [0, 1.5, "begin"], [1, -2.25, None], [2.5, 3, "end"]]


def book(tmp_path, **sheets):
    path = tmp_path / "r.xlsx"
    path.write_bytes(xlsx(sheets or {"Data": ROWS}))
    return path


def changed(path, name, change):
    """Write a workbook with another content of one part."""
    new = io.BytesIO()
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(new, "w", zipfile.ZIP_DEFLATED) as archive:
        for entry in old.infolist():
            data = old.read(entry)
            archive.writestr(entry.filename, change(data) if entry.filename == name else data)
    path.write_bytes(new.getvalue())
    return path


def test_a_sheet_is_a_table(tmp_path):
    got = read(Xlsx(path=book(tmp_path), channels=CHANNELS))
    np.testing.assert_allclose(got["gyro"][:, 0], np.deg2rad([1.5, -2.25, 3]))
    assert got.t.tolist() == [0, 1, 2.5]
    path = book(tmp_path, Notes=[["by night"]], Data=ROWS)
    assert Xlsx.settings_for(path, {}) == {"sheet": "Data"}
    assert len(read(Xlsx(path=path, channels=CHANNELS, sheet="Data"))) == 3
    with pytest.raises(MissingChannel, match="has no sheet 'data', it has Notes, Data; correct"):
        read(Xlsx(path=path, channels=CHANNELS, sheet="data"))


@pytest.mark.parametrize("place", [b'r="XFD1048576"', b"r = 'XFD1048576'", b'r="xfd1048576"'])
def test_a_cell_far_away_makes_no_room_for_all_before_it(tmp_path, place):
    path = changed(book(tmp_path), "xl/worksheets/sheet1.xml", lambda data: data.replace(b'r="B4"', place))
    with pytest.raises(UnreadableFile, match="a sheet of 1,048,576 rows and 16,384 columns takes"):
        read(Xlsx(path=path, channels=CHANNELS))


def test_what_is_no_workbook_is_refused(tmp_path, monkeypatch):
    path = book(tmp_path)
    monkeypatch.setattr(module, "PIECE", 100)
    monkeypatch.setattr(module, "check_size", lambda path, what, size: (_ for _ in ()).throw(UnreadableFile(what)))
    with pytest.raises(UnreadableFile, match="the workbook"):
        read(Xlsx(path=path, channels=CHANNELS))
    monkeypatch.undo()
    whole = path.read_bytes()
    with zipfile.ZipFile(tmp_path / "other.zip", "w") as archive:
        archive.writestr("notes.txt", "of the night shift")
    for data, message in (
        (whole[: len(whole) // 2], "is cut short or damaged"),
        ((tmp_path / "other.zip").read_bytes(), "a zip archive that is no workbook"),
        (b"t,g\n0,1\n", "is a text file, a file of kind xlsx was expected; use kind: csv"),
    ):
        path.write_bytes(data)
        with pytest.raises(UnreadableFile, match=message):
            read(Xlsx(path=path, channels=CHANNELS))
    monkeypatch.setattr(module, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"python-calamine is not installed.* pip install 'driftlab\[excel\]'"):
        read(Xlsx(path=path, channels=CHANNELS))
