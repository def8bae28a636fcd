"""The example that closes the loop on a measured recording, with its control beside it."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parent.parent.parent / "examples" / "02_oven_resistor"


def asked(which, out):
    code = f"import run; answer = run.ask({which!r}, 3, run.Path({str(out)!r})); import json; " + (
        "print(json.dumps([answer.verdict, answer.effects, {k: v[1][0] for k, v in answer.errors.items()}]))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=FOLDER, capture_output=True, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def test_the_lag_of_a_measured_resistor_is_named_and_its_error_at_least_halved(tmp_path):
    verdict, effects, error = asked("lagging", tmp_path / "out")
    assert verdict == "explained"
    assert [(e["kind"], e["channel"]) for e in effects] in (
        [("relaxation", "temperature")],
        [("thermal_lag", "temperature")],
    )
    assert error["before"] == pytest.approx(0.59e-6, rel=0.02)  # of the declared model, the constant removed: 0.59 ppm
    assert error["after"] < error["before"] / 2


def test_to_the_control_nothing_is_added_and_its_map_stays_byte_for_byte(tmp_path):
    _, effects, error = asked("control", tmp_path / "out")
    assert effects == []
    assert error["after"] == error["before"]
    assert (tmp_path / "out" / "explained.json").read_bytes() == (tmp_path / "out" / "declared.json").read_bytes()
