"""`driftlab.production.fleet`: no unit is calibrated twice, a failure stays alone, and files of others stay."""

import hashlib
import json
import os
import shutil
import sqlite3
from contextlib import closing
from pathlib import Path

import family
import fleets
import h5py
import polars as pl
import pytest

import driftlab
from driftlab.config import load_config
from driftlab.errors import ConfigError, DataError
from driftlab.production import fleet as job
from driftlab.production import units_pass

COUNT = 4


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return fleets.made_once(tmp_path_factory.mktemp("fleet"), COUNT)


@pytest.fixture
def fleet(made, tmp_path, monkeypatch):
    """A function that does a fleet again, in a copy of it; it gives the result, and the units (or pages) done."""
    shutil.copytree(made, tmp_path / "copy", copy_function=shutil.copy2)
    monkeypatch.chdir(tmp_path / "copy")

    def fleet(units="units.csv", config="family.yaml", out="made", *, lost=(), progress=None, settings=(), **wanted):
        here = fleets.Here(lost)
        monkeypatch.setattr(units_pass, "Pool", lambda workers: here)
        loaded = load_config(Path(config), settings=settings)
        result = job.fleet(loaded, units, Path(out), progress=progress, **wanted)
        return result, here.pages if "pages" in wanted else here.asked

    return fleet


def table(out="made"):
    return pl.read_parquet(Path(out) / "units.parquet")


def test_a_broken_file_is_a_row_with_its_error(fleet):
    result, asked = fleet()
    assert asked == []
    rows = table()
    assert rows["unit"].n_unique() == COUNT
    assert len(rows) == 3 * (COUNT - 1) + 1
    (failed,) = rows.filter(state="failed").to_dicts()
    assert failed["unit"] == "0003"
    assert "no file of the" in failed["error"] or "hdf5 was expected" in failed["error"]
    assert result.failed == {"0003": failed["error"]}
    assert result.lines()[0] == "4 units: 3 done, 1 failed (all of them before)"
    assert result.lines()[1] == f"failed: unit 0003: {failed['error']}"
    assert any("column `error` of units.parquet" in line for line in result.lines())


def test_all_that_fail_are_an_error_and_a_table_all_the_same(fleet):
    for path in Path("units").rglob("soak.h5"):
        path.write_bytes(b"no HDF5")
    with pytest.raises(DataError, match=r"^all 4 units failed; the first is 0000: "):
        fleet()
    assert table()["state"].to_list() == ["failed"] * COUNT
    with pytest.raises(DataError, match=r"^the only unit, soak, failed: .*units.0000.soak\.h5: [^;]*; use kind: csv$"):
        fleet("units/0000/soak.h5", out="one")


def test_a_folder_in_place_of_a_pattern_is_said_to_be_one(fleet):
    with pytest.raises(
        DataError, match=r"^--units units/: is a folder, .* quotes, as 'units/\*\.csv', or name a manifest$"
    ):
        fleet("units/", out="one")


@pytest.mark.parametrize("limited", [True, False])
def test_a_unit_in_doubt_is_not_said_to_be_good(fleet, limited):
    with h5py.File("units/0001/soak.h5", "r+") as file:
        file["gyro"][:, 1] = file["gyro"][:, 0]
    doubt = "gyro y shows what gyro x shows, row by row; correct source.channels.gyro.path"
    if not limited:
        config = Path("family.yaml")
        config.write_text("".join(row for row in config.read_text().splitlines(True) if not row.startswith("limits")))
    result, _ = fleet()
    told, page = result.summary, Path("made/report.html").read_text()
    assert result.lines()[0].startswith("4 units: 3 done (1 of them in doubt), 1 failed")
    assert f"  unit 0001: in doubt: {doubt}" in "\n".join(result.lines())
    assert "no unit stands out" not in result.lines()
    assert told["counts"]["in_doubt"] == 1
    of_yield = (0, 3) if limited else (2, 1)  # soaks so short decide no limit
    assert (told["yield"]["accepted"], told["yield"]["undecided"]) == of_yield
    assert "in doubt: gyro y shows what gyro x shows, row by row" in told["yield"]["reasons"]
    assert result.record("0001").doubts == [doubt]
    (row, *_) = table().filter(unit="0001").to_dicts()
    assert row["odd_why"].startswith(f"in doubt: {doubt}")
    assert row["limits"] == ("undecided" if limited else None)
    assert "1 odd, 1 of them in doubt" in page
    assert "1 of 3 units is odd, 1 of them in doubt." in page
    assert f"in doubt: {doubt}" in page


