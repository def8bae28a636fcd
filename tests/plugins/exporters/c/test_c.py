"""C99: what the compilers make of it is the emulation to the bit, and the loss is what it says."""

import json
import subprocess
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from firmware import AT_REST, M0, M4, RUNNING, STRICT, answers, bits, built
from tools import tool

from fusion_core.chunk import Chunk
from fusion_core.contracts import Calibrated, CurveError, Effect, Export, MapRecord, TriadMatrix
from fusion_core.contracts.effect import Domain, Function
from fusion_core.errors import ConfigError
from fusion_core.host.registry import registry
from fusion_core.thermal.fitted_map import FittedMap
from fusion_plugins.exporters.c import C99
from fusion_plugins.exporters.c.emulation import at_rest, inputs, run
from fusion_plugins.exporters.c.program import program_of

DEG_H = np.pi / 180 / 3600
LOW, HIGH = -21.7, 62.3


class Wavy(FittedMap):
    """A map of three axes with swings and wiggles as measured units have them."""

    def save(self, path):
        raise NotImplementedError

    def _bias(self, T):
        u = T / 10
        return DEG_H * np.stack(
            [900 * np.sin(u) + 60 * u**2, 3600 * 8 + 500 * np.cos(u / 2) + 20 * np.sin(3 * u), 200 * u - 4 * u**3],
            axis=1,
        )

    def _slope(self, T):
        return (self._bias(T + 1e-5) - self._bias(T - 1e-5)) / 2e-5


class Straight(Wavy):
    """A map that lines follow without loss."""

    def _bias(self, T):
        return DEG_H * np.outer(T, [5.0, -3.0, 2.0])


def sensor(*effects, of=Wavy):
    fitted = of(MapRecord(kind="wavy", domain=(LOW, HIGH), residual=(2e-5, 2e-5, 2e-5)), outside="clamp")
    return Calibrated("gyro", "rad/s", "deg/h", ("x", "y", "z"), fitted, effects)


def effect(kind, terms=1, **fields):
    coefficients = [] if kind == "thermal_lag" else [c * DEG_H for c in np.linspace(-9, 11, 3 * terms)]
    return registry().classes(Effect)[kind].model_validate({"kind": kind, "coefficients": coefficients, **fields})


EFFECTS = (
    effect("hysteresis", width="3 K"),
    effect("relaxation", tau="20 min"),
    effect("relaxation", channel="voltage", tau="5 min", form="late"),
    effect("turn_on", tau="600 s"),
    effect("drift"),
    effect("thermal_rate", tau="20 s"),
    effect("thermal_lag", tau="60 s"),
    effect("curve", 2, powers=2, above=3, low=-30, high=70),
    effect("curve", 3, channel="voltage", powers=3, low=3, high=4),
    effect("map_misfit", 7, intervals=4, low="-20 degC", high="60 degC"),
    effect("g_sensitivity", 3),
    effect("channel", 3, channel="magnetic field", columns=3),
    effect("interaction", 2, channels=["voltage", "temperature"], zero=[3.3, 20.0]),
    effect("thermal_gradient", 2, channel="temperature_case", window="60 s"),
)
ENDS = {"temperature": (5.0, 35.0), "voltage": (3.3, 3.7), "temperature_case": (6.0, 30.0),
        "accel": ((-5.0, 5.0),) * 3, "magnetic field": ((-20.0, 20.0), (-20.0, 10.0), (-1.0, 1.0))}  # fmt: skip
REMEMBER = {"hysteresis": 1.2, "relaxation": 4.0, "thermal_rate": 0.01, "thermal_gradient": 1.0}
HELD = tuple(
    own.model_copy(
        update={
            "domain": Domain({name: ENDS[name] for name in own.requires}),
            "regressors": ((-REMEMBER[own.kind], REMEMBER[own.kind]),) * len(own.labels)
            if own.kind in REMEMBER
            else None,
        }
    )
    for own in EFFECTS
)
COLUMNS = {"temperature": 1, "voltage": 1, "accel": 3, "magnetic field": 3, "temperature_case": 1}


