"""The commands as functions: the content of the command's files, arrays in memory, no file that nobody asked for."""

import json
import subprocess
import sys
from pathlib import Path

import h5py
import numpy as np
import polars as pl
import pytest
import yaml
from command_line import driftlab as command
from units_at_rest import UNITS, unit_at_rest

import driftlab
from driftlab.config import Config, load_config
from driftlab.errors import BadValue, ConfigError, FusionError, MissingChannel, TimeBackwards, UnitError
from fusion_core import errors
from fusion_core.chunk import Chunk
from fusion_core.contracts import ThermalMap
from fusion_core.host.registry import registry

DRIFTLAB = Path(sys.executable).with_name("driftlab")
CONFIG = {"extends": "mems_crs05", "latitude": "40.9 deg", "heading": "0 deg"}
LISTED = (Path(__file__).parents[2] / "docs" / "reference" / "errors.md").read_text()


@pytest.fixture(scope="module")
def unit():
    return unit_at_rest(seconds=400.0, temperature=lambda t: 20 + t / 40)


@pytest.fixture
def data(unit):
    return {"time": (unit.t, "s"), **{name: (v, UNITS[name]) for name, v in unit.channels().items()}}


@pytest.fixture
def files(unit, tmp_path, monkeypatch):
    """The same recording and config as files, in the working directory."""
    monkeypatch.chdir(tmp_path)
    unit.write("rest.h5")
    channels = {name: {"path": name} for name in UNITS}
    Path("unit.yaml").write_text(yaml.safe_dump({**CONFIG, "source": {"kind": "hdf5", "channels": channels}}))
    return tmp_path


def test_importing_it_loads_no_library():
    heavy = ["numba", "numpy", "scipy", "h5py", "polars", "pydantic", "matplotlib", "typer", "fusion_plugins"]
    code = f"import sys, driftlab; dir(driftlab); print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_error_of_the_core_is_an_error_of_driftlab():
    ours = {name for name, item in vars(errors).items() if isinstance(item, type) and issubclass(item, FusionError)}
    assert ours | {"WorkersError"} == set(driftlab.errors.__all__)


def test_a_run_is_what_the_command_writes(files):
    result = driftlab.run("unit.yaml", "rest.h5::0:300")
    assert not Path("driftlab_out").exists()
    process = [DRIFTLAB, "run", "unit.yaml", "--input", "rest.h5::0:300", "--out", "command"]
    subprocess.run(process, check=True, capture_output=True, timeout=300)
    result.save("saved")
    written = driftlab.run("unit.yaml", "rest.h5::0:300", out="written")
    for folder in ("saved", "written"):
        for name in ("summary.json", "report.html"):
            assert Path(folder, name).read_bytes() == Path("command", name).read_bytes()
        with h5py.File("command/estimates.h5") as theirs, h5py.File(f"{folder}/estimates.h5") as ours:
            assert dict(theirs.attrs) == dict(ours.attrs)
            assert set(theirs) == set(ours) == set(result) == set(written)
            for name, values in theirs.items():
                assert dict(values.attrs).keys() == dict(ours[name].attrs).keys()
                for array in (ours[name][:], result[name], written[name]):
                    assert array.dtype == values.dtype
                    np.testing.assert_array_equal(array, values[:])


@pytest.mark.parametrize("more", [{}, {"out": "{}"}, {"out": "{}", "smooth": True}])
def test_detail_is_more_columns_and_no_other_numbers(files, more):
    places = [more | {"out": more["out"].format(k)} if more else {} for k in range(2)]
    plain, detailed = (driftlab.run("unit.yaml", "rest.h5", detail=k == 1, **place) for k, place in enumerate(places))
    assert set(detailed) - set(plain) == {"white", "temperature_rate"}
    for name, values in plain.items():
        np.testing.assert_array_equal(detailed[name], values)
    np.testing.assert_allclose(np.sum(detailed["white"] ** 2, axis=1), detailed["nis"], rtol=1e-5)
    assert str(plain.summary) == str(detailed.summary)


