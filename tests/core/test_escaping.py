"""Each target's escaping, held against a reader of the target."""

import csv
import io
import json
import re

import pytest
import yaml
from hypothesis import example, given
from hypothesis import strategies as st

from fusion_core.escaping import (
    c_comment,
    comment,
    csv_cell,
    csv_comment,
    is_plain,
    json_of,
    json_text,
    line,
    lines,
    matlab_name,
    script_json,
    yaml_text,
)

ANY = st.text(st.characters(codec=None), max_size=40)
ENCODED = st.text(max_size=40)  # no halves of characters


@pytest.mark.parametrize(
    "text", ["gyro", "a b", "°C", "µ", "漢字", "10 deg/h", "x*/y", "a\N{NO-BREAK SPACE}b", "\N{GRINNING FACE}"]
)
def test_what_can_be_seen_stays(text):
    assert line(text) == text
    assert is_plain(text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a\nb", r"a\x0ab"), ("\x1b[31m", r"\x1b[31m"), ("\x85", r"\x85"), ("\u2028", r"\u2028"), ("\u202e", r"\u202e"),
        ("\u200b", r"\u200b"), ("\ud800", r"\ud800"), ("\U000e0041", r"\U000e0041"), ("\x00", r"\x00"), ("\t", r"\x09"),
    ],
)  # fmt: skip
def test_what_cannot_be_seen_is_told_by_its_code(text, said):
    assert line(text) == said
    assert not is_plain(text)


@given(ANY)
def test_a_text_is_one_line(text):
    for found in (line(text), comment(text), csv_comment(text), c_comment(text), yaml_text(text)):
        assert len(found.splitlines()) <= 1
        found.encode()
    assert lines(text).count("\n") == text.count("\n")


@given(ENCODED)
@example("yes")
@example("a: b # c")
@example("\x85\u2028\ufeff\U000e0041\x7f\x00")
def test_yaml_gives_the_text_again(text):
    assert yaml.safe_load(f"a: {yaml_text(text)}  # b\nc: {{d: {yaml_text(text)}}}") == {"a": text, "c": {"d": text}}
    assert yaml.safe_load(f"{yaml_text(text)}: 1") == {text: 1}


@given(ANY)
@example("=1+1")
@example(' "=1+1')
@example("a,=1+1")
@example('a,"b')
def test_a_cell_is_one_and_no_formula(text):
    (row,) = csv.reader(io.StringIO(f"{csv_cell(text)},2\n", newline=""))
    assert len(row) == 2
    assert not re.match(r"\s*[=+@-]", row[0])
    rows = list(csv.reader(io.StringIO(f"{csv_comment(text)}\n1,2\n", newline="")))
    assert rows[-1] == ["1", "2"]
    assert len(rows) == 2
    assert not any(re.match(r"\s*[=+@-]", cell) for part in rows[0] for cell in part.split(";")[1:])
    assert not any(re.match(r"\s*[=+@-]", cell) for cell in rows[0])


@given(ANY)
@example("*/")
@example("**//**//")
@example("???/")
@example("a\\")
def test_a_comment_of_c_ends_where_it_should(text):
    whole = f"/* {c_comment(text)}\n * {c_comment(text)} */"
    assert "??" not in whole
    assert whole.count("/*") == whole.count("*/") == 1
    assert "\\\n" not in whole


@given(ANY)
@example("end")
@example("1a")
def test_a_name_of_matlab(text):
    assert re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,62}", matlab_name(text))
    assert matlab_name("end") == "s_end"


@given(ENCODED)
def test_json_gives_the_text_again(text):
    for found in (json_text(text), script_json(text), json_of(json.dumps(text, ensure_ascii=False))):
        assert json.loads(found) == text
        assert found.isascii()
        assert "\x7f" not in json_text(text)
    assert "<" not in script_json(text)
