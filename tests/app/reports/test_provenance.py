"""The sheet of a page: every hash is that of what one has in hand."""

import hashlib
import subprocess
import sys
from datetime import UTC, datetime

import h5py
import jinja2
import numpy as np
import pytest
import yaml
from written_configs import GOOD, load

from driftlab.config import load_config
from driftlab.evaluation.limits import Measured, check_limits
from driftlab.reports.pages import prose
from driftlab.reports.provenance import sheet_of
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from driftlab.storage.recorder import RECORDED_MARK
from fusion_plugins.thermal_maps.polynomial import Polynomial

SOURCE = """
source:
  kind: hdf5
  path: rest.h5
  channels: {time: {path: t, unit: s}, gyro: {path: gyro, unit: deg/s}}
"""
MAP = GOOD.replace("bias:", "calibration: {kind: polynomial, path: map.json}, bias:")


@pytest.fixture
def folder(tmp_path):
    with h5py.File(tmp_path / "rest.h5", "w") as file:
        file["t"], file["gyro"] = np.arange(9.0), np.zeros((9, 3))
    return tmp_path


def sha256sum(path):
    return subprocess.run(["sha256sum", str(path)], capture_output=True, text=True, check=True).stdout.split()[0]


def test_hashes_are_of_the_files_and_of_the_config_as_it_is_understood(folder):
    config = load(folder, GOOD + SOURCE + "serial: A-7\n")
    found = sheet_of(config)
    assert (found.serial, found.config) == ("A-7", "")
    (one,) = found.recordings
    path = folder / "rest.h5"
    assert one == {"name": str(path), "bytes": path.stat().st_size, "sha256": sha256sum(path)}
    (folder / "understood.yaml").write_text(config.as_yaml())
    assert found.config_sha256 == sha256sum(folder / "understood.yaml")
    assert yaml.safe_load(config.as_yaml())["serial"] == "A-7"


def test_a_file_that_has_changed_has_another_hash(folder):
    config, path = load(folder, GOOD + SOURCE), folder / "rest.h5"
    before = sheet_of(config).recordings[0]["sha256"]
    path.write_bytes(path.read_bytes() + b"more")
    after = sheet_of(config).recordings[0]["sha256"]
    assert (before != after, after) == (True, sha256sum(path))


def test_the_name_of_a_config_is_that_of_its_file(folder):
    (folder / "unit.yaml").write_text(GOOD)
    config = load_config(folder / "unit.yaml")
    assert config.name == "unit.yaml"
    assert config.model_copy(update={"latitude": None}).name == "unit.yaml"


def test_what_is_not_kept_has_no_hash(folder):
    config = load(folder, GOOD + SOURCE.replace("kind: hdf5", "kind: csv").replace("rest.h5", '"-"'))
    assert sheet_of(config).recordings == [{"name": "-"}]
    assert "not kept" in page_of(sheet_of(config))
    assert sheet_of(load(folder, GOOD)).recordings == []


def test_samples_in_memory_have_a_hash_of_their_own(folder):
    memory = in_memory_name({"time": (np.arange(9.0), "s"), "gyro": (np.zeros((9, 3)), "rad/s")})
    config = load(folder, GOOD).model_copy(update={"source": memory})
    assert sheet_of(config).recordings == [{"name": "data", **InMemoryName(memory).identity()}]


def test_the_date_is_that_of_the_recording_where_it_says_one(folder):
    config = load(folder, GOOD + SOURCE)
    assert (sheet_of(config).dated, sheet_of(config).date) == ("page", datetime.now(UTC).date().isoformat())
    with h5py.File(folder / "rest.h5", "r+") as file:
        file.attrs["program"], file.attrs["started"] = f"{RECORDED_MARK} 0", 1_700_000_000.0
    assert (sheet_of(config).dated, sheet_of(config).date) == ("recorded", "2023-11-14")
    live = sheet_of(load(folder, GOOD), [str(folder / "rest.h5")])  # what a device has sent, and was kept
    assert (live.date, live.recordings[0]["sha256"]) == ("2023-11-14", sha256sum(folder / "rest.h5"))