def test_arrays_in_memory_give_what_the_file_gives(files, data):
    from_file, from_arrays = driftlab.run("unit.yaml", "rest.h5"), driftlab.run(CONFIG, data)
    for name, values in from_file.items():
        np.testing.assert_array_equal(from_arrays[name], values)
    assert sorted(path.name for path in files.iterdir()) == ["rest.h5", "unit.yaml"]


def test_the_forms_of_a_config_and_of_data_are_the_same(files, data, unit):
    expected = driftlab.run(CONFIG, data).bias
    text = yaml.safe_dump(CONFIG)
    for config in (text, Path("unit.yaml"), "unit.yaml", load_config(Path("unit.yaml"))):
        np.testing.assert_array_equal(driftlab.run(config, data).bias, expected)
    plain = {"time": unit.t, **unit.channels()}
    columns = {"time [s]": unit.t, "temperature": unit.temperature}
    for k, axis in enumerate("xyz"):
        columns |= {f"gyro_{axis} [rad/s]": unit.gyro[:, k], f"accel_{axis}": unit.accel[:, k]}
    for given, units in (
        (plain, UNITS),
        (Chunk(unit.t, unit.channels()), None),
        (pl.DataFrame(columns), {"accel": "m/s^2", "temperature": "degC"}),
    ):
        np.testing.assert_array_equal(driftlab.run(CONFIG, given, units=units).bias, expected)


def test_units_are_converted(unit, data):
    degrees = {**data, "gyro": (np.rad2deg(unit.gyro), "deg/s"), "temperature": (unit.temperature + 273.15, "kelvin")}
    got, expected = driftlab.run(CONFIG, degrees), driftlab.run(CONFIG, data)
    np.testing.assert_allclose(got.bias, expected.bias, rtol=0, atol=1e-15)
    np.testing.assert_allclose(got.temperature, expected.temperature, rtol=1e-6)


def test_what_is_given_is_not_changed_and_needs_no_order_in_memory(unit, data):
    given = {**data, "gyro": (np.asfortranarray(unit.gyro), "rad/s"), "accel": (unit.accel.astype(np.float32), "m/s^2")}
    before = {name: values.copy() for name, (values, _) in given.items()}
    for values, _ in given.values():
        values.flags.writeable = False
    driftlab.run(CONFIG, given)
    for name, (values, _) in given.items():
        np.testing.assert_array_equal(values, before[name])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (lambda d: d.pop("time"), MissingChannel, r'data: has no time, only accel, gyro, temperature; add "time": \(t'),
        (lambda d: d.pop("gyro"), MissingChannel, "channel 'gyro' is needed by the filter and the recording has"),
        (
            lambda d: d.update(gyro=d["gyro"][0]),
            UnitError,
            r'channel gyro has no unit; write "gyro": \(gyro, "deg/s"\)',
        ),
        (
            lambda d: d.update(gyro=(d["gyro"][0], "m")),
            UnitError,
            "'m' cannot be converted to rad/s; write a unit like",
        ),
        (
            lambda d: d.update(v=(d["time"][0], "Volts!")),
            UnitError,
            "unit 'Volts!' is not known; write it like 'hPa'",
        ),
        (
            lambda d: d.update(valid=(d["time"][0], "s")),
            UnitError,
            "cannot be converted to 1; it has no unit, remove it",
        ),
        (lambda d: d.update(v=d["time"][0][:-1]), BadValue, "channel v has 7999 rows and time 8000, as many were"),
        (
            lambda d: d.update(gyro=(d["gyro"][0][:, :0], "rad/s")),
            BadValue,
            r"has shape \(8000, 0\), \(N,\) or \(N, 1 to",
        ),
        (
            lambda d: d.update(v=["text"] * 8000),
            BadValue,
            "channel v is of type <U4, numbers were expected; convert it",
        ),
        (lambda d: d.update(time=(d["time"][0][::-1], "s")), TimeBackwards, "data: time runs backwards by 0.05 s"),
        (lambda d: d.update(tau=d["time"][0]), ConfigError, "channel 'tau': the program uses this name itself"),
    ],
)
def test_data_that_cannot_be_used_is_refused(data, change, error, message):
    change(data)
    with pytest.raises(error, match=message) as raised:
        driftlab.run(CONFIG, data)
    assert error not in {UnitError, BadValue} or f"\n    {raised.value}\n" in LISTED


