"""A live run is shown with what the run says, and its estimates."""

import json
from types import SimpleNamespace

import numpy as np

from driftlab.live import history
from driftlab.live.history import LiveHistory, column_names
from driftlab.live.status import UPDATES, Status


def stretch_of(rng, start, N):
    t = start + np.arange(N) * 0.01
    used = rng.random(N) < 0.8
    estimates = SimpleNamespace(used=used, nis=rng.chisquare(3, N))
    epochs = SimpleNamespace(t=t, channels={"temperature": 20 + t, "temperature_rate": np.ones(N)})
    return SimpleNamespace(
        epochs=epochs, estimates=estimates, still=used | (rng.random(N) < 0.5), bias=rng.normal(size=(N, 3)),
        sigma=rng.random((N, 3)),
    )  # fmt: skip


def test_its_history_has_the_estimates_and_the_mean_nis_of_the_last_that_were_used(monkeypatch):
    monkeypatch.setattr(history, "PERIOD", 0.0)
    monkeypatch.setattr(history, "WIDTH", 0.01)  # each update is a row
    rng, watch, status = np.random.default_rng(1), LiveHistory("xyz"), Status(m=3)
    stretches, start = [], 0.005
    for N in (1, 7, 300, 2, 90):
        stretches.append(stretch_of(rng, start, N))
        start += N * 0.01
        watch.seen(stretches[-1])
        if N != 7:  # more than one at once
            watch.report(status)
    rows = dict(zip(column_names("xyz"), watch.histories["whole"].view.rows.T, strict=True))
    used, still, nis = (
        np.concatenate([of(s) for s in stretches])
        for of in (lambda s: s.estimates.used, lambda s: s.still, lambda s: s.estimates.nis)
    )
    for k in range(3):
        np.testing.assert_array_equal(rows[f"bias_{k}"], np.concatenate([s.bias[:, k] for s in stretches]))
        np.testing.assert_array_equal(rows[f"sigma_{k}"], np.concatenate([s.sigma[:, k] for s in stretches]))
    means = [np.mean(nis[: k + 1][used[: k + 1]][-UPDATES:]) / 3 if used[: k + 1].any() else np.nan for k in range(400)]
    np.testing.assert_allclose(rows["nis"], means, rtol=1e-9)
    np.testing.assert_array_equal(rows["moving_high"], ~still)
    np.testing.assert_array_equal(rows["refused_high"], still & ~used)
    np.testing.assert_allclose(rows["temperature"], 20 + rows["t"])


def test_its_status_is_that_of_the_run_until_and_at_the_end(monkeypatch):
    monkeypatch.setattr(history, "PERIOD", 0.0)
    watch, status = LiveHistory("xyz", "raw.h5"), Status(samples=3)
    status.faults.add("torn frames", 2, "after 1 s")
    watch.report(status)
    found = json.loads(watch.status)
    assert found["samples"] == 3
    assert found["lines"] == ["torn frames: 2 (first after 1 s)"]
    assert (found["recording"], found["ended"]) == ("raw.h5", None)
    watch.end(["too short"], "out", failed=False)
    after = json.loads(watch.status)
    assert after["ended"] == {"failed": False, "lines": ["too short"], "out": "out"}
    assert {k: v for k, v in after.items() if k != "ended"} == {k: v for k, v in found.items() if k != "ended"}
