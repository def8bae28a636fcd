"""The example of a test station, run by OpenHTF itself: measurements, limits and certificate are in its record."""

import base64
import json
import subprocess
import sys
from pathlib import Path

import pytest

import driftlab

FOLDER = Path(__file__).parent.parent.parent / "examples" / "10_openhtf"
SOAK = {"kind": "soak", "start": "20 degC", "stop": "45 degC", "step": "5 K", "hold": "10 min", "down": True}
TWIN = {"source": {"kind": "synthetic", "rate": "1 Hz", "latitude": "40.9 deg", "profile": SOAK}}
CALL = "import sys; sys.path.insert(0, sys.argv[1]); import station; from pathlib import Path; {limits}; "
CALL += "sys.exit(0 if station.main('CRS-1', sys.argv[2], Path(sys.argv[3])) else 1)"


@pytest.fixture(scope="module")
def soak(tmp_path_factory):
    path = tmp_path_factory.mktemp("soak") / "soak.h5"
    driftlab.simulate(TWIN, out=path, seed=1)
    return path


@pytest.mark.parametrize(("limits", "code"), [("pass", 0), ("station.LIMITS['residual'] = 0.1", 1)])
def test_a_station_records_limits_map_and_certificate(soak, tmp_path, limits, code):
    command = [sys.executable, "-c", CALL.format(limits=limits), FOLDER, soak, tmp_path]
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    record = json.loads((tmp_path / "CRS-1.json").read_text())
    phase = record["phases"][-1]
    measured = phase["measurements"]
    assert record["outcome"] == ("FAIL" if code else "PASS")
    assert {name: one["outcome"] for name, one in measured.items()} == {
        "residual": "FAIL" if code else "PASS", "swing": "PASS", "decision": "FAIL" if code else "PASS"
    }  # fmt: skip
    assert measured["decision"]["measured_value"] == ("fail" if code else "pass")
    assert 0 < measured["residual"]["measured_value"] < 20
    attached = phase["attachments"]["map.certificate.json"]
    certificate = json.loads(base64.b64decode(attached["data"]))
    assert "CRS-1" in json.dumps(certificate)
    assert {"map.json", "map.report.html", "map.certificate.html"} <= set(phase["attachments"])