HELD = {"kind": "held", "channel": "pressure", "noise": "2 Pa/sqrt(Hz)",
        "bias": {"kind": "random_walk", "walk": "0.02 Pa/sqrt(s)"}}  # fmt: skip


def test_a_sensor_of_any_unit_needs_one():
    t = np.arange(400.0)
    pressure = np.random.default_rng(0).normal(0.0, 2.0, 400)
    right = driftlab.run({"filter": HELD}, {"time": (t, "s"), "pressure": (pressure / 100, "hPa")})
    of_chunk = driftlab.run({"filter": HELD}, Chunk(t, {"pressure": pressure}))  # which is in SI
    np.testing.assert_allclose(right.bias, of_chunk.bias, rtol=1e-12)
    message = r'data: channel pressure has no unit; write "pressure": \(pressure, "Pa"\), or units='
    with pytest.raises(UnitError, match=message) as raised:
        driftlab.run({"filter": HELD}, {"time": (t, "s"), "pressure": pressure / 100})
    assert f"\n    {raised.value}\n" in LISTED
    with pytest.raises(UnitError, match="channel pressure: is in V"):
        driftlab.run({"filter": HELD}, Chunk(t, {"pressure": pressure}), units={"pressure": "V"})


def test_an_error_shows_a_setting_as_the_function_takes_it(tmp_path):
    T = np.linspace(0.0, 50.0, 100)
    polynomial = registry().classes(ThermalMap)["polynomial"].model_validate({"kind": "polynomial", "order": 1})
    polynomial.fit(T, np.outer(T, [1e-5, 2e-5, 3e-5]), {}).save(tmp_path / "map.json")
    with pytest.raises(ConfigError, match=r"write e\.g\. settings=\{'loss': '1 deg/h'\}"):
        driftlab.export("c", tmp_path / "map.json", tmp_path / "firmware", settings={"loss": 1.0})


def test_rows_that_cannot_be_used_are_left_out_and_told(data, unit):
    gyro = unit.gyro.copy()
    gyro[4000] = np.nan
    result = driftlab.run(CONFIG, {**data, "gyro": (gyro, "rad/s")})
    assert any(line.startswith("rows where gyro is not a finite number, left out: 1") for line in result.lines())


@pytest.mark.parametrize(
    ("config", "more", "message"),
    [
        (7, {}, "config: is a int, a path, YAML text, a dict or a Config was expected; write e.g."),
        ("none.yaml", {}, "none.yaml: cannot be read"),
        ("filter:\n  gyro: {noise: 3}", {}, r"YAML text:2: filter\.gyro\.noise: 3 has no unit; write e\.g\."),
        ({"filter": {"gyro": {"noise": 3.0}}}, {}, r"config: filter\.gyro\.noise: 3\.0 has no unit; write e\.g\."),
        ({"extends": "mems_crs5"}, {}, "extends: 'mems_crs5' is neither a packaged product nor a file; did you mean"),
        (CONFIG, {"units": {"giro": "deg/s"}}, "units: names 'giro', which data does not have; did you mean 'gyro'?"),
        (CONFIG, {"units": {"gyro": "deg/s"}}, "data: channel gyro is in 'rad/s' and in 'deg/s' by units; remove one"),
        (CONFIG, {"data": [1]}, "data: is a list, a path, a mapping of names to arrays, a data frame or a Chunk was"),
        (CONFIG, {"data": "rest.h5"}, "source: is missing; say how the recording is read: its kind and its channels"),
        (CONFIG, {"data": "rest.h5", "units": {"gyro": "deg/s"}}, "units: are given with rest.h5, which says them"),
        (CONFIG, {"data": None, "units": {"gyro": "deg/s"}}, "units: are given without data; give the data"),
    ],
)
def test_what_is_given_wrong_is_told(data, config, more, message):
    with pytest.raises(FusionError, match=message) as raised:
        driftlab.run(config, **{"data": data, **more})
    if str(raised.value).startswith(("units: ", "config: is", "data: ")):
        assert f"\n    {raised.value}\n" in LISTED


