"""Units whose memories began before the recording: what the filter learns of it while it is aligned, and coasts with.

The oracle is one Gaussian conditioning over the whole alignment, by dense matrices from the equations; no recursion.
"""

import numpy as np
import pytest
from doses import draws
from epochs_at_rest import DEG_H, GYRO_NOISE

from driftlab.config import Config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from fusion_core.chunk import Chunk

WALK = 0.02 * float(DEG_H)  # rad/s/sqrt(s)
SHAKE = 1e-6  # rad
ALIGN = 300.0
C = np.array([4.0, -2.0, 1.0]) * DEG_H  # of the relaxation, rad/s/K
LOOP = np.array([1.0, 3.0, -2.0]) * DEG_H  # of the play, rad/s/K
LEVEL = np.array([200.0, -900.0, 40.0]) * DEG_H
SPREAD = np.array([30.0, 60.0, 10.0]) * DEG_H  # from switch-on to switch-on
TAU, WIDTH = 1500.0, 3.0
LAG_OFF, PLAY_OFF = 5.0, 1.0  # K, what the states are off by


def listed(values):
    return [float(v) for v in values]


def relaxation(**more):
    return {"kind": "relaxation", "tau": f"{TAU} s", "coefficients": listed(C), **more}


def hysteresis(**more):
    return {"kind": "hysteresis", "width": f"{WIDTH} K", "coefficients": listed(LOOP), **more}


def both():
    return [relaxation(initial=listed(LAG_OFF * abs(C))), hysteresis(initial=listed(PLAY_OFF * abs(LOOP)))]


def config(effects, **bias):
    rate = lambda values: [f"{float(v)!r} rad/s" for v in values]  # noqa: E731
    known = {"turn_on_bias": rate(LEVEL), "repeatability": rate(SPREAD)}
    model = {"kind": "thermal_derivative", "walk": f"{WALK!r} rad/s/sqrt(s)", "effects": effects, **known, **bias}
    model = {name: value for name, value in model.items() if value is not None}
    gyro = {"noise": f"{GYRO_NOISE!r} rad/s/sqrt(Hz)", "bias": model}
    settings = {"update_interval": "1 s", "align": f"{ALIGN} s", "rest": {"attitude": f"{SHAKE!r} rad"}, "gyro": gyro}
    return Config.model_validate({"filter": settings})


def temperature(t):
    """Warmed, held, cooled: the play is crossed within the alignment."""
    return np.interp(t, [0, 600, 1500, 3000, 4200], [20.0, 32.0, 32.0, 12.0, 18.0])


def lagging(T, tau, start):
    """Return T through a lag, straight between its samples of 1 s, step by step."""
    out, y, phi = np.empty_like(T), start, np.exp(-1 / tau)
    out[0] = start
    for k in range(1, len(T)):
        rate = T[k] - T[k - 1]
        y = T[k] - rate * tau + (y - T[k - 1] + rate * tau) * phi
        out[k] = y
    return out


def played(T, width, start):
    out, y = np.empty_like(T), start
    for k, value in enumerate(T):
        y = min(max(y, value - width / 2), value + width / 2)
        out[k] = y
    return out


def unit(seed, seconds=4200, play=False):
    """Return epochs of 1 s and the true bias (N, 3): each axis with a lag, and a play, that began somewhere else."""
    rng = np.random.default_rng(seed)
    t = np.arange(1.0, seconds + 1)
    T = temperature(t)
    bias = LEVEL + SPREAD * rng.normal(size=3) + WALK * np.cumsum(rng.normal(size=(len(t), 3)), axis=0)
    for axis in range(3):
        bias[:, axis] += C[axis] * (T - lagging(T, TAU, T[0] + LAG_OFF * rng.normal()))
        if play:
            bias[:, axis] += LOOP[axis] * (played(T, WIDTH, T[0] + PLAY_OFF * rng.uniform(-1.5, 1.5)) - T)
    gyro = bias + GYRO_NOISE * rng.normal(size=bias.shape)
    channels = {"gyro": gyro, "temperature": T, "tau": np.ones(len(t))}
    return Chunk(t, channels, Chunk(t[:1] - 1, {name: values[:1] for name, values in channels.items()})), bias


