"""What `driftlab explain` costs: 5.6 + 4 + 4 h at 10 Hz with three auxiliary channels and every effect installed."""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import units_with_effects as maker

from driftlab.config import load_config
from driftlab.loop.closing import explain

EFFECTS = ((), ("hysteresis",), ("thermal_lag", "turn_on"))


def main() -> None:
    """Print a table: undeclared effects, seconds, verdict."""
    maker.RATE = 10.0
    print(f"{'undeclared':24s} {'seconds':>8s}  verdict")
    for effects in EFFECTS:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            maker.make_unit(folder, 7, effects, ("voltage", "pressure", "flow"), hours=(5.6, 4.0, 4.0))
            config = folder / "declared.yaml"
            config.write_text(config.read_text().replace("update_interval: 1 s", "update_interval: 0.1 s"))
            soak, train, holdout = (str(folder / f"{part}.h5") for part in ("soak", "train", "holdout"))
            begun = time.perf_counter()
            closed = explain(load_config(config), [soak], [train], [holdout], folder / "out")
            taken = time.perf_counter() - begun
        kinds = ", ".join(effect["kind"] for effect in closed.content["effects"])
        print(f"{', '.join(effects) or 'nothing':24s} {taken:8.1f}  {closed.verdict.word} {kinds}")


if __name__ == "__main__":
    main()
