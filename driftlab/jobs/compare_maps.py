"""All installed kinds of maps on the same recordings at rest: `driftlab fit-map --compare`."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from driftlab.config import Config, with_recording
from driftlab.maps.blocks import GrowingBlocks
from driftlab.maps.division import divide
from driftlab.maps.fit import of_sensor, provenance, samples
from driftlab.maps.kinds import Comparison, candidates, compare
from fusion_core.chunk import Array
from fusion_core.contracts import FittedMap, ThermalMap
from fusion_core.faults import Faults
from fusion_core.host.registry import registry

MOST = 4096  # blocks of all recordings


def compare_maps(
    config: Config,
    recordings: Sequence[str],
    faults: Faults,
    progress: Callable[..., None] | None = None,
) -> tuple[FittedMap, Comparison]:
    """Judge every installed kind on what is left out of its fit, and fit the chosen one on all samples.

    `progress`, where given, is called with the recording's time in s and the number of samples, then with texts.

    Raises
    ------
    ConfigError, DataError
        If a recording cannot be used, or no kind can be fitted.
    """
    configs = [with_recording(config, item) for item in recordings] or [config]
    found = [samples(own, faults, progress) for own in configs]
    names = [own.source.name for own in configs if own.source is not None]
    T, bias = blocks(found)

    def report(done: int, count: int) -> None:
        if progress is not None:
            progress(f"{done} of {count} maps fitted")

    tried = candidates(config.maps(), registry().classes(ThermalMap).values())
    comparison = compare(tried, np.concatenate(T), np.concatenate(bias), divide(T), report)
    settings = comparison.chosen.settings
    assert settings is not None
    all_T, all_bias = (np.concatenate(part) for part in zip(*found, strict=True))
    note = {"comparison": f"{comparison.chosen.name} of {len(tried)} kinds and sizes"}
    fitted = settings.fit(all_T, all_bias, provenance(settings, names) | note)
    return of_sensor(config, fitted), comparison


def blocks(recordings: Sequence[tuple[Array, Array]]) -> tuple[list[Array], list[Array]]:
    """Return T (K_r,) and bias (K_r, d) of each recording's blocks, all of the same number of samples."""
    count = sum(len(T) for T, _ in recordings)
    n = 1
    while count > n * MOST:
        n *= 2
    means = []
    for own_T, own_bias in recordings:
        growing = GrowingBlocks(most=len(own_T) + 1, n=n)
        growing.add(own_T, own_bias)
        found = growing.blocks()
        means.append((found.T, found.bias))
    return [T for T, _ in means], [bias for _, bias in means]
