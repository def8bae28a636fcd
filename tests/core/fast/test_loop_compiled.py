"""The compiler keeps what it compiled file by file, and looks at that file alone to see whether it is still true.

So whatever a compiled function takes in from outside itself must stand in its own file: then no change can leave an old
result in use.
"""

import dis
import importlib
import inspect
import pkgutil
import re
import types

import numpy as np

import fusion_core
import fusion_plugins

PACKAGES = [fusion_core, fusion_plugins]


def compiled():
    """Yield every compiled function that is kept."""
    from numba.core.registry import CPUDispatcher

    import driftlab
    from fusion_core.fast import Compiled

    for package in [*PACKAGES, driftlab]:
        for info in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            module = importlib.import_module(info.name)
            for name, value in vars(module).items():
                if isinstance(value, CPUDispatcher | Compiled) and value.py_func.__module__ == info.name:
                    yield name, value.py_func


def test_what_is_compiled_together_stands_in_one_file():
    found = 0
    for name, function in compiled():
        found += 1
        for word in {i.argval for i in dis.get_instructions(function) if i.opname == "LOAD_GLOBAL"}:
            used = function.__globals__.get(word)
            if used is None or isinstance(used, types.ModuleType | types.BuiltinFunctionType):
                continue
            if isinstance(used, int | float | str | tuple | np.generic) and not isinstance(used, type):
                source = inspect.getsource(inspect.getmodule(function))
                set_here = re.search(rf"^([\w, ]*, )?{word}\b.*=", source, re.MULTILINE)
                assert set_here, f"{name}: {word} stands in another file"
                continue
            owner = inspect.getmodule(getattr(used, "py_func", used)) or used
            inside = owner.__name__ == function.__module__ or owner.__name__.split(".")[0] in {"numba", "numpy"}
            assert inside, f"{name} in {function.__module__} takes {word} from {owner.__name__}"
    assert found > 20
