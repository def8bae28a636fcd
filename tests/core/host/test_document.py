"""YAML of any kind: a config, or one readable line that says where; never a traceback, never minutes."""

import time
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from driftlab.config import Config, products
from fusion_core.errors import ConfigError
from fusion_core.host.config import read_document, validate
from fusion_core.host.document import parse

BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + k)}: &{chr(98 + k)} [{', '.join(['*' + chr(97 + k)] * 10)}]\n" for k in range(9)
)
BASE = "extends: mems_crs05\n"
SERIAL = (
    f"{BASE}source: {{kind: serial, port: p, interval: 1 s, "
    "framing: {kind: text, channels: {gyro: {path: a, unit: deg/s}}}, "
)
FOLLOWING = (
    f"{BASE}filter: {{gyro: {{bias: {{kind: thermal_derivative, walk: 1 deg/h/sqrt(s), map: {{kind: spline}}, "
    "effects: [{kind: hysteresis, "
)


def load(path, text):
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return validate(Config, read_document(path, products()))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nfilter: &a {gyro: *a}", r":2: an alias stands within its own anchor"),
        ("filter: &a [*a]", r":1: an alias stands within its own anchor"),
        (BOMB, r"with its aliases written out it holds more than 20000 values"),
        ("latitude: !!python/object/apply:os.system ['ls']", r":1: has the tag '!!python/object/apply:os"),
        ("latitude: !foo 3", r":1: has the tag '!foo'; remove it"),
        ("filter: !!set {a, b}", r":1: has the tag '!!set'"),
        ("latitude: !!binary aGVsbG8=", r":1: has the tag '!!binary'"),
        ("filter: {align: !!int abc}", r":1: 'abc' is not a plain integer"),
        ("filter: {align: !!float abc}", r":1: 'abc' is not a plain, finite number"),
        ("\nfilter: {align: .inf}", r":2: '\.inf' is not a plain, finite number"),
        ("filter: {align: .nan}", r":1: '\.nan' is not a plain, finite number"),
        (BASE + "filter: {rest: {false_alarm: nan}}", r":2: filter\.rest\.false_alarm: Input should be"),
        (FOLLOWING + "estimate: true, sigma: ['nan', 1, 1]}]}}}", r"sigma\.0: Input should be a finite number"),
        (FOLLOWING + "estimate: true, sigma: [-1, 1, 1]}]}}}", r"sigma\.0: Input should be greater than or"),
        (FOLLOWING + "coefficients: [1.0e+300, 1, 1]}]}}}", r"coefficients\.0: Input should be less"),
        (SERIAL + "baudrate: 1180591620717411303424}", r":2: source\..*baudrate: Input should be"),
        (SERIAL + "baudrate: 1_000}", r":2: '1_000' is not a plain integer"),
        (SERIAL + "baudrate: 010}", r":2: '010' is not a plain integer"),
        (SERIAL + "baudrate: 1:30}", r":2: '1:30' is not a plain integer"),
        (SERIAL + f"baudrate: {'9' * 5000}" + "}", r":2: '99999.*\.\.\.' is not a plain integer"),
        ("latitude: 2026-01-01", r":1: latitude: '2026-01-01' is not a quantity"),
        ("2026-01-01: 3", r":1: 2026-01-01: unknown key"),
        ("? [a, b]\n: 3", r":1: a mapping or a list is a key; write a name"),
        ("? {a: b}\n: 3", r":1: a mapping or a list is a key"),
        ("1: 3", r":1: 1: unknown key"),
        ("~: 3", r":1: ~: unknown key"),
        ("filter: {<<: {a: 1}}", r":1: '<<' does not merge here"),
        ("heading: 1 deg\nlatitude: 1 deg\nheading: 2 deg", r":3: key 'heading' is written twice, on line 1 and here"),
        ("filter: " + "[" * 5000 + "]" * 5000, r":1: is more than 32 levels deep"),
        ("".join(" " * k + "a:\n" for k in range(200)), r":32: is more than 32 levels deep"),
        ("filter: [" + "1," * 30_000 + "]", r"holds more than 20000 values"),
        ("a: " + "x" * 300_000, r"has more than 256 kB"),
        ("a: 1\nb: a\0b", r":2: has the character U\+0000"),
        ('latitude: "a\\0b"', r":1: has the character U\+0000"),
        ('latitude: "\\ud800"', r":1: has the character U\+D800"),
        ('latitude: "\\U00110000"', r"has an escape in quotes that is no character"),
        ('serial: "a\\nb"', r":1: serial: a text goes over several lines; write it on one"),
        ('"a\\u2028b": 1', r":1: a text goes over several lines"),
        ("a: \x1b[31m", r":1: has the character U\+001B"),
        (b"a: 1\nlatitude: \xff", r":2: is not UTF-8 text; save it as UTF-8"),
        ("latitude: 3 deg".encode("utf-16"), r":1: is not UTF-8 text"),
        ("a: 1\n---\nb: 2", r":2: is not YAML \(but found another document\)"),
        ("%FOO\n", r"is not YAML"),
        ("", r"is not a mapping of keys to values"),
        ("filter: {gyro: 3}", r":1: filter\.gyro: is not a mapping of keys to values; write its keys"),
        ("extends: " + "a" * 5000, r"extends: 'aaa.*\.\.\.' is neither a packaged product nor a file"),
        ("extends: [a, b]", r"is neither a packaged product nor a file"),
        ("extends: .", r"is neither a packaged product nor a file"),
        (BASE + "filter: {gyro: {bias: {kind: [a]}}}", r":2: filter\.gyro\.bias: kind '\['a'\]' is not inst"),
        (BASE + "filter: {gyro: {bias: {axes: [x, x]}}}", r"names x, x, each one once was expected"),
        (BASE + "filter: {gyro: {calibration: {kind: spline, path: 3}}}", r"3 is a number, a path is text"),
        (
            BASE + "filter: {gyro: {calibration: {kind: spline, path: " + "a" * 5000 + "}}}",
            r"cannot be a path; write a shorter one",
        ),
        (BASE + "filter: {align: 1e308 s}", r"align: '1e308 s' is not a size that can be meant, 1e-09 to 1e"),
        (BASE + "filter: {align: 1e-308 s}", r"align: '1e-308 s' is not a size that can be meant"),
        (BASE + "filter: {gyro: {noise: true}}", r"True has no unit; write e\.g\. '3\.18 deg/h/sqrt\(Hz\)'"),
        (BASE + "filter: {gyro: {noise: [[1 deg]]}}", r"has no unit; write e\.g\."),
    ],
)  # fmt: skip
def test_a_hostile_config_is_refused_in_readable_lines(tmp_path, text, message):
    begun = time.process_time()
    with pytest.raises(ConfigError, match=message) as error:
        load(tmp_path / "config.yaml", text)
    assert time.process_time() - begun < 5.0
    for line in str(error.value).splitlines():
        assert len(line) < 600
        assert line.isprintable()