def run_over(settings, chunk, size=None):
    """Return journal and joined columns of a run over the epochs, in chunks of `size`."""
    journal = RunLog()
    size = size or len(chunk)
    parts = [chunk.part(k, min(k + size, len(chunk))) for k in range(0, len(chunk), size)]
    return journal, joined(Run(settings, journal).over(parts))


def conditioned(turned, g, fadings, level, starts, N):
    """Return mean (q,) and covariance of the last level and the starts, after N epochs of 1 s of one axis.

    level = (mean, deviation) of the bias before the first epoch, g (N,) what is known to move it, fadings one (N,)
    for each start. Unknowns: level before, N steps of the walk, N parts of it within the epochs, the starts.
    """
    q = len(starts)
    one = np.tril(np.ones((N, N)))
    left = np.cumprod(np.stack([f[:N] for f in fadings]), axis=1).T if q else np.zeros((N, 0))
    level_at = np.hstack([np.ones((N, 1)), one, np.zeros((N, N)), np.zeros((N, q))])
    bias_at = level_at + np.hstack([np.zeros((N, 2 * N + 1)), left])
    before = np.vstack([np.eye(1, 2 * N + 1 + q), bias_at[:-1]])
    before[0, 2 * N + 1 :] = 1.0
    within = np.hstack([np.zeros((N, N + 1)), np.eye(N), np.zeros((N, q))])
    A = one @ ((bias_at + before) / 2 + within)
    drift = np.concatenate([[0.0], np.diff(g[:N])])
    known = level[0] + np.cumsum(drift)
    steady = one @ known  # of means over the epochs
    variance = np.concatenate([[level[1] ** 2], np.full(N, WALK**2), np.full(N, WALK**2 / 12), np.square(starts)])
    noise = GYRO_NOISE**2 * one @ one.T + SHAKE**2 * np.eye(N)
    S = (A * variance) @ A.T + noise
    ends = np.vstack([level_at[-1], np.eye(2 * N + 1 + q)[2 * N + 1 :] * left[-1][:, None]])
    cross = (ends * variance) @ A.T
    gain = np.linalg.solve(S, cross.T).T
    mean = gain @ (np.cumsum(turned[:N]) - steady) + np.concatenate([[known[-1]], np.zeros(q)])
    return mean, (ends * variance) @ ends.T - gain @ cross.T


def known_part(t, T):
    """Return what the effects add from equilibrium (N, 3), and the fadings (N,) of lag and play, as defined."""
    g = C * (T - lagging(T, TAU, T[0]))[:, None] + LOOP * (played(T, WIDTH, T[0]) - T)[:, None]
    of_lag = np.concatenate([[1.0], np.full(len(t) - 1, np.exp(-1 / TAU))])
    crossed = np.maximum.accumulate(T) - np.minimum.accumulate(T) >= WIDTH
    return g, [of_lag, np.where(crossed, 0.0, 1.0)]


