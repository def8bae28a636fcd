"""The house as a whole: what the wheel holds, what importing costs, and its structure, measured by `ast`."""

import ast
import collections
import importlib
import importlib.util
import inspect
import os
import re
import subprocess
import sys
import tomllib
from functools import cache
from pathlib import Path

import pytest

import driftlab
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
    assert (installed / "fusion_core" / "units" / "units.txt").is_file()
    templates = list((ROOT / "plugins" / "exporters" / "c" / "c99").glob("*.jinja"))
    assert templates
    assert all((installed / "fusion_plugins" / "exporters" / "c" / "c99" / p.name).is_file() for p in templates)


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
    plugins = {
        name for name, path, _ in modules() if name.startswith("fusion_plugins.") and "@hookimpl" in path.read_text()
    }
    assert set(points.values()) == {*plugins, "driftlab.products"}
    # a name that two families have is written with its family
    assert all(value.endswith(f".{name}") for name, value in points.items())
    for entry in registry().entries:
        assert entry.error is None
        if entry.family == "products":
            assert entry.path.parent == Path(driftlab.__file__).parent / "products"
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
        "prompt_toolkit",
        "onnx",
        "onnxruntime",
        "matplotlib",
        "jinja2",
        "serial",
        "pyulog",
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


# the structure, measured by ast

FOLDERS = {"fusion_core": "fusion_core", "plugins": "fusion_plugins", "driftlab": "driftlab"}
NO_NUMERICS = {"contracts", "host", "testing", "units"}


@cache
def modules():
    """Every module: its dotted name, its path, its tree."""
    return list(_modules())


def _modules():
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            if "__pycache__" not in path.parts:
                parts = [package, *path.relative_to(ROOT / folder).with_suffix("").parts]
                yield ".".join(parts[:-1] if parts[-1] == "__init__" else parts), path, ast.parse(path.read_text())


def docstring_lines(node):
    first = node.body[0] if node.body else None
    text = isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant) and isinstance(first.value.value, str)
    return set(range(first.lineno, first.end_lineno + 1)) if text else set()


def test_files_and_functions_stay_small():
    large = []
    for _, path, tree in modules():
        if (lines := path.read_text().count("\n")) > 500:
            large.append(f"{path.relative_to(ROOT)}: {lines} lines")
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                lines = node.end_lineno - node.lineno + 1 - len(docstring_lines(node))
                if lines > 40:
                    large.append(f"{path.relative_to(ROOT)}:{node.lineno} {node.name}: {lines} lines")
    assert not large


def test_the_numerics_of_the_core_stay_small():
    """Every module of the core that is no contract, host, law or unit counts: there is no list to forget one in."""
    rooms = {(name, path, tree) for name, path, tree in modules() if name.startswith("fusion_core.")}
    count = sum(code_lines(path, tree) for name, path, tree in rooms if name.split(".")[1] not in NO_NUMERICS)
    assert 0 < count <= 4139


def imports():
    """Each module with the modules that it imports: at its top, within its functions, and for types alone."""
    known = {name: tree for name, _, tree in modules()}
    for name, tree in known.items():
        found = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                assert node.level == 0, f"{name} imports relatively"
                found |= {n if (n := f"{node.module}.{a.name}") in known else node.module for a in node.names}
            elif isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
        yield name, (found & set(known)) - {name}


def test_what_tests_and_benchmarks_import_is_there():
    """Else a module of them fails before its first test, or a benchmark that nobody runs rots."""
    gone = []
    for path in (
        path for folder in ("tests", "benchmarks", "examples", "docs") for path in (ROOT / folder).rglob("*.py")
    ):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] in FOLDERS.values():
                for name in (alias.name for alias in node.names):
                    module = importlib.util.find_spec(node.module) and importlib.import_module(node.module)
                    inner = hasattr(module, "__path__") and importlib.util.find_spec(f"{node.module}.{name}")
                    if not hasattr(module, name) and not inner:
                        gone.append(f"{path.relative_to(ROOT)}: {node.module}.{name}")
    assert not gone


def circles(graph):
    """Return a graph without all that imports nothing, and without what nothing imports, again and again."""
    graph = {name: set(targets) for name, targets in graph.items()}
    while gone := {name for name, targets in graph.items() if not targets & set(graph)}:
        graph = {name: targets - gone for name, targets in graph.items() if name not in gone}
    while gone := set(graph) - set().union(*graph.values(), set()):
        graph = {name: targets for name, targets in graph.items() if name not in gone}
    return graph


