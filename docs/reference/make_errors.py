"""Write the list of all messages of errors.md from the source.

`python docs/reference/make_errors.py` rewrites it; `lines()` is what tests compare it with. A message is the text of an
error or of a note where it is made, with the expressions in it as `{name}`; a text of parts that other functions return
is not in the list.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

from fusion_core import errors

ROOT = Path(__file__).parents[2]
PAGE = Path(__file__).with_name("errors.md")
HEAD = "## All messages\n"
FOLDERS = {"driftlab": "driftlab", "fusion_core": "fusion_core", "plugins": "fusion_plugins"}
PARTS = {"problem": "ConfigError"}  # functions that make an error of a text
NOTES = {"add", "note"}  # methods of faults that keep one
WORDS = 3  # of a message, at the least


def lines() -> str:
    """Return the section of errors.md with the messages of each error, a row each."""
    rows: dict[str, set[tuple[str, str]]] = {}
    for module, tree in _modules():
        own, within = _errors_of(tree), _functions(tree)
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or not node.args:
                continue
            error = own.get(_name(node.func)) or _note(node.func)
            if error is not None:
                said = [_texts(part) for part in _written(node.args[0], within.get(node, tree))]
                rows.setdefault(error, set()).update((text, module) for texts in said for text in texts)
    text = [
        HEAD,
        "From the source, by `python docs/reference/make_errors.py`; `{name}` stands for what is named there.",
    ]
    for error in sorted(rows):
        head = f"`{error}`" if error else "Notes"
        text += [f"\n### {head}\n", f"{_summary(error)}\n", "| message | made in |", "|---|---|"]
        text += [f"| `{message}` | `{module}` |" for message, module in sorted(rows[error])]
    return "\n".join(text) + "\n"


def _modules() -> Iterator[tuple[str, ast.Module]]:
    for folder, package in FOLDERS.items():
        for path in sorted((ROOT / folder).rglob("*.py")):
            parts = [package, *path.relative_to(ROOT / folder).with_suffix("").parts]
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            yield name, ast.parse(path.read_text(encoding="utf-8"))


def _errors_of(tree: ast.Module) -> dict[str, str]:
    """Return the errors that a module raises by their names: those of the core, and what it derives of them."""
    known = {name: name for name, thing in vars(errors).items() if inspect.isclass(thing) and _is_own(thing)} | PARTS
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            bases = [known[name] for base in node.bases if (name := _name(base)) in known]
            known.update(dict.fromkeys([node.name], bases[0]) if bases else {})
    return known


def _is_own(thing: type) -> bool:
    return issubclass(thing, errors.FusionError)


def _note(function: ast.expr) -> str | None:
    """Return the empty name of what is no error but a note about a recording, None for another call."""
    is_note = isinstance(function, ast.Attribute) and function.attr in NOTES and _name(function.value) == "faults"
    return "" if is_note else None


def _functions(tree: ast.Module) -> dict[ast.AST, ast.AST]:
    """Return the innermost function about each node that is in one."""
    functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
    return {node: function for function in functions for node in ast.walk(function)}


def _written(node: ast.expr, tree: ast.AST) -> list[ast.expr]:
    """Return the text of a message, or what is assigned to its name where it has a name."""
    if not isinstance(node, ast.Name):
        return [node]
    known = (each for each in ast.walk(tree) if isinstance(each, ast.Assign))
    return [each.value for each in known if any(_name(target) == node.id for target in each.targets)]


def _name(node: ast.expr) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _texts(node: ast.expr) -> list[str]:
    """Return the texts that an expression can be, of those that are written there."""
    if isinstance(node, ast.IfExp):
        return [*_texts(node.body), *_texts(node.orelse)]
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        text = node.value
    elif isinstance(node, ast.JoinedStr):
        text = "".join(str(v.value) if isinstance(v, ast.Constant) else _part(v.value) for v in node.values)
    else:
        return []
    text = " ".join(text.replace("|", "\\|").replace("`", "'").split())
    plain = sum(word.strip("';:,.()").isalpha() for word in text.split())
    return [text] if plain >= WORDS else []


def _part(node: ast.expr) -> str:
    """Return a part of a message: one of its two texts, or a name for it."""
    if isinstance(node, ast.IfExp) and isinstance(node.body, ast.Constant):
        return str(node.body.value) or _part(node.orelse)
    if isinstance(node, ast.Constant):
        return str(node.value)
    return f"{{{_label(node)}}}"


def _label(node: ast.expr) -> str:
    """Return a name for a part of a message."""
    if isinstance(node, ast.Call):
        return _label(node.args[0]) if node.args else _label(node.func)
    if isinstance(node, ast.Subscript | ast.Starred | ast.Await):
        return _label(node.value)
    if isinstance(node, ast.BinOp | ast.Compare | ast.IfExp):
        return _label(node.body if isinstance(node, ast.IfExp) else node.left)
    return _name(node) or "..."


def _summary(error: str) -> str:
    if not error:
        return "What is used and reported."
    return " ".join((inspect.getdoc(getattr(errors, error)) or "").split("\n\n")[0].split())


if __name__ == "__main__":
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.partition(HEAD)[0].rstrip() + "\n\n" + lines(), encoding="utf-8")
