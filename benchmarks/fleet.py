"""A thousand units of one config."""

from __future__ import annotations

import numpy as np
from common import Row, best, problem, show

from fusion_core.fast.fleet import run_fleet


def rows(U: int = 1000, T: int = 4096) -> list[Row]:
    state, transition, measurement = problem(2, T)
    z = np.random.default_rng(0).random(size=(T, 6, U)) * 1e-7
    model = transition.F, transition.Q, measurement.H, measurement.R
    steps = type(transition)(*model[:2], np.zeros(12))
    found = []
    for every in (32, 1):
        some = z if every > 1 else z[:256]
        (seconds,) = best(lambda e=every, s=some: run_fleet(state, steps, *model[2:], s, every=e), turns=3)
        rate = some.shape[0] * U / seconds / 1e6
        what = f"fleet, {U:,} units, n = 12, m = 6, states at every {'update' if every == 1 else f'{every}nd update'}"
        least = 150 if every > 1 else None
        target = "≥ 150 (stretch 350)" if least else ""
        found.append(Row(what, f"{rate:,.0f} million unit-steps/s", target, None if least is None else rate >= least))
    return found


def main() -> None:
    show("Fleet", rows())


if __name__ == "__main__":
    main()
