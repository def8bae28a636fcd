"""Ablation of the identification: cases of `benchmarks/loop.py` with one part taken out at a time.

`python benchmarks/loop_ablation.py [--jobs N] [--only TEXT ...]`

The cases are of the develop split. `explain` runs in this process, with the part replaced by what is simpler.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")  # cases run side by side
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import tempfile

import numpy as np
from loop import cases
from loop_cases.answer import judged
from loop_cases.case import save

CASES = (
    "oven lagging, ramps 123", "oven control, ramps 123", "cats, holdout 3", "cats undeclared, holdout 3",
    "sweeps, 2 to 3", "cats with relaxation 0, holdout 3", "cats with play 0, holdout 3",
    "cats with channel and turn_on 0, holdout 3", "oven with relaxation 0, ramps 123", "field, relaxation 0",
    "field, nothing 0", "chamber, hysteresis 0", "chamber, thermal_lag and turn_on 0",
)  # fmt: skip


def _starts(always: bool) -> None:
    import driftlab.identification.search as search

    whole = search.candidates_of

    def offered(found: Any) -> Any:
        families = whole(found)
        free = {key[:3] for key in families if key[3]}
        return {key: terms for key, terms in families.items() if key[3] == (always and key[:3] in free)}

    search.candidates_of = offered


def _no_level_prior() -> None:
    import driftlab.identification.cross_validation as left_out
    import driftlab.identification.model as explained

    left_out.level_prior = lambda others, levels, left: (0.0, np.inf)
    explained._repeatability = lambda levels, left: None


def _ranked(key: Callable[[Any], float]) -> None:
    import driftlab.identification.search as search

    search._best = lambda passing: min(passing, key=key)


def _no_parts() -> None:
    from driftlab.identification.acceptance import CandidateEvidence

    CandidateEvidence.better = lambda self, sure=0.0: self.ratio < self.needed and self.left_out > 0


def _no_rule(name: str) -> None:
    from driftlab.identification.acceptance import CandidateEvidence

    setattr(CandidateEvidence, name, property(lambda self: False))


def _one_by_one() -> None:
    import driftlab.identification.trials as trials

    trials._retuned = lambda found, term, candidate: False


VARIANTS: dict[str, Callable[[], None]] = {
    "as it is": lambda: None,
    "every memory from equilibrium": lambda: _starts(always=False),
    "every start unknown": lambda: _starts(always=True),
    "no prior of the level": _no_level_prior,
    "ranked by likelihood": lambda: _ranked(lambda trial: -trial.likelihood),
    "ranked by left-out error alone": lambda: _ranked(lambda trial: trial.evidence.ratio),
    "parts not asked one by one": _no_parts,
    "no slow evidence": lambda: _no_rule("slow"),
    "no fast evidence": lambda: _no_rule("fast"),
    "memories one after the other": _one_by_one,
}


def run(asked: tuple[str, str]) -> dict[str, Any]:
    """Put one case to one variant."""
    variant, name = asked
    VARIANTS[variant]()
    from driftlab.commands.explain import explain
    from driftlab.config import load_config

    case = next(case for case in cases("develop", 1) if case.name == name)
    with tempfile.TemporaryDirectory(prefix="ablation_") as folder:
        prepared = case.make(Path(folder))
        config = load_config(save(prepared.config, Path(folder) / "declared.yaml"))
        names = [list(map(str, part)) for part in (prepared.calibration, prepared.train, prepared.holdout)]
        explain(config, *names, out=Path(folder) / "out")
        return judged(prepared, Path(folder) / "out")


def row(variant: str, found: Sequence[dict[str, Any]], names: Sequence[str]) -> str:
    """Return the table's row of a variant."""
    ratios = {name: one["after"] / one["before"] for name, one in zip(names, found, strict=True)}
    truths = [name for name in names if "nothing" not in name and "control" not in name and name != "cats, holdout 3"]
    right, false = sum(one["right"] for one in found), sum(len(one["false"]) for one in found)
    cells = [ratios.get(name, np.nan) for name in CASES[:1]]
    values = [ratios[name] for name in truths]
    rest = f"{np.exp(np.mean(np.log(values))):.2f} | {max(ratios.values()):.2f}"
    return f"| {variant} | {right} | {false} | {cells[0]:.2f} | {rest} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="variants whose names contain one")
    asked = parser.parse_args()
    variants = [v for v in VARIANTS if not asked.only or any(text in v for text in asked.only)]
    print("| part taken out | named | false | oven resistor | geometric mean of after/before | worst |")
    print("|---|---|---|---|---|---|")
    # a process a case: what is replaced in one stays there
    with ProcessPoolExecutor(asked.jobs, max_tasks_per_child=1) as pool:
        for variant in variants:
            print(row(variant, list(pool.map(run, [(variant, name) for name in CASES])), CASES), flush=True)


if __name__ == "__main__":
    main()
