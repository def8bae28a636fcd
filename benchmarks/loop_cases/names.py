"""Scoring of the effects that an answer names: those of the same physics count alike.

An answer is *right* where it is the truth or cannot differ from it in shape; *related* where channel and physics are
right and the shape is not; anything else that was added is *false*.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

Effect = Mapping[str, Any]  # as in loop.json
FAST = 200.0  # s; a lag shorter than this is a rate, and a rate such a lag
NEAR = 4.0  # within this factor, time constants of memories are the same
_SECONDS = {"s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0, "d": 86_400.0}


@dataclass(frozen=True)
class Pattern:
    """Effects of a kind, about a channel (None: any), with a hyper-parameter (SI) from `low` to `high`."""

    kind: str
    channel: str | None = None
    low: float = 0.0
    high: float = float("inf")
    form: str | None = None  # what the parameter `form` must not be

    def fits(self, effect: Effect) -> bool:
        """Return True if the effect is one of these; a hyper-parameter that is not given fits."""
        if self.kind not in (effect["kind"], "*"):
            return False
        if self.channel is not None and not _about(self.channel, str(effect.get("channel", ""))):
            return False
        parameters = effect.get("parameters", {})
        if self.form is not None and parameters.get("form") == self.form:
            return False
        value = next((_si(parameters[name]) for name in ("tau", "period", "width") if name in parameters), None)
        return value is None or self.low <= value <= self.high


@dataclass(frozen=True)
class Truth:
    """An effect in a recording, in words, and the answers that name it."""

    name: str
    right: tuple[Pattern, ...]
    related: tuple[Pattern, ...] = ()
    unexplained: str = ""  # the grade of saying that something is left which has no name


@dataclass(frozen=True)
class Named:
    """Counts of true effects that were named, of those named by a relative, and the false ones."""

    right: int
    related: int
    false: tuple[str, ...]


def _about(expected: str, channel: str) -> bool:
    """Return True if the channel, or the product of channels, is the expected one."""
    return sorted(expected.split("*")) == sorted(channel.split("*"))


def _si(text: str) -> float:
    number, _, unit = str(text).partition(" ")
    return float(number) * _SECONDS.get(unit, 1.0)


def shown(effect: Effect) -> str:
    """Return an effect of loop.json in words."""
    words = [f"{effect['kind']}"]
    if effect.get("channel") not in (None, "time", "temperature"):
        words.append(f"of {effect['channel']}")
    words += [str(v) for k, v in effect.get("parameters", {}).items() if k in ("tau", "period", "width", "form")]
    return " ".join(words)


def _rivals(effect: Effect) -> list[dict[str, str]]:
    """Return the effects that one could not be distinguished from, without parameters."""
    parts = [str(name).partition(" of ") for name in effect.get("indistinguishable_from", [])]
    return [{"kind": kind, **({"channel": channel} if channel else {})} for kind, _, channel in parts]


def judge(content: Mapping[str, Any], truths: Sequence[Truth], tolerated: Sequence[Pattern]) -> Named:
    """Return the score of the effects of loop.json; each names one true effect at most."""
    left = list(content["effects"])
    found = {"right": 0, "related": 0}
    open_ = list(truths)
    for grade in ("right", "related"):
        for truth in tuple(open_):
            match = next((e for e in left if _matches(e, truth, grade)), None)
            silent = truth.unexplained == grade and content["verdict"] == "unexplained"
            if match is None and not silent:
                continue
            open_.remove(truth)
            found[grade] += 1
            if match is not None:
                left.remove(match)
    false = [e for e in left if not any(pattern.fits(e) for pattern in tolerated)]
    return Named(found["right"], found["related"], tuple(map(shown, false)))


def _matches(effect: Effect, truth: Truth, grade: str) -> bool:
    if any(pattern.fits(effect) for pattern in getattr(truth, grade)):
        return True
    rivals = _rivals(effect) if grade == "related" else []
    return any(_loose(pattern, rival) for rival in rivals for pattern in truth.right)


def _loose(pattern: Pattern, rival: Effect) -> bool:
    return pattern.kind == rival["kind"] and ("channel" not in rival or pattern.channel in (None, rival["channel"]))


def _late(channel: str, low: float = 0.0, high: float = float("inf")) -> tuple[Pattern, ...]:
    """Return every name of a memory of a channel with tau from low to high."""
    own = (Pattern("thermal_lag", None, low, high),) if channel == "temperature" else ()
    return (Pattern("relaxation", channel, low, high), *own)


def memory(tau: float) -> Truth:
    """c (T - lag T), or a map that is a straight line and late."""
    right = _late("temperature", tau / NEAR, tau * NEAR)
    if tau < FAST:
        right = (*_late("temperature", high=max(FAST, tau * NEAR)), Pattern("thermal_rate"))
    return Truth(f"relaxation {tau:.4g} s", right, (*_late("temperature"), Pattern("thermal_rate")))


def late_map(tau: float) -> Truth:
    """A curved map that sees a late temperature."""
    right = (Pattern("thermal_lag", None, tau / NEAR, tau * NEAR),)
    return Truth(f"thermal_lag {tau:.4g} s", right, (*_late("temperature"), Pattern("thermal_rate")))


def rate() -> Truth:
    right = (Pattern("thermal_rate"), *_late("temperature", high=FAST))
    return Truth("thermal_rate", right, _late("temperature"))


def play(width: float) -> Truth:
    return Truth(f"hysteresis {width:.3g} K", (Pattern("hysteresis"),))


def turn_on(tau: float) -> Truth:
    return Truth(f"turn_on {tau:.4g} s", (Pattern("turn_on"),), (Pattern("drift"),))


def drift() -> Truth:
    return Truth("drift", (Pattern("drift"),), (Pattern("turn_on", low=3600.0),))


def line(period: float) -> Truth:
    return Truth(f"periodic {period:.4g} s", (Pattern("periodic", None, 0.97 * period, 1.03 * period),))


def _any_of(*channels: str) -> tuple[Pattern, ...]:
    """Return any effect of these channels: the right channel, in another shape."""
    products = [Pattern("interaction", f"{a}*{b}") for a in channels for b in (*channels, "temperature")]
    return (*(Pattern("*", channel) for channel in channels), *products)


def linear(channel: str) -> Truth:
    right = (Pattern("channel", channel), Pattern("curve", channel), Pattern("interaction", f"{channel}*{channel}"))
    return Truth(f"channel {channel}", right, _any_of(channel))


def square(channel: str) -> Truth:
    right = (Pattern("interaction", f"{channel}*{channel}"), Pattern("curve", channel))
    return Truth(f"{channel} squared", right, _any_of(channel))


def product(a: str, b: str) -> Truth:
    return Truth(f"interaction {a}*{b}", (Pattern("interaction", f"{a}*{b}"),), _any_of(a))


def late_channel(channel: str, tau: float) -> Truth:
    name = f"{channel} late by {tau:.4g} s"
    return Truth(name, _late(channel), _any_of(channel), unexplained="related")


def difference(channel: str) -> Truth:
    right = (Pattern("thermal_gradient", channel), Pattern("channel", channel), Pattern("curve", channel))
    return Truth(f"thermal_gradient of {channel}", right, _any_of(channel))


def shupe(channel: str) -> Truth:
    related = (Pattern("thermal_gradient", channel), *_any_of(channel))
    return Truth(f"rate of {channel} - T", (Pattern("thermal_gradient", channel, form="difference"),), related)


def curve(channel: str = "temperature") -> Truth:
    """A map that was not declared, or too stiff."""
    right = (Pattern("curve", channel), Pattern("map_misfit", channel), Pattern("channel", channel))
    return Truth(f"curve of {channel}", right, (Pattern("interaction", f"{channel}*{channel}"),))


def nameless(name: str) -> Truth:
    return Truth(name, (), (), unexplained="right")
