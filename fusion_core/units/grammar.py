"""The grammar of written quantities and units; no text is ever evaluated.

::

    quantity = number [unit]                            3.18 deg/h/sqrt(Hz)
    number   = [+-] digits [. digits] [e [+-] digits]   -20.5, .5, 5e-4
    unit     = [1 /] power {[* · / per] power}          m/s^2, rad s-1, 1/K
    power    = base [exponent]
    base     = name | sqrt(unit) | √base | (unit)       Hz, √Hz, (deg/s)
    exponent = ^n | **n | n behind a name | ² ³ ⁻¹      n = 2, -1, 0.5, (1/2)

Read from left to right, a space stands for a product, and all the text is one or the other: a decimal comma, a second
number, an expression or a comment is an error. Length, depth and exponents are bounded, so the time is too. What the
names mean is not known here.
"""

from __future__ import annotations

import re
from fractions import Fraction
from typing import NamedTuple

from fusion_core.errors import UnitError, quote

LONGEST = 120  # characters of a text
DEEPEST = 8  # parentheses within one another
HIGHEST = 9  # exponent, written or multiplied out

NUMBER = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")
Unit = dict[str, Fraction]  # names and their exponents
Token = tuple[str, str]  # kind and text

_SUPERSCRIPTS = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
_SPACE = " \t\u00a0"
_LETTER = r"(?:[^\W\d⁰¹²³⁴-⁹]|[°%])"
_TOKENS = re.compile(
    r"(?P<root>√|sqrt(?=[ ]?\())"
    r"|(?P<per>/|per(?![^\W\d_]))"
    r"|(?P<power>(?:\^|\*\*)[ ]?(?:[+-]?[0-9]+(?:\.[0-9]+)?|\([+-]?[0-9]+(?:\.[0-9]+|/[0-9]+)?\))|[⁺⁻]?[⁰¹²³⁴-⁹]+)"
    r"|(?P<times>[*·⋅])"
    rf"|(?P<name>{_LETTER}(?:{_LETTER}|[0-9])*(?:(?<=[^\W\d])-[0-9]+)?)"
    r"|(?P<bracket>[()])"
)
_PLAIN_POWER = re.compile(r"([^0-9-]*[^0-9_-])(-?[0-9]+)")  # m2, s-1; not g_0, nor mH2O


class Number(NamedTuple):
    """A number in front of a text, and what follows it, without the space between."""

    value: float
    rest: str


def read_quantity(text: str) -> tuple[float, Unit]:
    """Read `number unit`, or a number alone.

    Raises
    ------
    UnitError
        If the text is anything else; the message says what was read and what to write.
    """
    number = read_number(text)
    return number.value, read_unit(number.rest, text) if number.rest else {}


def read_scaled_unit(text: str) -> tuple[float, Unit]:
    """Read a unit that may carry a factor, as in `0.5 mrad/s`; raises UnitError."""
    plain = _bounded(text).strip()
    if plain == "1" or not NUMBER.match(plain):
        return 1.0, {} if plain == "1" else read_unit(plain)
    number = read_number(plain)
    if number.value == 0:
        raise UnitError(f"'{quote(text)}' is zero times a unit; write the size of one step, e.g. '0.5 mrad/s'")
    return number.value, read_unit(number.rest, text) if number.rest else {}


def read_number(text: str) -> Number:
    """Read the number in front of a text; raises UnitError where there is none, or it has no end."""
    plain = _bounded(text).strip()
    match = NUMBER.match(plain)
    if match is None:
        if re.match(r"[+-]?(nan|inf)", plain, re.IGNORECASE):
            raise UnitError(f"'{quote(text)}' is not a finite number; write a number and a unit, e.g. '0.1 s'")
        raise _wrong(text, f"it begins with '{quote(plain[:1])}' and not with a number", "write e.g. '0.1 s'")
    value, rest = float(match[0]), plain[match.end() :]
    if abs(value) == float("inf") or (value == 0 and re.search("[1-9]", re.split("[eE]", match[0])[0])):
        raise _wrong(text, f"{match[0]} is beyond the numbers of a computer", "write one like 5e-4")
    _check_end(text, match[0], rest)
    return Number(value, rest.lstrip(_SPACE))


def _check_end(text: str, number: str, rest: str) -> None:
    """Raise UnitError where what follows the number is more of a number."""
    after = rest.lstrip(_SPACE)
    if rest[:1] == ",":
        raise _wrong(
            text, f"a comma follows the number {number}", "write a decimal point, and nothing between thousands"
        )
    if rest[:1] in {".", "_", "'", "’"}:
        raise _wrong(text, f"'{rest[0]}' follows the number {number}", "write one number with one decimal point")
    if after[:1] in {"*", "+", "-", "^", ":"}:
        advice = "expressions are not worked out, write their value and a unit"
        raise _wrong(text, f"'{quote(after[:3])}' follows the number {number}", advice)
    again = after[:1].isnumeric() or after[:1] in {".", ","}
    if again and not re.match(rf"1[{_SPACE}]?/", after):
        raise _wrong(text, f"'{quote(after[:12])}' follows the number {number}", "write one number without spaces")


