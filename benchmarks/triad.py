"""Scale factor and misalignment of a triad over temperature, against units that are simulated by code of their own.

python benchmarks/triad.py sigma    # how many of 50 turntables and tumbles are within their sigma
python benchmarks/triad.py several  # the same with a recording each temperature, the level of the bias another in each
python benchmarks/triad.py family   # the same of units that are turned at one temperature, with their family
python benchmarks/triad.py warm_up  # the angle that a rotating unit is off after a warm-up, by what its map holds
python benchmarks/triad.py imucal   # sessions by Ferraris beside imucal, and a recording turned by hand (DRIFTLAB_DATA)
"""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import numpy as np

import driftlab

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "support"))

from turned_units import (
    AXES,
    Readings,
    bias_of,
    ferraris_session,
    matrix_of,
    sensitivity_of,
    sensor_frame,
    strained,
    tumble,
    turntable,
)

from driftlab.family.record import TermParabolas, UnitRecord
from driftlab.family.terms import fit_terms
from driftlab.triad.fit import fit_triad
from fusion_core.contracts import KnownRates, ThermalMap
from fusion_core.host.registry import registry

SEEDS, TEMPERATURES, AT = 50, [-20.0, 0.0, 20.0, 40.0, 60.0], np.array([-20.0, 20.0, 60.0])
TERMS, GRAVITY = "bias,scale,misalignment", 9.80665
GYRO = {
    "noise": "8e-5 rad/s/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 rad/s/sqrt(s)"},
    "calibration": {"kind": "polynomial"},
}  # fmt: skip
ACCEL = {"noise": "5e-4 m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-6 m/s^2/sqrt(s)"}}


def turned(seed, temperatures=TEMPERATURES, terms=TERMS, made=turntable, **how):
    """Return the map that fit-map makes of a turntable's recording."""
    t, y, T, table, *force = made(seed, temperatures, **how)
    data = {"time": (t, "s"), "gyro": (y, "rad/s"), "temperature": (T, "degC")}
    data |= {"accel": (force[0], "m/s^2")} if force else {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "table.csv"
        path.write_text(table)
        stimulus = {"kind": "rate_table", "segments": str(path)}
        return driftlab.fit_map({"filter": {"gyro": GYRO}, "stimulus": stimulus}, data, terms=terms)


def tumbled(seed):
    """Return the map that fit-map makes of a tumble in a chamber."""
    t, y, T = tumble(seed, TEMPERATURES)
    accel = {**ACCEL, "calibration": {"kind": "polynomial"}}
    config = {
        "filter": {"track": "accel", "gyro": GYRO, "accel": accel},
        "stimulus": {"kind": "tumble", "gravity": f"{GRAVITY} m/s^2"},
    }
    still = np.random.default_rng(seed).normal(0, 1e-3, y.shape)
    data = {"time": (t, "s"), "accel": (y, "m/s^2"), "gyro": (still, "rad/s"), "temperature": (T, "degC")}
    return driftlab.fit_map(config, data, terms=TERMS)


def by_recordings(seed, made, turn_on, channel, unit):
    """Return a recording each temperature, the level of the bias another in each, and the tables of the segments."""
    parts = [made(100 * seed + k, [T]) for k, T in enumerate(TEMPERATURES)]
    levels = np.random.default_rng(seed).normal(0, turn_on, (len(parts), 3))
    data = [{"time": (t, "s"), channel: (y + level, unit), "temperature": (T, "degC")}
            for (t, y, T, *_), level in zip(parts, levels, strict=True)]  # fmt: skip
    return data, [part[3] for part in parts if len(part) > 3]


def turned_again(seed, turn_on=1e-4):
    """Return the map that fit-map makes of a turntable's recordings, each from a power-up at another temperature."""
    data, tables = by_recordings(seed, turntable, turn_on, "gyro", "rad/s")
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / f"{k}.csv" for k in range(len(tables))]
        for path, table in zip(paths, tables, strict=True):
            path.write_text(table)
        stimulus = {"kind": "rate_table", "segments": [*map(str, paths)]}
        return driftlab.fit_map({"filter": {"gyro": GYRO}, "stimulus": stimulus}, data, terms=TERMS)


