"""Functions that numba compiles when they are first called."""

import os
import subprocess
import sys
import textwrap


def test_a_function_of_another_module_is_compiled_whatever_was_called_first(tmp_path):
    """In a process of its own, without numba's cache: what failed to compile once would fail for ever."""
    (tmp_path / "first.py").write_text(
        textwrap.dedent("""
        from fusion_core.fast import compiled

        @compiled
        def deep(x):
            return 2 * x

        @compiled
        def middle(x):
            return deep(x) + 1
    """)
    )
    (tmp_path / "second.py").write_text(
        textwrap.dedent("""
        from first import middle
        from fusion_core.fast import compiled

        @compiled
        def own(x):
            return x
    """)
    )
    code = "import second, first; second.own(1.0); print(second.middle(2.0), first.middle(2.0))"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "5.0 5.0\n", done.stderr


def test_threads_that_compile_at_once_get_the_same(tmp_path):
    """The first of them has not yet made all names of the module compiled ones when the others come."""
    names = "abcdefgh"
    lines = ["import sys, threading, time", "from fusion_core import fast", "from fusion_core.fast import compiled"]
    lines += [f"@compiled\ndef {name}(x):\n    return x" for name in names]
    lines += ["@compiled", "def total(x):", f"    return {' + '.join(f'{name}(x)' for name in names)}"]
    lines += [
        "made = fast.Compiled.dispatcher.func",
        "def slowly(self):",
        "    time.sleep(0.05)",
        "    return made(self)",
        "fast.Compiled.dispatcher.func = slowly",
        "threads = [threading.Thread(target=lambda: sys.stdout.write(f'{total(1.0)}\\n')) for _ in range(4)]",
        "[thread.start() for thread in threads]",
    ]
    (tmp_path / "threads.py").write_text("\n".join(lines))
    done = subprocess.run([sys.executable, "threads.py"], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout.split() == 4 * ["8.0"], done.stderr


def test_what_is_kept_is_loaded_without_what_can_be_compiled():
    code = """
import sys
import numpy as np
from fusion_core.consistency import Whiteness
Whiteness(2).add(np.ones((50, 2)))
print("numba.core.caching" in sys.modules, "numba.np.arraymath" in sys.modules)
"""
    command = [sys.executable, "-c", code]
    subprocess.run(command, check=True, capture_output=True)  # compiles it where nothing is kept yet
    assert subprocess.run(command, check=True, capture_output=True, text=True).stdout.split() == ["True", "False"]


def test_what_was_kept_for_other_types_is_not_taken(tmp_path):
    """Two processes that keep a function at one moment, each for types of its own, may both write its first file."""
    (tmp_path / "kept.py").write_text(
        "from fusion_core.fast import compiled\n@compiled\ndef twice(x):\n    return 2 * x\n"
    )
    code = "from kept import twice; print(twice({}))"
    said = []
    for value in ("3.0", "3", "3"):
        done = subprocess.run(
            [sys.executable, "-c", code.format(value)],
            cwd=tmp_path,
            env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)},
            capture_output=True,
            text=True,
        )
        said.append(done.stdout.strip())
        kept = sorted(tmp_path.rglob("*.nbc"))
        kept[-1].write_bytes(kept[0].read_bytes())
    assert said == ["6.0", "6", "6"]