def exported(folder, known, loss="1 deg/h", **fields):
    what = Export((known,), serial="SN 7")
    folder.mkdir(exist_ok=True)
    return C99.model_validate({"kind": "c", "loss": loss, **fields}).export(what, folder)


def program(known, loss=1.0, floats=False):
    return program_of(known, np.full(3, loss * DEG_H), floats=floats)


@cache
def its_program(floats=False, effects=()):
    return program(sensor(*effects), floats=floats)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """The folder of an export, each made once."""

    @cache
    def folder(knots="smallest", effects=()):
        made = tmp_path_factory.mktemp("exported")
        exported(made, sensor(*effects), knots=knots)
        return made

    return folder


@cache
def temperatures():
    """100,000: across and far beyond the domain, its ends, next to all knots, any bits there are."""
    rng = np.random.default_rng(5)
    table = its_program().tables[0]
    knots = (table.lowest + np.arange(len(table.knots)) / table.per_unit).astype(np.float32)
    special = [
        np.nan,
        np.inf,
        -np.inf,
        0.0,
        -0.0,
        1e-45,
        -1e-40,
        3.4e38,
        -3.4e38,
        table.lowest,
        table.highest,
        LOW,
        HIGH,
    ]
    beside = [np.nextafter(knots, np.float32(side)) for side in (-np.inf, np.inf)]
    found = np.concatenate(
        [np.array(special, dtype=np.float32), knots, *beside, rng.uniform(LOW - 40, HIGH + 40, 60_000)]
    )
    raw = rng.integers(0, 2**32, 100_000 - len(found), dtype=np.uint32).view(np.float32)
    return np.concatenate([found.astype(np.float32), raw])


@cache
def emulated(floats=False):
    return at_rest(its_program(floats), temperatures())


FLAGS = {
    "gcc": ((*STRICT, "-O2"), False),
    "gcc-fast": (("-std=gnu11", "-O3", "-ffp-contract=fast"), False),
    "cortex-m4": ((*STRICT, *M4, "-Os"), True),
    "cortex-m4-fused": (("-std=gnu11", *M4, "-O3", "-ffp-contract=fast"), True),
    "cortex-m0": ((*STRICT, *M0, "-Os"), True),
}
compiled = pytest.mark.parametrize(("flags", "arm"), FLAGS.values(), ids=FLAGS)


@compiled
@pytest.mark.parametrize("knots", ["smallest", "float"])
def test_compilers_give_the_bits_of_the_emulation(written, flags, arm, knots):
    own, T = its_program(knots == "float"), temperatures()
    found = answers(built(written(knots), AT_REST, 1, flags, arm=arm), T[:, None])
    assert len(found) == 100_000
    np.testing.assert_array_equal(bits(found), bits(emulated(knots == "float")))
    ends = at_rest(own, np.array([LOW, HIGH], dtype=np.float32))
    for value, end in ((np.nan, 0), (-np.inf, 0), (LOW - 1, 0), (np.inf, 1), (3e38, 1), (HIGH + 1, 1)):
        where = np.isnan(T) if np.isnan(value) else np.float32(value) == T
        np.testing.assert_array_equal(found[where], np.broadcast_to(ends[end], (np.sum(where), 3)))


def test_a_fused_multiply_add_would_change_bits(tmp_path):
    exported(tmp_path, sensor(), knots="float")
    source = tmp_path / "gyro_bias.c"
    source.write_text(source.read_text().replace("const volatile float rounded", "const float rounded"))
    T = temperatures()[:20_000]
    fused = answers(built(tmp_path, AT_REST, 1, FLAGS["cortex-m4-fused"][0], arm=True), T[:, None])
    assert np.any(bits(fused) != bits(at_rest(its_program(True), T)))


