"""Effects planted in measured noise: a resistor in an oven that has nothing to find of its own."""

from pathlib import Path

import numpy as np
import pytest
import yaml

from driftlab.commands.explain import explain
from driftlab.config import load_config

EXAMPLES = Path(__file__).parent.parent.parent / "examples"
RAMPS = ("::0:9300", "::9300:18300", "::18300:")  # s
SIZE = 0.5  # ppm rms, twice what is left of the recording without a plant


def planted(kind, t, oven):
    """Return what is planted (N,), its deviation 1, and the auxiliary channel (N,)."""
    rng = np.random.default_rng(5)
    supply = 5 + 0.1 * rng.normal(size=100)[(t // 700).astype(int)]  # another load every 700 s
    ramp = np.searchsorted([9300.0, 18300.0], t, side="right")
    begun = np.array([0.0, 9300.0, 18300.0])[ramp]
    shape = {
        "channel": supply,
        "turn_on": np.exp(-(t - begun) / 1100.0),
        "periodic": np.sin(2 * np.pi * t / 407.0),
    }[kind]
    return (shape - shape.mean()) / shape.std(), supply


@pytest.mark.parametrize("kind", ["channel", "turn_on", "periodic"])
def test_what_is_planted_is_named_and_what_is_left_is_the_bed(tmp_path, kind):
    """The error after is at most 1.1 times that of the recording with nothing planted."""
    table = np.genfromtxt(EXAMPLES / "data" / "oven_resistors" / "control.csv", delimiter=",", names=True)
    t, errors = table["time"], {}
    for name in ("bed", kind):
        effect, supply = planted(kind, t, table["oven"])
        ppm = table["ppm"] + (SIZE * effect if name == kind else 0.0)
        columns = np.stack([t, ppm, table["oven"], table["ambient"], supply], axis=1)
        path = tmp_path / f"{name}.csv"
        np.savetxt(path, columns, delimiter=",", header="time,ppm,oven,ambient,supply", comments="", fmt="%.6f")
        channels = {"voltage": {"path": "supply", "unit": "V"}}
        config = {"extends": str(EXAMPLES / "02_oven_resistor" / "control.yaml"), "source": {"channels": channels}}
        (tmp_path / "declared.yaml").write_text(yaml.safe_dump(config))
        names = [[f"{path}{ramp}"] for ramp in RAMPS]
        closed = explain(load_config(tmp_path / "declared.yaml"), *names, out=tmp_path / f"out_{name}").closed
        (outcome,) = closed.outcomes
        errors[name] = float(np.std(outcome.after - outcome.reference))
        expected = [] if name == "bed" else [kind]
        assert [effect["kind"] for effect in closed.content["effects"]] == expected
    assert errors[kind] < 1.1 * errors["bed"]
