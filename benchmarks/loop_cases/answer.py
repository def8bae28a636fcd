"""Ask `driftlab explain`, and measure its answer."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from loop_cases.case import Array, Case, Prepared, save
from loop_cases.names import judge, shown

COMMAND = [sys.executable, "-c", "from driftlab.cli import main; main()", "explain"]


@dataclass(frozen=True)
class Result:
    """One row: what was there, what was said, and the errors on the holdout (norm over the axes, rad/s)."""

    name: str
    group: str
    split: str
    truths: tuple[str, ...] = ()
    said: tuple[str, ...] = ()
    verdict: str = ""
    right: int = 0
    related: int = 0
    false: tuple[str, ...] = ()
    before: float = float("nan")
    after: float = float("nan")
    oracle: float = float("nan")
    bed: str | None = None
    seconds: float = 0.0
    error: str = ""  # why there is no answer


def ask(case: Case, timeout: float) -> Result:
    """Make a case in a folder of its own, put it to `explain`, and judge what comes back."""
    about = {"name": case.name, "group": case.group, "split": case.split, "bed": case.bed}
    with tempfile.TemporaryDirectory(prefix="loop_") as name:
        folder = Path(name)
        try:
            prepared = case.make(folder)
        except Exception:  # a row like any other: the others go on
            return Result(**about, error="not made: " + traceback.format_exc().strip().splitlines()[-1])
        about["truths"] = tuple(truth.name for truth in prepared.truths)
        seconds, error = _explain(prepared, folder, timeout)
        if error:
            return Result(**about, seconds=seconds, error=error)
        return Result(**about, seconds=seconds, **judged(prepared, folder / "out"))


def _explain(prepared: Prepared, folder: Path, timeout: float) -> tuple[float, str]:
    """Return its duration in seconds, and its error."""
    config = save(prepared.config, folder / "declared.yaml")
    options = ("calibration", prepared.calibration), ("train", prepared.train), ("holdout", prepared.holdout)
    words = [word for option, names in options for name in names for word in (f"--{option}", str(name))]
    begun = time.perf_counter()
    process = subprocess.Popen(
        [*COMMAND, str(config), *words, "--out", str(folder / "out")],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        cwd=folder,
        env={"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", **os.environ},
        start_new_session=True,
    )
    try:
        said, _ = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return time.perf_counter() - begun, f"not done after {timeout:.0f} s"
    error = f"exit code {process.returncode}: {_last(said)}" if process.returncode else ""
    return time.perf_counter() - begun, error


def _last(text: str) -> str:
    lines = [line.strip(" │╭╰─╮╯") for line in text.splitlines()]
    return next((line for line in reversed(lines) if line), "no output")


def judged(prepared: Prepared, out: Path) -> dict[str, Any]:
    """Return the score of the results of explain in a folder."""
    content = json.loads((out / "loop.json").read_text(encoding="utf-8"))
    named = judge(content, prepared.truths, prepared.tolerated)
    before, after = errors(out / "prediction.h5", prepared.bias)
    return {
        "said": tuple(map(shown, content["effects"])),
        "verdict": content["verdict"],
        "right": named.right,
        "related": named.related,
        "false": named.false,
        "before": before,
        "after": after,
        "oracle": float("nan") if prepared.oracle is None else prepared.oracle,
    }


def errors(path: Path, bias: tuple[Array, Array] | None) -> tuple[float, float]:
    """Return the open-loop errors of both models: rms without the constant, norm over the axes, rad/s."""
    found = []
    with h5py.File(path) as file:
        for group in file.values():
            truth = group["reference"][()]
            if bias is not None:
                t, b = bias
                truth = np.stack([np.interp(group["t"][()], t, axis) for axis in b.T], axis=1)
            found.append([spread(group[name][()] - truth) for name in ("before", "after")])
    before, after = np.sqrt(np.mean(np.square(found), axis=0))
    return float(before), float(after)


def spread(error: Array) -> float:
    """Return the rms of an error (N, d) without its constant, as the norm over the axes."""
    return float(np.linalg.norm(np.nanstd(error, axis=0)))
