"""Workbooks of Excel: sheets, dates, and what is too large or none."""

import io
import re
import zipfile
from datetime import datetime, timedelta

import numpy as np
import pytest
from logger_files import xlsx
from recordings_on_disk import read

from fusion_core.errors import ConfigError, MissingChannel, UnreadableFile
from fusion_plugins.sources import xlsx as module
from fusion_plugins.sources.xlsx import Xlsx

CHANNELS = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "g", "unit": "deg/s"}}
SHEET = "xl/worksheets/sheet1.xml"
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
    path = changed(book(tmp_path), SHEET, lambda data: data.replace(b'r="B4"', place))
    with pytest.raises(UnreadableFile, match="a sheet of 1,048,576 rows and 16,384 columns takes"):
        read(Xlsx(path=path, channels=CHANNELS))


@pytest.mark.parametrize("places", [rb' r="[A-Z]+\d+"', rb' r="[A-Z]*\d+"', rb' r="[B-Z]\d+"'])
def test_a_cell_or_row_without_a_place_follows_the_one_before(tmp_path, places):
    path = changed(book(tmp_path, Data=[["t", "g"], [0, 1.5], [1, 3]]), SHEET, lambda data: re.sub(places, b"", data))
    got = read(Xlsx(path=path, channels=CHANNELS))
    assert got.t.tolist() == [0, 1]
    np.testing.assert_allclose(got["gyro"][:, 0], np.deg2rad([1.5, 3]))


@pytest.mark.parametrize("row", [b'<row r="900000"><c/><c r="ZZ900000"/>', b'<row r="900000"/><x:row><c/><c r="ZZ1"/>'])
def test_a_row_far_away_makes_no_room_for_all_before_it(tmp_path, row):
    path = changed(book(tmp_path), SHEET, lambda data: data.replace(b"</sheetData>", row + b"</row></sheetData>", 1))
    with pytest.raises(UnreadableFile, match=r"a sheet of 900,00[01] rows and 702 columns takes"):
        read(Xlsx(path=path, channels=CHANNELS))


@pytest.mark.parametrize("cell", [b'<c r="AAAA1"/>', b'<c r="7"/>', b"<c a=b/>", b'</row><row r="A1"><c/>'])
def test_a_place_that_is_none_is_damage(tmp_path, cell):
    path = changed(book(tmp_path), SHEET, lambda data: data.replace(b"</row>", cell + b"</row>", 1))
    with pytest.raises(UnreadableFile, match=r"sheet1\.xml has a cell at a place that is none, .* was expected; save"):
        read(Xlsx(path=path, channels=CHANNELS))


def test_texts_that_cells_share_are_counted_for_each(tmp_path):
    path = book(tmp_path, Data=[*ROWS, *([3 + k, 0, "end"] for k in range(2000))])
    path = changed(path, "xl/sharedStrings.xml", lambda data: data.replace(b"end", b"e" * 1_000_000))
    with pytest.raises(UnreadableFile, match=r"a sheet of 2,005 texts of up to 1,000,0.. bytes takes"):
        read(Xlsx(path=path, channels=CHANNELS))


def broken(name, change):
    return lambda path: changed(path, name, change)


def deflate_damaged(path):
    data = bytearray(path.read_bytes())
    with zipfile.ZipFile(path) as archive:
        at = archive.getinfo(SHEET).header_offset + 30 + len(SHEET)
    data[at : at + 20] = b"\xff" * 20
    path.write_bytes(data)


def encrypted(path):
    data = path.read_bytes()
    path.write_bytes(data.replace(b"PK\3\4\x14\0\0", b"PK\3\4\x14\0\1").replace(
        b"PK\1\2\x14\3\x14\0\0", b"PK\1\2\x14\3\x14\0\1"))  # fmt: skip


