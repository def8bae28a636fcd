"""Units from manifests and patterns, and what is wrong with them."""

from pathlib import Path

import pytest

from driftlab.errors import ConfigError
from driftlab.production.manifest import read_manifest

LISTED = (Path(__file__).parents[3] / "docs" / "reference" / "errors.md").read_text()


@pytest.fixture
def manifest(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def read(text, name="units.csv"):
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_text(text, encoding="utf-8")
        return read_manifest(name)

    return read


@pytest.fixture
def found(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def of(pattern, *paths):
        for path in paths:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            Path(path).touch()
        return read_manifest(pattern)

    return of


def test_a_row_is_a_recording_and_paths_are_relative_to_the_manifest(manifest):
    read = manifest(
        "unit,role,path,lot,date,chamber\n"
        "0002,soak,a.h5,L1,2026-01-05,K2\n"
        "0001,calibration,b.h5::0:600,L1,2026-01-06,K2\n"
        "0001,test,/data/c.h5,L1,2026-01-09,K3\n"
        "0001,train,s3://bucket/d.h5,,,K2\n",
        "line/units.csv",
    )
    second, first = read.units
    assert (second.unit, first.unit) == ("0002", "0001")
    assert second.recordings == {"calibration": ("line/a.h5",)}
    assert first.recordings == {
        "calibration": ("line/b.h5::0:600",), "holdout": ("/data/c.h5",), "train": ("s3://bucket/d.h5",),
    }  # fmt: skip
    assert (first.lot, first.date) == ("L1", "2026-01-06")  # the day of the soak
    assert first.more == {"chamber": "K2, K3"}
    assert [list(unit.more) for unit in read.units] == [["chamber"], ["chamber"]]


def test_of_several_soaks_each_has_its_own_columns_in_the_order_of_the_rows(manifest):
    rows = ["1,soak,b.h5,K2", "1,train,c.h5,K3", "2,soak,e.h5,K1", "1,soak,a.h5,K1", "1,soak,d.h5,"]
    first, second = manifest("\n".join(["unit,role,path,chamber", *rows])).units
    assert first.recordings["calibration"] == ("b.h5", "a.h5", "d.h5")
    assert first.of_soaks == ({"chamber": "K2"}, {"chamber": "K1"}, {"chamber": ""})
    assert second.of_soaks == ()


@pytest.mark.parametrize(
    "text", ["unit;path\n1;a.h5\n", "unit\tpath\n1\ta.h5\n", "\ufeffUnit,Path\r\n1 , a.h5\r\n\r\n"]
)
def test_what_spreadsheets_write_is_read(manifest, text):
    (unit,) = manifest(text).units
    assert (unit.unit, unit.recordings) == ("1", {"calibration": ("a.h5",)})
    assert (unit.lot, unit.date, unit.more) == ("", "", {})


@pytest.mark.parametrize(
    ("written", "iso"),
    [
        ("06.11.2026", "2026-11-06"),
        ("6.1.2026 14:05", "2026-01-06 14:05"),
        ("31/01/2026", "2026-01-31"),
        ("1/31/2026", "2026-01-31"),
        ("05/05/2026", "2026-05-05"),
        ("2026-01-31T14:05", "2026-01-31T14:05"),
    ],
)
def test_dates_of_spreadsheets_are_read_where_they_are_one(manifest, written, iso):
    assert manifest(f"unit,path,date\n1,a.h5,{written}\n").units[0].date == iso


@pytest.mark.parametrize("date", ["05/06/2026", "31.02.2026", "13/13/2026", "05-06-2026"])
def test_a_date_that_is_none_or_two_is_a_mistake(manifest, date):
    with pytest.raises(ConfigError, match=rf"line 2: date '{date}' is no date, or two; write it as 2026-01-31"):
        manifest(f"unit,path,date\n1,a.h5,{date}\n")


def test_a_manifest_may_be_called_tsv(manifest):
    assert manifest("unit\trole\tpath\na\tcalibration\ta.h5\n", "units.tsv").units[0].unit == "a"


def test_the_same_recording_may_calibrate_and_train(manifest):
    (unit,) = manifest("unit,role,path\n1,calibration,a.h5\n1,train,a.h5\n").units
    assert unit.recordings == {"calibration": ("a.h5",), "train": ("a.h5",)}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no column 'unit' (it is empty)"),
        ("name,path\n1,a.h5\n", "has no column 'unit' (it has name, path); a manifest needs unit and path"),
        ("unit,file\n1,a.h5\n", "has no column 'path' (it has unit, file)"),
        ("unit,path,lot,lot\n", "column 'lot' is there twice"),
        ("unit,path\n", "has no unit; write a line a recording below the header"),
        ("unit,path\n1\n", "line 2: has 1 cells, the header 2"),
        ("unit,path\n1,a.h5\n2,./a.h5\n", "line 3: path ./a.h5 is in line 2 already"),
        ("unit,path\n1,a.h5\n1,a.h5\n", "line 3: path a.h5 is in line 2 already"),
        ("unit,role,path\n1,,a.h5\n1,test,a.h5\n", "line 3: path a.h5 is in line 2 already"),
        ("unit,role,path\n1,soaked,a.h5\n", "line 2: role 'soaked' is not known"),
        ("unit,role,path\n1,test,a.h5\n", "line 2: unit 1 has no recording to fit on"),
        ("unit,path,lot\n1,a.h5,A\n1,b.h5,B\n", "line 3: unit 1 is of lot B here and of A before"),
        ("unit,path,date\n1,a.h5,5.1.26\n", "line 2: date '5.1.26' is no date, or two"),
        ("unit,path\n1,\n", "line 2: unit 1 has no path"),
        ("unit,path\n../1,a.h5\n", "line 2: unit '../1' can be no folder's name"),
        ("unit,path\n.1,a.h5\n", "line 2: unit '.1' can be no folder's name"),
        ("unit,path\n,a.h5\n", "line 2: unit '' is empty"),
        (f"unit,path\n{'é' * 101},a.h5\n", "has more than 200 bytes"),
    ],
)
def test_what_is_wrong_with_a_manifest_is_said_with_its_line(manifest, text, said):
    with pytest.raises(ConfigError) as error:
        manifest(text)
    assert said in str(error.value)
    assert str(error.value).startswith("--units units.csv: ")
    assert str(error.value) in LISTED


