"""Every benchmark, one table each, in a process of its own; `--short` leaves out the longest recordings."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from common import machine

NAMES = (
    "install_size", "methods", "peers", "accuracy", "streaming", "growth", "explain", "dataflash", "end_to_end",
    "fleet",
)  # fmt: skip


def main() -> None:
    print(f"Measured on {machine()}.", flush=True)
    for name in NAMES:
        subprocess.run([sys.executable, Path(__file__).with_name(f"{name}.py"), *sys.argv[1:]], check=True)


if __name__ == "__main__":
    main()
