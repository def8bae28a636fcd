"""The simulated unit against hand values, statistics and laws; expected numbers do not come from its own code."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from fusion_core.chunk import concatenate
from fusion_core.faults import Faults
from fusion_plugins.earth import earth_rate, gravity
from fusion_plugins.sources import synthetic
from fusion_plugins.sources.synthetic import BLOCK, Synthetic

DEG = np.pi / 180
DEG_H = DEG / 3600
FLAT = [{}, {}, {}]  # no curve
QUIET = {"noise": "0 deg/h/sqrt(Hz)", "walk": "0 deg/s/sqrt(s)"}
STILL = {"kind": "table", "time": ["0 s"], "temperature": ["25 degC"]}
SOAK = {"kind": "soak"}


def read(source, size=BLOCK):
    return concatenate(source.chunks(size, Faults()))


def unit(**more):
    """A unit with no error but those that are asked for."""
    base = {
        "temperature": {"noise": "0 K", "resolution": "0 K"},
        "gyro": {**QUIET, "curve": FLAT},
        "accel": {"noise": "0 m/s/sqrt(h)", "walk": "0 ug/sqrt(s)"},
    }
    for name, value in more.items():
        base[name] = {**base[name], **value} if isinstance(base.get(name), dict) else value
    return Synthetic.model_validate(base)


def test_two_lines_are_a_config_and_give_the_paper_ramp():
    """27.28 to 34.08 degC at 2 K/min takes 204 s each way; with three holds of 60 s, 588 s."""
    got = read(Synthetic())
    assert len(got) == 58_800
    assert got["gyro"].shape == got["accel"].shape == got["bias_truth"].shape == (58_800, 3)
    assert got["temperature"].shape == (58_800,)
    np.testing.assert_array_equal(got.t, np.arange(58_800) / 100)
    exact = read(unit())
    for seconds, T in ((0, 27.28), (60, 27.28), (162, 30.68), (264, 34.08), (324, 34.08), (426, 30.68), (528, 27.28)):
        assert exact["temperature"][seconds * 100] == pytest.approx(T, abs=1e-9)


# the samples do not depend on how they are read


@settings(max_examples=15)
@given(size=st.integers(1, 1500), seed=st.integers(0, 2**40), hold=st.floats(0, 20).map(lambda s: round(s, 6)))
def test_chunks_of_any_size_are_the_same_samples(size, seed, hold):
    source = Synthetic.model_validate({
        "seed": seed, "rate": "7 Hz", "lag": "30 s", "duration": "200 s", "latitude": "40.9 deg",
        "profile": {"kind": "ramp", "low": "20 degC", "high": "25 degC", "rate": "4 K/min", "hold": f"{hold} s"},
        "gyro": {"turn_on": "9 deg/h", "resolution": "1e-3 deg/s", "hysteresis": {"width": "2 K", "gain": "9 deg/h/K"}},
    })  # fmt: skip
    whole, parts = read(source, 10_000), list(source.chunks(size, Faults()))
    assert max(map(len, parts)) <= size
    joined = concatenate(parts)
    np.testing.assert_array_equal(joined.t, whole.t)
    for name, values in whole.channels.items():
        np.testing.assert_array_equal(joined[name], values)


def test_chunks_that_straddle_the_blocks_are_the_same_samples():
    source = Synthetic.model_validate({"rate": "1000 Hz", "duration": "150 s"})
    whole = read(source)
    assert len(whole) > 2 * BLOCK
    for size in (9_999, BLOCK - 1, BLOCK + 1, 10**9):
        np.testing.assert_array_equal(read(source, size)["gyro"], whole["gyro"])


def test_the_walk_goes_on_from_block_to_block():
    got = read(unit(gyro={"walk": "1 deg/s/sqrt(s)"}, rate="1000 Hz", duration="150 s", profile=STILL))
    steps = np.diff(got["bias_truth"], axis=0)
    assert np.all(got["bias_truth"][0] == 0)
    seams = [BLOCK - 1, 2 * BLOCK - 1]
    assert np.all(np.abs(steps[seams]) < 5 * np.std(steps))
    assert np.all(steps[seams] != 0)


def test_a_seed_is_a_start_and_repeats_to_the_last_bit():
    one, again, other = (read(Synthetic(seed=seed, duration="20 s")) for seed in (1, 1, 2))
    for name in one.channels:
        np.testing.assert_array_equal(one[name], again[name])
        assert not np.any(one[name] == other[name]) or name in ("temperature", "bias_truth")


def test_a_longer_recording_begins_with_the_shorter_one():
    short, long = (read(Synthetic(duration=text)) for text in ("20 s", "20 min"))
    assert len(long) == 120_000
    for name, values in short.channels.items():
        np.testing.assert_array_equal(long[name][: len(short)], values)


def test_taking_one_error_away_leaves_the_others():
    full, without = (read(Synthetic(duration="20 s", gyro=g)) for g in ({}, {"walk": "0 deg/s/sqrt(s)"}))
    np.testing.assert_allclose(full["gyro"] - full["bias_truth"], without["gyro"] - without["bias_truth"], atol=1e-15)
    np.testing.assert_array_equal(full["accel"], without["accel"])


def test_channels_and_axes_are_independent():
    more = {"temperature": {"resolution": "0 K"}, "accel": {"walk": "0 ug/sqrt(s)"}}
    got = read(Synthetic(rate="10 Hz", duration="3 h", profile=STILL, **more))
    noise = np.column_stack([got["gyro"] - got["bias_truth"], got["accel"], got["temperature"]])
    r = np.corrcoef(noise.T) - np.eye(7)
    assert np.abs(r).max() < 5 / np.sqrt(len(noise))


# noise


def test_allan_deviation_gives_noise_and_walk_back():
    """White noise: sigma(tau) = N / sqrt(tau); random walk: K sqrt(tau / 3) (IEEE Std 952, annex C)."""
    allantools = pytest.importorskip("allantools")
    N, K = 3.18 * DEG_H, 1e-3 * DEG
    got = read(unit(gyro={"noise": "3.18 deg/h/sqrt(Hz)", "walk": "1e-3 deg/s/sqrt(s)"}, rate="20 Hz",
                    duration="8 h", profile=STILL))  # fmt: skip
    for axis in range(3):
        tau, sigma, _, _ = allantools.oadev(got["gyro"][:, axis], rate=20.0, data_type="freq", taus=[0.05, 0.1, 200.0])
        np.testing.assert_allclose(sigma[:2] * np.sqrt(tau[:2]), N, rtol=0.01)
        np.testing.assert_allclose(sigma[2] / np.sqrt(tau[2] / 3), K, rtol=0.25)  # 144 clusters


@pytest.mark.parametrize("rate", [1, 100, 400])
def test_white_noise_and_walk_at_any_rate(rate):
    """Mean of white noise over 1/rate: N sqrt(rate); increment of the walk: K / sqrt(rate). 5 sigma bounds."""
    got = read(unit(gyro={"noise": ["1 deg/h/sqrt(Hz)", "2 deg/h/sqrt(Hz)", "0 deg/h/sqrt(Hz)"],
                          "walk": "3 deg/h/sqrt(s)"},
                    accel={"noise": "0.05 m/s/sqrt(h)", "walk": "0 mg/sqrt(s)"},
                    rate=f"{rate} Hz", duration=f"{40_000 / rate} s", profile=STILL))  # fmt: skip
    bound = 5 / np.sqrt(2 * 40_000)
    white = np.std(got["gyro"] - got["bias_truth"], axis=0) / DEG_H / np.sqrt(rate)
    np.testing.assert_allclose(white, [1, 2, 0], rtol=bound, atol=1e-12)
    np.testing.assert_allclose(
        np.std(np.diff(got["bias_truth"], axis=0), axis=0) / DEG_H * np.sqrt(rate), 3, rtol=bound
    )
    np.testing.assert_allclose(np.std(got["accel"], axis=0) / np.sqrt(rate), 0.05 / 60, rtol=bound)


def test_turn_on_over_many_starts():
    source = unit(gyro={"turn_on": ["20 deg/h", "0 deg/h", "5 deg/h"]}, duration="0.02 s")
    starts = np.array([read(source.model_copy(update={"seed": seed}))["bias_truth"] for seed in range(400)])
    np.testing.assert_array_equal(starts[:, 0], starts[:, 1])  # a constant
    np.testing.assert_allclose(np.std(starts[:, 0], axis=0) / DEG_H, [20, 0, 5], rtol=5 / np.sqrt(800))
    assert np.all(np.abs(np.mean(starts[:, 0], axis=0)) / DEG_H <= np.array([20, 0, 5]) * 5 / 20)


def test_outputs_are_rounded_to_their_resolution():
    got = read(Synthetic(duration="30 s", gyro={"resolution": ["0.01 deg/s", "0 deg/s", "1 deg/h"]},
                         accel={"resolution": "1 mg"}))  # fmt: skip
    exact = read(Synthetic(duration="30 s", temperature={"resolution": "0 K"}))
    for values, truth, step in (
        (got["gyro"][:, 0], exact["gyro"][:, 0], 0.01 * DEG),
        (got["gyro"][:, 2], exact["gyro"][:, 2], DEG_H),
        (got["accel"][:, 1], exact["accel"][:, 1], 9.80665e-3),
        (got["temperature"], exact["temperature"], 0.01),
    ):
        np.testing.assert_allclose(values / step, np.round(values / step), atol=1e-9)
        assert np.abs(values - truth).max() <= step / 2 * (1 + 1e-9)
    np.testing.assert_array_equal(got["gyro"][:, 1], exact["gyro"][:, 1])


# temperature


def test_the_soak_of_the_paper():
    """From -20.53 degC by 5 degC to 44.47 (14 plateaus), and the last one at 48.08; 2.5 h each, 2 K/min between."""
    plateaus = [-20.53 + 5 * k for k in range(14)] + [48.08]
    got = read(unit(profile=SOAK, rate="0.1 Hz"))
    assert got.t[-1] == pytest.approx(15 * 9000 + 68.61 / 2 * 60, abs=10)
    T, counts = np.unique(np.round(got["temperature"], 6), return_counts=True)
    np.testing.assert_allclose(T[counts > 800], plateaus, atol=1e-6)
    assert np.all(np.abs(counts[counts > 800] - 900) <= 2)
    rate = np.diff(got["temperature"]) / np.diff(got.t)
    assert rate.max() == pytest.approx(2 / 60, abs=1e-12)
    assert rate.min() >= 0


def test_the_soak_goes_down_the_way_it_came_and_may_begin_at_the_top():
    down = unit(profile={**SOAK, "down": True}).profile.plateaus()
    np.testing.assert_allclose(down, down[::-1])
    assert len(down) == 29
    assert down[14] == 48.08
    cooling = unit(profile={"kind": "soak", "start": "60 degC", "stop": "-40 degC", "step": "50 K"}).profile.plateaus()
    np.testing.assert_allclose(cooling, [60, 10, -40])


def test_a_difference_may_be_written_in_degc():
    """`step: 5 degC` can only mean 5 K."""
    for field in ("5 degC", "5 °C", "5 K"):
        assert unit(profile={**SOAK, "step": field}).profile.step == 5
    assert unit(temperature={"resolution": "0.01 degC"}).temperature.resolution == 0.01


def test_a_table_is_joined_by_lines_and_held_at_its_ends():
    table = {"kind": "table", "time": ["10 s", "20 s", "1 min"], "temperature": ["20 degC", "300 K", "10 degC"]}
    got = read(unit(profile=table, rate="1 Hz", duration="100 s"))
    np.testing.assert_allclose(got["temperature"], np.interp(np.arange(100), [10, 20, 60], [20, 26.85, 10]), atol=1e-9)
    assert unit(profile=table).samples == 6000


@pytest.mark.parametrize("tau", [5.0, 200.0, 5000.0])
def test_the_body_lags_by_a_first_order(tau):
    """Independent: the differential equation, integrated in steps of 10 ms by Heun's rule."""
    ramp = {"kind": "ramp", "low": "20 degC", "high": "30 degC", "rate": "6 K/min", "hold": "30 s", "cycles": 2}
    chamber = read(unit(profile=ramp, duration="10 min"))["temperature"]
    got = read(unit(profile=ramp, duration="10 min", lag=f"{tau} s"))["temperature"]
    T = np.empty_like(chamber)
    T[0] = chamber[0]
    for k in range(1, len(T)):
        slope = (chamber[k - 1] - T[k - 1]) / tau
        T[k] = T[k - 1] + 0.005 * (slope + (chamber[k] - T[k - 1] - 0.01 * slope) / tau)
    np.testing.assert_allclose(got, T, atol=1e-5)


