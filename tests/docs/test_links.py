"""Every link, anchor and image of README, the docs and the examples points at something that is there."""

import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted({*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "examples").rglob("*.md")})
CODE = re.compile(r"^```.*?^```$|^(?:    [^\n]*\n)+|`[^`\n]+`", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"!?\[(?:[^][]|\[[^]]*\])*\]\(([^)\s]+)\)")


@cache
def anchors(page):
    """Return the anchors of a page's headings, as GitHub and MyST make them."""
    text = re.sub(r"^```.*?^```$", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)
    found = []
    for heading in re.findall(r"^#{1,6} +(.+?) *$", text, re.MULTILINE):
        plain = re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", heading).lower()
        found.append(re.sub(r"[^\w\- ]", "", plain).replace(" ", "-"))
    return {f"{name}-{found[:k].count(name)}" if name in found[:k] else name for k, name in enumerate(found)}


def broken(page, text):
    """Yield the links of a page's text that lead nowhere."""
    for link in LINK.findall(CODE.sub("", text)):
        if re.match(r"\w+:", link):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            yield link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    assert list(broken(page, page.read_text(encoding="utf-8"))) == []


def test_links_that_lead_nowhere_are_seen():
    page = ROOT / "docs" / "README.md"
    wrong = "[a](nope.md), [b](how-to/read_your_files.md#nope), ![c](images/no.png), [`d`](../nope.py), [e](#nope)"
    right = "[f](how-to/read_your_files.md), [g](../LICENSE), [h](https://example.org/x#y), `[i](nope.md)`"
    assert list(broken(page, f"{wrong}\n{right}")) == re.findall(r"\((\S+?)\)", wrong)
