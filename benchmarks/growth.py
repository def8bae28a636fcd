"""Growth of the time with the number of samples: the exponent p of a + b N^p, which is 1 where it is linear."""

from __future__ import annotations

import numpy as np
from common import Row, best, problem, show
from recording import blocks, write_config, write_map

from driftlab.config import load_config
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from driftlab.recordings.epochs import epochs
from fusion_core.chunk import Chunk
from fusion_core.kalman import estimate

DECADES = (1_000, 10_000, 100_000, 1_000_000)


def exponent(what: str, sizes: tuple[int, ...], seconds: list[float]) -> Row:
    """Return the row of a growth: seconds at each size, and the exponent p of a + b N^p through the last three.

    Where the time falls, or does not double in the last step, noise and fixed costs are what was timed: the exponent is
    not measured, and nothing is met.
    """
    shown = ", ".join(f"{n:,}: {s * 1e3:.3g} ms" for n, s in zip(sizes, seconds, strict=True))
    what, target = f"{what} ({shown})", "N^1, at most N^1.1"
    rises = np.diff(seconds)[-2:]
    if len(rises) < 2 or rises[0] <= 0 or seconds[-1] < 2 * seconds[-2]:
        return Row(what, "not measured: the time does not rise enough", target)
    p = np.linspace(0.01, 5.0, 5000)
    steps = np.diff(np.asarray(sizes[-3:], dtype=float)[:, None] ** p, axis=0)
    slope = float(np.interp(rises[1] / rises[0], steps[1] / steps[0], p))
    return Row(what, f"N^{slope:.2f}", target, slope <= 1.1)


def main() -> None:
    import tempfile
    from pathlib import Path

    rows = []
    for what, varying, method in (("recursive", True, "recursive"), ("steady", False, "steady")):
        models = [problem(2, N, varying=varying) for N in DECADES]
        seconds = best(*(lambda args=args, method=method: estimate(*args, method=method) for args in models), turns=3)
        rows.append(exponent(what, DECADES, seconds))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        config = load_config(write_config(folder / "c.yaml", write_map(folder / "map.onnx"), "10 ms"))
        sizes = (70_000, 700_000, 7_000_000)
        t, *values = (np.concatenate(part) for part in zip(*blocks(sizes[-1], 1000.0), strict=True))
        whole = Chunk(t, dict(zip(("gyro", "accel", "temperature"), values, strict=True)))

        def run(N: int) -> None:
            some = (whole.part(k, min(k + 65_536, N)) for k in range(0, N, 65_536))
            for _ in Run(config, RunLog()).over(epochs(some, 0.01)):
                pass

        seconds = best(*(lambda N=N: run(N) for N in sizes), turns=3)
        rows.append(exponent("samples to estimates, 1 kHz at 10 ms", sizes, seconds))
    show("Growth", rows)


if __name__ == "__main__":
    main()
