"""Packaged configurations of product lines, one YAML file each."""

from __future__ import annotations

from pathlib import Path

from fusion_core.hookspecs import hookimpl


@hookimpl
def products() -> dict[str, Path]:
    """Register the products."""
    return {path.stem: path for path in sorted(Path(__file__).parent.glob("*.yaml"))}