def test_a_circle_is_found():
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"b"}, "d": set()}) == {"b": {"c"}, "c": {"b"}}
    assert not circles({"a": {"b", "c"}, "b": {"c"}, "c": set()})


@pytest.mark.parametrize("level", [1, 2, 3, 9])
def test_no_import_circle(level):
    """Among modules, among the folders of a package, and among packages; `__init__` of a top package is all of it."""
    graph = {}
    tops = {name for name, _, _ in modules() if "." not in name}
    for name, targets in imports():
        if name in tops and level > 1:
            continue  # a package's own face is made of what is in it
        short = ".".join(name.split(".")[:level])
        graph.setdefault(short, set()).update(
            other for t in targets if (other := ".".join(t.split(".")[:level])) != short and t not in tops
        )
    assert not circles(graph)


def test_tests_mirror_the_tree():
    """A test file is named for its module, and lies where that lies; what is about several is at the top."""
    homes = {"core": "fusion_core", "plugins": "plugins", "app": "driftlab"}
    astray = []
    for part, home in homes.items():
        for path in (ROOT / "tests" / part).rglob("test_*.py"):
            inside = path.relative_to(ROOT / "tests" / part)
            if len(inside.parts) == 1:
                continue  # what goes through all of it
            words = inside.stem[5:].split("_")
            stems = {"_".join(words[:k]) for k in range(1, len(words) + 1)}
            folder = ROOT / home / inside.parent
            if folder.name not in stems and not any((folder / f"{stem}.py").is_file() for stem in stems):
                astray.append(str(inside))
    assert not astray


# budgets that may only fall, and the words


BUDGET = {
    "driftlab": 639,
    "driftlab/commands": 3811,
    "driftlab/evaluation": 1609,
    "driftlab/family": 3407,
    "driftlab/filtering": 1329,
    "driftlab/identification": 2351,
    "driftlab/live": 844,
    "driftlab/maps": 2090,
    "driftlab/noise": 1558,
    "driftlab/planning": 1261,
    "driftlab/production": 3222,
    "driftlab/products": 6,
    "driftlab/recordings": 853,
    "driftlab/reports": 3560,
    "driftlab/soak": 890,
    "driftlab/spc": 1686,
    "driftlab/starter": 926,
    "driftlab/storage": 1287,
    "driftlab/triad": 717,
    "fusion_core": 1975,
    "fusion_core/contracts": 1995,
    "fusion_core/fast": 862,
    "fusion_core/host": 745,
    "fusion_core/testing": 988,
    "fusion_core/thermal": 1320,
    "fusion_core/units": 428,
    "plugins": 302,
    "plugins/bias_models": 251,
    "plugins/effects": 711,
    "plugins/exporters": 1720,
    "plugins/framings": 625,
    "plugins/measurement_models": 752,
    "plugins/sources": 5478,
    "plugins/stimuli": 298,
    "plugins/thermal_maps": 889,
}
"""Lines of code a room may have: neither blank, nor comment, nor docstring. A change may lower them."""

SMALL = 9  # modules under 60 lines that are no plugin
ANNEXES = 2  # modules under 120 lines whose only importer lies in their own folder
QUESTION = re.compile(r"((Return|Yield) )?(what|who|whose|how|which|where|when|why|whether|whatever)\b", re.IGNORECASE)
NO_NAMES = {
    "after", "ahead", "asked", "before", "doing", "done", "each", "found", "given", "hands", "judged", "kept", "known",
    "learned", "lost", "more", "odd", "own", "said", "seen", "shown", "telling", "told", "wanted",
}  # fmt: skip
"""Participles and prepositions: no module and no public class or function has one for a name."""


def code_lines(path, tree):
    documented = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            documented |= docstring_lines(node)
    lines = enumerate(path.read_text().splitlines(), 1)
    return sum(bool(s := line.strip()) and not s.startswith("#") and k not in documented for k, line in lines)


def test_rooms_keep_their_budgets():
    rooms = {}
    for _, path, tree in modules():
        top, second, *rest = path.relative_to(ROOT).parts
        room = f"{top}/{second}" if rest else top
        rooms[room] = rooms.get(room, 0) + code_lines(path, tree)
    assert set(rooms) == set(BUDGET)
    over = {room: n for room, n in rooms.items() if n > BUDGET[room]}
    assert not over, f"{over} lines; delete as many as were added, or raise BUDGET by those of a new plugin"


