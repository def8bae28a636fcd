"""The grammar of a quantity, independently of the program: a number, a unit, and nothing else.

::

    quantity = number unit              number = -20.5, 5e-4, ...
    unit     = factor {("*" | "/" | " ") factor}      factor = word[exponent] | "sqrt(" unit ")" | "(" unit ")"

A text that is none must not be accepted; one whose words are all known here must have the value that is computed here.
"""

from __future__ import annotations

import math
import re

NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?", re.ASCII)
WORD = re.compile(r"[A-Za-zµμ°Ω%]+(?:_[A-Za-z]+)*")
EXPONENT = re.compile(r"(?:\^|\*\*)?([+-]?\d+(?:\.\d+)?)|(?:\^|\*\*)\(([+-]?\d+(?:\.\d+)?)\)|([²³])", re.ASCII)
Value = tuple[float, dict[str, float]]  # size in SI, exponents of the base units

G = 9.80665
WORDS: dict[str, Value] = {
    "rad": (1, {"rad": 1}), "deg": (math.pi / 180, {"rad": 1}), "degree": (math.pi / 180, {"rad": 1}),
    "arcsec": (math.pi / 648_000, {"rad": 1}), "arcmin": (math.pi / 10_800, {"rad": 1}),
    "s": (1, {"s": 1}), "min": (60, {"s": 1}), "h": (3600, {"s": 1}), "hour": (3600, {"s": 1}), "day": (86_400,
    {"s": 1}),
    "m": (1, {"m": 1}), "Hz": (1, {"s": -1}), "g": (G, {"m": 1, "s": -2}), "K": (1, {"K": 1}), "V": (1, {"V": 1}),
    "Pa": (1, {"Pa": 1}), "degC": (1, {"K": 1}), "degF": (5 / 9, {"K": 1}),
}  # fmt: skip
PREFIXED = ("rad", "s", "m", "g", "V", "Hz", "K", "Pa")
PREFIXES = {"m": 1e-3, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "n": 1e-9, "k": 1e3}
NOT_HERE = {"min", "h", "kg"}  # a prefix and a word, and yet another word


class NotAQuantity(ValueError):
    """The text is not a number and a unit."""


class NotKnown(ValueError):
    """A word of the unit is not in the table here."""


def number(text: str) -> float | None:
    """Return the number that the whole text is, or None."""
    return float(text) if NUMBER.fullmatch(text) else None


def quantity(text: str) -> Value:
    """Return a quantity in SI, an offset temperature in degC; raises NotAQuantity, NotKnown."""
    text = text.strip()
    found = NUMBER.match(text)
    if found is None:
        raise NotAQuantity(text)
    unit = text[found.end() :].strip()
    if not unit:
        return float(found[0]), {}
    size, powers = _unit(unit)
    offset = -32 * 5 / 9 if unit in ("degF", "°F") else 0.0
    return float(found[0]) * size + offset, powers


def unit_with_factor(text: str) -> Value:
    """Return what 1 of a unit is that may carry a factor, as in `0.5 mrad/s`; its zero is not looked at."""
    text = text.strip()
    found = NUMBER.match(text)
    rest = text[found.end() :].strip() if found else text
    size, powers = _unit(rest) if rest else (1.0, {})
    return (float(found[0]) if found else 1.0) * size, powers


def _unit(text: str) -> Value:
    value, rest = _product(text.strip())
    if rest:
        raise NotAQuantity(text)
    return value


def _product(text: str) -> tuple[Value, str]:
    (size, powers), rest = _factor(text)
    while rest and rest[0] != ")":
        sign = -1 if rest.lstrip()[:1] == "/" else 1
        rest = re.sub(r"^(?:\s*[*/·]\s*|\s+)", "", rest, count=1)
        (more, others), rest = _factor(rest)
        size *= more**sign
        powers = {name: powers.get(name, 0) + sign * others.get(name, 0) for name in {**powers, **others}}
    return (size, {name: power for name, power in powers.items() if power}), rest


def _factor(text: str) -> tuple[Value, str]:
    root = text.startswith(("sqrt(", "√("))
    if root or text.startswith("("):
        value, rest = _product(text.partition("(")[2].strip())
        if not rest.startswith(")"):
            raise NotAQuantity(text)
        rest, power = rest[1:], 0.5 if root else 1.0
    elif text.startswith("1/"):
        return (1.0, {}), text[1:]
    else:
        found = WORD.match(text.removeprefix("√"))
        if found is None:
            raise NotAQuantity(text)
        value, rest = _word(found[0]), text.removeprefix("√")[found.end() :]
        power = 0.5 if text.startswith("√") else 1.0
    if found := EXPONENT.match(rest):
        power *= {"²": 2.0, "³": 3.0}[found[3]] if found[3] else float(found[1] or found[2])
        rest = rest[found.end() :]
    return (value[0] ** power, {name: p * power for name, p in value[1].items()}), rest


def _word(word: str) -> Value:
    word = {"°C": "degC", "°F": "degF", "°": "deg"}.get(word, word)
    if word in WORDS:
        return WORDS[word]
    prefix, base = word[:1], word[1:]
    if word not in NOT_HERE and prefix in PREFIXES and base in PREFIXED:
        return PREFIXES[prefix] * WORDS[base][0], WORDS[base][1]
    raise NotKnown(word)