def test_what_looks_otherwise_and_is_the_same_is_not_done_again(fleet):
    before = fleets.contents(Path("made"))
    for path in Path("units").rglob("soak.h5"):
        os.utime(path)
    assert fleet()[1] == []
    assert fleets.contents(Path("made")) == before


def test_a_recording_that_changed_is_done_again_and_no_other(fleet):
    shutil.copy("units/0001/soak.h5", "units/0003/soak.h5")
    result, asked = fleet()
    assert asked == ["0003"]
    assert result.summary["replaced"] == ["0003"]
    assert not result.failed
    assert result.lines()[0] == "4 units: 4 done, 0 failed (1 of them now, 3 before)"
    rows = table()
    assert rows.filter(unit="0001")["noise"].to_list() == rows.filter(unit="0003")["noise"].to_list()


def test_another_config_does_all_again(fleet):
    assert len(fleet(settings=["filter.align=50 s"])[1]) == COUNT
    assert fleet(settings=["filter.align=50 s"])[1] == []


def test_force_does_all_again_to_the_same_end(fleet):
    before = fleets.contents(Path("made"))
    assert len(fleet(force=True)[1]) == COUNT
    after = fleets.contents(Path("made"))
    failed = "units/0003/unit.json"  # whose error names the file where it is now
    assert after.pop(failed)["key"] == before.pop(failed)["key"]
    assert after == before


def test_a_pattern_finds_the_units_of_the_manifest(fleet):
    result, asked = fleet("units/*/soak.h5")
    assert asked == []
    assert table()["unit"].unique().sort().to_list() == [f"{k:04d}" for k in range(COUNT)]
    assert table()["lot"].null_count() == len(table())
    assert result.summary["counts"]["done"] == COUNT - 1


def test_lots_dates_and_the_rest_are_those_of_the_manifest_now(fleet):
    assert table()["chamber"].unique().sort().to_list() == ["K0", "K1"]
    text = Path("units.csv").read_text().replace("L00", "north").replace("chamber", "noise")
    Path("units.csv").write_text(text)
    _, asked = fleet()
    assert asked == []
    rows = table()
    assert rows["lot"].unique().sort().to_list() == ["L01", "north"]
    assert rows["manifest_noise"].unique().sort().to_list() == ["K0", "K1"]
    record = json.loads(Path("made/units/0000/unit.json").read_text())
    assert (record["lot"], record["more"]) == ("north", {"noise": "K0"})


def test_one_recording_given_for_two_units_is_said_to_be(fleet):
    result, _ = fleet()
    assert result.summary["same_recordings"] == []
    shutil.copy("units/0000/soak.h5", "units/0002/soak.h5")
    result, asked = fleet()
    assert asked == ["0002"]
    assert result.summary["same_recordings"] == [["0000", "0002"]]
    said = "units 0000, 0002 have the same recordings and count as 2: name these once"
    assert said in result.lines()


def test_a_unit_that_left_stays_where_it_is_and_out_of_the_tables(fleet):
    lines = Path("units.csv").read_text().splitlines()
    Path("units.csv").write_text("\n".join(line for line in lines if not line.startswith("0001")))
    result, asked = fleet()
    assert asked == []
    assert (Path("made") / "units" / "0001" / "unit.npz").is_file()
    assert "0001" not in table()["unit"].to_list()
    assert any(line.startswith("1 unit is not in the manifest any more (0001)") for line in result.lines())


def test_a_recording_that_is_gone_does_not_take_its_results_along(fleet):
    Path("units/0001/soak.h5").unlink()
    result, asked = fleet()
    assert asked == []
    assert any("0001" in line and "--force drops them" in line for line in result.lines())
    assert table().filter(unit="0001")["state"].to_list() == ["done"] * 3
    result, _ = fleet(force=True)
    assert sorted(result.failed) == ["0001", "0003"]


def test_a_unit_whose_worker_was_lost_is_done_by_the_next_command(fleet):
    shutil.rmtree("made/units/0002")
    result, _ = fleet(lost={"0002": "its worker was killed"})
    assert result.failed["0002"] == "its worker was killed"
    result, asked = fleet()
    assert asked == ["0002"]
    assert list(result.failed) == ["0003"]


