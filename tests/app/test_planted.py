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


def explained(folder, kind):
    """Return the kinds that are found in the recording with an effect planted, or none, and the error after."""
    table = np.genfromtxt(EXAMPLES / "data" / "oven_resistors" / "control.csv", delimiter=",", names=True)
    effect, supply = planted(kind or "channel", table["time"], table["oven"])
    ppm = table["ppm"] + (SIZE * effect if kind else 0.0)
    columns = np.stack([table["time"], ppm, table["oven"], table["ambient"], supply], axis=1)
    path = folder / "planted.csv"
    np.savetxt(path, columns, delimiter=",", header="time,ppm,oven,ambient,supply", comments="", fmt="%.6f")
    channels = {"voltage": {"path": "supply", "unit": "V"}}
    config = {"extends": str(EXAMPLES / "02_oven_resistor" / "control.yaml"), "source": {"channels": channels}}
    (folder / "declared.yaml").write_text(yaml.safe_dump(config))
    names = [[f"{path}{ramp}"] for ramp in RAMPS]
    closed = explain(load_config(folder / "declared.yaml"), *names, out=folder / "out").closed
    (outcome,) = closed.outcomes
    return [effect["kind"] for effect in closed.content["effects"]], np.std(outcome.after - outcome.reference)


@pytest.fixture(scope="module")
def bed(tmp_path_factory):
    found, error = explained(tmp_path_factory.mktemp("bed"), None)
    assert found == []
    return error


@pytest.mark.parametrize("kind", ["channel", "turn_on", "periodic"])
def test_what_is_planted_is_named_and_what_is_left_is_the_bed(tmp_path, bed, kind):
    """The error after is at most 1.1 times that of the recording with nothing planted."""
    found, error = explained(tmp_path, kind)
    assert found == [kind]
    assert error < 1.1 * bed
