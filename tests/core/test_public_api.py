"""The names of `fusion_core` itself: each resolves, is what its module has, and is loaded only when asked for."""

import ast
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import fusion_core
import fusion_core.contracts


@pytest.mark.parametrize("package", [fusion_core, fusion_core.contracts], ids=lambda package: package.__name__)
def test_every_public_name_is_that_of_its_module(package):
    stub = ast.parse(Path(package.__file__).with_suffix(".pyi").read_text())
    home = {name.asname: node.module for node in stub.body if isinstance(node, ast.ImportFrom) for name in node.names}
    assert sorted(home) == package.__all__
    for name, module in home.items():
        assert getattr(package, name) is getattr(import_module(module), name)
        assert name in dir(package)


def test_a_name_is_loaded_when_it_is_asked_for():
    code = "import sys, fusion_core; fusion_core.StateSpace; print('numba' in sys.modules, 'pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_a_name_that_there_is_not_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'fusion_core' has no attribute 'estimated'"):
        fusion_core.estimated  # noqa: B018
