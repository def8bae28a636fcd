"""Names of the Allan coefficients: those of data sheets, with their letters, in a terminal of 80 columns too."""

from types import SimpleNamespace

import numpy as np
import pytest

from driftlab.noise.allan_model import KEYS
from driftlab.reports.allan import UNITS, names_of, result_lines, table

SIZES = {"gyro": [5e-6, 1.5e-5, 4e-6, 2.8e-6, 3.6e-7], "accel": [2e-4, 8.3e-4, 1e-4, 2e-5, 6e-7]}  # SI, of MEMS units


def analysis(channel):
    value = np.array(SIZES[channel])
    fit = SimpleNamespace(value=value, low=0.9112 * value, high=1.113 * value)
    axes, fits = {channel: ["x", "y", "z"]}, {channel: [fit] * 3}
    return SimpleNamespace(axes=axes, sensors={}, coefficients=fits, curves={channel: []})


@pytest.mark.parametrize(("channel", "noise"), [("gyro", "angle random walk (ARW, N)"), ("accel", "velocity random")])
def test_each_coefficient_has_its_name_and_its_letter(channel, noise):
    names = names_of(UNITS[channel])
    assert names["white"].startswith(noise)
    letters = [names[key].rstrip(")").replace(",", "").split("(")[1].split()[-1] for key in KEYS]
    assert letters == ["Q", "N", "B", "K", "R"]
    (line,) = result_lines(analysis(channel))
    assert line.startswith(f"{channel}, worst axis: {names['white']} ")


@pytest.mark.parametrize("channel", ["gyro", "accel"])
def test_80_columns_cut_nothing(channel):
    from rich.console import Console

    console = Console(width=80, record=True, file=None, quiet=False)
    with console.capture() as printed:
        console.print(table(analysis(channel), channel))
    assert "…" not in printed.get()
    for what in ("bias instability", "B [", "N [", "K [", "RRW" if channel == "gyro" else "VRW"):
        assert what in printed.get()