@pytest.mark.parametrize("seed", range(3))
def test_state_and_level_at_the_departure_and_the_coast_are_those_of_one_dense_conditioning(seed):
    chunk, _ = unit(seed, seconds=2000, play=True)
    _, found = run_over(config(both()), chunk)
    t, T = chunk.t, chunk["temperature"]
    N = int(np.searchsorted(t, t[0] + ALIGN * (1 - 1e-9))) + 1
    assert np.all(np.isnan(found["coast"][:N]))
    assert np.all(np.isfinite(found["coast"][N:]))
    g, fadings = known_part(t, T)
    for axis in range(3):
        starts = [LAG_OFF * abs(C[axis]), PLAY_OFF * abs(LOOP[axis])]
        prior = LEVEL[axis] + g[0, axis], SPREAD[axis]
        x, P = conditioned(chunk["gyro"][:, axis], g[:, axis], fadings, prior, starts, N)
        states = [3 + axis, 6 + axis, 9 + axis]  # behind the attitude errors: level, start of the lag, of the play
        scale = 1e-9 * np.abs(x[0])
        np.testing.assert_allclose(found["x"][N - 1, states], x, rtol=0, atol=scale)
        np.testing.assert_allclose(found["sigma"][N - 1, states], np.sqrt(np.diag(P)), rtol=1e-9, atol=1e-30)
        np.testing.assert_allclose(found["bias"][N - 1, axis], np.sum(x), rtol=0, atol=scale)
        later = np.cumprod(np.stack(fadings)[:, N:], axis=1).T
        C_k = np.hstack([np.ones((len(t) - N, 1)), later])
        expected = C_k @ x + g[N:, axis] - g[N - 1, axis]
        np.testing.assert_allclose(found["coast"][N:, axis], expected, atol=scale)
        variance = np.einsum("ki,ij,kj->k", C_k, P, C_k) + WALK**2 * (t[N:] - t[N - 1])
        np.testing.assert_allclose(found["coast_sigma"][N:, axis], np.sqrt(variance), rtol=1e-9)


def test_the_level_of_the_prior_is_that_of_the_first_sample():
    """With hardly a doubt about the switch-on, the first epoch shows map and effects there, and no jump from zero."""
    chunk, _ = unit(5, seconds=400)
    hot = chunk.having(temperature=60 + chunk["temperature"] / 1e4)
    settings = config([{"kind": "curve", "low": 0.0, "high": 100.0, "coefficients": [1e-2, -2e-2, 3e-2]}],
                      turn_on_bias=["0 rad/s"] * 3, repeatability="1e-4 deg/h")  # fmt: skip
    curve = np.array([1e-2, -2e-2, 3e-2]) * ((hot["temperature"] - 50) / 50)[:, None]
    rng = np.random.default_rng(0)
    hot = hot.having(gyro=curve + GYRO_NOISE * rng.normal(size=curve.shape))
    _, found = run_over(settings, hot)
    np.testing.assert_allclose(found["bias"][:10], curve[:10], rtol=0, atol=3 * WALK * np.sqrt(10))
    assert np.all(found["used"])
    assert 0.8 < np.mean(found["nis"]) / 3 < 1.2


def test_a_coast_is_as_good_as_it_says_where_the_memory_began_somewhere_else():
    """68 % and 95 % of the errors after an hour are within their bands, and far less than from equilibrium."""
    z, errors, before = [], [], []
    settings, without = config([relaxation(initial=listed(LAG_OFF * abs(C)))]), config([relaxation()])
    for seed in range(draws(60, 200)):
        chunk, bias = unit(1000 + seed)
        at = int(ALIGN) + 3600
        _, found = run_over(settings, chunk)
        error = found["coast"][at] - bias[at]
        z.append(error / found["coast_sigma"][at])
        errors.append(error)
        if seed < draws(20, 40):
            before.append(run_over(without, chunk)[1]["coast"][at] - bias[at])
    z = np.abs(np.array(z))
    assert abs(np.mean(z < 1) - 0.683) < 3 * np.sqrt(0.68 * 0.32 / z.size)
    assert abs(np.mean(z < 1.96) - 0.95) < 3 * np.sqrt(0.95 * 0.05 / z.size)
    rms, blind = (np.sqrt(np.mean(np.square(e), axis=0)) for e in (errors[: len(before)], before))
    assert np.all(rms < 0.8 * blind), rms / blind


# -- at another level ------------------------------------------------------------------------------------------------


def stepped():
    """A unit whose bias steps twice by 2,000 deg/h."""
    chunk, bias = unit(7, play=True)
    gyro = chunk["gyro"].copy()
    gyro[1200:] += 2000 * DEG_H
    gyro[2500:] -= 3000 * DEG_H
    return chunk.having(gyro=gyro), bias