def tumbled_again(seed, turn_on=2e-3):
    """Return the map that fit-map makes of tumbles, each from a power-up at another temperature."""
    data, _ = by_recordings(seed, tumble, turn_on, "accel", "m/s^2")
    rng = np.random.default_rng(seed)
    data = [{**one, "gyro": (rng.normal(0, 1e-3, one["accel"][0].shape), "rad/s")} for one in data]
    config = {
        "filter": {"track": "accel", "gyro": GYRO, "accel": {**ACCEL, "calibration": {"kind": "polynomial"}}},
        "stimulus": {"kind": "tumble", "gravity": f"{GRAVITY} m/s^2"},
    }
    return driftlab.fit_map(config, data, terms=TERMS)


def with_strain(seed):
    """Return the map with g-sensitivity that fit-map makes of a vertical turntable, each axis up and down."""
    return turned(seed, terms=f"{TERMS},g_sensitivity", made=strained)


def several():
    """Print these shares of a recording each temperature."""
    count({"turntable, recording by recording": (turned_again, lambda M: M, np.deg2rad(1.0)),
           "tumble, recording by recording": (tumbled_again, sensor_frame, 0.3)})  # fmt: skip


def own_matrix(seed):
    """M over temperature of a unit of a family: parabolas of 1000, 400 and 100 ppm beside those of all."""
    own = np.random.default_rng([909, seed]).normal(size=(3, 3, 3)) * [1e-3, 4e-4, 1e-4]
    return lambda T: matrix_of(T) + own @ (((T - 20.0) / 35.0) ** np.arange(3))


def family(units=40):
    """Print the errors of units that were turned at one temperature, with and without a family of others."""
    kind, ends = registry().classes(ThermalMap)["polynomial"].model_validate({}), [-15.0, 20.0, 55.0]
    records = []
    for seed in range(units):
        fit = turned(seed, ends, matrix=own_matrix(seed), hold=8.0).fit
        terms = dict(zip(("c", "covariance"), fit.parabolas, strict=True))
        records.append(UnitRecord(key="", unit=str(seed), state="done", parabolas=TermParabolas(T=fit.domain, **terms)))
    prior, at = fit_terms(records).prior(), np.array(ends)
    for T in (20.0, 55.0):
        errors, z = [], []
        for seed in range(1000, 1000 + units):
            true = np.array([own_matrix(seed)(one).ravel() for one in at])
            stimulus = turned(seed, [T], matrix=own_matrix(seed), hold=8.0).fit.stimulus
            made = [fit_triad(stimulus, kind, np.deg2rad(1.0), walk=1e-6, prior=law) for law in (prior, None)]
            errors.append([fit.terms.at(at)[:, 3:12] - true for fit in made])
            z.append(np.abs(errors[-1][0] / made[0].sigma(at)[:, 3:12]))
        rms = 1e6 * np.sqrt(np.mean(np.square(errors), axis=(0, 3)))
        print(
            f"turned at {T:g} °C, M at {at} °C: rms {np.round(rms[0])} ppm with the family, {np.round(rms[1])} alone; "
            f"{units} units within one sigma {np.mean(np.less(z, 1)):.1%}, within 1.96 {np.mean(np.less(z, 1.96)):.1%}"
        )


def sigma():
    """Print the share of the terms within one and 1.96 sigma, and the largest sigma."""
    rate = np.deg2rad(1.0)
    cases = {"turntable": (turned, lambda M: M, rate), "tumble": (tumbled, sensor_frame, 0.3),
             "turntable up and down, with g-sensitivity": (with_strain, lambda M: M, rate)}  # fmt: skip
    count(cases)


