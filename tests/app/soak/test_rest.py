"""Steep is not motion, motion is cut out finely, and what is not used is said. The recordings are drawn here."""

import numpy as np
import pytest

from driftlab.commands.fit_map import fit_map
from driftlab.config import Config
from driftlab.errors import SwingTooSmall
from driftlab.maps.fit import fit_gathered, gather
from driftlab.soak.rest import Used, at_rest
from driftlab.storage.in_memory import InMemoryName, in_memory_name
from fusion_core.chunk import Chunk
from fusion_core.contracts import ThermalMap
from fusion_core.faults import Faults
from fusion_core.host.registry import registry

DEG_H = np.deg2rad(1 / 3600)
DT, FOG, MEMS = 0.5, 2e-7, 1.54e-5


def config(noise, **filter):
    walk = {"kind": "random_walk", "walk": f"{noise / 50} rad/s/sqrt(s)"}
    gyro = {"noise": f"{noise} rad/s/sqrt(Hz)", "bias": walk}
    return Config.model_validate({"filter": {"update_interval": f"{DT} s", "gyro": gyro, "accel": None, **filter}})


def soak(noise, slope, pace, seconds=3600.0, seed=0):
    """Return t, temperature up and down by `pace` K a minute, and a gyro of a bent curve of `slope` deg/h a K."""
    rng = np.random.default_rng(seed)
    t = np.arange(1, seconds / DT + 1) * DT
    T = -20 + pace / 60 * (seconds / 2 - np.abs(t - seconds / 2))
    curve = slope * DEG_H * (0.8 * T + 0.2 * 10 * np.log(np.cosh((T - 5) / 10)))
    rates = curve[:, None] * [1, -0.5, 0.3] + rng.normal(size=(len(t), 3)) * noise / np.sqrt(DT)
    return t, T, rates


def of(t, T, rates):
    tau = np.full(len(t), DT)
    channels = {"gyro": rates, "temperature": T, "tau": tau}
    return Chunk(t, channels, Chunk(t[:1] - DT, {name: values[:1] for name, values in channels.items()}))


def bumped(rates, t, every=180.0, length=6.0, size=0.01):
    """Return the rates with a bump every so often, and when (N,)."""
    moved = (t % every > every / 2) & (t % every <= every / 2 + length)
    shaken = size * np.sin(2 * np.pi * 0.37 * t) * moved
    return rates + shaken[:, None], moved


def recording(t, T, rates):
    return InMemoryName(
        in_memory_name({"time": (t, "s"), "gyro": (rates, "rad/s"), "temperature": (T, "degC")}, None, "data")
    )


@pytest.mark.parametrize("noise", [FOG, MEMS])
@pytest.mark.parametrize(("slope", "pace"), [(22, 1.0), (100, 5.0), (100, 0.2)])
def test_a_steep_curve_is_at_rest(noise, slope, pace):
    used = Used()
    list(at_rest(config(noise), [of(*soak(noise, slope, pace, seconds=1800.0))], Faults(), used))
    assert used.moved <= 0.02


def test_a_rate_that_drifts_while_the_temperature_stands_is_motion():
    """The same drift as that of a curve, at 20 degC all the time: no bias does that."""
    t, T, rates = soak(FOG, 100, 5.0, seconds=900.0)
    used = Used()
    list(at_rest(config(FOG), [of(t, 20 + 0 * T, rates)], Faults(), used))
    assert used.moved > 0.9


def test_a_step_on_a_steep_ramp_is_motion():
    """By 30 deviations of an epoch, for 20 s."""
    t, T, rates = soak(FOG, 22, 1.0, seconds=900.0)
    turned = (t > 400) & (t <= 420)
    rates = rates + (turned * 30 * FOG / np.sqrt(DT))[:, None]
    rests = list(at_rest(config(FOG), [of(t, T, rates)], Faults()))
    taken = np.concatenate([rest.window.t for rest in rests])
    assert not np.any((taken > 402) & (taken <= 418))
    assert len(taken) > 0.9 * len(t)


@pytest.mark.parametrize("noise", [FOG, MEMS])
def test_bumps_are_cut_out_and_not_whole_windows(noise):
    t, T, rates = soak(noise, 10, 0.5, seconds=772.0)
    rates, moved = bumped(rates, t)
    used = Used()
    rests = list(at_rest(config(noise), [of(t, T, rates)], Faults(), used))
    taken = np.concatenate([rest.window.t for rest in rests])
    assert not np.any(np.isin(t[moved], taken))
    lost = DT * (len(t) - len(taken))
    assert lost <= DT * np.sum(moved) + 4 * 8, "a bump of 6 s costs no more than 14"
    assert used.moving == len(t) - len(taken)


