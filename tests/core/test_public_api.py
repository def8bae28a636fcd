"""What `fusion_core` itself offers: all of it resolves, is what its module has, and is loaded only when asked for."""

import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import fusion_core


def test_every_public_name_is_that_of_its_module():
    assert sorted(fusion_core._HOME) == fusion_core.__all__
    for name, module in fusion_core._HOME.items():
        assert getattr(fusion_core, name) is getattr(import_module(f"fusion_core.{module}"), name)
        assert name in dir(fusion_core)


def test_what_type_checkers_see_is_what_there_is():
    source = Path(fusion_core.__file__).read_text()
    for module, names in fusion_core._HOMES.items():
        block = source.split(f"    from fusion_core.{module} import ")[1].split("\n    from ")[0].split("\n\n")[0]
        assert sorted(block.replace("(", " ").replace(")", " ").replace(",", " ").split()) == sorted(names)


def test_a_name_is_loaded_when_it_is_asked_for():
    code = "import sys, fusion_core; fusion_core.StateSpace; print('numba' in sys.modules, 'pydantic' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]


def test_a_name_that_there_is_not_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'fusion_core' has no attribute 'estimated'"):
        fusion_core.estimated  # noqa: B018