@pytest.mark.parametrize("char", list("[{&?-!|:\"'%*#,>@` \n\t~<"))
@pytest.mark.parametrize("after", ["", " ", "a", " a,"])
def test_a_quarter_of_a_megabyte_of_anything_is_answered_at_once(tmp_path, char, after):
    text = "filter: " + (char + after) * (200_000 // len(char + after))
    begun = time.process_time()
    with suppress(ConfigError):  # a comment is none
        load(tmp_path / "config.yaml", text)
    assert time.process_time() - begun < 5.0


@given(
    st.lists(
        st.sampled_from([*"abc:,-?[]{}&*!|>'\"%#\n \t", "\n  ", ": ", "- ", "&a ", "*a", "<<", "!!int ", "1e9"]),
        max_size=60,
    )
)
def test_any_text_is_a_config_or_a_config_error(tmp_path_factory, parts):
    path = tmp_path_factory.getbasetemp() / "any.yaml"
    path.write_text("".join(parts), encoding="utf-8")
    try:
        parse(path)
    except ConfigError as error:
        if str(path) not in str(error):
            raise


def test_aliases_and_plain_values_are_read(tmp_path):
    path = tmp_path / "config.yaml"
    path.write_text("﻿a: &x {n: -3, f: 2.5, t: yes, u: null, d: 2026-01-01, s: '1_000', e: 1e-7}\nb: [*x, 0]\n")
    data, lines = parse(path)
    assert data["b"][0] == data["a"]
    assert data["a"] == {"n": -3, "f": 2.5, "t": True, "u": None, "d": "2026-01-01", "s": "1_000", "e": "1e-7"}
    assert lines["b", 1] == (path, 2)


def test_a_chain_of_configs_ends(tmp_path):
    for k in range(1500):
        (tmp_path / f"c{k}.yaml").write_text(f"extends: c{k + 1}.yaml")
    with pytest.raises(ConfigError, match="is the end of more than 32 configs that extend one another"):
        read_document(tmp_path / "c0.yaml")


@pytest.mark.parametrize(
    ("name", "message"), [("", "Is a directory"), ("none.yaml", "No such file"), ("x" * 5000, "cannot")]
)
def test_what_is_no_file(tmp_path, name, message):
    with pytest.raises(ConfigError, match=message):
        read_document(tmp_path / name if name else tmp_path)