def sequence(N=20_000, bad=True):
    """Steps (N,) and channels: every rate there is, ramps and rests, samples that are not finite."""
    rng = np.random.default_rng(11)
    dt = rng.choice([0.001, 0.01, 1.0, 1.0, 30.0, 400.0], N)
    t = np.cumsum(dt)
    swing = 20 + 45 * np.sin(t / 9000) + np.cumsum(rng.normal(size=N)) * 0.05
    channels = {
        "temperature": swing,
        "voltage": 3.5 + 0.6 * np.sin(t / 700),
        "accel": rng.normal(size=(N, 3)) * 9.8,
        "magnetic field": rng.normal(size=(N, 3)) * 30,
        "temperature_case": swing + 2 * np.sin(t / 500),
    }
    channels = {name: values.astype(np.float32) for name, values in channels.items()}
    dt = dt.astype(np.float32)
    if bad:
        dt[[50, 51, 52]] = [np.nan, np.inf, -1.0]
        for name, values in channels.items():
            values[rng.choice(np.arange(1, N), 60)] = np.nan
            values[rng.choice(np.arange(1, N), 60)] = np.inf
            values[rng.choice(np.arange(1, N), 60)] = -3e38 if name != "accel" else 1e-42
        channels["temperature"][0] = np.nan
    dt[0] = 0.0
    return dt, channels


@cache
def emulated_sequence(effects):
    return run(its_program(effects=effects), *sequence())


def records(own):
    """The sequence as records, and how the code is called with one."""
    order = ["temperature", *own.channels]
    places = np.cumsum([1, *(COLUMNS[name] for name in order)])
    arguments = (f"in[{k}]" if COLUMNS[n] == 1 else f"in+{k}" for n, k in zip(order, places, strict=False))
    dt, channels = sequence()
    return np.column_stack([dt, *(channels[name] for name in order)]), ",".join(arguments)


@compiled
@pytest.mark.parametrize("effects", [EFFECTS, HELD], ids=["effects", "held"])
def test_a_sequence_with_states_is_the_emulation_to_the_bit(written, flags, arm, effects):
    own = its_program(effects=effects)
    assert {"temperature": 1, **own.channels} == {name: COLUMNS[name] for name in ("temperature", *own.channels)}
    assert len(own.channels) == 4
    given, arguments = records(own)
    found = answers(
        built(written(effects=effects), RUNNING, given.shape[1], flags, arguments=arguments, arm=arm), given
    )
    expected = emulated_sequence(effects)
    assert np.all(np.isfinite(expected))
    np.testing.assert_array_equal(bits(found), bits(expected))


@pytest.mark.parametrize("effects", [(), EFFECTS], ids=["map", "effects"])
def test_nothing_is_read_outside_of_the_table_whatever_the_compiler_is_told(written, effects):
    own, folder = its_program(effects=effects), written(effects=effects)
    flags = ("-O3", "-ffast-math", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
    T = temperatures()
    found = answers(built(folder, AT_REST, 1, flags), T[:, None])
    np.testing.assert_allclose(found, at_rest(own, T), rtol=1e-4, atol=1e-3 * DEG_H)
    if effects:
        given, arguments = records(own)
        command = built(folder, RUNNING, given.shape[1], flags, arguments=arguments)
        assert np.all(np.isfinite(answers(command, given)))


@pytest.mark.parametrize("effects", [(), EFFECTS], ids=["map", "effects"])
def test_the_self_test_passes_and_can_fail(tmp_path, effects):
    exported(tmp_path, sensor(*effects))
    command = [tool("gcc"), *STRICT, "-DTOLERANCE=0.0f", "gyro_bias.c", "gyro_bias_test.c", "-o", "selftest"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "selftest"]).returncode == 0
    source = tmp_path / "gyro_bias.c"
    before = source.read_text()
    first = before.index("    {") + 5
    source.write_text(before[:first] + "9" + before[first:].replace("-", "", 1))
    subprocess.run(["gcc", "-std=c99", "gyro_bias.c", "gyro_bias_test.c", "-o", "selftest"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "selftest"]).returncode > 0


