"""Folders of units in a bucket, of moto, which serves the API of S3: a fleet there is as in its own folder."""

import json
from pathlib import Path

import fleets
import fsspec
import polars as pl
import pytest
from clusters import s3, said, scheduler, worker

from driftlab.config import load_config
from driftlab.errors import ConfigError, Unwritable
from driftlab.family.record import UnitRecord
from driftlab.production import fleet as job
from driftlab.production import fleet_folder, units_pass
from driftlab.production.unit_folders import UnitPlace
from driftlab.production.unit_store import UnitStore, open_store

COUNT = 4


@pytest.fixture(scope="module", autouse=True)
def server(tmp_path_factory):
    with s3(tmp_path_factory.mktemp("server")) as system:
        system.mkdir("results")
        yield


@pytest.fixture
def bucket():
    """The file system of the bucket `results`, which is empty."""
    system = fsspec.filesystem("s3")
    system.invalidate_cache()
    for name in system.find("results"):
        system.rm_file(name)
    return system


@pytest.fixture(scope="module")
def line(tmp_path_factory):
    """A fleet's recordings, of which one cannot be read, and what is made of them in a folder, `here`."""
    folder = tmp_path_factory.mktemp("line")
    fleets.write_fleet(folder, COUNT, broken=[3])
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(units_pass, "Pool", lambda workers: fleets.Here())
        job.fleet(load_config(Path("family.yaml")), "units.csv", Path("here"), pages=["0001"], certificate=True)
    return folder


def unit(name="7", **more):
    return UnitRecord(key="k", unit=name, state="failed", error="none", **more)


def test_a_unit_is_there_when_its_record_is_and_what_others_put_there_stays(bucket):
    units = open_store("s3://results/a/", "id")
    assert open_store("s3://results/a", "id") == units
    assert units.reached()
    assert units.names() == []
    assert units.record("7") is None
    put = units.put(unit(), {"map.json": b"1", "page/report.html": b"p"})
    assert units.record("7").written.keys() == {*put.written, "unit.json"}
    bucket.pipe_file("results/a/units/7/mine.txt", b"mine")
    bucket.pipe_file("results/a/units/7/page/report.html", b"edited")
    units.put(unit(), {"map.json": b"2"})
    assert units.names() == ["7"]
    assert units.names("map.json") == ["7"]
    assert units.read("7", "map.json") == b"2"
    assert units.read("7", "mine.txt") == b"mine"
    assert units.read("7", "page/report.html") == b"edited"
    with units.file("7", "map.json") as path:
        assert path.read_bytes() == b"2"


def test_scratch_is_gone_at_the_end(bucket):
    units = open_store("s3://results/a", "id")
    with units.scratch() as scratch:
        scratch.write("part-1", b"1")
        assert scratch.read("part-1") == b"1"
        with scratch.files(["part-1"]) as (path,):
            assert path.read_bytes() == b"1"
    assert units.find("") == ["driftlab.json"]


def test_another_s_place_is_refused(bucket):
    open_store("s3://results/a", "id")
    with pytest.raises(ConfigError, match="has the units of another fleet; name another place"):
        open_store("s3://results/a", "other")
    assert not UnitStore("s3://results/a", "other").reached()
    bucket.pipe_file("results/b/notes.txt", b"mine")
    with pytest.raises(ConfigError, match="has objects that no fleet of driftlab wrote"):
        open_store("s3://results/b", "id")
    for url in ("results/a", "file:///folder", "https://host/line"):
        with pytest.raises(ConfigError, match="is no URL of a store"):
            open_store(url, "id")
    with pytest.raises(ConfigError, match="cannot be reached"):
        open_store("nosuch://line", "id")
    with pytest.raises(Unwritable, match=r"s3://no-such-bucket/a: there is no such bucket .*; create it"):
        open_store("s3://no-such-bucket/a", "id")


def in_store(bucket, place):
    """Return the objects of a fleet as files in a folder."""
    folder = Path(f"copy-{place}")
    for name in bucket.find(f"results/{place}/units"):
        path = folder / name.removeprefix(f"results/{place}/")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bucket.cat_file(name))
    return folder


def test_a_fleet_there_is_as_in_a_folder(line, bucket, monkeypatch):
    monkeypatch.chdir(line)
    here = fleets.Here()
    monkeypatch.setattr(units_pass, "Pool", lambda workers: here)
    wanted = {"pages": ["0001"], "certificate": True}
    result = job.fleet(load_config(Path("family.yaml")), "units.csv", Path("there"), store="s3://results/c", **wanted)
    assert not (line / "there" / "units").exists()
    assert [name for name in result.written if "s3:" in name] == [
        "s3://results/c/units/", "pages of 1 in s3://results/c/units/NAME/page/",
    ]  # fmt: skip
    assert result.record("0001").state == "done"
    found, expected = fleets.contents(in_store(bucket, "c")), fleets.contents(line / "here")
    expected = {name: content for name, content in expected.items() if name.startswith("units/")}
    assert found.keys() == expected.keys()
    # a certificate is identified by its map, which says when it was fitted
    assert [name for name in found if found[name] != expected[name] and "certificate" not in name] == []
    tables = [pl.read_parquet(f"{name}/units.parquet").drop("seconds") for name in ("there", "here")]
    assert tables[0].equals(tables[1])
    assert Path("there/family.json").exists() == Path("here/family.json").exists()
    assert "s3://results/c/units/0001/page/report.html" in Path("there/report.html").read_text()
    here.asked.clear()
    again = job.fleet(load_config(Path("family.yaml")), "units.csv", Path("there"), **wanted)  # it knows its store
    assert here.asked == []
    assert again.summary["store"] == "s3://results/c"
    with pytest.raises(ConfigError, match="the units of there are in s3://results/c; leave --store out"):
        job.fleet(load_config(Path("family.yaml")), "units.csv", Path("there"), store="s3://results/d")
    with pytest.raises(ConfigError, match="the units of here are in the folder itself"):
        job.fleet(load_config(Path("family.yaml")), "units.csv", Path("here"), store="s3://results/d")


def test_workers_that_do_not_see_the_folder_go_through_the_store(line, bucket, tmp_path, monkeypatch):
    monkeypatch.chdir(line)
    monkeypatch.setattr(job, "ALONE", 0)
    monkeypatch.setattr(units_pass, "Pool", None)  # nobody else works
    with scheduler(tmp_path) as (_, log):
        address = said(log, "Scheduler at:").split()[-1]
        monkeypatch.setattr(
            fleet_folder, "UnitPlace", lambda path, signed: UnitPlace(path, b"another's")
        )  # out of sight
        with worker(tmp_path, address):
            job.fleet(
                load_config(Path("family.yaml")), "units.csv", Path("far"), scheduler=address, store="s3://results/e"
            )
    expected = {name: content for name, content in fleets.contents(line / "here").items() if "units/" in name}
    found = fleets.contents(in_store(bucket, "e"))
    assert {name: expected[name] for name in found} == found
    assert {name for name in expected if name not in found} == {
        name for name in expected if "page/" in name or "certificate" in name
    }
    assert json.loads(bucket.cat_file("results/e/driftlab.json"))["program"] == "driftlab fleet"