def test_one_axis_and_other_units_in_two_columns_are_told():
    frame = pl.DataFrame({"time [s]": [0.0, 1.0], "gyro_x [deg/s]": [0.0, 1.0], "gyro_y [rad/s]": [0.0, 1.0]})
    with pytest.raises(UnitError, match="columns gyro: are in deg/s and rad/s; convert them to one unit"):
        driftlab.run(CONFIG, frame)


def test_a_result_is_arrays_a_table_a_figure_and_a_page(data):
    result = driftlab.run(CONFIG, data)
    assert result.t is result["t"]
    assert result.units["bias"] == "rad/s"
    assert result.labels["bias"] == ("x", "y", "z")
    assert {"t", "bias", "bias_sigma", "coast", "coast_sigma", "x", "sigma", "to_polars"} <= set(dir(result))
    with pytest.raises(AttributeError, match="RunResult has no 'biass'; its arrays are t, x"):
        _ = result.biass
    with pytest.raises(KeyError, match="biass; there are t, x"):
        result["biass"]
    table = result.to_polars()
    assert len(table) == len(result.t)
    np.testing.assert_array_equal(table["bias_y [rad/s]"], result.bias[:, 1])
    np.testing.assert_array_equal(
        table["x_attitude_error_z [rad]"], result.x[:, result.labels["x"].index("attitude_error_z")]
    )
    labels = [panel.get_ylabel() for panel in result.plot().axes]
    over_time = [f"{what} {axis} [deg/h]" for what in ("bias", "error") for axis in "xyz"]
    assert labels == [*over_time, "temperature [°C]"]
    assert "bias (x, y, z) [rad/s]" in repr(result)
    assert "data:image/png;base64," in result._repr_html_()


def test_masked_rows_are_rows_left_out(data):
    gyro, unit = data["gyro"]
    wrong = np.ma.array(gyro.copy())
    wrong[1000:1200] = 0.5
    wrong[1000:1200] = np.ma.masked
    result = driftlab.run(CONFIG, {**data, "gyro": (wrong, unit)})
    without = np.delete(np.arange(len(gyro)), np.arange(1000, 1200))
    clean = driftlab.run(CONFIG, {name: (values[without], unit) for name, (values, unit) in data.items()})
    np.testing.assert_array_equal(result.bias, clean.bias)
    assert any(line.startswith("rows where gyro is not a finite number, left out: 200") for line in result.lines())


def test_a_run_is_smoothed_into_its_folder(data, tmp_path):
    result = driftlab.run(CONFIG, data, out=tmp_path / "out", smooth=True)
    assert set(result.smoothed) == {"x", "sigma", "bias"}
    assert result.smoothed["bias"].shape == result.bias.shape
    assert np.all(result.smoothed["sigma"] <= result.sigma * (1 + 1e-6))
    with pytest.raises(ConfigError, match=r"^smooth: the way back goes over what a file has kept; give out, a folder"):
        driftlab.run(CONFIG, data, smooth=True)