def read_unit(text: str, whole: str | None = None) -> Unit:
    """Read a unit: each name in it with its exponent.

    Parameters
    ----------
    text : str
        Of the unit.
    whole : str, optional
        What the unit is a part of, for the messages.

    Raises
    ------
    UnitError
        If the text is not a unit of the grammar.
    """
    return _Reader(_bounded(text).strip(), text if whole is None else whole).read()


class _Reader:
    """The tokens of a unit on their way into products."""

    def __init__(self, text: str, whole: str) -> None:
        self.whole, self.at = whole, 0
        self.tokens = self._tokens(text)

    def _tokens(self, text: str) -> list[Token]:
        """Split the text; spaces are left out."""
        tokens: list[Token] = []
        at = 0
        one = re.match(rf"1[{_SPACE}]*/", text)
        if one:  # 1/s
            tokens, at = [("per", "/")], one.end()
        while at < len(text):
            if text[at] in _SPACE:
                at += 1
                continue
            match = _TOKENS.match(text, at)
            if match is None or match.lastgroup is None:
                advice = "write products and quotients of units, e.g. 'deg/h/sqrt(Hz)' or 'm/s^2'"
                raise _wrong(self.whole, f"'{quote(text[at : at + 12])}' is no part of a unit", advice)
            kind, part = match.lastgroup, match[0]
            plain = _PLAIN_POWER.fullmatch(part) if kind == "name" else None
            tokens += [("name", plain[1]), ("power", plain[2])] if plain else [(kind, part)]
            at = match.end()
        return tokens

    def read(self) -> Unit:
        """Read all of it."""
        if not self.tokens:
            raise _wrong(self.whole, "there is no unit", "write one like deg/s")
        unit = self._product(0, {} if self._next() == "per" else self._power(0))  # 1/s, 5 /s
        if self.at < len(self.tokens):
            raise _wrong(self.whole, "a ')' has no '('", "write as many of the one as of the other")
        return unit

    def _next(self) -> str | None:
        return self.tokens[self.at][0] if self.at < len(self.tokens) else None

    def _product(self, depth: int, unit: Unit) -> Unit:
        """Multiply by what follows, up to a closing bracket or the end."""
        while self.at < len(self.tokens) and self.tokens[self.at][1] != ")":
            sign = 1
            if self._next() in {"per", "times"}:
                sign = -1 if self._next() == "per" else 1
                self.at += 1
            factor = self._power(depth)
            for name, exponent in factor.items():
                unit[name] = self._checked(unit.get(name, Fraction(0)) + sign * exponent)
        return unit

    def _power(self, depth: int) -> Unit:
        base = self._base(depth)
        if self._next() != "power":
            return base
        text = self.tokens[self.at][1].lstrip("^*").strip(" ()").translate(_SUPERSCRIPTS)
        self.at += 1
        if len(text) > 5:
            self._checked(Fraction(HIGHEST + 1))
        return self._raised(base, self._exponent(text))

    def _exponent(self, text: str) -> Fraction:
        try:
            return self._checked(Fraction(text))
        except ZeroDivisionError:
            raise _wrong(self.whole, f"the exponent {text} divides by zero", "write one like 1/2") from None

    def _base(self, depth: int) -> Unit:
        if depth > DEEPEST:
            raise _wrong(self.whole, f"parentheses are more than {DEEPEST} deep", "write it with fewer")
        kind, text = self.tokens[self.at] if self.at < len(self.tokens) else ("end", "")
        self.at += 1
        if kind == "name":
            return {text: Fraction(1)}
        if kind == "root":
            return self._raised(self._base(depth + 1), Fraction(1, 2))
        if text == "(":
            unit = self._product(depth + 1, self._power(depth + 1))
            if self._next() is None:  # a product goes up to a ')' or to the end
                raise _wrong(self.whole, "a '(' has no ')'", "write as many of the one as of the other")
            self.at += 1
            return unit
        where = "at the end" if kind == "end" else f"where '{quote(text)}' stands"
        raise _wrong(self.whole, f"the name of a unit is missing {where}", "write e.g. 'deg/h/sqrt(Hz)' or 'm/s^2'")

    def _raised(self, unit: Unit, exponent: Fraction) -> Unit:
        return {name: self._checked(power * exponent) for name, power in unit.items()}

    def _checked(self, exponent: Fraction) -> Fraction:
        if abs(exponent) > HIGHEST or exponent.denominator > HIGHEST:
            raise _wrong(self.whole, f"an exponent is beyond -{HIGHEST} to {HIGHEST}", "write a unit of physics")
        return exponent


def _bounded(text: str) -> str:
    if len(text) > LONGEST:
        raise UnitError(
            f"'{quote(text)}' has {len(text)} characters, a quantity has at most {LONGEST}; write a number and a unit"
        )
    return text


def _wrong(text: str, why: str, advice: str) -> UnitError:
    return UnitError(f"'{quote(text)}' is not a quantity, {why}; {advice}")