@pytest.mark.parametrize(
    ("cells", "settings", "date"),
    [
        (["2024-02-29T23:59:58", "2024-02-29T23:59:59"], "dates: {time: '%Y-%m-%dT%H:%M:%S'}", "2024-02-29"),
        (["1709251198.5", "1709251199.5"], "", "2024-02-29"),
        (["", "1709251199.5"], "", "2024-02-29"),
        (["23:59:58", "23:59:59"], "dates: {time: '%H:%M:%S'}", None),
        (["0.5", "1.5"], "", None),
        (["x", "1709251199.5"], "", None),
    ],
)
def test_the_date_is_that_of_the_first_row_whose_time_is_one(tmp_path, cells, settings, date):
    (tmp_path / "rest.csv").write_text("time,x,y,z\n" + "".join(f"{cell},0,0,0\n" for cell in cells))
    channels = "channels: {time: {path: time, unit: s}, gyro: {path: [x, y, z], unit: deg/s}}"
    config = load(tmp_path, f"{GOOD}\nsource:\n  kind: csv\n  path: rest.csv\n  {settings}\n  {channels}\n")
    expected = ("page", datetime.now(UTC).date().isoformat()) if date is None else ("recorded", date)
    assert (sheet_of(config).dated, sheet_of(config).date) == expected
    named = sheet_of(config, [f"{tmp_path / 'rest.csv'}::0:1"])
    assert (named.dated, named.date) == expected


def test_the_map_says_on_what_it_was_fitted(folder):
    T = np.linspace(0, 40, 300)
    bias = np.stack([1e-5 * T] * 3, axis=1) + 4.8481368e-6 * np.resize([1, -1], 300)[:, None]  # 1 deg/h
    fitted = Polynomial(order=1).fit(T, bias, {"recordings": "soak.h5", "fitted_at": "2026-01-02T03:04:05+00:00"})
    fitted.save(folder / "map.json")
    (one,) = sheet_of(load(folder, MAP)).maps
    assert (one["kind"], one["file"], one["sha256"]) == (
        "polynomial", str(folder / "map.json"), sha256sum(folder / "map.json"),
    )  # fmt: skip
    assert (one["fitted_on"], one["domain"]) == ("soak.h5", "0.00 to 40.00 °C")
    assert one["residual"] == "1, 1, 1 deg/h in samples"
    (folder / "map.json").unlink()
    assert sheet_of(load(folder, MAP)).maps == []  # as before it is fitted


def test_versions_are_those_that_ran(folder):
    found = sheet_of(load(folder, GOOD))
    assert found.versions["numpy"] == np.__version__
    assert found.versions["Python"] == sys.version.split()[0]
    assert {item["kind"] for item in found.plugins} >= {"zupt", "random_walk"}


def page_of(sheet):
    body = (
        '{% import "sheet.html" as sheets %}{{ sheets.head(sheet) }}{{ sheets.limits(sheet) }}{{ sheets.whole(sheet) }}'
    )
    package = jinja2.PackageLoader("driftlab.reports", "pages")
    loader = jinja2.ChoiceLoader([jinja2.DictLoader({"one.html": body}), package])
    environment = jinja2.Environment(loader=loader, autoescape=True)
    environment.filters["prose"] = prose
    return environment.get_template("one.html").render(sheet=sheet)


def test_no_text_of_a_user_is_taken_for_a_part_of_the_page(folder):
    config = load(folder, GOOD + "serial: '<b>&1'\nlimits: {coast: 2 deg/h}\n")
    judged = check_limits(
        config.limits, {"coast": Measured(*[np.ones(1), ("<i>",), np.ones(1), np.ones(1)], stands_on="<u>")}
    )
    html = page_of(sheet_of(config, [], judged=judged))
    assert "&lt;b&gt;&amp;1" in html
    for tag in ("<b>", "<i>", "<u>"):
        assert tag not in html
    assert 'class="verdict fail"' in html
    assert hashlib.sha256(config.as_yaml().encode()).hexdigest() in html
