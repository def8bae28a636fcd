"""Cost of `driftlab explain`: 5.6 + 4 + 4 h at 10 Hz with every effect installed, and its growth."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests" / "support"))

import units_with_effects as maker
from common import Row, limit, show
from end_to_end import driftlab, measured
from growth import exponent

EFFECTS = ((), ("hysteresis",), ("thermal_lag", "turn_on"))
CHANNELS = ("voltage", "pressure", "flow")


def closed(effects: tuple[str, ...], channels: tuple[str, ...], hours: tuple[float, ...]) -> tuple[float, int, str]:
    """Close the loop on a made unit; return seconds, candidates tried, and the verdict with the effects added."""
    maker.RATE = 10.0
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        maker.make_unit(folder, 7, effects, channels, hours=hours)
        config = folder / "declared.yaml"
        config.write_text(config.read_text().replace("update_interval: 1 s", "update_interval: 0.1 s"))
        parts = ("calibration", "soak"), ("train", "train"), ("holdout", "holdout")
        recordings = [word for option, part in parts for word in (f"--{option}", folder / f"{part}.h5")]
        seconds, _ = measured(driftlab("explain", config, *recordings, "--out", folder / "out"))
        content = json.loads((folder / "out" / "loop.json").read_text())
    kinds = ", ".join(effect["kind"] for effect in content["effects"]) or "nothing added"
    return seconds, content["candidates_tried"], f"{content['verdict']}, {kinds}"


def rows() -> list[Row]:
    found = []
    for effects in EFFECTS:
        seconds, _, said = closed(effects, CHANNELS, (5.6, 4.0, 4.0))
        what = f"explain, 13.6 h at 10 Hz, undeclared: {', '.join(effects) or 'nothing'} ({said})"
        found.append(limit(what, seconds, "s", 10))
    lengths = [(0.06, 0.04, 0.04), (0.6, 0.4, 0.4), (6.0, 4.0, 4.0), (60.0, 40.0, 40.0)]
    samples = tuple(int(sum(hours) * 36_000) for hours in lengths)
    found.append(exponent("explain, samples", samples, [closed((), CHANNELS, hours)[0] for hours in lengths]))
    tried = [closed((), CHANNELS[:k], (2.8, 2.0, 2.0))[:2] for k in (0, 1, 3)]
    found.append(exponent("explain, effects tried", tuple(n for _, n in tried), [s for s, _ in tried]))
    return found


def main() -> None:
    show("Closing the loop", rows())


if __name__ == "__main__":
    main()
