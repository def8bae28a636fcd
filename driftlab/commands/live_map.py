"""A map that `driftlab live` fits while it runs: its options, and what is said of it at the end."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from driftlab.config import Config
    from driftlab.live.growing_map import GrowingMap

MapFile = Annotated[
    Path | None, typer.Option("--fit-map", metavar="MAP", help="Fit a thermal map meanwhile, into this file.")
]
Kind = Annotated[str | None, typer.Option("--kind", help="Kind of that map, instead of the config's.")]
Sigma = Annotated[
    str | None, typer.Option("--sigma", metavar="SIGMA", help="Say when the map is so sure, e.g. '3 deg/h'.")
]
Span = Annotated[
    str | None, typer.Option("--range", metavar="LOW..HIGH", help="Where it is to be, e.g. '-20..50 degC'.")
]
UntilReached = Annotated[bool, typer.Option("--until-reached", help="End when --sigma is reached over --range.")]


def soaking_of(
    config: Config,
    path: Path | None,
    kind: str | None,
    sigma: str | None,
    span: str | None,
    until_reached: bool,
    read: Collection[Path],
) -> GrowingMap | None:
    """Return the map that the options ask for, None where they do not; raises ConfigError and UnitError."""
    from driftlab.live.growing_map import soaking
    from fusion_core.errors import ConfigError

    if path is not None:
        return soaking(config, path, kind=kind, sigma=sigma, span=span, until_reached=until_reached, read=read)
    for option, value in (("--kind", kind), ("--sigma", sigma), ("--range", span)):
        if value is not None:
            raise ConfigError(f"{option}: is of a map that is fitted meanwhile; add --fit-map MAP")
    if until_reached:
        raise ConfigError("--until-reached: is of a map that is fitted meanwhile; add --fit-map MAP")
    return None


def written(soaking: GrowingMap | None) -> tuple[list[str], Exception | None]:
    """Write the map, where there is one; return what to say of it, and why it was not written, if so."""
    if soaking is None:
        return [], None
    try:
        soaking.finish()
    except Exception as problem:  # raised when the results of the run have been shown
        return [str(problem)], problem
    known = [*soaking.status.lines(), *soaking.faults.lines()]
    return [*(f"map {soaking.status.kind}: {line}" for line in known), f"map written to {soaking.path}"], None
