r"""Text that someone else wrote, as it may stand in a file of another program or on a terminal: one function a target.

A name, a unit or a serial number comes from a file that a stranger made. What leaves with it is data: a text is on one
line, ends no comment and no string, and is no key, command or formula of the target. Text of letters, digits, signs and
spaces alone leaves as it is.

========================  ======================================================================================
`line`, `lines`           a terminal, and each comment: control characters, line ends of any kind, marks that turn the
                          direction of writing, characters of no width and halves of characters are written as `\x1b`
`comment`                 `#` of parameter files, YAML and the like
`yaml_text`               a value or key of YAML
`csv_cell, csv_comment`   a spreadsheet takes what begins with `=`, `+`, `-` or `@` for a formula, after a comma too
`c_comment`               C and C++, trigraphs and spliced lines included
`matlab_name`             a variable of MATLAB
`json_text, script_json`  JSON for programs, and within a script of a page
`css_text`                a string of CSS
========================  ======================================================================================
"""

from __future__ import annotations

import json
import re
from typing import Any
from unicodedata import category

PLAIN = re.compile(r"(\.{0,2}/)*[A-Za-z_][\w./^-]*")
WORDS = {"y", "n", "yes", "no", "on", "off", "true", "false", "null"}  # that YAML takes for something else
FORMULA = "=+\\-@\uff1d\uff0b\uff0d\uff20"  # with the wide forms, which some spreadsheets take for the same
KEYWORDS = re.compile(
    "break|case|catch|classdef|continue|else|elseif|end|for|function|global|if|otherwise|parfor|persistent|return|spmd|"
    "switch|try|while"
)  # of MATLAB
LONGEST = 63  # characters of a name in MATLAB


def line(text: object) -> str:
    """Return a text on one line, with the code of each character that is none to be seen."""
    plain = str(text)
    return plain if plain.isprintable() else "".join(map(_seen, plain))


def lines(text: str) -> str:
    """Return a text of lines, each as `line` has it."""
    return "\n".join(map(line, text.split("\n")))


def is_plain(text: str) -> bool:
    """Return True if `line` leaves a text as it is."""
    return text.isprintable() or line(text) == text


def comment(text: object) -> str:
    """Return a line of a parameter file, of YAML or the like that is a comment."""
    return f"# {line(text)}"


def yaml_text(text: str) -> str:
    """Return a text as a value or a key of YAML."""
    if PLAIN.fullmatch(text) and text.lower() not in WORDS:
        return text
    return line(json.dumps(text, ensure_ascii=False))  # the codes that `line` writes are those of YAML in quotes


def csv_cell(text: str) -> str:
    """Return a text as a cell of a CSV file; before a sign that begins a formula there is an apostrophe."""
    plain = re.sub(rf"^(\s*)(?=[{FORMULA}])", r"\1'", line(text))
    return '"' + plain.replace('"', '""') + '"' if re.search(r"[,;\"]|^\s|\s$", plain) else plain


def csv_comment(text: object) -> str:
    """Return a comment of a CSV file, which a spreadsheet takes for a row like all others."""
    plain = comment(text).replace('"', "'")
    return re.sub(rf"([,;]\s*)(?=[{FORMULA}])", r"\1'", plain)


def c_comment(text: object) -> str:
    """Return a text that ends no comment of C, begins none, and goes on in no next line."""
    plain = line(text)
    while (apart := re.sub(r"\*(?=/)|/(?=\*)|\?(?=\?)", r"\g<0> ", plain)) != plain:
        plain = apart
    return f"{plain}." if plain.endswith("\\") else plain


def matlab_name(text: str) -> str:
    """Return a text as the name of a variable of MATLAB."""
    plain = re.sub(r"[^A-Za-z0-9_]", "_", text)[:LONGEST]
    return plain if plain[:1].isalpha() and not KEYWORDS.fullmatch(plain) else f"s_{plain}"[:LONGEST]


def json_text(content: Any, indent: int | None = None, *, allow_nan: bool = True) -> str:
    """Return JSON of ASCII that can be seen, and of line feeds."""
    return json.dumps(content, indent=indent, allow_nan=allow_nan).replace("\x7f", "\\u007f")


def json_of(text: str) -> str:
    """Return JSON text in ASCII, with the codes of all else."""
    return re.sub(r"[^\n -~]", lambda match: json.dumps(match[0])[1:-1].replace("\x7f", "\\u007f"), text)


def script_json(content: Any) -> str:
    """Return JSON that a page may hold in a script: no text in it can end the script."""
    text = json.dumps(content, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace("&", "\\u0026")


def css_text(text: str) -> str:
    """Return a text as a string of CSS: letters, digits and spaces, and the code of all else."""
    return '"' + "".join(c if c.isalnum() or c == " " else f"\\{ord(c):x} " for c in text) + '"'


def _seen(character: str) -> str:
    """Return a character, or its code where it is none to be seen; a space of any width is one."""
    if character.isprintable() or category(character) == "Zs":
        return character
    code = ord(character)
    return f"\\x{code:02x}" if code < 1 << 8 else f"\\u{code:04x}" if code < 1 << 16 else f"\\U{code:08x}"