def test_a_map_is_fitted_in_memory_saved_and_followed(data, unit, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    config = {
        **CONFIG,
        "filter": {"gyro": {"calibration": {"kind": "polynomial", "order": 2, "path": "map.json", "outside": "clamp"}}},
    }
    fitted = driftlab.fit_map(config, data)
    assert list(tmp_path.iterdir()) == []
    fitted.save("map.json")
    driftlab.fit_map(config, data, out="again.json")
    there, again = (json.loads(Path(name).read_text()) for name in ("map.json", "again.json"))
    assert there["record"]["residual"] == again["record"]["residual"]
    T = fitted.temperature
    np.testing.assert_array_equal(fitted.map.bias(T), fitted.bias)
    np.testing.assert_allclose(np.gradient(fitted.bias[:, 0], T)[1:-1], fitted.slope[1:-1, 0], rtol=1e-3)
    result = driftlab.run(config, data)
    np.testing.assert_allclose(
        result.calibration[:, 0], fitted.map.bias(result["temperature"].astype(float))[:, 0], rtol=1e-5
    )
    curve = next(line for line in fitted.plot().axes[0].lines if line.get_label() == "curve")
    np.testing.assert_allclose(curve.get_ydata(), np.rad2deg(fitted.map.bias(curve.get_xdata())[:, 0]) * 3600)


def test_all_kinds_of_maps_are_compared_and_one_cannot_be_asked_for_beside(data, unit):
    config = {**CONFIG, "filter": {"gyro": {"calibration": {"kind": "polynomial", "order": 1}}}}
    with pytest.raises(ConfigError, match=r"^compare: tries all kinds, and kind asks for one"):
        driftlab.fit_map(config, data, kind="spline", compare=True)
    fitted = driftlab.fit_map(config, data, compare=True)
    assert fitted.comparison is not None
    assert fitted.map.record.kind == fitted.comparison.chosen.settings.kind


def test_several_recordings_make_one_map(data, unit):
    """Each may have a level of its own: the map is that of one recording within its uncertainty, and not to the bit."""
    config = {**CONFIG, "filter": {"gyro": {"calibration": {"kind": "polynomial", "order": 2}}}}
    half = len(unit.t) // 2
    parts = [{name: (v[rows], u) for name, (v, u) in data.items()} for rows in (slice(half), slice(half, None))]
    both, whole = driftlab.fit_map(config, parts), driftlab.fit_map(config, data)
    assert both.map.record.provenance["recordings"] == "data[0], data[1]"
    T = np.linspace(*both.map.domain, 20)
    off, sigma = both.map.bias(T) - whole.map.bias(T), both.map.sigma(T)
    assert np.all(np.mean(off**2, axis=0) < 3**2 * np.mean(sigma**2, axis=0))
    assert np.all(sigma < 5e-5)


def test_allan_is_what_the_command_says(files, data):
    result = driftlab.allan(CONFIG, data)
    said = json.loads(command("allan", "unit.yaml", "--input", "rest.h5", "--json", cwd=files).stdout)
    assert result.summary["gyro"]["x"]["white"]["value"] == said["gyro"]["x"]["white"]["value"]
    assert result.config_lines == said["config"]
    np.testing.assert_array_equal(result.gyro[:, 2], said["curves"]["gyro"]["z"]["allan"])
    np.testing.assert_array_equal(result.accel_sigma[:, 0], said["curves"]["accel"]["x"]["allan_sigma"])
    result.save("allan")
    assert json.loads(Path("allan/allan.json").read_text())["gyro"] == said["gyro"]


def test_compare_is_what_the_command_writes(files):
    Path("slow.yaml").write_text("extends: unit.yaml\nfilter: {gyro: {bias: {walk: 1e-6 deg/s/sqrt(s)}}}\n")
    result = driftlab.compare(["unit.yaml", "slow.yaml"], "rest.h5")
    command("compare", "unit.yaml", "slow.yaml", "--input", "rest.h5", "--out", "command", cwd=files)
    result.save("saved")
    for name in ("summary.json", "report.html"):
        assert Path("saved", name).read_bytes() == Path("command", name).read_bytes()
    table = result.to_polars()
    row = table.filter((pl.col("row") == "coast, to the end") & (pl.col("config") == "slow") & (pl.col("axis") == "y"))
    assert row["error [rad/s]"].item() == result["slow"].yardsticks.coast["to the end"][1]
    assert result.plot().axes[0].get_ylabel() == "bias x [deg/h]"


def test_configs_to_compare_have_names(data):
    with pytest.raises(ConfigError, match=r'one of them is no file and has no name; write \{"name": config'):
        driftlab.compare([CONFIG, CONFIG], data)
    with pytest.raises(ConfigError, match="a config is named twice"):
        driftlab.compare(["a.yaml", "a.yaml"], data)


def test_a_simulation_in_memory_is_the_file(tmp_path):
    config = {"source": {"kind": "synthetic", "rate": "10 Hz", "duration": "3 min", "latitude": "40.9 deg"}, **CONFIG}
    made = driftlab.simulate(config, seed=5)
    written = driftlab.simulate(config, seed=5, out=tmp_path / "made.h5")
    made.save(tmp_path / "saved.h5")
    assert len(written) == 0
    for name in ("made.h5", "saved.h5"):
        with h5py.File(tmp_path / name) as file:
            assert set(file) == set(made)
            for channel, values in made.items():
                np.testing.assert_array_equal(file[channel][:], values)
    assert (made.summary["rows"], written.summary["path"]) == (1800, str(tmp_path / "made.h5"))
    # what no unit measures is not given on
    assert not any("bias_truth" in line for line in driftlab.check(CONFIG, made).remarks)
    assert [panel.get_ylabel() for panel in made.plot().axes][-1] == "bias_truth [rad/s]"


def test_check_understands_the_config(data):
    found = driftlab.check(CONFIG, data)
    assert isinstance(found.config, Config)
    assert found.quantities["latitude"] == np.deg2rad(40.9)
    assert "recording: data, 20 Hz at its start" in found.remarks


def test_the_loop_is_closed_in_memory_as_in_files(files, unit):
    """A rate that nobody declared, proportional to a second channel, is found, and nothing is left behind."""
    config = {**CONFIG, "filter": {"gyro": {"bias": {"kind": "random_walk", "walk": "1e-6 deg/s/sqrt(s)"}}}}

    def recording(seed):
        made = unit_at_rest(seconds=1200.0, rate=2.0, walk=1e-9, seed=seed)
        volts = np.sin(made.t / (60.0 + seed))
        gyro = made.gyro + 3e-4 * volts[:, None]
        return {
            "time": (made.t, "s"),
            "gyro": (gyro, "rad/s"),
            "accel": (made.accel, "m/s^2"),
            "supply": (volts, "V"),
            "temperature": (made.temperature, "degC"),
        }

    first, second, third = map(recording, (1, 2, 3))
    result = driftlab.explain(config, first, [first, second], third)
    assert result.verdict == "explained"
    assert result.summary["effects"][0]["channel"] == "supply"
    hashes = [item["sha256"] for items in result.summary["recordings"].values() for item in items]
    assert len(set(hashes)) == 3
    assert len(hashes) == 4
    before, after = (np.std(result[name] - result.reference) for name in ("before", "after"))
    assert after < before / 3
    assert sorted(path.name for path in files.iterdir()) == ["rest.h5", "unit.yaml"]
    result.save("explained")
    assert Path("explained/explained.yaml").read_text() == result.config
    with pytest.raises(ConfigError, match=r"^holdout .*overlaps .*, which was given for fitting"):
        driftlab.explain(config, first, first, first)


def test_a_run_says_that_a_map_lies_unused_beside_its_config_and_that_a_map_has_seen_the_recording(files):
    def notes(**settings):
        config = load_config(Path("unit.yaml"), settings=[f"{name}={value}" for name, value in settings.items()])
        result = driftlab.run(config, "rest.h5", out="out")
        page = Path("out/report.html").read_text()
        found = [line for line in result.lines() if "map.json" in line or "map was fitted" in line]
        assert all(line.partition(";")[0] in page for line in found)
        return found

    assert notes() == []
    driftlab.fit_map("unit.yaml", "rest.h5").save("unit.map.json")
    (unused,) = notes()
    assert unused.startswith("unit.map.json is beside the config, which names no map, so none was used;")
    (seen,) = notes(**{"filter.gyro.calibration": unused.partition("calibration: ")[2]})
    assert seen.startswith("the map was fitted on rest.h5:")
