import json

import numpy as np
import pytest
from command_line import driftlab as run
from turned_units import bias_of, matrix_of, sensitivity_of, sensor_frame, strained, tumble, turntable

import driftlab
from driftlab.errors import ConfigError
from driftlab.evaluation.uncertainty import bias_budget
from driftlab.storage.map_file import read_map

GYRO = """
latitude: 0 deg
source:
  kind: csv
  path: turned.csv
  channels:
    time: {path: t, unit: s}
    gyro: {path: [gx, gy, gz], unit: rad/s}
    temperature: {path: T, unit: degC}
filter:
  gyro:
    noise: 8e-5 rad/s/sqrt(Hz)
    bias: {kind: random_walk, walk: 1e-6 rad/s/sqrt(s)}
    calibration: {kind: polynomial, path: gyro.json}
stimulus: {kind: rate_table, segments: table.csv}
"""
TERMS = "bias,scale,misalignment"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A unit on a turntable, with the map that the command line made of it."""
    folder = tmp_path_factory.mktemp("turned")
    t, y, T, table = turntable(0, [-20.0, 20.0, 60.0], hold=12.0)
    np.savetxt(folder / "turned.csv", np.c_[t, y, T], delimiter=",", header="t,gx,gy,gz,T", comments="", fmt="%.9g")
    (folder / "table.csv").write_text(table)
    (folder / "gyro.yaml").write_text(GYRO)
    done = run("fit-map", "gyro.yaml", "--terms", TERMS, cwd=folder)
    assert done.returncode == 0, done.stderr
    (folder / "said.txt").write_text(done.stdout)
    return folder


def test_the_terminal_shows_each_term_and_how_to_use_the_map(folder):
    said = (folder / "said.txt").read_text()
    rows = {line.split(" [")[0].strip(): line.split() for line in said.splitlines() if "[" in line}
    assert len([name for name in rows if name.startswith(("bias", "scale", "misalignment"))]) == 12
    assert float(rows["scale x"][3]) == pytest.approx(4000, abs=40)  # ppm at 20 degC
    assert float(rows["scale x"][5]) == pytest.approx(12000, abs=80)
    assert rows["scale y"][5] == "none"
    assert all(len(line) <= 80 for line in said.partition("frame")[0].splitlines())
    assert "frame: that of the stimulus, with the mounting of the unit in it (9 terms of M)" in said
    assert "to use it, write in the config: filter.gyro.calibration.path: gyro.json\n" in said


def test_a_map_that_the_bias_model_follows_is_used_where_it_is(folder):
    followed = "kind: thermal_derivative, walk: 1e-6 rad/s/sqrt(s), map: {kind: polynomial}}"
    text = GYRO.replace("kind: random_walk, walk: 1e-6 rad/s/sqrt(s)}", followed)
    (folder / "followed.yaml").write_text(text.replace("    calibration: {kind: polynomial, path: gyro.json}\n", ""))
    done = run("fit-map", "followed.yaml", "--terms", TERMS, cwd=folder)
    assert "to use it, write in the config: filter.gyro.bias.map.path: followed.map.json\n" in done.stdout
    used = ("--set", "filter.gyro.bias.map.path=followed.map.json", "--set", "filter.accel=null")
    assert run("check", "followed.yaml", *used, cwd=folder).returncode == 0


def test_json_says_what_each_term_is(folder):
    done = run("fit-map", "gyro.yaml", "--terms", TERMS, "--json", "--out", "other.json", cwd=folder)
    triad = json.loads(done.stdout)["triad"]
    assert triad["frame"] == "given"
    term = triad["terms"]["scale z"]
    assert (term["unit"], term["told"], term["change_told"], term["curve"]) == ("1", True, True, "order 2")
    np.testing.assert_allclose(term["value"][0], matrix_of(triad["temperature"][0])[2, 2], atol=5 * term["sigma"][0])


@pytest.mark.parametrize("accel", [True, False], ids=["measured force", "vertical table"])
def test_g_sensitivity_is_fitted_held_and_left_out_of_exports(folder, accel):
    t, y, T, table, force = strained(0, [0.0, 20.0, 40.0], hold=8.0)
    (folder / "strained.csv").write_text(table)
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    data |= {"accel": (force, "m/s^2")} if accel else {}
    walk = {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"}
    config = {
        "filter": {"gyro": {"noise": "8e-5 rad/s/sqrt(Hz)", "bias": walk}},
        "stimulus": {"kind": "rate_table", "segments": str(folder / "strained.csv")},
    } | ({} if accel else {"latitude": "0 deg"})  # fmt: skip
    made = driftlab.fit_map(config, data, terms=f"{TERMS},g_sensitivity", out=folder / "g.json", certificate=True)
    page, sheet = (folder / f"g.{name}.html" for name in ("report", "certificate"))
    assert "g-sensitivities to" in page.read_text()
    assert "force along z" in page.read_text()
    assert "1 g adds up to 560 deg/h" in sheet.read_text()  # the largest row of G, 2.77e-4 rad/s a m/s^2
    assert made["terms"].shape[1] == len(made.labels["terms"]) == len(made.units["terms"]) == 21
    assert (made.labels["terms"][12], made.units["terms"][12]) == ("g-sensitivity_xx", "rad/s/(m/s^2)")
    at = np.array([0.0, 20.0, 40.0])
    true = np.array([sensitivity_of(x).ravel() for x in at])
    assert np.max(np.abs(made.map.record.sensitivity.terms(at) - true) / made.fit.sigma(at)[:, 12:]) < 4.5
    done = run("export", "c", "g.json", "--out", "g_c", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert "left out: gyro: g-sensitivity, up to 52" in done.stdout  # 2.6e-4 rad/s a m/s^2 are 526 deg/h/g
    assert "c leaves it out" in done.stdout


def test_an_accelerometer_has_no_g_sensitivity():
    t, y, T = tumble(0, [20.0], placements=4)
    accel = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)"}}
    gyro = {"noise": "1 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1 deg/s/sqrt(s)"}}
    config = {"filter": {"gyro": gyro, "accel": accel, "track": "accel"}, "stimulus": {"kind": "tumble"}}
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (0 * y, "rad/s"), "temperature": (T, "degC")}
    with pytest.raises(ConfigError, match="terms g_sensitivity: is a gyro's, not one of accel; leave it out"):
        driftlab.fit_map(config, data, terms="bias,g_sensitivity")


@pytest.mark.parametrize("bias", ["calibration", "map"])
def test_a_run_takes_scale_and_misalignment_off(folder, bias):
    """The accelerometer at rest, warming: what is left of it is its own noise."""
    t, y, T = tumble(0, [-20.0, 0.0, 20.0, 40.0, 60.0], placements=14, hold=4.0)
    sensors = {"gyro": {"noise": "1 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1 deg/s/sqrt(s)"}}}
    accel = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)"}}
    config = {"latitude": "45 deg", "filter": {**sensors, "track": "accel", "accel": accel},
              "stimulus": {"kind": "tumble", "gravity": "9.80665 m/s^2"}}  # fmt: skip
    quiet = np.random.default_rng(0).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (quiet, "rad/s"), "temperature": (T, "degC")}
    made = driftlab.fit_map(config, data, terms=TERMS, out=folder / f"{bias}.json")
    assert made.fit.observable.sum() == 9

    N, up, g = 3000, np.array([0.6, 0.0, 0.8]), 9.806199
    T = np.linspace(-15, 55, N)
    force = np.array([(np.eye(3) + sensor_frame(matrix_of(x))) @ up * g + bias_of(x, 0.3) for x in T])
    force += np.random.default_rng(1).normal(0, 5e-4 / np.sqrt(0.1), force.shape)
    settings = {"kind": "spline", "path": str(folder / f"{bias}.json")}
    accel = {**accel, "calibration": settings}
    if bias == "map":
        del accel["calibration"]
        accel["bias"] = {"kind": "thermal_derivative", "walk": "1e-5 m/s^2/sqrt(s)", "map": settings}
    warming = {"time": (np.arange(N) * 0.1, "s"), "accel": (force, "m/s^2"), "temperature": (T, "degC"),
               "gyro": (np.random.default_rng(2).normal(0, 1e-3, (N, 3)), "rad/s")}  # fmt: skip
    result = driftlab.run({**config, "filter": {**config["filter"], "accel": accel}}, warming)
    at = np.interp(result.t, np.arange(N) * 0.1, T)
    whole = np.array([sensor_frame(matrix_of(x)) @ up * g + bias_of(x, 0.3) for x in at])
    left = (result.bias - whole)[20:]
    along = left @ up  # across it the tilt of the unit is not known
    assert np.ptp(whole @ up) > 0.2
    assert np.ptp(along) < 5e-3


@pytest.mark.parametrize(("kind", "suffix", "more"), [("polynomial", "json", []), ("onnx_network", "onnx", ["spline"])])
def test_without_the_bias_that_of_the_configs_map_stays(folder, kind, suffix, more):
    with_map = GYRO.replace("kind: polynomial, path: gyro.json", f"kind: {kind}, path: known.{suffix}")
    (folder / "both.yaml").write_text(with_map)
    T = np.linspace(-20, 60, 300)
    known = driftlab.fit_map(with_map.replace("stimulus", "#"), {
        "time": (np.arange(300.0), "s"), "temperature": (T, "degC"),
        "gyro": (np.random.default_rng(0).normal(0, 1e-6, (300, 3)) + np.outer(T, [1e-6, 2e-6, 3e-6]), "rad/s"),
    }, out=folder / f"known.{suffix}").map  # fmt: skip
    more = ["--kind", *more] if more else []
    asked = ["fit-map", "both.yaml", *more, "--terms"]
    result = run(*asked, "scale,misalignment", "--out", f"whole.{suffix}", cwd=folder)
    assert result.returncode == 0, result.stderr
    assert "bias x" not in result.stdout
    assert "The bias is that of the map which the config names." in (folder / "whole.report.html").read_text()
    whole = read_map(folder / f"whole.{suffix}")
    T = np.linspace(*known.domain, 20)
    np.testing.assert_array_equal(whole.bias(T), known.bias(T))
    assert whole.record.matrix.at(np.array([20.0]))[0] == pytest.approx(matrix_of(20.0), abs=1e-4)
    alone = run(*asked, "scale", "--out", f"scale.{suffix}", cwd=folder)
    assert "misalignment" not in alone.stdout.partition("frame")[0]


def test_the_bias_of_a_stimulus_has_its_level_in_its_curve(folder):
    """The noise of a mean over all samples is no part of it; power-ups are, where the fit had several."""
    fitted = read_map(folder / "gyro.json")
    assert [source.name for source in bias_budget(fitted).sources] == ["curve"]
    of_level = bias_budget(fitted, level=1e-4).sources[-1]
    assert of_level.name == "power-ups"
    np.testing.assert_array_equal(of_level.u, 1e-4)
    with_soak = fitted.noting(matrix=fitted.record.matrix.model_copy(update={"error": None}))
    assert [source.name for source in bias_budget(with_soak).sources] == ["curve", "mean"]


def test_terms_that_all_move_are_all_followed(tmp_path):
    """One curve alone would hardly lower what the constants of the others leave."""

    def bent(T):
        x = (T - 20.0) / 40.0
        return matrix_of(20.0) + 0.004 * x * (np.eye(3) - 0.5) + 0.003 * x**2 * (0.7 - np.eye(3))

    t, y, T, table = turntable(3, [-20.0, 20.0, 60.0], hold=12.0, matrix=bent)
    (tmp_path / "table.csv").write_text(table)
    config = GYRO.replace("table.csv", str(tmp_path / "table.csv"))
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    fit = driftlab.fit_map(config, data, terms=TERMS).fit
    for at in (-20.0, 20.0, 60.0):
        off = fit.terms.at(np.array([at]))[0, 3:] - bent(at).ravel()
        assert np.max(np.abs(off / fit.sigma(np.array([at]))[0, 3:])) < 4
        assert np.max(np.abs(off)) < 1e-4


def test_check_shows_each_term_and_whether_the_unit_turns(folder):
    turning = driftlab.check(folder / "gyro.yaml").remarks
    lines = [line.partition(": ")[2] for line in turning if " ppm = " in line or " mrad = " in line]
    assert len(lines) == 9
    first = lines[0].split()
    assert first[:2] == ["scale", "x"]
    assert float(first[2]) == pytest.approx(4000, abs=40)
    assert float(first[5]) == pytest.approx(0.004, abs=4e-5)
    assert not any("nothing of scale factor" in line for line in turning)
    rng = np.random.default_rng(0)
    still = np.c_[
        np.arange(500) * 0.1, rng.normal(0, 3e-4, (500, 3)) + bias_of(20.0, np.deg2rad(1.0)), np.full(500, 20)
    ]
    np.savetxt(folder / "still.csv", still, delimiter=",", header="t,gx,gy,gz,T", comments="")
    (folder / "still.yaml").write_text(GYRO.replace("turned.csv", "still.csv"))
    (said,) = (line for line in driftlab.check(folder / "still.yaml").remarks if "nothing of scale factor" in line)
    assert said.startswith("gyro: turns by 0.0")

    driftlab.fit_map(GYRO.replace("stimulus", "#"), {
        "time": (np.arange(300.0), "s"), "temperature": (np.linspace(-20, 60, 300), "degC"),
        "gyro": (rng.normal(0, 1e-6, (300, 3)), "rad/s"),
    }, out=folder / "alone.json")  # fmt: skip
    (folder / "alone.yaml").write_text(GYRO.replace("gyro.json", "alone.json"))
    assert any(line.startswith("stimulus: lies unused") for line in driftlab.check(folder / "alone.yaml").remarks)
    assert not any("lies unused" in line for line in turning)


def test_compare_states_the_terms_that_each_config_takes_off(folder):
    driftlab.fit_map(GYRO.replace("stimulus", "#"), {
        "time": (np.arange(300.0), "s"), "temperature": (np.linspace(-20, 60, 300), "degC"),
        "gyro": (np.random.default_rng(0).normal(0, 1e-6, (300, 3)), "rad/s"),
    }, out=folder / "bias.json")  # fmt: skip
    N = 4000
    data = {"time": (np.arange(N) * 0.1, "s"), "temperature": (np.linspace(10, 30, N), "degC"),
            "gyro": (np.random.default_rng(0).normal(0, 3e-4, (N, 3)), "rad/s")}  # fmt: skip
    configs = {}
    for name in ("bias", "gyro"):
        (folder / f"with_{name}.yaml").write_text(GYRO.replace("gyro.json", f"{name}.json"))
        configs[name] = folder / f"with_{name}.yaml"
    result = driftlab.compare(configs, data)
    terms = {name: one["terms"] for name, one in result.summary["configs"].items()}
    assert list(terms["bias"]) == ["bias x", "bias y", "bias z"]
    assert list(terms["gyro"])[:5] == ["bias x", "bias y", "bias z", "scale x", "misalignment xy"]
    assert "bias: takes off bias x, bias y, bias z" in result.lines()
    assert not any(
        "takes off" in line for line in driftlab.compare({"a": configs["bias"], "b": configs["bias"]}, data).lines()
    )


@pytest.mark.parametrize("form", ["csv_table", "px4"])
def test_what_an_export_does_not_hold_is_measured(folder, form):
    out = f"without_{form}{'.csv' if form == 'csv_table' else '.params'}"
    more = ["--set", "device_id=7"] if form == "px4" else []
    done = run("export", form, "gyro.json", "--out", out, *more, cwd=folder)
    assert done.returncode == 0, done.stderr
    M = np.array([matrix_of(T) for T in np.linspace(-20, 60, 400)])
    scale = 1e6 * np.max(np.abs(M[:, range(3), range(3)]), axis=0)
    across = 1e3 * np.max(np.linalg.norm(M * (1 - np.eye(3)), axis=2), axis=0)
    (lost,) = json.loads((folder / "loss.json").read_text())["exports"][out]["loss"]
    np.testing.assert_allclose(lost["matrix"]["scale_ppm"]["largest"], scale, atol=60)
    np.testing.assert_allclose(lost["matrix"]["misalignment_mrad"]["largest"], across, atol=0.06)
    for text in (done.stdout, (folder / out).read_text()):
        assert "ppm of scale factor and " in " ".join(text.replace("#", "").split())


def corrected_in_flight(form, parameters, reading, T, bias):
    """The input as the firmware takes it: less its bias at T, times its scale; offsets are zero."""
    begin = {"px4": "CAL_ACC0_{}SCALE", "ardupilot": "INS_ACCSCAL_{}"}[form]
    scale = np.array([parameters[begin.format(axis)] for axis in "XYZ"])
    return (reading - bias(T)) * scale


@pytest.mark.parametrize("form", ["px4", "ardupilot"])
def test_autopilots_hold_constant_scale_factors_of_accelerometers(tmp_path, form):
    t, y, T = tumble(0, [-20.0, 0.0, 20.0, 40.0, 60.0], placements=14, hold=4.0)
    sensors = {"gyro": {"noise": "1 deg/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1 deg/s/sqrt(s)"}}}
    accel = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)"}}
    config = {"filter": {**sensors, "track": "accel", "accel": accel},
              "stimulus": {"kind": "tumble", "gravity": "9.80665 m/s^2"}}  # fmt: skip
    quiet = np.random.default_rng(0).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (quiet, "rad/s"), "temperature": (T, "degC")}
    made = driftlab.fit_map(config, data, kind="polynomial", terms=TERMS, out=tmp_path / "accel.json")
    more = ["--set", "accel_device_id=7"] if form == "px4" else ["--set", "accel_offsets=true"]
    suffix = ".params" if form == "px4" else ".parm"
    done = run("export", form, "accel.json", "--out", f"out{suffix}", *more, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = [line.split() for line in (tmp_path / f"out{suffix}").read_text().splitlines() if line[0] != "#"]
    parameters = {line[-3 if form == "px4" else 0]: float(line[-2 if form == "px4" else 1]) for line in lines}
    at = np.linspace(-20, 60, 81)
    (lost,) = json.loads((tmp_path / "loss.json").read_text())["exports"][f"out{suffix}"]["loss"]
    for axis, u in enumerate(10 * np.eye(3)):
        reading = u + made.fit.terms.matrix(at) @ u + made.map.bias(at)
        off = corrected_in_flight(form, parameters, reading, at, made.map.bias) - u
        assert np.max(np.abs(off[:, axis])) / 10 * 1e6 == pytest.approx(
            lost["matrix"]["scale_ppm"]["largest"][axis], abs=5
        )
        assert np.max(np.abs(off[:, axis])) / 10 < 0.7 * np.max(np.abs(made.fit.terms.matrix(at)[:, axis, axis]))
    if form == "px4":
        assert {parameters[f"CAL_ACC0_{axis}OFF"] for axis in "XYZ"} == {0.0}

    with (tmp_path / f"out{suffix}").open("a") as file:  # which a vehicle has
        file.write("1\t1\tCAL_ACC0_ID\t7\t6\n" if form == "px4" else "")
    back = run("import", form, f"out{suffix}", "--channel", "accel", "--out", "back.json", cwd=tmp_path)
    assert back.returncode == 0, back.stderr
    assert "scale x " in back.stdout
    taken = read_map(tmp_path / "back.json")
    reading = np.array([[1.0, 2.0, 9.0]] * len(at)) + made.map.bias(at)
    np.testing.assert_allclose(
        taken.corrected(reading, at), corrected_in_flight(form, parameters, reading, at, taken.bias), atol=1e-6
    )


def test_a_mat_file_holds_all_terms_and_gives_them_back(folder):
    from scipy.io import loadmat

    assert run("export", "mat", "gyro.json", "--out", "gyro.mat", cwd=folder).returncode == 0
    done = run("import", "mat", "gyro.mat", "--kind", "spline", "--out", "again.json", cwd=folder)
    assert done.returncode == 0, done.stderr
    struct = loadmat(folder / "gyro.mat", simplify_cells=True)["gyro"]
    row = int(np.argmin(np.abs(struct["temperature"] - 20.0)))
    np.testing.assert_allclose(struct["matrix"][row].reshape(3, 3), matrix_of(20.0), atol=3e-5)
    known, again = (read_map(folder / name).record.matrix for name in ("gyro.json", "again.json"))
    T = np.linspace(-19.9, 59.9, 37)
    np.testing.assert_allclose(again.terms(T), known.terms(T), atol=1e-8)
    np.testing.assert_allclose(struct["matrix_sigma"][row], known.sigma(np.array([20.0]))[0], rtol=0.05)
    assert (again.frame, again.told, again.error) == (known.frame, known.told, None)
    assert np.all(np.isnan(again.sigma(T)))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--terms", "bias,scala"], "'scala' is none of bias, scale, misalignment, g_sensitivity; name those"),
        (["--terms", "scale,g_sensitivity"], "the bias of a soak has its part of it; add bias"),
        (["--stimulus", "tumble"], "--stimulus: is that of --terms"),
        (["--terms", TERMS, "--stimulus", "shaker"], "is none of positions, rate_table, tumble; name one of them"),
        (
            ["--terms", TERMS, "--compare"],
            "--terms: tries the curves of one kind, of no lot; leave --select, --compare and --lot out",
        ),
        (["--terms", TERMS, "--kind", "onnx_network"], "not linear in its coefficients"),
        (["--terms", TERMS, "--stimulus", "positions"], "channel 'accel' is needed"),
        (["--terms", TERMS, "--set", "stimulus.segments=no.csv"], "no.csv: cannot be read"),
    ],
)
def test_what_does_not_go_is_refused_with_a_remedy(folder, options, message):
    done = run("fit-map", "gyro.yaml", *options, "--out", "refused.json", cwd=folder)
    assert done.returncode in (1, 2)
    assert message in done.stderr
    assert not (folder / "refused.json").exists()


def test_terms_without_a_stimulus_are_refused(folder):
    config = GYRO.partition("stimulus")[0]
    with pytest.raises(ConfigError, match="stimulus: is missing, so the input of the triad is not known; add"):
        driftlab.fit_map(config, str(folder / "turned.csv"), terms=TERMS)
