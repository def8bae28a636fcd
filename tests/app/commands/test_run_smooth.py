"""`run --smooth` beside the joint least-squares solution: all states of all updates at once, no filter."""

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner
from units_at_rest import unit_at_rest

from driftlab.cli import app
from driftlab.config import load_config
from driftlab.filtering import smoothing
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from fusion_core.errors import ConfigError

CONFIG = """
extends: mems_crs05
source:
  kind: hdf5
  channels:
    time: {path: time, unit: s}
    gyro: {path: gyro, unit: rad/s}
    temperature: {path: temperature, unit: degC}
filter:
  align: 10 s
  update_interval: 1 s
  accel: null
  rest: {realign_after: 10 s}
  gyro: {bias: {kind: random_walk, walk: 3e-3 deg/s/sqrt(s), sigma_0: 0.3 deg/s}}
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory):
    """A gap, a motion that is not used, and a turn to another bias, where the filter begins anew."""
    folder = tmp_path_factory.mktemp("bench")
    unit = unit_at_rest(seconds=90, rate=20, seed=3)
    t, gyro = unit.t - unit.t[0], unit.gyro.copy()
    gyro[(t > 25) & (t < 28)] += [0.2, 0, 0]
    gyro[t > 60] += np.deg2rad([2.0, -1.0, 0.5])
    kept = (t < 40) | (t > 43)
    with h5py.File(folder / "unit.h5", "w") as file:
        file["time"], file["gyro"], file["temperature"] = 500 + t[kept], gyro[kept], unit.temperature[kept]
    (folder / "unit.yaml").write_text(CONFIG)
    return folder


def driftlab(*args):
    return CliRunner().invoke(app, [str(arg) for arg in args])


def run(folder, *more):
    done = driftlab("run", folder / "unit.yaml", "--input", folder / "unit.h5", "--out", folder / "out", *more)
    assert done.exit_code == 0, done.output
    with h5py.File(folder / "out" / "estimates.h5") as file:
        found = {}
        file.visititems(lambda name, item: found.update({name: item[:]}) if isinstance(item, h5py.Dataset) else None)
    return found


def least_squares(began, steps, reset):
    """Means and deviations (N, n) of all states, from their joint information matrix; `steps` are one epoch each."""
    n, N = len(began.x), len(steps)
    keep = np.diag(np.where(reset, 0.0, 1.0))
    A, b = np.zeros((n * (N + 1), n * (N + 1))), np.zeros(n * (N + 1))
    tiny = 1e-22 * np.eye(n)  # what is known exactly

    def add(J, r, cover):
        nonlocal A, b
        W = np.linalg.inv(cover)
        A += J.T @ W @ J
        b += J.T @ W @ r

    def at(k, M=None):
        J = np.zeros((n, n * (N + 1)))
        J[:, n * k : n * (k + 1)] = np.eye(n) if M is None else M
        return J

    add(at(0), began.x, began.P + tiny)
    for k, (F, Q, u, z, H, R, used) in enumerate(steps, start=1):
        if used:
            add(at(k) - at(k - 1, F), u, Q + tiny)
            J = np.zeros((len(z), A.shape[0]))
            J[:, n * k : n * (k + 1)] = H
            add(J, z, R)
        else:  # what is reset begins from zero
            add(at(k) - at(k - 1, keep @ F), keep @ u, keep @ Q @ keep + tiny)
    scale = 1 / np.sqrt(np.diag(A))
    P = np.linalg.inv(A * scale * scale[:, None]) * scale * scale[:, None]
    x = (P @ b).reshape(N + 1, n)[1:]
    return x, np.sqrt(np.diag(P)).reshape(N + 1, n)[1:]


def segments(folder):
    """Of each stretch from a prior to the next: the prior and the steps that the filter was run on."""
    running = Run(load_config(folder / "unit.yaml", str(folder / "unit.h5")), RunLog(), keep_model=True)
    found = []
    for stretch in running:
        transition, measured = stretch.model
        if stretch.began is not None:
            found.append((stretch.began, []))
        N = len(stretch.epochs)

        def each(a, ndim, N=N):
            return np.broadcast_to(a, (N, *a.shape[-ndim:]))

        found[-1][1].extend(
            zip(
                each(transition.F, 2), each(transition.Q, 2), each(transition.u, 1), measured.z, each(measured.H, 2),
                each(measured.R, 2), stretch.estimates.used, strict=True,
            )
        )  # fmt: skip
    return found, running.model.restarting


def test_it_is_the_joint_least_squares_solution_between_two_alignments(bench):
    found = run(bench, "--smooth")
    parts, reset = segments(bench)
    assert len(parts) > 1, "the filter began anew"
    assert not all(step[-1] for _, steps in parts for step in steps), "and refused something"
    expected = [least_squares(began, steps, reset) for began, steps in parts]
    x, sigma = (np.concatenate(column) for column in zip(*expected, strict=True))
    np.testing.assert_allclose((found["smoothed/x"] - x) / np.maximum(sigma, 1e-12), 0, atol=2e-4)
    np.testing.assert_allclose(found["smoothed/sigma"][:, ~reset], sigma[:, ~reset], rtol=1e-4)
    np.testing.assert_array_equal(found["smoothed/bias"], found["smoothed/x"][:, ~reset])


def test_it_changes_no_estimate_and_knows_no_less(bench):
    plain, found = run(bench), run(bench, "--smooth")
    assert set(found) - set(plain) == {"smoothed/x", "smoothed/sigma", "smoothed/bias"}
    for name, values in plain.items():
        np.testing.assert_array_equal(found[name], values)
    assert np.all(found["smoothed/sigma"] <= found["sigma"] * (1 + 1e-6))
    parts, _ = segments(bench)
    ends = np.cumsum([len(steps) for _, steps in parts]) - 1
    np.testing.assert_allclose(found["smoothed/x"][ends], found["x"][ends], rtol=1e-9, atol=1e-15)
    assert sorted(path.name for path in (bench / "out").iterdir()) == ["estimates.h5", "report.html", "summary.json"]
    assert "given all of it" in (bench / "out" / "report.html").read_text()


def test_a_spool_goes_on_where_an_earlier_run_was_killed(bench, tmp_path):
    config = load_config(bench / "unit.yaml", str(bench / "unit.h5"))
    whole = list(Run(config, RunLog(), keep_model=True))
    model, spool, first = (
        Run(config, RunLog()).model,
        smoothing.Spool(tmp_path / "all"),
        smoothing.Spool(tmp_path / "s"),
    )
    for stretch in whole:
        spool.add(stretch)
    for stretch in whole[:3]:
        first.add(stretch)
    rows = sum(len(stretch.epochs) for stretch in whole[:2])
    again = smoothing.Spool(tmp_path / "s", keep=rows)  # the third was no part of the checkpoint
    assert again.rows == rows
    for stretch in whole[2:]:
        again.add(stretch)
    both = (found.smoothed(model.restarting, model.places["gyro"]) for found in (spool, again))
    for one, other in zip(*both, strict=True):
        assert one[0] == other[0]
        np.testing.assert_array_equal(one[1], other[1])
    with pytest.raises(ConfigError, match="was begun without it; begin anew without --resume, or leave --smooth out"):
        smoothing.Spool(tmp_path / "none", keep=5)
