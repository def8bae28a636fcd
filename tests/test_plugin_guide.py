"""Every piece of code in docs/how-to/write_a_plugin.md is run, and its plugins are held to the laws."""

import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from fusion_core.contracts import Framing
from fusion_core.faults import Faults
from fusion_core.host.registry import Registry
from fusion_core.testing import check_plugin
from fusion_core.thermal.soak_noise import cells_of

GUIDE = Path(__file__).parent.parent / "docs" / "how-to" / "write_a_plugin.md"


@pytest.fixture(scope="module")
def guide(tmp_path_factory):
    """The code of the page as one module, beside the product that it names."""
    folder = tmp_path_factory.mktemp("guide")
    (folder / "acme_x1.yaml").write_text("extends: mems_crs05\n")
    module = types.ModuleType("guide")
    module.__file__ = str(folder / "guide.py")
    sys.modules["guide"] = module
    for block in re.findall(r"```python\n(.*?)```", GUIDE.read_text(), flags=re.DOTALL):
        exec(compile(block, str(GUIDE), "exec"), module.__dict__)
    yield module
    del sys.modules["guide"]


def test_its_hooks_are_accepted(guide):
    registry = Registry()
    registry.register(guide)
    kinds = {"warm_up", "chamber_fan", "npy", "wave", "sure_wave", "csv3", "acme_x1"}
    assert {entry.kind for entry in registry.entries} == kinds
    assert all(entry.error is None for entry in registry.entries)


def test_its_own_tests_pass(guide):
    (marker,) = guide.test_warm_up.pytestmark
    for law in marker.args[1]:
        guide.test_warm_up(law)
    guide.test_the_others()


def test_its_other_plugins_keep_the_laws(guide, tmp_path):
    check_plugin(guide.FollowsHeat, [guide.FollowsHeat(gain=5e-5, walk=1e-6)])
    check_plugin(guide.Wave)
    check_plugin(guide.SureWave)
    check_plugin(guide.Words)
    rows = np.zeros(300, dtype=[("t", float), ("gyro", float, 3)])
    rows["t"], rows["gyro"] = np.arange(300) / 10, np.random.default_rng(0).normal(size=(300, 3))
    np.save(tmp_path / "r.npy", rows)
    channels = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "gyro", "unit": "rad/s"}}
    source = guide.Npy(path=tmp_path / "r.npy", channels=channels)
    check_plugin(guide.Npy, [source])
    np.testing.assert_array_equal(next(source.chunks(1000, Faults()))["gyro"], rows["gyro"])


def test_a_map_that_says_how_sure_it_is_answers_as_it_is_fitted(guide):
    rng = np.random.default_rng(0)
    T, bias = 25 - 25 * np.cos(np.linspace(0, 6 * np.pi, 3000)), 1e-5 * rng.normal(size=(3000, 2))
    for settings in guide.SureWave().variants():
        fitted = settings.fit(T, bias, {})
        blocks, grid = cells_of(T, bias), np.linspace(1, 49, 9)
        for axis in range(2):
            H = settings.smoother(T, bias)(blocks, grid, axis)
            np.testing.assert_allclose(H @ blocks.y[:, axis], fitted.bias(grid)[:, axis], atol=1e-8)
        # of N samples of white noise p coefficients keep p / N, of which one, the level, is not in sigma
        expected = 1e-5 * np.sqrt((len(settings._used) - 1) / 3000)
        assert 0.8 * expected < np.sqrt(np.mean(fitted.sigma(T) ** 2)) < 1.25 * expected


@pytest.mark.parametrize("stream", [b"a,b,c\n", b"1,2\n3,4,5\n", b"\xff,1,2\n", b"1,2,3" * 10_000])
def test_the_framing_says_nothing_that_it_does_not_know(guide, stream):
    framing = guide.Csv3()
    assert isinstance(framing, Framing)
    frames, memory = framing.decode(b"2,3\n" + stream + b"\n7,8,9\n", None)
    np.testing.assert_allclose(np.rad2deg(frames.channels["gyro"][-1]), [7, 8, 9])
    assert 1 + (b"3,4,5" in stream) == frames.N
    assert len(memory[1]) == 0