def count(cases):
    """Print the shares of cases: how each is fitted, the frame of M, and the size of the bias."""
    for name, (fitted, frame, size) in cases.items():
        truth = np.array([np.concatenate([bias_of(T, size), frame(matrix_of(T)).ravel()]) for T in AT])
        if fitted is with_strain:
            truth = np.hstack([truth, [sensitivity_of(T).ravel() for T in AT]])
        z, largest = [], 0.0
        for seed in range(SEEDS):
            fit = fitted(seed).fit
            z.append(((fit.terms.at(AT) - truth) / fit.sigma(AT))[:, fit.free])
            largest = max(largest, float(np.max(fit.sigma(AT)[:, 3:12])))
        z, bias = np.abs(np.array(z)), int(np.sum(fit.free[:3]))
        parts = {"bias": z[:, :, :bias], "the others": z[:, :, bias:]}
        shares = "; ".join(f"{of} {np.mean(z < 1):.1%}, {np.mean(z < 1.96):.1%}" for of, z in parts.items())
        print(
            f"{name}: {SEEDS} seeds, {z.shape[2]} terms at {len(AT)} temperatures, within one and 1.96 sigma: "
            f"{shares}; largest sigma of M {largest * 1e6:.0f} ppm"
        )


def moving_scale(T):
    """M of a unit whose scale factors move by 1 % over 60 K."""
    return matrix_of(20.0) + np.eye(3) * 0.01 * (T - 20.0) / 60.0


def warm_up():
    """Print the error of the angle after half an hour at 10 deg/s about z, from 0 to 60 degC."""
    over_T, at_one = (turned(0, T, matrix=moving_scale) for T in ([0.0, 15.0, 30.0, 45.0, 60.0], [25.0] * 3))
    made, seconds, rate = Readings(1, 10.0, 8e-5, 1e-6, np.deg2rad(1.0)), 1800, np.deg2rad(10.0)
    for k in range(seconds):
        T = 60 * (1 - np.exp(-k / 400)) / (1 - np.exp(-seconds / 400))
        made.stretch(1.0, [0.0, 0.0, rate], T, moving_scale(T))
    _, y, T = made.arrays()
    bias = over_T.map.bias(T)
    constant = np.linalg.solve(np.eye(3) + at_one.fit.terms.matrix(np.array([25.0]))[0], (y - bias).T).T
    rows = {"bias over temperature alone": y - bias, "and scale and misalignment at 25 °C": constant,
            "and scale and misalignment over temperature": over_T.map.corrected(y, T)}  # fmt: skip
    print(f"{np.rad2deg(rate) * seconds:.0f} deg turned about z from 0 to 60 °C in 30 min; error of the angle, deg")
    for name, omega in rows.items():
        error = np.rad2deg((omega - [0.0, 0.0, rate]).sum(axis=0) * made.dt)
        print(f"  {name:45s} about z {error[2]:+9.3f}   across {np.hypot(*error[:2]):8.3f}")


def by_imucal(sections, seconds, g=GRAVITY):
    """Return imucal's K_g R_g - I, K_ga and K_a R_a - I of a session's sections; a turn takes `seconds`."""
    import imucal as peer

    regions = {f"acc_{n}": accel for n, (accel, _) in sections.items()}
    regions |= {f"gyr_{n}": np.rad2deg(gyro) for n, (_, gyro) in sections.items()}
    hz = len(sections["x_rot"][0]) / seconds
    units = {"from_acc_unit": "m/s^2", "from_gyr_unit": "deg/s"}
    found = peer.FerrarisCalibration(grav=g).compute(peer.FerrarisSignalRegions(**regions), hz, **units)
    return found.K_g @ found.R_g - np.eye(3), np.deg2rad(found.K_ga), found.K_a @ found.R_a - np.eye(3)


