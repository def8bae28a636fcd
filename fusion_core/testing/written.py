"""Files that were written with hostile texts, against those with plain ones: the same lines, keys, cells and code.

Each is read as its target reads it: YAML and JSON by their readers, CSV as a spreadsheet does, C as a compiler sees it
(trigraphs, spliced lines, comments taken out), any other text by its lines. Of a file that is no text there is nothing
to compare but that it is there.
"""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Mapping
from typing import Any

from fusion_core.escaping import FORMULA, is_plain

TRIGRAPHS = {"/": "\\", "'": "^", "(": "[", ")": "]", "<": "{", ">": "}", "=": "#", "!": "|", "-": "~"}
HOSTILE = (
    "a\nEVIL,1\n# ", "a\r\nEVIL 1", "\rEVIL 1", "a\x85EVIL: 1", "a\u2028EVIL: 1", "a\u2029EVIL: 1", "a\x0bEVIL: 1",
    "a\x1cEVIL 1", "\x00", "\x1b[2J\x1b]0;evil\x07", "\x9b31m", "\x7f", "\u202eevil\u202c", "a\u200bb", "\ufeff",
    "\ud800", "\U000e0041", '"', "'", "`", "\\", "a\\", "*/ int evil; /*", "*", "/", "//", "/* ", "??/", "*??/",
    "?>", "]]>", "--> <!--", "</script>", "<img src=x onerror=alert(1)>", "{{ 7 * 7 }}", "{% raw %}",
    "=cmd|' /C calc'!A1", "@SUM(1,1)", "+1", "-1", "a,=1+1", "a;=1+1", "a\t=1", "\uff1d1", "%", "%YAML:1.0", "#",
    "# a", "a: b", "- a", "&a", "*a", "!!python/object:os.system {}", "? a", "|", ">", "---", "...", "~", "null",
    "1e3", "0x10", " ", " a ", "a" * 5000, "\N{GRINNING FACE}", "\N{MICRO SIGN}\N{DEGREE SIGN}", "end", "int",
    "product", "driftlab", "../../evil", "/etc/passwd", "con", "a.b", "a" * 64,
)  # fmt: skip


def skeleton(name: str, content: bytes) -> Any:
    """Return what a file is but for the texts in it, which are the same for all that are data alone."""
    try:
        whole = content.decode()
    except UnicodeDecodeError:
        return "no text"
    if "\x00" in whole:
        return "no text"
    of_form = FORMS.get(name.rpartition(".")[2])
    return len(whole.splitlines()), None if of_form is None else of_form(whole)


def check_like(before: Mapping[str, Any], found: Mapping[str, bytes], said: str) -> None:
    """Raise AssertionError where files differ in more than a text from the skeletons of others."""
    assert len(found) == len(before), f"{said}: {len(found)} files are written, {len(before)} with a plain text"
    for (other, wanted), (name, content) in zip(sorted(before.items()), sorted(found.items()), strict=True):
        assert is_plain(name), f"{said}: a file is called {name!r}"
        own = skeleton(name, content)
        assert own == wanted, f"{said}: {name} has other lines, keys, cells or code than {other} with a plain text"
        if own != "no text":
            strange = [line for line in content.decode().split("\n") if not is_plain(line.replace("\t", " "))]
            assert not strange, f"{said}: {name} has {strange[0]!r}"


def _keys(whole: str) -> Any:
    import yaml

    try:  # what OpenCV writes first is no directive of others
        return _shape(yaml.safe_load(whole.removeprefix("%YAML:1.0")))
    except yaml.YAMLError:
        return "no YAML"


def _shape(content: Any) -> Any:
    if isinstance(content, dict):
        return {name: _shape(value) for name, value in content.items()}
    return [_shape(value) for value in content] if isinstance(content, list) else type(content).__name__


def _cells(whole: str) -> list[tuple[bool, int]]:
    """Return how many cells each row has, comments aside, and whether one is a formula."""
    rows = csv.reader(io.StringIO(whole, newline=""))
    formula = re.compile(rf"\s*[{FORMULA}](?![\d.])")
    return [
        (any(formula.match(cell) for cell in row), 0 if row and row[0].startswith("#") else len(row)) for row in rows
    ]


def _code(whole: str) -> str:
    """Return C without comments, its words all alike."""
    for letter, sign in TRIGRAPHS.items():
        whole = whole.replace(f"??{letter}", sign)
    spliced = re.sub(r"\\[ \t]*\n", "", whole)
    bare = re.sub(r'("(?:\\.|[^"\\\n])*")|/\*.*?\*/|//[^\n]*', lambda found: found[1] or " ", spliced, flags=re.DOTALL)
    return re.sub(r"[\w.+-]+", "w", bare)


def _plain_lines(whole: str) -> list[str]:
    """Return the lines that are no comments."""
    return [line for line in whole.splitlines() if not line.startswith("#")]


FORMS = {
    "yaml": _keys, "yml": _keys, "json": lambda whole: _shape(json.loads(whole)), "csv": _cells, "c": _code, "h": _code,
    "params": _plain_lines, "parm": _plain_lines,
}  # fmt: skip
