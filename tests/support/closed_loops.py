"""The loop on units made for a test, with what a test asks of it."""

import h5py
import numpy as np
from units_with_effects import make_unit

from driftlab.commands.explain import explain
from driftlab.config import load_config
from driftlab.identification.columns import EffectRegressors
from driftlab.identification.config_edit import calibrated, with_map
from driftlab.identification.cross_validation import LeftOutPart, error
from driftlab.identification.least_squares import LeastSquares
from driftlab.identification.records import gather
from driftlab.noise.local_level import LocalLevel

AUXILIARY = ("voltage", "pressure", "flow")
TOLD = 8.5e-6  # rad/s an axis: the error of a model that is told the truth, on units of this kind


def loop(folder, seed, effects, channels=AUXILIARY, out="out", **options):
    truth = make_unit(folder, seed, effects, channels, **options)
    names = [[str(folder / f"{name}.h5")] for name in ("soak", "train", "holdout")]
    closed = explain(load_config(folder / "declared.yaml"), *names, out=folder / out).closed
    with h5py.File(folder / out / "prediction.h5") as file, h5py.File(folder / "holdout.h5") as holdout:
        group, t = file["holdout"], holdout["time"][()]
        true = np.stack([np.interp(group["t"][()], t, axis) for axis in truth.T], axis=1)
        error = {name: np.std(group[name][()] - true, axis=0) for name in ("before", "after")}
    return closed, error


def kinds(closed):
    return sorted(effect["kind"] for effect in closed.content["effects"])


def left_out(closed, config, calibration, train, holdout):
    """Return the loop's own error on the holdout (n, d) and its times, as if it had been a recording left out."""
    declared = calibrated(with_map(config, path=closed[0] / "declared.json")) if config.maps() else config
    found = closed[1].search
    whole = gather(declared, calibration, [*train, *holdout], lambda text: None)
    basis = None
    if config.maps():
        T = np.concatenate([chunk["temperature"] for chunk in whole.chunks[:-1]])
        basis = config.maps()[0].basis((float(T.min()), float(T.max())))
    columns = EffectRegressors(whole, basis)
    r, t, rows = len(whole.records) - 1, whole.records[-1].t, whole.slices[-1]
    rest = tuple(k for k, segment in enumerate(columns.segments) if segment.record != r)
    window = slice(rows.start, rows.start + int(np.searchsorted(t, t[0] + whole.align, side="right")))
    part = LeftOutPart(r, rows, True, rest, rest, window)
    squares = LeastSquares(columns, found.squares.smoothing, found.squares.colour)
    errors = []
    for axis, noise in enumerate(found.noises):
        y = columns.scale[columns.y[axis]]
        same = LocalLevel(noise.gain, noise.variance * (found.columns.scale[found.columns.y[axis]] / y) ** 2)
        errors.append(error(squares, found.model, axis, part, same) * y)
    return t[window.stop - rows.start :], np.stack(errors, axis=1), whole.rate[window.stop : rows.stop]


def assert_same_coast(path, t, errors, rate):
    with h5py.File(path) as file:
        (group,) = file.values()
        coast = np.stack([np.interp(t, group["t"][()], axis) for axis in group["after"][()].T], axis=1)
    off = coast - rate
    np.testing.assert_allclose(np.std(off, axis=0), np.sqrt(np.mean(errors**2, axis=0)), rtol=0.03)