def test_what_others_put_into_a_unit_s_folder_stays_there(fleet):
    note = Path("made/units/0003/note.txt")
    note.write_text("dropped")
    shutil.copy("units/0001/soak.h5", "units/0003/soak.h5")
    fleet()
    assert note.read_text() == "dropped"
    assert (note.parent / "unit.npz").is_file()


def test_a_folder_of_someone_else_is_refused(fleet):
    Path("mine").mkdir()
    Path("mine/thesis.txt").write_text("")
    with pytest.raises(ConfigError, match=r"^--out mine: exists and is not the output of an earlier fleet;"):
        fleet(out="mine")
    assert os.listdir("mine") == ["thesis.txt"]


def test_a_fleet_has_one_writer(fleet):
    said = []

    def progress(stage):
        with pytest.raises(ConfigError, match=r"^--out made: is being written by "):
            job.fleet(load_config(Path("family.yaml")), "units.csv", Path("made"))
        said.append(stage.name)

    fleet(force=True, progress=progress)
    assert said
    assert not Path("made/driftlab.lock").exists()


def test_what_was_being_replaced_when_all_ended_is_finished(fleet):
    before, units = fleets.contents(Path("made")), Path("made/units")
    shutil.copytree(units / "0000", units / ".0000.old")
    shutil.rmtree(units / "0000")
    shutil.copytree(units / "0001", units / ".0001.new")
    shutil.copytree(units / "0002", units / ".0002.old")
    (units / ".0002.old" / "note.txt").write_text("kept")
    assert fleet()[1] == []
    assert (units / "0002" / "note.txt").read_text() == "kept"
    (units / "0002" / "note.txt").unlink()
    assert fleets.contents(Path("made")) == before


def test_a_unit_done_again_before_the_end_came_has_its_map_with_the_family_again(fleet, monkeypatch):
    before = fleets.contents(Path("made"))
    assert "units/0002/family_map.json" in before

    def killed(*_):
        raise SystemExit

    with monkeypatch.context() as patch:
        patch.setattr(job, "analyse", killed)
        shutil.rmtree("made/units/0002")
        with pytest.raises(SystemExit):
            fleet()
    assert json.loads(Path("made/fleet.json").read_text())["complete"] is False
    assert fleet()[1] == []
    assert fleets.contents(Path("made")) == before


def test_a_record_that_is_damaged_is_done_again(fleet):
    before = fleets.contents(Path("made"))
    Path("made/units/0002/unit.json").write_text('{"schema": 1')
    assert fleet()[1] == ["0002"]
    after = fleets.contents(Path("made"))
    aside = {f"units/0002/{name}.before-1" for name in ("unit.json", "map.json", "unit.npz")}  # which nothing knows
    assert {name: text for name, text in after.items() if name not in aside} == before
    assert aside < set(after)


def test_pages_are_made_for_those_that_are_asked_for(fleet):
    assert not list(Path("made/units").glob("*/page"))
    result, asked = fleet(pages=["000[12]", "0003"])
    assert asked == ["0001", "0002"]
    assert result.summary["pages"] == ["0001", "0002"]
    assert (Path("made/units/0001/page/report.html")).is_file()
    assert fleet(pages=["0001"])[1] == []
    assert fleet()[1] == []
    with pytest.raises(ConfigError, match=r"^--pages 77: no unit is called so;"):
        fleet(pages=["77"])


def test_progress_says_how_far_it_is(fleet):
    said = []
    fleet(force=True, progress=lambda stage: said.append(stage.text()))
    assert said[0] == "units: 0 of 4 units"
    assert any(text.startswith("units: 4 of 4 units, 1 failed") for text in said)


def test_a_scheduler_has_its_own_workers(fleet):
    with pytest.raises(ConfigError, match=r"^--workers and --scheduler: both are given;"):
        fleet(workers=2, scheduler="tcp://127.0.0.1:1")


