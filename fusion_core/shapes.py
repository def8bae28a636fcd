"""Shapes of arrays whose leading axis, time, may be left out."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from fusion_core.chunk import Array


def common_lead(who: str, arrays: Mapping[str, Array], ndim: int) -> tuple[int, ...]:
    """Return the leading (N,) of the arrays, or () where none has one; raises ValueError where they differ."""
    leads = {name: array.shape[0] for name, array in arrays.items() if array.ndim > ndim}
    if len(set(leads.values())) > 1:
        found = ", ".join(f"{name} {N}" for name, N in leads.items())
        raise ValueError(f"{who}: steps differ in number ({found}); give each N of them, or one without leading N")
    return tuple(leads.values())[:1]


def check_shape(who: str, what: str, array: Array, shape: tuple[int, ...], *, lead: bool = False) -> None:
    """Raise ValueError where an array is not of that shape; with `lead`, (N, *shape) will do too."""
    found = np.shape(array)
    if found == shape or (lead and found[1:] == shape and len(found) == len(shape) + 1):
        return
    last = ", ".join(map(str, shape))
    alone = f"({last},)" if len(shape) == 1 else f"({last})"
    expected = f"{alone} or (N, {last})".replace("(N, )", "(N,)") if lead else alone
    raise ValueError(f"{who}: {what} has the shape {found}, {expected} was expected; time comes first, then states")