def test_of_many_mistakes_the_first_five_are_said(manifest):
    rows = "".join(f"{k},no,{k}.h5\n" for k in range(9))
    with pytest.raises(ConfigError) as error:
        manifest(f"unit,role,path\n{rows}")
    lines = str(error.value).splitlines()
    assert [line.split(":")[1] for line in lines[:-1]] == [f" line {k}" for k in range(2, 7)]
    assert lines[-1] == "and 4 more of the kind"


def test_a_manifest_that_cannot_be_read_is_refused(manifest, tmp_path):
    with pytest.raises(ConfigError, match=r"^--units no\.csv: cannot be read \(No such file or directory\);"):
        read_manifest("no.csv")
    (tmp_path / "odd.csv").write_bytes(b"unit,path\n\xff,a.h5\n")
    with pytest.raises(ConfigError, match=r"^--units odd\.csv: is not UTF-8 text;"):
        read_manifest("odd.csv")


@pytest.mark.parametrize(
    ("pattern", "paths", "names"),
    [
        ("units/*/soak.h5", ["units/0001/soak.h5", "units/0002/soak.h5"], ["0001", "0002"]),
        ("soak_*.h5", ["soak_a.h5", "soak_b.h5"], ["a", "b"]),
        ("*/*.csv", ["L1/a.csv", "L1/b.csv"], ["a", "b"]),
        ("*/*.csv", ["L1/a.csv", "L2/a.csv"], ["L1", "L2"]),
        ("*/*.csv", ["L1/a.csv", "L2/b.csv"], ["L1-a", "L2-b"]),
        ("**/soak.h5", ["a/soak.h5", "b/c/soak.h5"], ["a", "b-c"]),
        ("u?[0-9]/s.h5", ["uA1/s.h5", "uB1/s.h5", "uAA/s.h5"], ["A", "B"]),
        ("u?[0-9]/s.h5", ["uA1/s.h5"], ["A-1"]),
        ("units/one.h5", ["units/one.h5"], ["one"]),
    ],
)
def test_a_unit_of_a_pattern_is_called_as_its_path_differs(found, pattern, paths, names):
    units = found(pattern, *paths).units
    assert [unit.unit for unit in units] == names
    assert [unit.recordings for unit in units] == [{"calibration": (path,)} for path in paths[: len(names)]]


def test_a_pattern_is_looked_up_where_it_points(found, tmp_path):
    found("units/*/a.h5", "units/1/a.h5", "units/2/a.h5")
    units = read_manifest(str(tmp_path / "units" / "*" / "a.h5")).units
    assert [unit.unit for unit in units] == ["1", "2"]


def test_a_pattern_of_buckets_is_listed_there(tmp_path):
    fsspec = pytest.importorskip("fsspec")
    memory = fsspec.filesystem("memory")
    for name in ("0001", "0002"):
        memory.pipe_file(f"/bucket/{name}/soak.h5", b"")
    memory.pipe_file("/bucket/line/units.csv", b"unit,path\n7,../0001/soak.h5\n")
    try:
        units = read_manifest("memory://bucket/*/soak.h5").units
        assert [unit.unit for unit in units] == ["0001", "0002"]
        assert units[0].recordings == {"calibration": ("memory:///bucket/0001/soak.h5",)}
        (unit,) = read_manifest("memory://bucket/line/units.csv").units
        assert unit.recordings == {"calibration": ("memory://bucket/line/../0001/soak.h5",)}
    finally:
        memory.rm("/bucket", recursive=True)


def test_a_pattern_without_units_is_refused(found):
    with pytest.raises(ConfigError, match=r"^--units units/\*/soak\.h5: no file is called so;"):
        found("units/*/soak.h5")
    with pytest.raises(ConfigError, match=r"are both of unit a-b-c;"):
        found("*/*.h5", "a/b-c.h5", "a-b/c.h5")


def test_rows_cells_and_mistakes_without_end_are_bounded(manifest, monkeypatch):
    monkeypatch.setattr("driftlab.production.manifest.COUNT", 3)
    with pytest.raises(ConfigError, match="has more than 3 recordings, or 10,000,000 cells; make several fleets of it"):
        manifest("unit,path\n" + "".join(f"u{k},{k}.h5\n" for k in range(4)))
    with pytest.raises(ConfigError, match="and 99995 more of the kind"):
        manifest("unit,path\n" + "a\n" * 100_000)
