"""This revision beside another one: `python against.py REV [--cases help,m10] [--pairs 3]`, in the repository.

Both are installed into environments of their own, in a temporary folder, on the libraries of the environment that runs
this, where a revision that needs others finds them (2aca0dbd: skl2onnx). Each case is run in turns, the other revision
first in every second pair, so that what else the machine does hits both; the ratio of each pair is printed with the
least and the largest. Below 1 this revision is the faster one.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

from recording import write_config, write_hdf5

ROOT = Path(__file__).parent.parent
LONG = {  # length in s, samples a second, interval of updates
    "10 min at 100 Hz": (600, 100, "10 ms"),
    "6 h at 1 kHz, an update each 10 ms": (21_600, 1000, "10 ms"),
    "24 h at 100 Hz": (86_400, 100, "10 ms"),
}
CASES = ("--help", "check", *LONG)
MAP = "import sys; from pathlib import Path; from recording import write_map; write_map(Path(sys.argv[1]))"


class Spent(NamedTuple):
    """Seconds of the wall and of the processor, and the largest memory in MB."""

    wall: float
    processor: float
    memory: float


class Installed:
    """A revision in an environment of its own; None is the tree as it is."""

    def __init__(self, revision: str | None, folder: Path) -> None:
        self.name, self.folder = revision or "this", folder
        source = folder / "source"
        source.mkdir(parents=True)
        tree = (
            revision
            or subprocess.run(
                ["git", "stash", "create"], cwd=ROOT, check=True, capture_output=True, text=True
            ).stdout.strip()
        )
        packed = subprocess.run(["git", "archive", tree or "HEAD"], cwd=ROOT, check=True, capture_output=True).stdout
        subprocess.run(["tar", "x", "-C", str(source)], input=packed, check=True)
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder / "venv")], check=True)
        self.bin = folder / "venv" / "bin"
        packages = sysconfig.get_path("purelib", vars={"base": str(folder / "venv")})
        (Path(packages) / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
        python, how = str(self.bin / "python"), ["-q", "--no-deps", "--no-build-isolation", "--ignore-installed"]
        self._do([sys.executable, "-m", "pip", "--python", python, "install", *how, str(source)])
        self._do([str(self.bin / "python"), "-c", MAP, str(folder / "map.onnx")], PYTHONPATH=str(source / "benchmarks"))

    def _do(self, command: list[str], **variables: str) -> Spent:
        """Run a command without what is set for Python; raises RuntimeError with its messages where it fails."""
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
        with tempfile.TemporaryFile("w+") as messages:
            begun = time.perf_counter()
            process = subprocess.Popen(
                command, cwd=self.folder, env=inherited | variables, stdout=subprocess.DEVNULL, stderr=messages
            )
            _, status, used = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            wall = time.perf_counter() - begun
            if process.returncode:
                messages.seek(0)
                raise RuntimeError(f"{self.name}: {' '.join(command)}: exit status {status}\n{messages.read()}")
        return Spent(wall, used.ru_utime + used.ru_stime, used.ru_maxrss / 1024)

    def spent(self, case: str, recording: Path | None) -> Spent:
        """Run a case."""
        shutil.rmtree(self.folder / "out", ignore_errors=True)
        program = str(self.bin / "driftlab")
        if recording is None:
            return self._do([program, "--help"])
        config = self.folder / "config.yaml"
        write_config(config, self.folder / "map.onnx", LONG.get(case, (0, 0, "10 ms"))[2])
        if case == "check":
            return self._do([program, "check", str(config), "--input", str(recording)])
        return self._do([program, "run", str(config), "--input", str(recording), "--out", "out", "--json"])


def compared(case: str, both: tuple[Installed, Installed], recording: Path | None, pairs: int) -> None:
    """Print the least times of a case, and the ratios of this revision to the other."""
    for one in both:
        one.spent(case, recording)  # compiled, and the recording in memory
    times: dict[str, list[Spent]] = {one.name: [] for one in both}
    for k in range(pairs):
        for one in both[:: 1 if k % 2 else -1]:
            times[one.name].append(one.spent(case, recording))
    this, other = (times[one.name] for one in both)
    quantities = (("wall", "s"), ("processor", "s"), ("memory", "MB"))
    for quantity, unit in quantities[: 3 if case in LONG else 2]:  # of a small process it would be that of this one
        mine, theirs = ([getattr(one, quantity) for one in some] for some in (this, other))
        ratios = [a / b for a, b in zip(mine, theirs, strict=True)]
        least = f"{min(mine):.3g} {unit} | {min(theirs):.3g} {unit} | {min(mine) / min(theirs):.2f}"
        scatter = f"{median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})"
        print(f"| {case} | {quantity} | {least} | {scatter} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("revision")
    parser.add_argument("--cases", default=",".join(CASES), help=f"some of: {', '.join(CASES)}; by their beginnings")
    parser.add_argument("--pairs", type=int, default=3)
    asked = parser.parse_args()
    chosen = [case for case in CASES if any(case.startswith(name) for name in asked.cases.split(","))]
    with tempfile.TemporaryDirectory(prefix="against-") as folder:
        both = Installed(None, Path(folder) / "this"), Installed(asked.revision, Path(folder) / "other")
        for one in both:
            first = one.spent("24 h", write_hdf5(Path(folder) / "first.h5", 120, 100))
            print(
                f"{one.name}: first run after installation {first.wall:.1f} s, {first.processor:.1f} s of the processor"
            )
        print(f"\n| case | | this | {asked.revision} | least / least | pairs: median (least to largest) |")
        print("|---|---|---|---|---|---|")
        for case in chosen:
            seconds, rate, _ = LONG.get(case, (600, 100, ""))
            recording = None if case == "--help" else write_hdf5(Path(folder) / "recording.h5", seconds, rate)
            compared(case, both, recording, asked.pairs)


if __name__ == "__main__":
    main()