def test_gyros_lag_behind_a_thermometer_in_the_chamber():
    """On a long ramp of s K/s a body is s tau behind; the bias is that of the body."""
    table = {"kind": "table", "time": ["0 s", "1 h"], "temperature": ["0 degC", "36 degC"]}
    more = {"profile": table, "lag": "100 s", "rate": "1 Hz", "gyro": {"curve": [{"linear": "1 deg/h/K"}, {}, {}]}}
    body, chamber = (read(unit(**more, temperature={"at": at})) for at in ("body", "chamber"))
    np.testing.assert_array_equal(body["bias_truth"], chamber["bias_truth"])
    np.testing.assert_allclose((chamber["temperature"] - body["temperature"])[2000:], 0.01 * 100, rtol=1e-8)
    np.testing.assert_allclose(chamber["bias_truth"][:, 0] / DEG_H + 25, body["temperature"], atol=1e-9)


# the bias


def test_the_curve_is_its_polynomial_and_its_step():
    """By hand at T = 35 degC, reference 25: 1 + 10 * 2 + 100 * 0.3 + 1000 * 0.01 = 61 deg/h."""
    curve = [
        {"offset": "1 deg/h", "linear": "2 deg/h/K", "quadratic": "0.3 deg/h/K^2", "cubic": "0.01 deg/h/K^3"},
        {"reference": "35 degC", "offset": "-7 deg/h", "linear": "5 deg/h/K"},
        {"steps": [{"at": "31 degC", "height": "72 deg/h", "width": "0.8 K"}]},
    ]
    points = [35, 30.6, 31, 31.4]
    table = {"kind": "table", "time": [f"{k} s" for k in range(4)], "temperature": [f"{T} degC" for T in points]}
    bias = read(unit(profile=table, rate="1 Hz", duration="4 s", gyro={"curve": curve}))["bias_truth"] / DEG_H
    np.testing.assert_allclose(bias[0, :2], [61, -7], rtol=1e-12)
    np.testing.assert_allclose(bias[1:, 2], [7.2, 36, 64.8], rtol=1e-9)  # 10 %, half, 90 % of the height
    assert bias[0, 2] == pytest.approx(72, rel=1e-4)


