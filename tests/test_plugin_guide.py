"""Code of docs/how-to/write_a_plugin.md and the pages of families is run, and its plugins are held to the laws."""

import re
import sys
import types
from pathlib import Path

import numpy as np
import pytest

from fusion_core.chunk import Chunk
from fusion_core.contracts import Framing, Site
from fusion_core.faults import Faults
from fusion_core.host.registry import Registry
from fusion_core.testing import check_plugin
from fusion_core.thermal.soak_noise import cells_of

DOCS = Path(__file__).parent.parent / "docs"
FAMILIES = DOCS / "reference" / "plugins"
KINDS = {
    DOCS / "how-to" / "write_a_plugin.md": {"warm_up"},
    FAMILIES / "bias_models.md": {"follows_heat"},
    FAMILIES / "thermal_maps.md": {"wave", "sure_wave"},
    FAMILIES / "effects.md": {"chamber_fan"},
    FAMILIES / "sources.md": {"npy"},
    FAMILIES / "framings.md": {"csv3"},
    FAMILIES / "measurement_models.md": {"sealed"},
    FAMILIES / "exporters.md": {"acme_words"},
    FAMILIES / "report_sections.md": {"acme_worst"},
    FAMILIES / "stimuli.md": {"fixture"},
    FAMILIES / "products.md": {"acme_x1"},
    FAMILIES / "families.md": set(),
}


@pytest.fixture(scope="module")
def code_of(tmp_path_factory):
    """Return a function: the code of a page as one module, beside the product that one of them names."""
    folder, made = tmp_path_factory.mktemp("guide"), {}
    (folder / "acme_x1.yaml").write_text("extends: mems_crs05\n")

    def code_of(page):
        if page not in made:
            module = types.ModuleType(f"guide_{page.stem}")
            module.__file__ = str(folder / "guide.py")
            sys.modules[module.__name__] = made[page] = module
            for block in re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL):
                exec(compile(block, str(page), "exec"), module.__dict__)
        return made[page]

    yield code_of
    for module in made.values():
        del sys.modules[module.__name__]


def test_every_page_is_looked_at():
    assert {page for page in FAMILIES.glob("*.md") if page.stem != "README"} < KINDS.keys()


@pytest.mark.parametrize("page", KINDS, ids=lambda page: page.stem)
def test_its_hooks_are_accepted(page, code_of):
    registry = Registry()
    registry.register(code_of(page))
    assert all(entry.error is None for entry in registry.entries)
    assert {entry.kind for entry in registry.entries} == KINDS[page]


def test_its_own_tests_pass(code_of):
    guide = code_of(DOCS / "how-to" / "write_a_plugin.md")
    (marker,) = guide.test_it_keeps_the_laws_of_its_family.pytestmark
    for law in marker.args[1]:
        guide.test_it_keeps_the_laws_of_its_family(law)
    guide.test_the_transient_falls_to_a_third_in_one_time_constant()


def test_it_shows_the_plugin_of_the_template(code_of):
    """The page's plugin and the template's answer alike."""
    shown = code_of(DOCS / "how-to" / "write_a_plugin.md").WarmUp
    template = types.ModuleType("template")
    path = DOCS.parent / "examples" / "plugin_template" / "driftlab_warm_up" / "warm_up.py"
    exec(compile(path.read_text(), str(path), "exec"), template.__dict__)
    chunk = Chunk(np.array([0.0, 1.0, 3.0])).part(1, 3)
    (one, _), (other, _) = (made(tau=60.0, walk=1e-6).transition(chunk, None) for made in (shown, template.WarmUp))
    for name in ("F", "Q", "u", "C"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    ("page", "name"),
    [("thermal_maps", "Wave"), ("thermal_maps", "SureWave"), ("effects", "ChamberFan"), ("exporters", "Words"),
     ("measurement_models", "Sealed"), ("report_sections", "Worst")],
)  # fmt: skip
def test_a_plugin_that_needs_no_example_keeps_the_laws(page, name, code_of):
    check_plugin(getattr(code_of(FAMILIES / f"{page}.md"), name))


def test_the_others_keep_the_laws(code_of, tmp_path):
    model = code_of(FAMILIES / "bias_models.md").FollowsHeat
    check_plugin(model, [model(gain=5e-5, walk=1e-6)])
    check_plugin(code_of(FAMILIES / "framings.md").Csv3, stream=b"1.5,2,-3e-1\n" * 20)
    rows = np.zeros(300, dtype=[("t", float), ("gyro", float, 3)])
    rows["t"], rows["gyro"] = np.arange(300) / 10, np.random.default_rng(0).normal(size=(300, 3))
    np.save(tmp_path / "r.npy", rows)
    channels = {"time": {"path": "t", "unit": "s"}, "gyro": {"path": "gyro", "unit": "rad/s"}}
    npy = code_of(FAMILIES / "sources.md").Npy
    source = npy(path=tmp_path / "r.npy", channels=channels)
    check_plugin(npy, [source])
    np.testing.assert_array_equal(next(source.chunks(1000, Faults()))["gyro"], rows["gyro"])


def test_a_measurement_model_of_a_page_finds_the_bias_of_its_sensor(code_of):
    """The mean reading less the known pressure, to what white noise leaves of it."""
    sealed = code_of(FAMILIES / "measurement_models.md").Sealed
    (model,) = sealed.examples()
    tau, z = np.full(400, 0.1), 101325.0 + 30.0 + np.random.default_rng(0).normal(size=(400, 1)) * 0.5 / np.sqrt(0.1)
    chunk = Chunk(np.arange(400) * 0.1, {"tau": tau, "pressure": z})
    alignment = model.aligned(chunk, Site(None, None))
    step, _ = model.bias.transition(chunk.part(1, 400), None)
    transition, measured = model.equations(chunk.part(1, 400), [step], alignment)
    assert transition.F.shape[-2:] == (1, 1)
    np.testing.assert_allclose(np.mean(measured.z), 30.0, atol=4 * 0.5 / np.sqrt(40))
    np.testing.assert_allclose(measured.R, 0.5**2 / 0.1)


def test_a_map_that_says_how_sure_it_is_answers_as_it_is_fitted(code_of):
    guide = code_of(FAMILIES / "thermal_maps.md")
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
def test_the_framing_says_nothing_that_it_does_not_know(code_of, stream):
    framing = code_of(FAMILIES / "framings.md").Csv3()
    assert isinstance(framing, Framing)
    frames, memory = framing.decode(b"2,3\n" + stream + b"\n7,8,9\n", None)
    np.testing.assert_allclose(np.rad2deg(frames.channels["gyro"][-1]), [7, 8, 9])
    assert 1 + (b"3,4,5" in stream) == frames.N
    assert len(memory[1]) == 0
