"""The house as a whole: what the wheel holds, and what importing costs."""

import inspect
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import fusion_core
import fusion_plugins
from fusion_core import hookspecs
from fusion_core.contracts.families import FAMILIES
from fusion_core.host.registry import registry

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def sources_of(folder):
    return {p.relative_to(ROOT / folder) for p in (ROOT / folder).rglob("*.py") if "__pycache__" not in p.parts}


@pytest.mark.skipif("DRIFTLAB_TEST_WHEEL" not in os.environ, reason="the suite runs on a source tree, not on the wheel")
def test_the_suite_runs_on_the_wheel_and_the_wheel_is_whole():
    installed = Path(fusion_core.__file__).parent.parent
    assert "site-packages" in installed.parts
    assert Path(fusion_plugins.__file__).parent.parent == installed
    for folder, package in (("fusion_core", "fusion_core"), ("plugins", "fusion_plugins"), ("driftlab", "driftlab")):
        missing = {path for path in sources_of(folder) if not (installed / package / path).is_file()}
        assert not missing
        assert (installed / package / "py.typed").is_file()
    for product in (ROOT / "driftlab" / "products").glob("*.yaml"):
        assert (installed / "driftlab" / "products" / product.name).is_file()
    assert all(
        (installed / "driftlab" / "reports" / "pages" / p.name).is_file()
        for p in (ROOT / "driftlab" / "reports" / "pages").glob("*.html")
    )
    assert (installed / "fusion_core" / "units.txt").is_file()


def test_every_package_on_disk_is_listed():
    rename = {"plugins": "fusion_plugins"}
    on_disk = set()
    for top in ("fusion_core", "plugins", "driftlab"):
        for init in (ROOT / top).rglob("__init__.py"):
            first, *rest = init.parent.relative_to(ROOT).parts
            on_disk.add(".".join([rename.get(first, first), *rest]))
    assert on_disk == set(PROJECT["tool"]["setuptools"]["packages"])


def test_every_plugin_module_is_an_entry_point_of_its_own_name():
    points = PROJECT["project"]["entry-points"]["fusion_core"]
    modules = {
        f"fusion_plugins.{p.parent.name}.{p.stem}": p
        for p in (ROOT / "plugins").glob("*/*.py")
        if "@hookimpl" in p.read_text()
    }
    assert set(points.values()) == {*modules, "driftlab.products"}
    assert all(value.rpartition(".")[2] == name for name, value in points.items())
    for entry in registry().entries:
        assert entry.error is None
        if entry.family == "products":
            assert entry.path.parent == ROOT / "driftlab" / "products"
            continue
        assert entry.kind == entry.module.rpartition(".")[2]
        assert entry.plugin.__doc__


@pytest.mark.parametrize("module", ["fusion_core", "fusion_core.contracts", "fusion_core.host", "driftlab.cli"])
def test_importing_loads_no_plugin_and_no_heavy_library(module):
    heavy = [
        "numba",
        "scipy",
        "h5py",
        "polars",
        "onnx",
        "onnxruntime",
        "sklearn",
        "skl2onnx",
        "matplotlib",
        "pint",
        "jinja2",
        "serial",
        "fastcrc",
        "fusion_plugins",
    ]
    code = f"import sys, {module}; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_every_hook_is_a_family_is_documented_and_is_explained():
    specs = {name: item for name, item in vars(hookspecs).items() if hasattr(item, f"{hookspecs.PROJECT}_spec")}
    assert set(specs) == {"families", "products"}
    guide = (ROOT / "docs" / "how-to" / "write_a_plugin.md").read_text()
    for name in (*specs, *(family.name for family in FAMILIES)):
        assert f"`{name}()`" in guide
    assert all(map(inspect.getdoc, specs.values()))
    for family in FAMILIES:
        assert family.purpose
        assert inspect.getdoc(family.contract)
        assert all(hasattr(family.contract, name) for name in family.answers)


def test_files_and_functions_stay_small():
    for path in [p for top in ("fusion_core", "plugins", "driftlab") for p in (ROOT / top).rglob("*.py")]:
        assert path.read_text().count("\n") <= 320, path


def test_nothing_speaks_of_the_machine_it_was_made_on():
    tracked = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True).stdout.split()
    if not tracked:
        pytest.skip("not a git checkout")
    for name in tracked:
        path = ROOT / name
        if path.suffix in {".py", ".md", ".yaml", ".toml"} and path.is_file() and path != Path(__file__):
            assert not re.search(r"/(?:root|home|tmp)/\w|/work/", path.read_text()), name


def test_every_family_has_its_contract():
    for family in FAMILIES:
        for name in family.contract.__abstractmethods__:
            assert inspect.getdoc(getattr(family.contract, name))