def test_hysteresis_closes_its_loop_and_cooling_less_warming_is_gain_times_width():
    """Up: p = T - w/2, down: p = T + w/2, so the two differ by gain w where the play is taken up."""
    gain = np.array([5.0, -3.0, 0.0])
    loop = {"width": "4 K", "gain": [f"{g} deg/h/K" for g in gain]}
    ramp = {"kind": "ramp", "low": "20 degC", "high": "30 degC", "rate": "1 K/min", "hold": "0 s", "cycles": 3}
    got = read(unit(profile=ramp, rate="1 Hz", gyro={"hysteresis": loop}))
    bias, T = got["bias_truth"] / DEG_H, got["temperature"]
    up, down = (np.arange(len(T)) // 600 == k for k in (2, 3))
    inside = (T > 24.01) & (T < 25.99)  # more than the width from both ends
    warming, cooling = bias[up & inside], bias[down & inside]
    np.testing.assert_allclose(warming, np.tile(-gain * 2, (len(warming), 1)), atol=1e-9)
    np.testing.assert_allclose(cooling - warming, np.tile(gain * 4, (len(warming), 1)), atol=1e-9)
    np.testing.assert_allclose(bias[1200:2400], bias[2400:3600], atol=1e-9)  # closed after the first cycle
    assert np.abs(bias[:, 0]).max() <= 10 + 1e-9


@settings(max_examples=30)
@given(
    T=st.lists(st.integers(-40, 60), min_size=2, max_size=12),
    width=st.floats(0.1, 30),
    lag=st.sampled_from([0, 3, 50, 1000]),
)
def test_the_play_operator_is_what_a_step_by_step_scan_gives(T, width, lag):
    """Independent: p_k = min(max(p_k-1, T_k - w/2), T_k + w/2) over dense samples."""
    table = {"kind": "table", "time": [f"{60 * k} s" for k in range(len(T))], "temperature": [f"{x} degC" for x in T]}
    loop = {"width": f"{width} K", "gain": "1 rad/s/K"}
    got = read(unit(profile=table, rate="10 Hz", lag=f"{lag} s", gyro={"hysteresis": loop}))
    p, scanned = got["temperature"][0], []
    for now in got["temperature"]:
        p = min(max(p, now - width / 2), now + width / 2)
        scanned.append(p - now)
    step = np.abs(np.diff(got["temperature"])).max() if lag else 0.0  # a turn between two samples is seen by one only
    np.testing.assert_allclose(got["bias_truth"][:, 0], scanned, atol=1e-9 + step * 0.05)


# where it stands


@pytest.mark.parametrize(
    ("latitude", "heading", "pitch", "roll"), [(40.9, 0, 0, 0), (-33, 75, 12, -20), (52, 300, -70, 110)]
)
def test_earth_rate_and_gravity_are_the_application_s(latitude, heading, pitch, roll):
    got = read(unit(latitude=f"{latitude} deg", heading=f"{heading} deg", pitch=f"{pitch} deg", roll=f"{roll} deg",
                    duration="1 s"))  # fmt: skip
    f = got["accel"][0]
    up = f / np.linalg.norm(f)
    assert np.linalg.norm(f) == pytest.approx(gravity(latitude * DEG), rel=1e-12)
    assert up[0] == pytest.approx(np.sin(pitch * DEG))
    np.testing.assert_allclose(got["gyro"][0], earth_rate(up, latitude * DEG, heading * DEG), atol=1e-18)


def test_level_and_north_by_hand():
    """At 40.9 deg: 15.041 deg/h times (cos, 0, sin), and gravity along z; on its right side, y points down."""
    got = read(unit(latitude="40.9 deg", duration="1 s"))
    np.testing.assert_allclose(got["gyro"][0] / DEG_H, [11.3688, 0, 9.8480], atol=1e-3)
    np.testing.assert_allclose(read(unit(duration="1 s"))["accel"][0], [0, 0, 9.80665], atol=1e-12)
    np.testing.assert_array_equal(read(unit(duration="1 s"))["gyro"], np.zeros((100, 3)))
    east = read(unit(latitude="40.9 deg", heading="90 deg", duration="1 s"))["gyro"][0] / DEG_H
    np.testing.assert_allclose(east, [0, 11.3688, 9.8480], atol=1e-3)  # x to the east, y (left of it) to the north


def test_accelerometer_bias():
    got = read(unit(accel={"bias": ["1 mg", "0 mg", "-2 mg"]}, duration="1 s"))
    np.testing.assert_allclose(got["accel"][5] - [0, 0, 9.80665], 9.80665e-3 * np.array([1, 0, -2]), atol=1e-15)


# mistakes


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rate": "-10 Hz"}, "'-10 Hz' must be greater than zero"),
        ({"rate": True}, "True has no unit; write e.g. '100 Hz'"),
        ({"rate": "3 m"}, "cannot be converted to Hz"),
        ({"duration": "1 ms"}, "0.001 s at 100 Hz have no sample; write a longer duration, or a higher rate"),
        ({"seed": -1}, "greater than or equal to 0"),
        ({"lag": "-1 s"}, "'-1 s' must be at least 0 s"),
        ({"gyro": {"noise": ["1 deg/h/sqrt(Hz)"] * 2}}, "noise has 2 values for 3 axes; write one for all"),
        (
            {"gyro": {"noise": ["1 deg/h/sqrt(Hz)", "-1 deg/h/sqrt(Hz)", "1 deg/h/sqrt(Hz)"]}},
            "must be at least 0 rad/s/sqrt(Hz)",
        ),
        ({"gyro": {"curve": [{}]}}, "1 curves are given for 3 axes; write a list of 3, one an axis"),
        ({"gyro": {"hysteresis": {"width": "4 K", "gain": ["1 deg/h/K"] * 4}}}, "gain has 4 values for 3 axes"),
        ({"gyro": {"walc": "1 deg/h/sqrt(s)"}}, "did you mean 'walk'"),
        ({"profile": {"kind": "sook"}}, "'soak', 'ramp', 'table'"),
        ({"profile": {"kind": "ramp", "low": "30 degC", "high": "20 degC"}}, "low is 30 degC and high 20 degC; write"),
        ({"profile": {**STILL, "time": ["0 s", "1 s"]}}, "2 times and 1 temperatures are given; write one"),
        ({"profile": {"kind": "table", "time": ["5 s", "5 s"], "temperature": ["1 degC"] * 2}}, "times that increase"),
        ({"profile": {"kind": "soak", "step": "0 K"}}, "'0 K' must be greater than zero"),
        ({"profile": STILL}, "0 s at 100 Hz have no sample; write a longer duration"),
        ({"temperature": {"at": "moon"}}, "'body' or 'chamber'"),
    ],
)
def test_mistakes_are_named(settings, message):
    with pytest.raises(ValidationError) as error:
        Synthetic.model_validate(settings)
    assert message in str(error.value)


def test_a_config_is_written_back_as_it_was_understood():
    source = Synthetic(gyro={"noise": ["1 deg/h/sqrt(Hz)"] * 3}, profile={**SOAK, "step": "5 degC"}, duration="1 min")
    text = source.model_dump(mode="json", exclude_none=True)
    assert text["profile"]["step"] == "5 K"
    assert text["gyro"]["noise"] == ["1 deg/h/sqrt(Hz)"] * 3
    again = Synthetic.model_validate(text)
    np.testing.assert_array_equal(read(again)["gyro"], read(source)["gyro"])


def test_keys_of_the_random_numbers_stay():
    """Another order, or another block, would give every seed other samples."""
    assert synthetic.STREAMS[:6] == ("gyro", "gyro_walk", "turn_on", "accel", "accel_walk", "temperature")
    assert BLOCK == 65_536