def test_what_began_fades_on_where_the_unit_is_aligned_anew():
    chunk, _ = stepped()
    journal = RunLog()
    stretches = list(Run(config(both(), sigma_0="10 deg/s"), journal).over([chunk]))
    fresh = [stretch for stretch in stretches if stretch.fresh]
    assert len(fresh) == len(journal.alignments) == 3
    g, fadings = known_part(chunk.t, chunk["temperature"])
    left = np.cumprod(np.stack(fadings), axis=1).T
    for stretch in fresh[1:]:
        now = int(np.searchsorted(chunk.t, stretch.epochs.t[0])) - 1
        sigma = np.sqrt(np.diag(stretch.began.P))
        np.testing.assert_allclose(stretch.began.x, [0, 0, 0, *(LEVEL + g[now]), *np.zeros(6)], atol=1e-12)
        expected = [0, 0, 0, *np.full(3, np.deg2rad(10)), *(left[now, 0] * LAG_OFF * abs(C)), *np.zeros(3)]
        np.testing.assert_allclose(sigma, expected, rtol=1e-9, atol=1e-30)
    np.testing.assert_allclose(fresh[0].began.x[3:6], LEVEL + g[0], atol=1e-12)


@pytest.mark.parametrize("size", [1, 130, 997])
def test_any_split_aligns_anew_alike(size):
    chunk, _ = stepped()
    journal, whole = run_over(config(both()), chunk)
    again, split = run_over(config(both()), chunk, size)
    assert [a.t for a in again.alignments] == [a.t for a in journal.alignments]
    np.testing.assert_array_equal(split["used"], whole["used"])
    for name in ("x", "sigma", "bias", "bias_sigma", "coast", "coast_sigma"):
        scale = 1e-12 * (np.nanmax(np.abs(whole[name])) + np.nanmax(whole["sigma"]))
        np.testing.assert_allclose(split[name], whole[name], rtol=0, atol=scale, err_msg=name)


def test_where_nothing_fades_any_more_the_filter_is_one_of_constant_matrices():
    """Steady gains stay usable: F and C have no leading N, but for the first sample and where a play is crossed."""
    chunk, _ = unit(0)
    model = config(both()).filter.gyro.bias
    memory, lead = None, []
    for k in range(0, len(chunk), 100):
        step, memory = model.transition(chunk.part(k, k + 100), memory)
        assert step.C.shape == (3, 9)
        assert step.Q.ndim == 2
        lead.append(step.F.ndim == 3)
    crossed = int(np.argmax(chunk["temperature"] - chunk["temperature"][0] >= WIDTH)) // 100
    assert np.flatnonzero(lead).tolist() == [0, crossed]


def test_a_model_without_a_map_asks_for_no_temperature():
    chunk, _ = unit(0, seconds=600)
    bare = Chunk(chunk.t, {"gyro": chunk["gyro"], "tau": chunk["tau"]}, chunk.previous)
    drift = {"kind": "drift", "coefficients": [0.0, 0.0, 0.0]}
    settings = config([drift])
    assert settings.filter.gyro.bias.fitted is None
    assert settings.maps() == []
    assert settings.filter.gyro.bias.requires == ()
    _, found = run_over(settings, bare)
    assert np.all(np.isfinite(found["bias"]))
    walk = Config.model_validate({"filter": {**settings.filter.model_dump(mode="json"), "gyro": {
        "noise": f"{GYRO_NOISE!r} rad/s/sqrt(Hz)",
        "bias": {"kind": "random_walk", "walk": f"{WALK!r} rad/s/sqrt(s)"}}}})  # fmt: skip
    plain = config([], turn_on_bias=None, repeatability=None)
    for name in ("bias", "bias_sigma", "coast", "coast_sigma"):
        np.testing.assert_array_equal(run_over(plain, bare)[1][name], run_over(walk, bare)[1][name])