def test_a_header_is_read_by_cpp_too(tmp_path):
    exported(tmp_path, sensor(*EFFECTS))
    (tmp_path / "main.cpp").write_text(
        '#include "gyro_bias.h"\nint main() { float b[3]; gyro_bias(1.0f, b); return 0; }'
    )
    subprocess.run(
        [tool("g++"), "-Wall", "-Wextra", "-Werror", "-pedantic", "-c", "main.cpp"], cwd=tmp_path, check=True
    )


def test_three_axes_at_one_degree_an_hour_take_less_than_a_kilobyte_and_a_half(tmp_path):
    exported(tmp_path, sensor())
    compiler, size = tool("arm-none-eabi-gcc"), tool("arm-none-eabi-size")
    subprocess.run([compiler, *STRICT, *M4, "-Os", "-ffreestanding", "-c", "gyro_bias.c"], cwd=tmp_path, check=True)
    text = subprocess.run([size, "gyro_bias.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    code, data, zeroed = (int(word) for word in text.splitlines()[1].split()[:3])
    assert 300 < code <= 1500
    assert (data, zeroed) == (0, 0)


@pytest.mark.parametrize("loss", [0.5, 1.0, 20.0])
@pytest.mark.parametrize("floats", [False, True])
def test_the_loss_is_kept_and_no_knot_is_too_many(loss, floats):
    own = program(sensor(), loss, floats)
    T = np.linspace(LOW, HIGH, 30_011)
    error = (at_rest(own, T.astype(np.float32)) - sensor().fitted.bias(T)) / DEG_H
    assert np.max(np.abs(error)) <= loss
    # lines through the curve itself would need more of them for the same
    n = len(own.tables[0].knots)
    knots = np.linspace(LOW, HIGH, n)
    lines = np.stack([np.interp(T, knots, column) for column in sensor().fitted.bias(knots).T], axis=1)
    assert np.max(np.abs(lines - sensor().fitted.bias(T))) / DEG_H > 1.5 * loss
    assert own.tables[0].whole is (not floats)


def test_the_loss_that_is_said_is_the_loss(tmp_path):
    loss = exported(tmp_path, sensor())
    own = program(sensor())
    T = np.linspace(LOW, HIGH, 20_010)
    error = at_rest(own, T.astype(np.float32)) - sensor().fitted.bias(T)
    np.testing.assert_allclose(loss.sensors[0].domain.rms, np.sqrt(np.mean(error**2, axis=0)))
    np.testing.assert_allclose(loss.sensors[0].domain.largest, np.max(np.abs(error), axis=0))
    T = np.linspace(LOW, HIGH, 200_001)  # between the knots of the table, and between those places
    error = at_rest(own, T.astype(np.float32)) - sensor().fitted.bias(T)
    np.testing.assert_allclose(loss.sensors[0].domain.largest, np.max(np.abs(error), axis=0), rtol=0.02)
    header = (tmp_path / "gyro_bias.h").read_text()
    assert all(f" * {line}\n" in header for line in loss.lines())
    assert " * Unit SN 7.\n" in header


def test_states_follow_the_effects_within_what_single_precision_and_gathered_steps_leave():
    known = sensor(of=Straight)
    # two hours at 10 Hz: a ramp up, a rest, a ramp down
    t = np.arange(0, 7200, 0.1)
    T = np.interp(t, [0, 2400, 4200, 7200], [-10.0, 45.0, 45.0, 5.0])
    channels = {
        "temperature": T,
        "voltage": 3.5 + 0.3 * np.sin(t / 700),
        "accel": np.stack([np.sin(t / 60), np.cos(t / 60), 9.8 + 0 * t], axis=1),
        "magnetic field": np.stack([30 * np.sin(t / 90), 20 + 0 * t, 5 + 0 * t], axis=1),
        "temperature_case": T + 2 * np.sin(t / 500),
    }
    dt = np.full(len(t), 0.1, dtype=np.float32)
    dt[0] = 0.0
    single = {name: values.astype(np.float32) for name, values in channels.items()}
    for own in (*EFFECTS, *HELD):
        alone = sensor(own, of=Straight)
        expected = alone.bias(Chunk(t, channels))
        found = run(program(alone, 0.02, floats=True), dt, single)
        part = np.max(np.abs(expected - known.bias(Chunk(t, channels))), axis=0)
        error = np.max(np.abs(found - expected), axis=0)
        assert np.all(part > 0)
        # 1 / 4096 of a signal where a lag's steps are gathered; the tables' loss, of a bend between their places too
        loss = 0.02 if own.domain is None else 0.03
        assert np.all(error <= part / 2000 + loss * DEG_H), own.kind


def test_a_kilohertz_does_not_stop_a_lag_of_hours():
    own = effect("relaxation", tau="10 h")
    known = sensor(own)
    N = 1_800_000  # half an hour
    T = np.full(N, 30.0, dtype=np.float32)
    T[0] = 20.0
    dt = np.full(N, 1e-3, dtype=np.float32)
    dt[0] = 0.0
    found = run(program(known), dt, {"temperature": T})[-1] - at_rest(program(known), T[-1:])[0]
    # after the first step the lag has 10 K to follow
    expected = 10 * np.exp(-(N - 1) * 1e-3 / 36_000) * np.asarray(own.coefficients)
    begun = 10 * np.asarray(own.coefficients)
    np.testing.assert_allclose(
        (begun - found) / (begun - expected), 1, atol=0.01
    )  # 8.8 s of half an hour wait to be gathered


def test_what_cannot_be_in_the_code_is_left_out_with_its_size(tmp_path):
    periodic = effect("periodic", 2, period="97 s")
    known = sensor(periodic, effect("hysteresis", width="3 K"), effect("g_sensitivity", 3))
    loss = exported(tmp_path, known)
    assert loss.left_out == ("gyro: periodic: it cannot be computed from channels and time since switch-on",)
    (cause,) = loss.sensors[0].causes.items()
    assert cause[0] == "periodic, which is left out"
    sine, cosine = np.asarray(periodic.coefficients).reshape(3, 2).T
    np.testing.assert_allclose(cause[1].rms, np.hypot(sine, cosine) / np.sqrt(2), rtol=0.01)
    assert any("g_sensitivity of accel is in the code" in note for note in loss.notes)
    bare = effect("relaxation").model_copy(update={"coefficients": None})
    assert exported(tmp_path, sensor(bare)).left_out == ("gyro: relaxation: it has no coefficients",)


def test_functions_of_functions_are_left_out(tmp_path):
    class Nested(registry().classes(Effect)["relaxation"]):
        def realisation(self):
            (behind,) = super().realisation()
            return (replace(behind, of=Function(behind.of, np.sin, 0.0, 1.0)),)

    nested = Nested(coefficients=(1e-6, 1e-6, 1e-6), tau=1200.0)
    assert exported(tmp_path, sensor(nested)).left_out == ("gyro: relaxation: it is made of functions of functions",)


def test_several_sensors_have_a_pair_each(tmp_path):
    first, odd = sensor(), replace(sensor(), channel="2nd gyro/int", shown="rad/s")
    accel = replace(sensor(), channel="accel", unit="m/s^2", shown="mg")
    C99(knots="float").export(Export((first, accel, odd)), tmp_path)
    names = {path.name for path in tmp_path.iterdir()}
    stems = ("gyro", "accel", "c_2nd_gyro_int")
    assert names == {f"{stem}_bias{end}" for stem in stems for end in (".h", ".c", "_test.c")}
    assert "bias of the accel in m/s^2" in (tmp_path / "accel_bias.h").read_text()
    objects = [str(path) for path in tmp_path.glob("*_bias.c")]
    (tmp_path / "main.c").write_text("int main(void) { return 0; }")
    subprocess.run([tool("gcc"), *STRICT, *objects, str(tmp_path / "main.c"), "-o", str(tmp_path / "all")], check=True)


def test_without_a_loss_it_is_a_tenth_of_what_the_map_is_good_to(tmp_path):
    loss = exported(tmp_path, sensor(), loss=None).sensors[0].domain
    assert np.all(loss.largest <= 2e-6)
    assert np.max(loss.largest) > 1e-6
    json.dumps([value.tolist() for value in vars(loss).values()])


def test_a_loss_of_another_unit_and_one_that_is_too_small_are_refused(tmp_path):
    with pytest.raises(
        ConfigError, match=r"export c: loss 1 mg is no rad/s, the unit of gyro; write e\.g\. --set 'loss=1 deg/h'"
    ):
        exported(tmp_path, sensor(), loss="1 mg")
    with pytest.raises(ConfigError, match=r"export c: 1000 knots leave more of gyro than .* deg/h; set a larger loss"):
        exported(tmp_path, sensor(), loss="1e-4 deg/h")
    assert not list(tmp_path.iterdir())


INPUT = """
#include "gyro_bias.h"
int main(void)
{
    float input[3];
    while (filled()) { gyro_input(in[0], in + 1, in + 4, input); put(input, sizeof input); }
    return 0;
}
"""


def turned():
    """A sensor whose map has scale factors and misalignments that bend over temperature by a per cent."""
    T, rng = np.linspace(LOW, HIGH, 5), np.random.default_rng(3)
    error = CurveError(T=(LOW, HIGH), modes=(((1e-4,) * 9, (2e-4,) * 9),), bend=(0.0,) * 9)
    matrix = TriadMatrix(
        T=T.tolist(), values=rng.normal(0, 5e-3, (5, 9)).tolist(), slopes=rng.normal(0, 1e-4, (5, 9)).tolist(),
        frame="given", kinds=("order 3",) * 9, told=(True,) * 9, error=error,
    )  # fmt: skip
    known = sensor(*EFFECTS[:1])
    return replace(known, map=known.map.noting(matrix=matrix))


@compiled
@pytest.mark.parametrize("knots", ["smallest", "float"])
def test_scale_factor_and_misalignment_are_those_of_the_emulation(tmp_path, flags, arm, knots):
    known, rng = turned(), np.random.default_rng(2)
    loss = exported(tmp_path, known, knots=knots)
    own = program_of(known, np.full(3, DEG_H), floats=knots == "float")
    assert own.matrix.whole is (knots == "smallest")
    T = temperatures()[::5]
    bias, reading = (rng.normal(0, size, (len(T), 3)).astype(np.float32) for size in (1e-3, 3.0))
    given = np.column_stack([T, bias, reading])
    found = answers(built(tmp_path, INPUT, 7, flags, arm=arm), given)
    np.testing.assert_array_equal(bits(found), bits(inputs(own, T, bias, reading)))

    inside = np.isfinite(T) & (T > LOW) & (T < HIGH)  # and it is the map's own inverse, within what is said
    less = reading[inside].astype(float) - bias[inside]
    exact = less - known.map.record.matrix.distortion(less, T[inside].astype(float))
    lost = loss.sensors[0].matrix
    ppm = 1e6 * float(np.max(lost.scale.largest + np.sqrt(2) * lost.misalignment.largest))
    off = np.max(np.abs(found[inside] - exact), axis=1) / np.max(np.abs(less), axis=1)
    assert 0.2 * ppm < 1e6 * np.max(off) < 1.05 * ppm + 1
    assert ppm < 60
    assert not any("misalignment" in what for what in loss.left_out)


def test_the_self_test_sees_a_wrong_matrix(tmp_path):
    exported(tmp_path, turned(), knots="float")
    command = [tool("gcc"), *STRICT, "-DTOLERANCE=0.0f", "gyro_bias.c", "gyro_bias_test.c", "-o", "selftest"]
    subprocess.run(command, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "selftest"]).returncode == 0
    source = tmp_path / "gyro_bias.c"
    source.write_text(source.read_text().replace("terms[(3u * axis) + k]", "terms[axis + (3u * k)]"))
    subprocess.run(["gcc", "-std=c99", "gyro_bias.c", "gyro_bias_test.c", "-o", "selftest"], cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "selftest"]).returncode == 32