def test_from_python_it_is_arrays_of_the_units_that_are_done(fleet, monkeypatch):
    monkeypatch.setattr(units_pass, "Pool", lambda workers: fleets.Here())
    result = driftlab.fleet("family.yaml", "units.csv", "made")
    rows = table().filter(state="done")
    assert result.unit.tolist() == ["0000", "0001", "0002"]
    assert result.noise.shape == result.coast_sigma.shape == (3, 3)
    assert result.noise[1].tolist() == rows.filter(unit="0001")["noise"].to_list()
    assert (result.units["noise"], result.units["walk"], result.units["T_low"]) == (
        "rad/s/sqrt(Hz)", "rad/s/sqrt(s)", "degC",
    )  # fmt: skip
    assert result.labels["swing"] == ("x", "y", "z")
    assert result.to_polars().equals(table())
    assert result.record("0001").key == rows.filter(unit="0001")["key"][0]
    assert result.summary == json.loads(Path("made/fleet.json").read_text())
    assert [axes.get_ylabel() for axes in result.plot().axes][:2] == ["residual [rad/s]", "noise [rad/s/sqrt(Hz)]"]
    result.save("saved")
    assert fleets.contents(Path("saved")) == fleets.contents(Path("made"))
    with pytest.raises(ConfigError, match=r"^out saved: exists;"):
        result.save("saved")
    with pytest.raises(ConfigError, match=r"^unit 9: is not in made;"):
        result.record("9")


def test_a_family_that_is_known_is_not_fitted_again(fleet):
    law = Path("made/family.json").read_bytes()
    shutil.move("made", "before")
    result, _ = fleet(out="new", family=Path("before/family.json"))
    assert any(line.startswith("before/family.json, a family of 3 units") for line in result.lines())
    known = json.loads(Path("new/family.json").read_text())
    assert known["mu"] == json.loads(law)["mu"]
    assert Path("new/units/0001/family_map.json").is_file()
    with pytest.raises(ConfigError, match=r"^--out before: holds before/family\.json, which is used here;"):
        fleet(out="before", family=Path("before/family.json"))


def test_a_map_with_the_family_that_was_edited_is_put_aside(fleet):
    path = Path("made/units/0000/family_map.json")
    path.write_text(edited := path.read_text() + "\n")
    Path("units.csv").write_text(Path("units.csv").read_text().replace("L00", "north"))  # another family
    fleet()
    assert path.with_name("family_map.json.before-1").read_text() == edited
    assert path.read_text() != edited


CERTIFICATE = ("certificate={number: 2026-7, laboratory: A <b>, customer: B}",)
SIGNED = {"certificate.html", "certificate.json"}


def certificates(out="made"):
    """The certificates of a fleet, by unit."""
    return {path.parent.name: json.loads(path.read_text()) for path in Path(out).rglob("certificate.json")}


def test_each_unit_that_is_done_has_a_certificate_and_none_is_done_again_for_it(fleet):
    result, asked = fleet(certificate=True, settings=CERTIFICATE)
    made = certificates()
    assert asked == []
    assert sorted(made) == ["0000", "0001", "0002"]
    assert "3 certificates" in result.written
    for unit, content in made.items():
        record = result.record(unit)
        files = {name: hashlib.sha256((Path("made/units") / unit / name).read_bytes()).hexdigest() for name in SIGNED}
        assert files.items() <= record.written.items()
        assert (content["item"]["serial"], content["laboratory"]["number"]) == (unit, f"2026-7/{unit}")
        assert content["method"]["map"]["sha256"] == record.written[record.map_file]
        assert content["method"]["performed"] == record.date
        assert content["method"]["config_sha256"] == hashlib.sha256(result.summary["config"].encode()).hexdigest()
        assert [row["verdict"] for row in content["limits"]] == [row["verdict"] for row in record.limits]
        names = [figure["name"] for figure in content["figures"]]
        assert names.count("noise") == 0  # the limit is held against another measurement of it
        coast = content["figures"][names.index("coast")]
        assert coast["U"] == pytest.approx([2 * sigma for sigma in record.figures["coast"].sigma])
        page = (Path("made/units") / unit / "certificate.html").read_text()
        assert "A &lt;b&gt;" in page
        assert "A <b>" not in page


def test_a_unit_whose_page_was_made_later_has_the_map_that_its_record_knows(fleet):
    maps = sorted(Path("made/units").glob("*/map.json"))
    before = [path.read_bytes() for path in maps]
    fleet(pages=["0001"])
    result, _ = fleet(certificate=True, settings=CERTIFICATE)
    assert [path.read_bytes() for path in maps] == before
    assert not [line for line in result.lines() if "has no certificate" in line]
    page = Path("made/units/0001/page/report.html").read_text()
    assert result.record("0001").written["map.json"] in page


