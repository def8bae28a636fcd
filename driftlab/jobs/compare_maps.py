"""The choice among all installed kinds of maps: `driftlab fit-map --compare`."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from driftlab.config import Config
from driftlab.maps.fit import GatheredSoak
from driftlab.maps.kind_selection import KindComparison, candidates, compare, divide
from driftlab.soak.blocks import GrowingBlocks
from fusion_core.chunk import Array
from fusion_core.contracts import ThermalMap
from fusion_core.errors import ConfigError
from fusion_core.host.registry import registry

MOST = 4096  # blocks of all recordings


def check_comparison(kind: str | None, neurons: range | None) -> None:
    """Raise ConfigError where one kind, or the size of one, is asked for beside a comparison of all."""
    for option, value in (("--kind", kind), ("--select", neurons)):
        if value is not None:
            raise ConfigError(f"--compare: tries all kinds, and {option} asks for one; give one of the two")


def settings_compared(
    config: Config, found: GatheredSoak, progress: Callable[..., None] | None = None
) -> tuple[ThermalMap, KindComparison, str]:
    """Return the settings that the samples ask for, what was tried, and what a map's record says of it.

    `progress`, where given, is called with texts.

    Raises
    ------
    ConfigError
        If no kind can be fitted.
    """
    T, bias = blocks(found)

    def report(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} maps fitted")

    tried = candidates(config.tracked_maps(), registry().classes(ThermalMap).values())
    comparison = compare(tried, np.concatenate(T), np.concatenate(bias), divide(T), report)
    settings = comparison.chosen.settings
    assert settings is not None
    return settings, comparison, f"{comparison.chosen.name}, of {len(tried)} kinds and sizes"


def blocks(found: GatheredSoak) -> tuple[list[Array], list[Array]]:
    """Return T (K_r,) and bias (K_r, d) of each recording's blocks, all of the same number of samples."""
    n = 1
    while len(found.T) > n * MOST:
        n *= 2
    T, bias = [], []
    for start, stop in zip(found.starts, [*found.starts[1:], len(found.T)], strict=True):
        growing = GrowingBlocks(most=stop - start + 1, n=n)
        growing.add(np.arange(start, stop, dtype=np.float64), found.T[start:stop], found.bias[start:stop])
        means = growing.blocks()
        T.append(means.T)
        bias.append(means.bias)
    return T, bias
