"""A station of OpenHTF that calibrates a gyro: measurements with limits, the map and the certificate are in its record.

python examples/10_openhtf/station.py SERIAL SOAK.h5      (pip install openhtf; a station would record the soak itself)
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import openhtf as htf
import yaml
from openhtf.output.callbacks import json_factory

import driftlab

HERE = Path(__file__).parent
OUT = HERE.parents[1] / "demo_out" / "openhtf"
DEG_H = np.deg2rad(1 / 3600)  # rad/s
LIMITS = {"residual": 20.0, "swing": 2000.0}  # deg/h


def calibration(soak: Path, out: Path) -> htf.PhaseDescriptor:
    """Return the phase that fits the thermal map on a soak, and measures what is limited, in deg/h."""
    config = yaml.safe_load((HERE / "unit.yaml").read_text())
    config["limits"] = {name: f"{limit} deg/h" for name, limit in LIMITS.items()}
    measured = [htf.Measurement(name).in_range(maximum=limit).doc("deg/h") for name, limit in LIMITS.items()]

    @htf.measures(*measured, htf.Measurement("decision").equals("pass").doc("with the uncertainty, ISO 14253-1"))
    def thermal_calibration(test: htf.TestApi) -> None:
        serial = test.test_record.dut_id
        folder = out / serial
        folder.mkdir(parents=True, exist_ok=True)
        result = driftlab.fit_map({**config, "serial": serial}, soak, out=folder / "map.json", certificate=True)
        for row in result.limits:
            test.measurements[row.name] = row.value / DEG_H
        test.measurements.decision = next((row.verdict for row in result.limits if row.verdict != "pass"), "pass")
        for sentence in result.lines():
            test.logger.info(sentence)
        for path in result.written:
            test.attach_from_file(str(path))

    return thermal_calibration


def main(serial: str, soak: str, out: Path = OUT) -> bool:
    """Run the test of one unit; return True if it passes."""
    test = htf.Test(calibration(Path(soak), out), test_name="thermal_calibration")
    out.mkdir(parents=True, exist_ok=True)
    test.add_output_callbacks(json_factory.OutputToJSON(str(out / "{dut_id}.json"), indent=2))
    return test.execute(test_start=lambda: serial)


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    sys.exit(0 if main(*sys.argv[1:]) else 1)