def test_a_certificate_stays_until_its_results_change_and_one_that_was_filled_in_is_put_aside(fleet):
    fleet(certificate=True, settings=CERTIFICATE)
    before = fleets.contents(Path("made"))
    fleet(certificate=True, settings=CERTIFICATE)
    assert fleets.contents(Path("made")) == before
    page = Path("made/units/0001/certificate.html")
    page.write_text(page.read_text() + "filled in")
    Path("units.csv").write_text(Path("units.csv").read_text().replace("chamber", "serial"))
    fleet(certificate=True, settings=("certificate.customer=C",))
    assert certificates()["0001"]["laboratory"]["customer"] == "C"
    assert certificates()["0001"]["item"]["serial"] == "K1"  # of the manifest
    assert page.with_name("certificate.html.before-1").read_text().endswith("filled in")
    assert not page.read_text().endswith("filled in")


def test_a_unit_that_is_done_again_has_no_old_certificate(fleet):
    fleet(certificate=True)
    assert len(certificates()) == COUNT - 1
    fleet(settings=["filter.align=50 s"])
    assert certificates() == {}


def test_a_map_that_was_changed_is_not_certified(fleet):
    path = Path("made/units/0001/map.json")
    path.write_text(path.read_text() + " ")
    result, _ = fleet(certificate=True)
    assert sorted(certificates()) == ["0000", "0002"]
    assert any(line.startswith("unit 0001 has no certificate: ") for line in result.lines())


def test_the_yield_is_told_by_the_columns_that_are_asked_for(fleet):
    result, asked = fleet()
    whole, rows = result.summary["yield"], table().unique("unit").sort("unit")
    assert asked == []
    passed = rows["limits"].to_list().count("pass")
    assert (whole["units"], whole["accepted"]) == (COUNT, passed)
    assert [*whole["by"]] == ["lot"]
    again, asked = fleet(by=["chamber", "T_low"])
    told = again.summary["yield"]["by"]
    assert asked == []  # the units stay as they are
    assert [(one["chamber"], one["units"]) for one in told["chamber"]["groups"]] == [("K0", 2), ("K1", 2)]
    assert told["T_low"]["groups"][-1]["T_low"] == "not known"  # of the unit that failed
    assert any(line.startswith(f"yield: {passed} of {COUNT} units, ") for line in again.lines())
    page = (Path("made") / "report.html").read_text()
    assert "By chamber" in page
    assert "whether any is odd was not judged" in page  # so few are not
    assert sum(len(why) > 0 for why in rows["reasons"]) == COUNT - passed
    assert rows["reasons"].to_list()[3][0].startswith("not calibrated: ")
    assert {reason for why in rows["reasons"] for reason in why} == set(whole["reasons"])
    same, _ = fleet(by=["chamber", "T_low"])  # nothing is made again, and it says the same
    assert same.summary["yield"] == again.summary["yield"]
    with pytest.raises(ConfigError, match=r"--by colour: no such column; choose lot, .*chamber"):
        fleet(by=["colour"])


def moved(known, by):
    """Move the frozen level of a family's file by so much, rad/s: every unit is then out of control."""
    content = json.loads(known.read_text())
    for limits in content["baseline"]["limits"]:
        if limits["quantity"] == "level":
            limits["centre"] += by
    known.write_text(json.dumps(content))


