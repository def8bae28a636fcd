"""The wheel on each Python that is there: `python packaging/try_wheel.py python3.11 python3.12 ...`, in the repository.

It is built from what git knows, in a temporary folder, and installed with its dependencies into an environment of its
own; a soak is simulated, a map fitted, a filter run, and the C code of the map compiled where there is a compiler.
What a Python lacks ends the script with its name.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).parent.parent
CONFIG = """
source:
  kind: hdf5
  channels: {time: {path: time}, gyro: {path: gyro}, accel: {path: accel}, temperature: {path: temperature}}
filter: {gyro: {noise: 3.18 deg/h/sqrt(Hz), bias: {kind: thermal_derivative, walk: 2.2e-5 deg/s/sqrt(s),
  map: {kind: polynomial, order: 3, path: map.json}}}}
"""
TWIN = """
source: {kind: synthetic, rate: 1 Hz, profile: {kind: ramp}}
filter: {gyro: {noise: 3.18 deg/h/sqrt(Hz), bias: {kind: random_walk, walk: 2.2e-5 deg/s/sqrt(s)}}}
"""
COMMANDS = (
    ("simulate", "twin.yaml", "--out", "soak.h5", "--seed", "1"),
    ("init", "soak.h5", "--out", "first.yaml"),
    ("fit-map", "unit.yaml", "--input", "soak.h5"),
    ("run", "unit.yaml", "--input", "soak.h5", "--out", "results"),
    ("export", "c", "map.json", "--out", "firmware"),
)


def call(*command: object, folder: Path) -> None:
    """Run a command, and end with what it says where it fails."""
    done = subprocess.run([*map(str, command)], cwd=folder, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))}\n{done.stdout[-2000:]}{done.stderr[-4000:]}")


def main(pythons: list[str]) -> None:
    """Build the wheel, try it on each Python, and put it into dist/."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source = folder / "source"
        source.mkdir()
        packed = subprocess.run(["git", "archive", "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "x", "-C", str(source)], input=packed, check=True)
        call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", "dist", source, folder=folder)
        (wheel,) = (folder / "dist").glob("*.whl")
        for python in pythons:
            began = time.monotonic()
            work = folder / Path(python).name
            work.mkdir()
            call(python, "-m", "venv", "venv", folder=work)
            program = work / "venv" / "bin"
            call(program / "pip", "install", "--quiet", "--disable-pip-version-check", wheel, folder=work)
            call(program / "pip", "check", folder=work)
            (work / "unit.yaml").write_text(CONFIG)
            (work / "twin.yaml").write_text(TWIN)
            for arguments in COMMANDS:
                call(program / "driftlab", *arguments, folder=work)
            if shutil.which("gcc"):
                sources = sorted((work / "firmware").glob("*.c"))
                call("gcc", "-std=c99", "-Wall", "-Werror", "-c", *sources, folder=work)
            size = sum(file.stat().st_size for file in (work / "venv").rglob("*") if file.is_file()) / 1e6
            print(f"{python}: {wheel.name}, {size:.0f} MB installed, {time.monotonic() - began:.0f} s")
        (ROOT / "dist").mkdir(exist_ok=True)
        shutil.copy(wheel, ROOT / "dist")


if __name__ == "__main__":
    main(sys.argv[1:] or [sys.executable])
