import numpy as np
import pytest
from effect_recordings import on_one_axis

from fusion_core.chunk import Chunk
from fusion_plugins.effects.periodic import Periodic


def test_periodic_finds_a_line_in_noise():
    """A line with a tenth of the noise's variance, in two recordings of different lengths."""
    rng = np.random.default_rng(7)
    recordings = []
    for N in (6000, 4000):
        t = 300 + np.arange(N) * 1.0
        line = 0.45 * np.sin(2 * np.pi * t / 97.0 + rng.uniform(0, 6))
        recordings.append(Chunk(t, {"residual": line[:, None] * [1.0, 0.0, -1.0] + rng.normal(size=(N, 3))}))
    periods = [c.period for c in Periodic().proposals(recordings)]
    assert periods[0] == pytest.approx(97.0, rel=0.005)
    assert len(periods) == 3
    slow = 5 * np.sin(2 * np.pi * np.arange(6000) / 700)[:, None] * np.ones(3)  # 8.6 cycles are a drift
    drifting = [c.having(residual=c["residual"] + slow[: len(c)]) for c in recordings]
    assert min(6000 / c.period for c in Periodic().proposals(drifting)) >= 10
    silent = Chunk(np.arange(100.0), {"residual": np.zeros((100, 3))})
    assert list(Periodic().proposals([silent])) == []


def test_gaps_at_the_beginning_leave_a_proposal():
    """The first rows are further apart than most: a slow line by their step is one of too few cycles by the clock."""
    rows = np.arange(800)
    t = np.cumsum(np.where(rows < 120, 4.0, 1.0))
    residual = np.sin(2 * np.pi * 10.5 * rows / 800)[:, None] * np.ones(3)
    periods = [c.period for c in Periodic().proposals([Chunk(t, {"residual": residual})])]
    assert periods
    assert np.all(np.isfinite(periods))


def test_periodic_is_a_line_of_any_phase():
    t = 40 + np.arange(500) * 0.5
    B = on_one_axis(Periodic(period="97 s"), Chunk(t))
    c = np.array([np.cos(0.7), np.sin(0.7)]) * 3
    np.testing.assert_allclose(B @ c, 3 * np.sin(2 * np.pi * t / 97 + 0.7), atol=1e-12)


def test_periodic_has_one_phase_wherever_a_recording_begins():
    t = 1e6 + np.arange(900) * 0.5
    whole, _ = Periodic(period="97 s").signature(Chunk(t), None)
    later, _ = Periodic(period="97 s").signature(Chunk(t[300:]), None)
    np.testing.assert_array_equal(later, whole[300:])