def test_a_note_on_an_alarm_stays_until_the_alarm_is_another(fleet):
    shutil.move("made", "before")
    known, nasty = Path("before/family.json"), "<script>alert(1)</script> [bold]known[/]"
    moved(known, 1.0)
    first, _ = fleet(out="new", family=known)
    assert first.summary["family"]["open"] == ["0000", "0001", "0002"]
    with pytest.raises(ConfigError, match=r"0003 has no alarm.*; units with an alarm: 0000, 0001, 0002$"):
        fleet(out="new", family=known, acknowledge={"0001": nasty, "0003": "none"}, operator="anna")
    noted, asked = fleet(out="new", family=known, operator="anna")  # the note on the other one is kept
    fleet(out="new", family=known, acknowledge={"0001": nasty}, operator="anna")  # the same note again is no other
    assert asked == []
    assert noted.summary["family"]["open"] == ["0000", "0002"]
    assert f"acknowledged: unit 0001: {nasty} (anna, " in "\n".join(noted.lines())
    again, _ = fleet(out="new", family=known)  # nothing is made again, and it says the same
    assert again.summary["family"] == noted.summary["family"] | {"lines": again.summary["family"]["lines"]}
    by_lot, _ = fleet(out="new", family=known, by=["chamber"])  # all is made again
    assert by_lot.summary["family"]["acknowledged"] == noted.summary["family"]["acknowledged"]
    page = Path("new/report.html").read_text()
    assert "&lt;script&gt;alert(1)" in page
    assert nasty not in page
    listed, apart = page.index('id="alarms"'), page.index('id="acknowledged"')
    assert "0001" not in page[listed:apart]
    moved(known, 1.0)
    opened, _ = fleet(out="new", family=known)
    assert opened.summary["family"]["open"] == ["0000", "0001", "0002"]
    assert opened.summary["family"]["acknowledged"] == {}
    assert [one["note"] for one in opened.summary["acknowledgements"]] == [nasty]  # it is kept, and shown beside
    assert "noted before: &lt;script&gt;" in Path("new/report.html").read_text()
    with pytest.raises(ConfigError, match="--acknowledge 0009: no unit is called so"):
        fleet(out="new", family=known, acknowledge={"0009": "n"})


def test_results_go_to_a_database_and_its_options_nowhere(fleet):
    url = "sqlite:///line.db?timeout=86421.53197"  # an option, as a password may be one
    first, asked = fleet(to=url)
    again, _ = fleet(to=url, by=["chamber"])
    assert asked == []
    assert first.summary["id"] == again.summary["id"]
    with closing(sqlite3.connect("line.db")) as database:
        known = database.execute("SELECT fleet, name, units, done, failed FROM driftlab_fleets").fetchall()
        rows = database.execute("SELECT count(*), count(DISTINCT chamber) FROM driftlab_units").fetchall()
        limits = database.execute("SELECT DISTINCT name FROM driftlab_limits ORDER BY name").fetchall()
    assert known == [(first.summary["id"], "made", COUNT, COUNT - 1, 1)]
    assert rows == [(len(table()), 2)]
    assert limits == [("noise",), ("residual",)]
    assert not [path for path in Path("made").rglob("*") if path.is_file() and b"86421.53197" in path.read_bytes()]
    shutil.move("made", "elsewhere")
    there, _ = fleet(to=url, out="elsewhere")
    assert there.summary["id"] == first.summary["id"]


def test_units_that_were_soaked_twice_are_a_gauge_study(fleet):
    rows = Path("units.csv").read_text().splitlines()
    family.write(Path("again.h5"), family.soak(family.deal(COUNT, 1, lots=2)[0], fleets.HOURS, seed=9))
    one = rows[1].split(",")
    again = ",".join([one[0], "again.h5", *one[2:4], "K7"])
    Path("units.csv").write_text("\n".join([*rows, again]) + "\n")
    result, asked = fleet(appraiser="chamber")
    assert asked == [one[0]]
    repeats = result.record(one[0]).repeats
    assert [soak.name.rpartition("/")[2] for soak in repeats] == ["soak.h5", "again.h5"]
    assert [soak.place for soak in repeats] == [0, 1]
    record = result.record(one[0])
    for name in ("residual", "noise", "swing", "coast", "level"):
        apart = [soak.figures[name].value for soak in repeats]
        assert all(value is not None for of_soak in apart for value in of_soak), name
        assert apart[0] != apart[1]
    assert repeats[0].figures["noise"].value == pytest.approx(record.figures["noise"].value, rel=0.2)
    assert result.summary["gauge"]["why_not"].startswith("1 unit was soaked twice or more over the same range; soak 10")
    assert any(line.startswith("gauge R&R: 1 unit was soaked twice") for line in result.lines())
    assert "Gauge R&amp;R" in Path("made/report.html").read_text()
    with pytest.raises(ConfigError, match="--appraiser lot: no such column; choose chamber"):
        fleet(appraiser="lot")


def test_what_a_killed_worker_had_begun_to_write_is_gone_at_the_end(fleet):
    left = Path("made/units/.0001.0123456789ab.new")

    def note(_):
        left.mkdir(exist_ok=True)
        (left / "unit.npz").write_bytes(b"")

    fleet(progress=note)
    assert Path("made/fleet.json").is_file()
    assert not left.exists()
