"""A live run compiles all that it needs before the device is listened to."""

import json
import subprocess
import sys

CHILD = """
import json
import sys
import numba
from driftlab.config import Config
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from driftlab.filtering.run import warm_up
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog
from fusion_core.chunk import Chunk
from fusion_core.faults import Faults

sys.path.insert(0, sys.argv[1])
from units_at_rest import unit_at_rest

def compiled():
    found = {}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("driftlab", "fusion_core", "fusion_plugins"):
            for key, value in vars(module).items():
                if isinstance(value, numba.core.registry.CPUDispatcher) and value.signatures:
                    found[f"{value.py_func.__module__}.{key}"] = len(value.signatures)
    return found

FILTER = {
    "align": "20 s",
    "gyro": {"noise": "3.18 deg/h/sqrt(Hz)", "bias": {"kind": "random_walk", "walk": "1.5e-4 deg/s/sqrt(s)"}},
    "accel": {"noise": "0.05 m/s/sqrt(h)", "bias": {"kind": "random_walk", "walk": "2e-3 m/s/h/sqrt(s)"}},
}
config = Config.model_validate({"latitude": "40.9 deg", "filter": FILTER, "source": {"kind": "synthetic"}})
warm_up(config)
before = compiled()
unit = unit_at_rest(seconds=120)
samples = Chunk(unit.t, unit.channels())
N = len(samples)
pieces = [samples.part(0, 600)] + [samples.part(k, k + 1) for k in range(600, 700)] + [samples.part(700, N)]
for _ in Run(config, RunLog()).over(epochs(read(config, Faults(), stream=pieces), 0.1)):
    pass
print(json.dumps([before, compiled()]))
"""


def test_a_run_after_the_warm_up_compiles_nothing_more(pytestconfig):
    support = str(pytestconfig.rootpath / "tests" / "support")
    child = subprocess.run([sys.executable, "-c", CHILD, support], capture_output=True, text=True, check=False)
    assert child.returncode == 0, child.stderr
    before, after = json.loads(child.stdout)
    assert before == after
    assert any(name.endswith("recursive") for name in before)
    assert any(name.endswith("steady") for name in before)