@pytest.mark.parametrize(
    "damage",
    [
        broken(SHEET, lambda data: data[: len(data) // 2]),
        broken(SHEET, lambda data: data.replace(b't="s"', b't="zz"')),
        broken("xl/_rels/workbook.xml.rels", lambda data: data.replace(b"sheet1.xml", b"none.xml")),
        deflate_damaged,
        encrypted,
    ],
)
def test_a_damaged_workbook_is_one(tmp_path, damage):
    path = book(tmp_path)
    damage(path)
    for use in (lambda: read(Xlsx(path=path, channels=CHANNELS)), lambda: Xlsx.settings_for(path, {})):
        with pytest.raises(UnreadableFile, match=r"r\.xlsx: is cut short or damaged \(.*\); copy or record it again$"):
            use()


@pytest.mark.parametrize("begun", [datetime(2026, 3, 28, 23, 59, 58), datetime(2026, 3, 28)])
def test_a_midnight_among_moments_is_a_moment(tmp_path, begun):
    """A cell of 00:00:00 comes as the day alone."""
    rows = [[begun + timedelta(seconds=k), k] for k in range(5)]
    path = book(tmp_path, Data=[["t", "g"], *rows])
    found = Xlsx.settings_for(path, {})
    assert found["dates"] == {"t": "%Y-%m-%d %H:%M:%S"}
    got = read(Xlsx(path=path, channels=CHANNELS, dates=found["dates"]))
    np.testing.assert_allclose(np.diff(got.t), 1)


def test_a_moment_above_a_column_of_days_leaves_them_days(tmp_path):
    rows = [[k, datetime(2026, 3, 28), f"10:00:0{k}", k] for k in range(5)]
    path = book(tmp_path, Data=[["Exported", datetime(2026, 4, 1, 10, 30)], ["n", "day", "clock", "g"], *rows])
    assert Xlsx.settings_for(path, {})["dates"] == {"day + clock": "%Y-%m-%d %H:%M:%S"}


def test_a_date_that_is_none_is_damage(tmp_path):
    path = book(tmp_path, Data=[["t", "g"], [datetime(2026, 1, 1), 0]])
    changed(path, SHEET, lambda data: re.sub(rb'(s="1"><v>)[^<]*', rb"\g<1>-1e300", data))
    with pytest.raises(UnreadableFile, match="is cut short or damaged"):
        Xlsx.settings_for(path, {})


def test_sheets_of_charts_are_skipped(tmp_path):
    def chart(data):
        return data.replace(b'worksheet" Target="worksheets/sheet1', b'chartsheet" Target="chartsheets/sheet1')

    path = changed(book(tmp_path, Chart=[], Data=ROWS), "xl/_rels/workbook.xml.rels", chart)
    assert Xlsx.settings_for(path, {}) == {}
    assert len(read(Xlsx(path=path, channels=CHANNELS))) == 3
    changed(book(tmp_path), "xl/_rels/workbook.xml.rels", chart)
    with pytest.raises(UnreadableFile, match="has no sheet of cells"):
        Xlsx.settings_for(path, {})


def test_text_in_one_column_is_to_be_split(tmp_path):
    path = book(tmp_path, Data=[["t,g"], ["0,1.5"], ["1,-2.25"]])
    found = Xlsx.settings_for(path, {})
    assert "separator" not in found
    with pytest.raises(MissingChannel, match=r"the single cell 't,g', .* expected; split column A into columns at ','"):
        read(Xlsx(path=path, channels=CHANNELS, **found))


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
        ((tmp_path / "other.zip").read_bytes(), "is a zip archive, a workbook of Excel was expected; unpack it"),
        (b"t,g\n0,1\n", "is a text file, a file of kind xlsx was expected; use kind: csv"),
    ):
        path.write_bytes(data)
        with pytest.raises(UnreadableFile, match=message):
            read(Xlsx(path=path, channels=CHANNELS))
    monkeypatch.setattr("fusion_core.errors.find_spec", lambda name: None)
    path.write_bytes((tmp_path / "other.zip").read_bytes())
    with pytest.raises(UnreadableFile, match="is a zip archive"):
        read(Xlsx(path=path, channels=CHANNELS))
    path.write_bytes(whole)
    with pytest.raises(ConfigError, match=r"python-calamine is not installed.* pip install 'driftlab\[excel\]'"):
        read(Xlsx(path=path, channels=CHANNELS))
