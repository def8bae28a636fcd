"""Request for a plan: the chamber and its range, from the options of the command and the config."""

from __future__ import annotations

import re
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np

from driftlab.config import Config
from driftlab.planning.chamber import Chamber
from driftlab.planning.unit_model import UnitModel, fitted_map, twin_of
from driftlab.units import BiasUnit, tracked_unit
from fusion_core.chunk import Array
from fusion_core.contracts import Twin
from fusion_core.errors import ConfigError, UnitError, quote
from fusion_core.faults import RANGES
from fusion_core.units import LIMITS, to_si
from fusion_core.units.grammar import NUMBER

RATE, LAG, START = "2 K/min", "10 min", "25 degC"
HOURS = (0.01, 10_000.0)

Range = str | tuple[float, float] | None


class PlanRequest(NamedTuple):
    """Chamber, unit that is planned for, sigma to reach (SI), and source of the body's lag."""

    chamber: Chamber
    subject: UnitModel
    target: float | None
    lag_of: str


def parse_request(
    config: Config, *, range: Range = None, rate: str | None = None, lag: str | None = None,
    start: str | None = None, walk: str | None = None, sigma: str | None = None, kind: str | None = None,
) -> PlanRequest:  # fmt: skip
    """Return the request of the options, with the values of the config where an option is None.

    Raises
    ------
    ConfigError
        If a value cannot be meant, or neither option nor config has one that is needed.
    """
    unit = tracked_unit(config.filter)
    subject = UnitModel.of(config, kind, None if walk is None else _walk(walk, unit))
    twin = twin_of(config)
    low, high = _range(config, range, twin)
    fastest = quantity("rate", RATE if rate is None else rate, "delta_degC/s", RATE)
    begin = quantity("start", START if start is None else start, "degC", START)
    coldest, hottest, _ = RANGES["temperature"]
    if not all(coldest <= T <= hottest for T in (low, high, begin)):
        raise ConfigError(
            f"--range {low:g}..{high:g} degC, --start {begin:g} degC: is no temperature that can be; write those of a "
            f"chamber, from {coldest:g} to {hottest:g} degC"
        )
    if high - low < subject.map.min_swing:
        raise ConfigError(
            f"--range {low:g}..{high:g} degC: spans {high - low:g} K, a map needs {subject.map.min_swing:g} K; write "
            "the lower temperature first, and more between"
        )
    lag_of = "--lag" if lag is not None else "the simulated unit's" if twin is not None else "the default"
    own = twin.lag if lag is None and twin is not None else None
    behind = quantity("lag", LAG if lag is None else lag, "s", LAG) if own is None else own
    if fastest <= 0 or behind < 0:
        raise ConfigError(f"--rate {rate or RATE}, --lag {lag or LAG}: one is negative, or the rate zero; correct it")
    target = None if sigma is None else quantity("sigma", sigma, unit.si, f"3 {unit.shown}")
    if target is not None and target <= 0:
        raise ConfigError(f"--sigma {sigma}: must be greater than zero; write e.g. --sigma '3 {unit.shown}'")
    return PlanRequest(Chamber(low, high, begin, fastest, behind), subject, target, lag_of)


def read_hours(hours: Any) -> float:
    """Return a length in h, of a number or of a text, in which h is the unit where it has none.

    Raises ConfigError where it cannot be meant.
    """
    if isinstance(hours, str):
        bare = re.fullmatch(NUMBER, hours.strip())
        hours = quantity("hours", f"{hours} h" if bare else hours, "s", "8 h") / 3600
    number = isinstance(hours, int | float | np.integer | np.floating)
    if not (number and HOURS[0] <= hours <= HOURS[1]):
        given = quote(repr(hours)) if not number else "beyond 1e300" if abs(hours) > 1e300 else f"{hours:g}"
        raise ConfigError(f"--hours {given}: is not a length that can be meant; write hours from 0.01 to 10000")
    return float(hours)


def quantity(name: str, text: str, unit: str, example: str) -> float:
    """Return the value of an option in SI; raises ConfigError that names it, with an example."""
    try:
        number = to_si(text, unit)
    except UnitError as error:
        raise ConfigError(f"--{name}: {error} (here e.g. '{example}')") from None
    low, high = LIMITS.get(unit, (1e-30, 1e30))
    if number and not low <= abs(number) <= high:
        raise ConfigError(f"--{name} {quote(text)}: is not a size that can be meant; correct it")
    return number


def _walk(text: str, unit: BiasUnit) -> Array:
    example = f"0.02 {unit.shown}/sqrt(s)"
    parts = [quantity("walk", part, f"{unit.si}/sqrt(s)", example) for part in text.split(",")]
    if min(parts) < 0:
        raise ConfigError(f"--walk {quote(text)}: is negative; write a density of zero or more")
    return np.array(parts)


def _range(config: Config, given: Range, twin: Twin | None) -> tuple[float, float]:
    """Return the range in degC: as it is given, of the config's fitted map, or of the chamber that is simulated."""
    if given is not None:
        return read_range(given) if isinstance(given, str) else (float(given[0]), float(given[1]))
    if (fitted := fitted_map(config)) is not None:
        return fitted.domain
    if twin is not None and np.ptp(twin.temperature) > 0:
        return float(np.min(twin.temperature)), float(np.max(twin.temperature))
    raise ConfigError(
        "--range: is missing, and the config has neither a fitted map nor a simulated chamber to take it from; write "
        "e.g. --range '-20..50 degC'"
    )


def read_range(text: str) -> tuple[float, float]:
    """Return first and last temperature in degC of a text like `-20..50 degC`; raises ConfigError."""
    low, dots, rest = text.partition("..")
    number = NUMBER.match(rest.strip())
    if dots and low.strip() and number is not None:
        unit = rest.strip()[number.end() :]
        with_unit = re.search(r"[A-Za-z°]\s*$", low) and not NUMBER.fullmatch(low.strip())
        with suppress(UnitError):
            return to_si(low if with_unit else f"{low.strip()} {unit}", "degC"), to_si(rest, "degC")
    raise ConfigError(f"--range {quote(text)}: is no range of temperature; write e.g. --range '-20..50 degC'")
