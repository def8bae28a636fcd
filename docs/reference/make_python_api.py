"""Write the signatures of python_api.md from the signatures and docstrings of `driftlab` and `fusion_core`.

`python docs/reference/make_python_api.py` rewrites them; `lines()` is what tests compare them with.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import driftlab
import fusion_core

PAGE = Path(__file__).with_name("python_api.md")
HEAD = "## Signatures\n"
LITERAL = re.compile(r"\n*\x08\n((?:.+\n)*.+)")  # lines that the command line does not fill


def lines() -> str:
    """Return the section of python_api.md with the functions, the errors and the core."""
    text = [HEAD, "From the source, by `python docs/reference/make_python_api.py`."]
    for name in driftlab.__all__:
        if name != "errors":
            text += _function(name)
    text += ["\n### `driftlab.errors`\n", "| error | is a | raised for |", "|---|---|---|"]
    for name in driftlab.errors.__all__:
        error = getattr(driftlab.errors, name)
        text.append(f"| `{name}` | `{error.__base__.__name__}` | {_summary(error)} |")
    text += ["\n### `fusion_core`\n", "| name | subject |", "|---|---|"]
    text += [f"| `{_call(name, getattr(fusion_core, name))}` | {_subject(name)} |" for name in fusion_core.__all__]
    return "\n".join(text) + "\n"


def _function(name: str) -> list[str]:
    """Return the section of a command's function: signature, summary, arguments and results."""
    function = getattr(driftlab, name)
    doc, *sections = re.split(r"\n\n(\w+)\n-+\n", inspect.getdoc(function) or "")
    parts = dict(zip(sections[::2], sections[1::2], strict=True))
    text = [f"\n### `driftlab.{name}`\n", f"    driftlab.{_call(name, function)}\n", LITERAL.sub(_as_code, doc) + "\n"]
    text += ["| argument | form | meaning |", "|---|---|---|"]
    for names, form, meaning in _entries(parts["Parameters"]):
        text.append(f"| {', '.join(f'`{one}`' for one in names.split(', '))} | {form} | {meaning} |")
    returned = " ".join(f"`{names}`: {meaning}" for names, _, meaning in _entries(parts["Returns"]))
    return [*text, f"\nReturns {returned}"]


def _as_code(block: re.Match[str]) -> str:
    return "\n\n" + "\n".join(f"    {line}" for line in block[1].split("\n"))


def _entries(section: str) -> list[tuple[str, str, str]]:
    """Return names, form and meaning of the entries of a numpydoc section, each without line ends."""
    entries = re.findall(r"^(\S[^:\n]*?)(?: : (.*))?$((?:\n {4}.*)*)", section, re.MULTILINE)
    return [(names, form, " ".join(meaning.split())) for names, form, meaning in entries]


def _call(name: str, thing: Any) -> str:
    """Return a function with its parameters and their defaults; any other thing by its name."""
    if not inspect.isfunction(thing):
        return name
    words = []
    for item in inspect.signature(thing).parameters.values():
        if item.kind is item.KEYWORD_ONLY and "*" not in words:
            words.append("*")
        words.append(item.name if item.default is item.empty else f"{item.name}={item.default!r}")
    return f"{name}({', '.join(words)})"


def _summary(thing: Callable[..., Any]) -> str:
    return " ".join((inspect.getdoc(thing) or "").split("\n\n")[0].split())


def _subject(name: str) -> str:
    """Return the first sentence of a class or function of the core; of another object its definition."""
    thing = getattr(fusion_core, name)
    if str(getattr(thing, "__module__", "")).startswith("fusion_core"):
        return _summary(thing)
    stub = Path(fusion_core.__file__).with_suffix(".pyi").read_text(encoding="utf-8")
    module = re.search(rf"^from (\S+) import {name} as", stub, re.MULTILINE)
    assert module is not None
    value = re.search(rf"^{name}\b.* = (.+)$", inspect.getsource(import_module(module[1])), re.MULTILINE)
    return f"`{value[1]}`, in `{module[1]}`" if value else f"in `{module[1]}`"


if __name__ == "__main__":
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(page.partition(HEAD)[0].rstrip() + "\n\n" + lines(), encoding="utf-8")
