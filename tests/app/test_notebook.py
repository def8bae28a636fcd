"""The notebook runs from its first cell to its last, and every cell that ends in a result can be shown."""

import ast
import re
from pathlib import Path

import numpy as np

NOTEBOOK = Path(__file__).parents[2] / "examples" / "notebooks" / "first_run.py"


def cells(text):
    """The code cells of a notebook in the percent format."""
    parts = re.split(r"^# %%(.*)$", text, flags=re.M)
    return [code for kind, code in zip(parts[1::2], parts[2::2], strict=True) if "[markdown]" not in kind]


def test_every_cell_runs_and_shows_what_it_ends_in(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names, shown = {}, []
    for code in cells(NOTEBOOK.read_text()):
        body = ast.parse(code).body
        last = body.pop() if isinstance(body[-1], ast.Expr) and isinstance(body[-1].value, ast.Name) else None
        exec(compile(ast.Module(body, []), NOTEBOOK.name, "exec"), names)
        if last is not None:
            value = names[last.value.id]
            shown.append(type(value).__name__)
            assert "<img" in value._repr_html_() if "Result" in shown[-1] else value.axes
    assert shown == ["SimulateResult", "FitMapResult", "RunResult", "CompareResult", "Figure"]
    assert list(tmp_path.iterdir()) == []
    # the map brings the prediction to a fraction of what it is without
    coast = {name: found.yardsticks.coast["to the end"] for name, found in names["compared"].items()}
    assert np.linalg.norm(coast["thermal derivative"]) < 0.1 * np.linalg.norm(coast["random walk"])
