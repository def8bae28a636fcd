"""The messages of errors.md are those of the source: no run of three words of one stands in no text of the code."""

import ast
import importlib.util
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "errors.md"
RUN = 3  # words in a row; fewer may be names and values
OF_OTHERS = re.compile(r"\w+Error: [^;]*|Input should be less than or equal to|\([^()]*\)")  # Python, pydantic, readers


def texts():
    """Return the constant parts of all texts in the code, the longest first."""
    parts = set()
    for top in ("fusion_core", "plugins", "driftlab"):
        for path in (ROOT / top).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Constant) and isinstance(node.value, str):
                    parts.update(
                        part.strip(" ;,:.()'`") for part in re.split(r"\{[^{}]*\}", " ".join(node.value.split()))
                    )
    return sorted((part for part in parts if len(part) >= 4), key=len, reverse=True)


def unknown(message, known):
    """Return the runs of RUN words or more of a message that no text of the code has."""
    covered = [False] * len(message)
    for other in OF_OTHERS.finditer(message):
        covered[other.start() : other.end()] = [True] * len(other[0])
    for part in known:
        start = message.find(part)
        while start >= 0:
            end = start + len(part)
            if not message[start - 1 : start].isalnum() and not message[end : end + 1].isalnum():
                covered[start:end] = [True] * len(part)
            start = message.find(part, start + 1)
    runs, run = [], []
    for word in [*re.finditer(r"\S+", message), None]:
        plain = word is not None and re.fullmatch(r"[A-Za-z][a-z'-]{2,}[,.;:]?", word[0])
        if plain and not all(covered[word.start() : word.end() - (not word[0][-1].isalpha())]):
            run.append(word[0])
            continue
        if len(run) >= RUN:
            runs.append(" ".join(run))
        run = []
    return runs


def test_every_message_stands_in_the_code():
    known = texts()
    lines = [line.strip() for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("    ")]
    messages = [line for line in lines if not line.startswith("$")]
    assert len(messages) > 400
    found = {message: runs for message in messages if (runs := unknown(message, known))}
    assert found == {}
    assert unknown("driftlab: a.yaml:11: the yardstick flatters quickly", known) == ["the yardstick flatters quickly"]


def test_the_list_of_all_messages_is_that_of_the_source():
    """`python docs/reference/make_errors.py` changes nothing."""
    spec = importlib.util.spec_from_file_location("make_errors", PAGE.with_name("make_errors.py"))
    spec.loader.exec_module(module := importlib.util.module_from_spec(spec))
    made = module.lines()
    assert made.count("\n| `") > 450
    assert "| `{file}: no column holds numbers: " in made
    assert PAGE.read_text(encoding="utf-8").endswith(made)
