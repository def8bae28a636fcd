"""Does `driftlab explain` close the loop? Measured, planted and simulated cases, named or not, better or worse.

`python benchmarks/loop.py [--split develop|check] [--groups measured control planted simulated] [--seeds N]
[--jobs N] [--timeout S] [--only TEXT ...] [--json FILE] [--list]`

`explain` is a black box: a subprocess that is given a config and recordings, and whose loop.json and prediction.h5
are judged. PYTHONPATH says which tree of driftlab answers. Errors are open loop on the holdout, the constant removed
from each axis, as the norm over the axes. The splits have no case and no seed in common: develop on one, then check.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # cases run side by side
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from loop_cases import chamber, field, measured, planted
from loop_cases.answer import Result, ask
from loop_cases.case import Case
from loop_cases.tables import print_groups, print_rows, row_of

GROUPS = ("measured", "control", "planted", "simulated")
FIRST_SEED = {"develop": 0, "check": 1000}


def cases(split: str, seeds: int) -> list[Case]:
    """Return every case of a split, beds first."""
    drawn = range(FIRST_SEED[split], FIRST_SEED[split] + seeds)
    return [
        case
        for case in (*measured.cases(), *(c for k in (planted, chamber, field) for c in k.cases(drawn)))
        if case.split == split
    ]


def chosen(everything: list[Case], groups: list[str], only: list[str]) -> list[Case]:
    """Return the cases of the groups whose names contain one of the texts, and the beds that they need."""
    wanted = [case for case in everything if case.group in groups]
    if only:
        wanted = [case for case in wanted if any(text in case.name for text in only)]
    names = {case.name for case in wanted} | {case.bed for case in wanted if case.bed}
    return [case for case in everything if case.name in names]


def answers(todo: list[Case], jobs: int, timeout: float) -> list[Result]:
    """Put all cases to `explain`, some side by side, and print each answer as it comes."""
    found: dict[str, Result] = {}
    begun = time.perf_counter()
    with ProcessPoolExecutor(jobs) as pool:
        waiting = {pool.submit(ask, case, timeout): case.name for case in todo}
        for future in as_completed(waiting):
            result = future.result()
            found[result.name] = result
            at = f"[{len(found)}/{len(todo)}, {time.perf_counter() - begun:.0f} s]"
            print(at, row_of(result, found), flush=True)
    order = sorted(todo, key=lambda case: GROUPS.index(case.group))
    return [found[case.name] for case in order]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", choices=list(FIRST_SEED), default="develop")
    parser.add_argument("--groups", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--seeds", type=int, default=1, help="draws of each planted and simulated kind")
    parser.add_argument("--jobs", type=int, default=2, help="cases side by side")
    parser.add_argument("--timeout", type=float, default=300.0, help="seconds that an explain may take")
    parser.add_argument("--only", nargs="+", default=[], metavar="TEXT", help="cases whose names contain one of these")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all rows to a file too")
    parser.add_argument("--list", action="store_true", help="print the names of the cases and stop")
    asked = parser.parse_args()
    todo = chosen(cases(asked.split, asked.seeds), asked.groups, asked.only)
    if asked.list:
        print("\n".join(f"{case.group:10} {case.name}" for case in todo))
        return
    results = answers(todo, asked.jobs, asked.timeout)
    if asked.json is not None:
        asked.json.write_text(json.dumps([asdict(result) for result in results], indent=1), encoding="utf-8")
    print_rows(f"Closing the loop, {asked.split} split", results)
    print_groups(results)


if __name__ == "__main__":
    main()