def test_the_first_line_says_what_is_not_used_and_the_map_covers_it():
    t, T, rates = soak(MEMS, 22, 1.0)
    handled = t <= 400.0
    rates = rates + (handled * np.deg2rad(3) * np.sin(2 * np.pi * 0.31 * t))[:, None]
    found = fit_map(config(MEMS), [recording(t, T, rates)], kind="spline")
    first = found.lines()[0]
    assert first.startswith("1")
    assert "% of the soak is not used: " in first
    assert "was taken for motion (first at 0.5 s" in first
    assert found.summary["judged"]["unused"]["motion"] == pytest.approx(400 / 3600, abs=0.02)
    low, high = found.map.domain
    assert low <= T.min()
    assert high >= T.max()
    found.map.bias(T)
    still = fit_map(config(MEMS), [recording(*soak(MEMS, 22, 1.0))], kind="spline")
    assert "not used" not in still.lines()[0]


def test_rows_that_are_left_out_are_not_used_either():
    t, T, rates = soak(MEMS, 22, 1.0)
    rates[1000:1800] = np.nan
    found = fit_map(config(MEMS), [recording(t, T, rates)], kind="spline")
    assert found.lines()[0].startswith(
        "11% of the soak is not used: 11% of the rows were left out (rows where gyro is not"
    )


def test_a_swing_that_is_too_small_says_how_long_it_lasts_and_first_what_left_the_rows_out():
    t, T, rates = soak(MEMS, 22, 1.0)
    said = r"T moves by only \d\.\d+ K, .*; it lasts 1\d\d s: where length or swing are not what was recorded, "
    with pytest.raises(SwingTooSmall, match=said):
        fit_map(config(MEMS), [recording(*soak(MEMS, 22, 1.0, seconds=120.0))], kind="spline")
    rates[1000:, 1] = rates[1000, 1]
    said = r"^\d\d% of the soak is not used: .*gyro is stuck, first y at 5.*; the 5\d\d s that are left .*spline: T"
    with pytest.raises(SwingTooSmall, match=said):
        fit_map(config(MEMS), [recording(t, np.where(t > 600, T, 20 + 1e-3 * t), rates)], kind="spline")


def test_a_fit_that_fails_says_that_motion_took_the_samples():
    t, T, rates = soak(MEMS, 22, 1.0, seconds=1800.0)
    moving = (t > 60) & (t <= 1730)
    rates = rates + (moving * np.deg2rad(3) * np.sin(2 * np.pi * 0.31 * t))[:, None]
    gathered = gather(config(MEMS), [recording(t, T, rates)], Faults())
    settings = registry().classes(ThermalMap)["spline"].model_validate({})
    with pytest.raises(SwingTooSmall, match=r"9\d% of the soak is not used: 9\d% was taken for motion"):
        fit_gathered(config(MEMS), settings, gathered)


def test_the_curve_of_a_fog_is_found_on_its_own_ramp():
    """300 deg/h at 1 K a minute: 94 of 100 samples were taken for motion once."""
    t, T, rates = soak(FOG, 10, 1.0, seconds=5400.0)
    found = fit_map(config(FOG), [recording(t, T, rates)], kind="spline")
    assert "not used" not in found.lines()[0]
    truth = 10 * DEG_H * (0.8 * T + 0.2 * 10 * np.log(np.cosh((T - 5) / 10)))
    off = found.map.bias(T)[:, 0] - truth
    assert np.sqrt(np.mean((off - off.mean()) ** 2)) < 0.1 * DEG_H


@pytest.mark.parametrize(("factor", "noted"), [(1.0, False), (3.0, False), (1e-3, True), (8.0, True)])
def test_an_axis_in_another_unit_than_its_noise_is_named(factor, noted):
    faults = Faults()
    t, T, rates = soak(MEMS, 22, 1.0, seconds=1800.0)
    rates[:, 1] *= factor
    list(at_rest(config(MEMS), [of(t, T, rates)], faults))
    lines = [line for line in faults.lines() if "noise is not as declared" in line]
    assert len(lines) == noted
    for line in lines:
        assert "or correct unit and path of source.channels.gyro" in line
        assert float(line.split("declared: y ")[1].split(")")[0]) == pytest.approx(factor, rel=0.05)


@pytest.mark.parametrize(("factor", "noted"), [(1.0, False), (2.0, False), (5.0, True)])
def test_noise_that_is_larger_in_one_range_of_temperature_is_a_doubt(factor, noted):
    faults = Faults()
    t, T, rates = soak(MEMS, 22, 1.0)
    rates[:, 0] += (
        np.where((T > -10) & (T < 0), factor, 0.0) * MEMS / np.sqrt(DT) * np.random.default_rng(3).normal(size=len(t))
    )
    list(at_rest(config(MEMS), [of(t, T, rates)], faults))
    texts = [text for text in faults.doubts if "as of vibration" in text]
    assert len(texts) == noted
    assert all("between -9" in text and "and -0" in text for text in texts)
