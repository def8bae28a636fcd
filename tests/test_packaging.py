"""Recipes of packages beside pyproject.toml: the same version, dependencies and commands."""

import re
import runpy
import tomllib
from pathlib import Path

import pytest
import yaml

from driftlab.config import load_config

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CONDA = {"matplotlib": "matplotlib-base", "prompt-toolkit": "prompt_toolkit"}  # the first without a toolkit for windows


@pytest.fixture(scope="module")
def recipe():
    return yaml.safe_load((ROOT / "packaging" / "recipe.yaml").read_text())


def test_the_conda_recipe_has_the_dependencies_of_the_wheel(recipe):
    parts = [re.fullmatch(r"([\w.-]+)(>=[\d.]+)", text) for text in PROJECT["dependencies"]]
    wanted = [f"{CONDA.get(part[1], part[1])} {part[2]}" for part in parts]
    python = f"python {PROJECT['requires-python']}"
    assert sorted(recipe["requirements"]["run"]) == sorted([python, *wanted])
    assert python in recipe["requirements"]["host"]


def test_the_conda_recipe_has_the_version_and_the_commands_of_the_wheel(recipe):
    assert str(recipe["context"]["version"]) == PROJECT["version"]
    commands = [f"{name} = {place}" for name, place in PROJECT["scripts"].items()]
    assert recipe["build"]["python"]["entry_points"] == commands


def test_the_container_installs_extras_that_there_are():
    text = (ROOT / "packaging" / "Containerfile").read_text()
    (extras,) = re.findall(r"\[([\w,]+)\]\"", text)
    assert set(extras.split(",")) <= set(PROJECT["optional-dependencies"])
    assert re.search(r"^ENTRYPOINT \[\"driftlab\"\]$", text, re.MULTILINE)


def test_the_citation_has_the_version_of_the_wheel():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == PROJECT["version"]


@pytest.mark.parametrize("name", ["CONFIG", "TWIN"])
def test_the_wheel_is_tried_with_configs_that_are_valid(tmp_path, name):
    (tmp_path / "unit.yaml").write_text(runpy.run_path(str(ROOT / "packaging" / "try_wheel.py"))[name])
    assert load_config(tmp_path / "unit.yaml", "soak.h5" if name == "CONFIG" else None).source is not None