def test_a_file_is_a_subject():
    importers = {}
    for name, targets in imports():
        for target in targets:
            importers.setdefault(target, set()).add(name)
    small, annexes = [], []
    for name, path, _ in modules():
        lines = path.read_text().count("\n")
        if path.stem in ("__init__", "__main__") or name.startswith("fusion_plugins."):
            continue
        if lines < 60:
            small.append(name)
        users = importers.get(name, set())
        if lines < 120 and len(users) == 1 and next(iter(users)).rpartition(".")[0] == name.rpartition(".")[0]:
            annexes.append(name)
    assert len(small) <= SMALL, small
    assert len(annexes) <= ANNEXES, annexes


def public(tree):
    return [
        node
        for node in tree.body
        if isinstance(node, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef) and not node.name.startswith("_")
    ]


def test_a_public_class_name_exists_once():
    homes = {}
    for name, _, tree in modules():
        for node in public(tree):
            if isinstance(node, ast.ClassDef):
                homes.setdefault(node.name, []).append(name)
    assert {name: where for name, where in homes.items() if len(where) > 1 and name not in TWICE} == {}


TWICE = {"Block", "Channel", "Family", "Mat"}
"""Exported names that a plugin of another family has too, or that two packages export."""


def test_names_are_nouns_and_verbs():
    wrong = []
    for name, _, tree in modules():
        stem = name.rpartition(".")[2]
        if stem in NO_NAMES or stem.startswith("of_"):
            wrong.append(name)
        wrong += [f"{name}.{node.name}" for node in public(tree) if node.name.lower() in NO_NAMES]
    assert not wrong


def script(name):
    """A script of the reference, which writes one of its pages."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "reference" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_every_module_is_in_the_glossary():
    written = (ROOT / "docs" / "reference" / "names.md").read_text()
    assert written.endswith(script("make_names").lines()), "run python docs/reference/make_names.py"


def test_the_python_api_is_that_of_the_source():
    written = (ROOT / "docs" / "reference" / "python_api.md").read_text()
    assert written.endswith(script("make_python_api").lines()), "run python docs/reference/make_python_api.py"


def test_what_moved_is_where_the_page_says():
    moved = script("make_moved")
    assert (ROOT / "docs" / "reference" / "moved.md").read_text() == moved.text(), "run docs/reference/make_moved.py"
    for _, _, place, name in moved.rows():
        try:
            home = importlib.import_module(place)
        except ModuleNotFoundError:
            module, _, holder = place.rpartition(".")
            home = getattr(importlib.import_module(module), holder)
        assert hasattr(home, name), f"{place}.{name}"


def test_docstrings_begin_with_their_subject():
    """Of modules, classes, functions and fields, of the product, the examples and the benchmarks."""
    paths = [path for folder in (*FOLDERS, "examples", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    assert len(paths) > 400
    asking = []
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Expr)
                and isinstance(node.value, ast.Constant)
                and QUESTION.match(str(node.value.value))
            ):
                asking.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not asking


def test_the_filter_knows_no_sensor():
    sensors = re.compile(r"gyro|accel|temperature|thermal|driftlab", re.IGNORECASE)
    filters = {
        "kalman", "model", "statespace", "discretize", "smoother", "consistency", "feedback", "checks", "chunk",
        "recursions", "fast",
    }  # fmt: skip
    found = {
        name: words
        for name, path, _ in modules()
        if name.startswith("fusion_core.") and name.split(".")[1] in filters
        if (words := sorted(set(sensors.findall(path.read_text()))))
    }
    assert found == {}


def test_figures_and_prose_come_last():
    """Of the application only commands, pages and results draw or print; all else computes on typed objects."""
    libraries, allowed = {"rich", "jinja2", "typer"}, PROSE
    wrong = []
    for name, _, tree in modules():
        if not name.startswith("driftlab.") or name.split(".")[1] in allowed:
            continue
        for node in ast.walk(tree):
            names = [node.module or ""] if isinstance(node, ast.ImportFrom) else []
            names += [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            wrong += [f"{name}: {n}" for n in names if n.partition(".")[0] in libraries]
    assert not wrong


PROSE = {"cli", "commands", "live", "production", "reports"}


def test_nothing_public_is_unused():
    words = collections.Counter()
    for _, path, _ in modules():
        words.update(re.findall(r"\w+", path.read_text()))
    unused = [f"{name}.{node.name}" for name, _, tree in modules() for node in public(tree) if words[node.name] < 2]
    assert not [name for name in unused if not name.startswith(("fusion_plugins.", "fusion_core.testing"))]
