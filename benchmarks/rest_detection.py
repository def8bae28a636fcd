"""Detection of motion: false alarms on soaks at rest, and the power on real motion.

    python benchmarks/rest_detection.py [--foreign] [--json FILE] [--seeds 3] [--against FILE] [--only "FOG 100"]

Soaks of one hour, drawn here: gyros from a FOG to MEMS, curves of 0 to 100 deg/h a K (bent), chambers of 0.2 to 5 K a
minute (triangle, staircase with soft and hard corners), thermometers with noise and steps. Motion on top of them, each
event sized by the noise of the gyro or by what a hand does: bumps, shaking, turns, slow turns, tilts, sway. For the
gathering of a map (`driftlab.soak.rest`), and for the detector of a run: the share of the time at rest that is refused,
and the share of the events of which a tenth is refused. `--foreign` takes the soaks, the references and the motion of
`foreign_motion.py` instead, which know nothing of the method. `--against` puts the table of another tree beside it,
written there by `--json`; the power is then that on recordings of which the other refuses less than a twentieth.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np

from driftlab.config import Config
from driftlab.soak.rest import at_rest
from fusion_core.chunk import Chunk
from fusion_core.faults import Faults
from fusion_core.thermal.rate_estimators import with_rate

DEG_H = np.deg2rad(1 / 3600)
G = 9.80206
DT = 0.1
SECONDS = 3600
GYROS = {"FOG": (2e-7, 1e-4), "tactical": (3e-6, 3e-4), "MEMS": (1.54e-5, 8.3e-4)}  # densities of gyro and accel
SLOPES, RATES = (0, 22, 100), (0.2, 1.0, 5.0)  # deg/h a K, K a minute
THERMOMETERS = {"fine": (0.0, 0.0), "noise 0.02 K": (0.02, 0.0), "steps 0.1 K": (0.02, 0.1), "steps 1 K": (0.1, 1.0)}


def profile(kind, rate, t):
    """Return temperatures (N,) of a chamber that moves by at most `rate` K a minute."""
    half = min(1500.0, 70 / rate * 60)
    if kind == "triangle":
        return -20 + rate / 60 * half * (1 - np.abs((t / half) % 2 - 1))
    step = 300.0  # on the way, and as long at rest
    T = -20 + rate / 60 * np.minimum(t % (2 * step), step) + rate / 60 * step * np.floor(t / (2 * step))
    if kind == "hard stairs":
        return T
    tau, soft, N = 40.0, np.empty_like(T), len(T)
    soft[0] = T[0]
    k = 1 - np.exp(-DT / tau)
    for j in range(1, N):
        soft[j] = soft[j - 1] + k * (T[j] - soft[j - 1])
    return soft


def unit(gyro, slope, rate, kind, thermometer, seed):
    """Return t, T as read, readings of gyro and accel of a unit at rest."""
    rng = np.random.default_rng([seed, *map(ord, gyro + kind + thermometer), slope, int(10 * rate)])
    t = np.arange(1, SECONDS / DT + 1) * DT
    T, N = profile(kind, rate, t), int(SECONDS / DT)
    noise, vrw = GYROS[gyro]
    # a curve whose slope goes from half to all of the stated one, within 12 K
    curve = slope * DEG_H * (0.75 * T + 0.25 * 12 * np.log(np.cosh((T - 5) / 12)))
    signs = np.array([1.0, -0.6, 0.3])
    walk = np.cumsum(rng.normal(size=(N, 3)), axis=0) * noise * 0.02 * np.sqrt(DT)
    rates = 4e-5 + curve[:, None] * signs + walk + rng.normal(size=(N, 3)) * noise / np.sqrt(DT)
    force = np.array([0.05, -0.02, G]) + 2e-4 * slope / 22 * (T[:, None] - 20) * [1, -1, 1]
    force = force + rng.normal(size=(N, 3)) * vrw / np.sqrt(DT)
    scatter, step = THERMOMETERS[thermometer]
    seen = T + rng.normal(size=N) * scatter
    return t, (np.round(seen / step) * step if step else seen), rates, force


def smooth_box(t, start, length, edge):
    """Return 0 to 1 and back, with edges of `edge` s."""
    return np.clip((t - start) / edge, 0, 1) * np.clip((start + length - t) / edge, 0, 1)


def events(gyro, t, seed):
    """Return name, rates (N, 3), forces (N, 3) and mask (N,) of the motion, one event of each kind."""
    s = GYROS[gyro][0] / np.sqrt(DT)
    rng = np.random.default_rng(seed + 77)
    kinds = {
        "bump": (6.0, 0.3, lambda u: np.deg2rad(1) * np.sin(2 * np.pi * 2.3 * u), 0.2),
        "shaking, 20 sigma": (8.0, 0.3, lambda u: 20 * s * np.sin(2 * np.pi * 1.1 * u), 0.0),
        "turn, 20 sigma, 10 s": (10.0, 0.5, lambda u: 20 * s + 0 * u, 0.0),
        "turn, 0.01 deg/s, 60 s": (60.0, 1.0, lambda u: np.deg2rad(0.01) + 0 * u, 1.0),
        "sway, 40 sigma, 20 s": (60.0, 5.0, lambda u: 40 * s * np.sin(2 * np.pi * u / 20), 0.0),
        "sway, 40 sigma, 60 s": (120.0, 5.0, lambda u: 40 * s * np.sin(2 * np.pi * u / 60), 0.0),
    }
    for k, (name, (length, edge, rate, tilts)) in enumerate(kinds.items()):
        start = 400 + 500 * k + rng.uniform(0, 90)
        box = smooth_box(t, start, length, edge)
        added, force = np.zeros((len(t), 3)), np.zeros((len(t), 3))
        added[:, k % 3] = box * rate(t - start)
        if tilts == 1.0:  # about a level axis: gravity turns with it
            added = np.roll(added, -(k % 3), axis=1)
            force[:, 1] = G * np.cumsum(added[:, 0]) * DT
        elif tilts:
            force[:, k % 3] = box * tilts * rate(t - start) / np.deg2rad(1)
        yield name, added, force, (t > start) & (t < start + length)


def config_of(densities):
    noise, vrw = densities
    walk = {"kind": "random_walk", "walk": f"{noise * 0.02} rad/s/sqrt(s)"}
    accel = {"noise": f"{vrw} m/s^2/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1e-5 m/s^2/sqrt(s)"}}
    return Config.model_validate({
        "latitude": "40.9 deg",
        "filter": {"gyro": {"noise": f"{noise} rad/s/sqrt(Hz)", "bias": walk}, "accel": accel},
    })  # fmt: skip


def refused(config, t, T, rates, force, dt=DT):
    """Return the epochs (N,) that are refused by the gathering of a map, and by the detector of a run."""
    N = len(t)
    channels = {"gyro": rates, "accel": force, "temperature": T, "tau": np.full(N, dt)}
    channels = {name: values for name, values in channels.items() if values is not None}
    chunk = Chunk(t, channels, Chunk(t[:1] - dt, {k: v[:1] for k, v in channels.items()}))
    taken = np.zeros(N, dtype=bool)
    for rest in at_rest(config, [chunk], Faults()):
        taken[np.searchsorted(t, rest.window.t[0]) : np.searchsorted(t, rest.window.t[-1]) + 1] = True
    model = config.filter
    detector = model.detector(model.aligned(chunk.part(0, round(model.align / dt)), config.site))
    rated, _ = with_rate(chunk, model.temperature_rate, None)
    still, _, _ = detector.look(rated, detector.start())
    return ~taken, ~still


def foreign(seeds):
    """Yield a cell, t, T, rates and forces at rest, the same moved, the masks, and the densities."""
    import foreign_motion

    for white in (2e-7, 3e-6, 1.54e-5):
        for slope in (22, 100):
            for pace in (1.0, 5.0):
                for seed in range(seeds):
                    noise = {"white": white, "walk": white * 0.02, "accel_white": 3.3e-4}
                    rest = foreign_motion.still(seed, slope=slope * DEG_H, pace=pace, hours=1.5, **noise)
                    yield from _moved(
                        foreign_motion, rest, (f"{white:g}", slope, pace, "chamber", "0.01 K"), seed, noise
                    )
    for unit in ("ppm", "V"):
        for seed in range(2 * seeds):
            held = foreign_motion.reference(seed, unit, pace=1.0)
            scale = 1.0 if unit == "ppm" else 7e-6
            noise = {"white": 0.1 * np.sqrt(2) * scale, "walk": 5e-4 * scale}
            yield (f"reference [{unit}]", 0, 1.0, "chamber", "0.01 K"), seed, held, None, {}, noise


def _moved(foreign_motion, rest, cell, seed, noise):
    found = foreign_motion.moved(rest, seed, each=1)
    masks = {e.kind: (rest.t >= e.begin) & (rest.t < e.end) for e in found.events}
    yield cell, seed, rest, found.recording, masks, noise


def foreign_rows(seeds):
    rows = []
    for cell, seed, rest, moved, masks, noise in foreign(seeds):
        if moved is None:
            walk = {"kind": "random_walk", "walk": f"{noise['walk']} rad/s/sqrt(s)", "axes": ["x"]}
            gyro = {"noise": f"{noise['white']} rad/s/sqrt(Hz)", "bias": walk}
            config = Config.model_validate({"filter": {"gyro": gyro, "accel": None, "align": "300 s",
                                                       "update_interval": "2 s"}})  # fmt: skip
            flags = refused(config, rest.t + 2, rest.temperature, rest.x[:, None], None, 2.0)
            rows.append({"cell": cell, "seed": seed, "alarms": [float(np.mean(f)) for f in flags]})
            continue
        config = config_of((noise["white"], noise["accel_white"]))
        t = rest.t + DT
        alarms = [float(np.mean(f)) for f in refused(config, t, rest.temperature, rest.gyro, rest.accel)]
        flags = refused(config, t, moved.temperature, moved.gyro, moved.accel)
        found = {name: [bool(np.mean(f[mask]) > 0.1) for f in flags] for name, mask in sorted(masks.items())}
        beside = [float(np.mean(f[~np.any(list(masks.values()), axis=0)])) for f in flags]
        rows.append({"cell": cell, "seed": seed, "alarms": alarms, "beside": beside, "found": found})
    return rows


def cells(seeds):
    for gyro in GYROS:
        for slope in SLOPES:
            for rate in RATES:
                for kind in ("triangle", "soft stairs", "hard stairs"):
                    for thermometer in THERMOMETERS:
                        for seed in range(seeds):
                            yield gyro, slope, rate, kind, thermometer, seed


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--json", type=Path)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", default="")
    parser.add_argument("--foreign", action="store_true")
    args = parser.parse_args()
    rows = foreign_rows(args.seeds) if args.foreign else own_rows(args.seeds, args.only)
    if args.json:
        args.json.write_text(json.dumps(rows))
    old = json.loads(args.against.read_text()) if args.against else None
    for place, title in enumerate(("map", "run")):
        show(title, place, rows, old)


def own_rows(seeds, only):
    rows = []
    for cell in cells(seeds):
        if only not in " ".join(map(str, cell)):
            continue
        gyro, seed = cell[0], cell[-1]
        config = config_of(GYROS[gyro])
        t, T, rates, force = unit(*cell)
        alarms = [float(np.mean(flags)) for flags in refused(config, t, T, rates, force)]
        moved, pushed, masks = rates.copy(), force.copy(), {}
        for name, added, more, mask in events(gyro, t, seed):
            moved, pushed, masks[name] = moved + added, pushed + more, mask
        flags = refused(config, t, T, moved, pushed)
        found = {name: [bool(np.mean(f[mask]) > 0.1) for f in flags] for name, mask in masks.items()}
        anywhere = np.any(list(masks.values()), axis=0)
        beside = [float(np.mean(f[~anywhere])) for f in flags]
        rows.append({"cell": cell[:5], "seed": seed, "alarms": alarms, "beside": beside, "found": found})
    return rows


def show(title, place, rows, old):
    """Print false alarms and power, those of another tree beside them."""
    before = {(*r["cell"], r["seed"]): r for r in old or []}
    pairs = [(r, before.get((*r["cell"], r["seed"]))) for r in rows]

    def share(pick, pairs):
        values = [[100 * np.mean(pick(r)) for r in column if r is not None] for column in zip(*pairs, strict=True)]
        return "".join(f"{np.mean(v):9.2f}" for v in values if v)

    print(
        f"\n{title}: % of the time at rest that is refused{'   now   before' if old else ''}, and the worst recording"
    )
    for k, what in enumerate(("gyro", "deg/h/K", "K/min", "profile", "thermometer")):
        for name in dict.fromkeys(r["cell"][k] for r in rows):
            mine = [pair for pair in pairs if pair[0]["cell"][k] == name]
            worst = max(100 * r["alarms"][place] for r, _ in mine)
            print(f"{what:12s}{name!s:22s} {share(lambda r: r['alarms'][place], mine)}   {worst:6.1f}")
    print(f"{title}: % of the events that are found")
    fair = [pair for pair in pairs if "found" in pair[0] and (not old or (pair[1] and pair[1]["alarms"][place] < 0.05))]
    for name in fair[0][0]["found"]:
        print(f"{name:34s} {share(lambda r, name=name: r['found'][name][place], fair)}")
    print(f"{'time beside the events, refused':34s} {share(lambda r: r['beside'][place], fair)}   of {len(fair)}")


if __name__ == "__main__":
    main()