def by_driftlab(sections, seconds):
    """Return M and G of the gyros and M of the accelerometers from the means of the same sections."""
    names, T = list(sections), np.array([20.0])
    along = np.array([AXES["xyz".index(n[0])] for n in names])
    force = GRAVITY * np.array([[{"a": -1, "p": 1, "rot": 1}[n[2:]]] for n in names]) * along
    u = -2 * np.pi / seconds * np.array([[n[2:] == "rot"] for n in names]) * along
    accel, gyro = (np.stack([sections[n][of].mean(axis=0) for n in names]) for of in (0, 1))
    kind = registry().classes(ThermalMap)["polynomial"].model_validate({})
    each = np.full(len(names), 20.0), 60.0 * np.arange(len(names))
    of_gyro = fit_triad(KnownRates(u, gyro, *each, force), kind, np.deg2rad(1.0), np.ones(21, dtype=bool)).terms
    of_accel = fit_triad(KnownRates(force, accel, *each), kind, 0.5).terms
    return of_gyro.matrix(T)[0], of_gyro.sensitivity(T)[0], of_accel.matrix(T)[0]


def imucal(sessions=20):
    """Print rms errors of both on simulated sessions, and scale factors of a measured recording by both."""
    truth = matrix_of(20.0), sensitivity_of(20.0), matrix_of(20.0)
    made = [ferraris_session(seed) for seed in range(sessions)]
    both = [(by_imucal(one, 5.0), by_driftlab(one, 5.0)) for one in made]
    scales = {"gyro, M [ppm]": 1e6, "gyro, G [deg/h/g]": np.rad2deg(3600) * GRAVITY, "accelerometer, M [ppm]": 1e6}
    print(f"{sessions} simulated sessions by Ferraris, rms over the 9 terms")
    for k, (name, scale) in enumerate(scales.items()):
        errors = [scale * np.sqrt(np.mean([(own[side][k] - truth[k]) ** 2 for own in both])) for side in (0, 1)]
        apart = scale * np.sqrt(np.mean([(own[0][k] - own[1][k]) ** 2 for own in both]))
        print(f"  {name:24s} imucal {errors[0]:8.2f}   driftlab {errors[1]:8.2f}   apart {apart:8.2f}")
    measured_by_hand()


def measured_by_hand():
    """Print scale factors of accelerometers turned by hand; imucal takes the six best placements for faces."""
    folder = Path(os.environ["DRIFTLAB_DATA"]) / "data" / "imu_tk"
    log = np.loadtxt(folder / "xsens_acc.txt.gz")
    y = (log[:, 1:] - 32768) * 0.0024
    data = {"time": (log[:, 0], "s"), "accel": (y, "m/s^2"), "gyro": (1e-3 * y, "rad/s")}
    config = {"filter": {"track": "accel", "gyro": GYRO, "accel": ACCEL},
              "stimulus": {"kind": "positions", "gravity": "9.81744 m/s^2", "rest": "1 s"}}  # fmt: skip
    fit = driftlab.fit_map(config, data, terms=TERMS).fit
    up = fit.stimulus.y / np.linalg.norm(fit.stimulus.y, axis=1)[:, None]
    best = {f"{name}_{way}": int(np.argmax(sign * up[:, k]))
            for k, name in enumerate("xyz") for way, sign in (("p", 1), ("a", -1))}  # fmt: skip
    tilt = [np.rad2deg(np.arccos(abs(up[row, "xyz".index(name[0])]))) for name, row in best.items()]
    sections = {name: (fit.stimulus.y[[row, row]], np.zeros((2, 3))) for name, row in best.items()}
    sections |= {f"{name}_rot": (sections[f"{name}_p"][0], -np.pi * AXES[[k, k]]) for k, name in enumerate("xyz")}
    theirs = np.diag(sensor_frame(by_imucal(sections, 2.0, 9.81744)[2])) * 1e6
    ours, of = fit.terms.matrix(np.array([25.0]))[0], fit.sigma(np.array([25.0]))[0, [3, 7, 11]] * 1e6
    print(f"accelerometers of an Xsens MTi turned by hand; its faces are off by {min(tilt):.1f} to {max(tilt):.1f} deg")
    print(f"  scale [ppm]: imucal {np.round(theirs)}   driftlab {np.round(np.diag(ours) * 1e6)} +- {np.round(of)}")


if __name__ == "__main__":
    one = {"sigma": sigma, "several": several, "family": family, "warm_up": warm_up, "imucal": imucal}
    one[sys.argv[1]]()
