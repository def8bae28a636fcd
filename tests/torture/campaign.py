"""Bad input, kills and full disks, by the thousand; a table at the end says what each of them came to.

    python tests/torture/campaign.py [--only configs,maps] [--dose 0.1] [--seed 1] [--case configs:123]

Exit status 1 where there was a traceback, a hang, accepted nonsense or lost data. Each such case is printed with its
number and written to `--failures DIR`; `--case CAMPAIGN:NUMBER` with the same seed makes it again.
"""

from __future__ import annotations

import argparse
import importlib
import shutil
import sys
import tempfile
import time
from collections import defaultdict
from contextlib import suppress
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path += [str(HERE.parent / name) for name in ("", "support", "core")]  # as the workers, and pytest's, have it

from torture.outcome import FAILURES, KINDS, Outcome  # noqa: E402

NAMES = (
    "configs", "recordings", "tables", "maps", "streams", "kills", "disks", "injections", "surroundings", "extremes",
    "bombs",
)  # fmt: skip
KEPT = 5  # cases of one cause that are written and printed
LARGEST = 20 << 20  # bytes of a file that is kept with its case
SEED = 20_180_509


class Tally:
    """The outcomes of the cases of one campaign."""

    def __init__(self, name: str, seed: int, failures: Path) -> None:
        self.name, self.seed, self.failures = name, seed, failures
        self.counts = dict.fromkeys(KINDS, 0)
        self.causes: dict[tuple[str, str], list[int]] = defaultdict(list)
        self.begun, self.seconds, self.last = time.monotonic(), 0.0, 0.0

    def add(self, number: int, outcome: Outcome, case: Path) -> None:
        """Count a case, and keep it where it failed."""
        self.counts[outcome.kind] += 1
        self.seconds = time.monotonic() - self.begun
        if outcome.kind in FAILURES:
            known = self.causes[outcome.kind, outcome.cause]
            known.append(number)
            if len(known) <= KEPT:
                self._keep(number, outcome, case)
        if sys.stderr.isatty() and self.seconds - self.last > 1:
            self.last = self.seconds
            sys.stderr.write(f"\r{self.name}: {sum(self.counts.values())} cases, {self.seconds:.0f} s ")

    def _keep(self, number: int, outcome: Outcome, case: Path) -> None:
        target = self.failures / f"{self.name}-{self.seed}-{number}"
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        (target / "what.txt").write_text(f"{outcome.kind}: {outcome.cause}\n\n{outcome.detail}\n", errors="replace")
        for path in case.rglob("*") if case.is_dir() else ():
            if path.is_file() and not path.is_symlink() and path.stat().st_size <= LARGEST:
                copy = target / path.relative_to(case)
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy(path, copy)
        sys.stderr.write(f"{self.name} {number}: {outcome.kind}: {outcome.cause}\n")

    @property
    def failed(self) -> int:
        """The number of cases that failed."""
        return sum(self.counts[kind] for kind in FAILURES)


def table(tallies: list[Tally]) -> str:
    """Return the table of all campaigns, and the causes of what failed below it."""
    heads = ("campaign", "cases", "accepted", "clean errors", "undetectable", "tracebacks", "hangs", "nonsense", "lost")
    rows = [[tally.name, sum(tally.counts.values()), *tally.counts.values()] for tally in tallies]
    rows.append(["all", *(sum(column) for column in zip(*(row[1:] for row in rows), strict=True))])
    seconds = [f"{tally.seconds:.0f}" for tally in tallies]
    cells = [[*map(str, row), s] for row, s in zip(rows, [*seconds, f"{sum(map(float, seconds)):.0f}"], strict=True)]
    widths = [max(map(len, column)) for column in zip((*heads, "seconds"), *cells, strict=True)]
    lines = [
        "  ".join(cell.rjust(w) for cell, w in zip(row, widths, strict=True)) for row in [(*heads, "seconds"), *cells]
    ]
    for tally in tallies:
        for (kind, cause), numbers in sorted(tally.causes.items(), key=lambda item: -len(item[1])):
            some = ", ".join(map(str, numbers[:KEPT])) + (", ..." if len(numbers) > KEPT else "")
            lines.append(f"{tally.name}: {len(numbers)} x {kind}: {cause} (cases {some})")
    return "\n".join(lines)


def selected(options: argparse.Namespace) -> list[tuple[Any, list[int]]]:
    """Return the modules of the campaigns, and the numbers of the cases."""
    if options.case:
        name, _, number = options.case.partition(":")
        return [(importlib.import_module(f"torture.{name}"), [int(number)])]
    names = options.only.split(",") if options.only else NAMES
    modules = [importlib.import_module(f"torture.{name}") for name in names]
    return [(module, list(range(max(1, round(module.CASES * options.dose))))) for module in modules]


def main() -> int:
    """Run the campaigns."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"some of {','.join(NAMES)}")
    parser.add_argument("--dose", type=float, default=1.0, help="share of the cases")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--case", help="a single one, as CAMPAIGN:NUMBER")
    parser.add_argument("--workers", type=int, help="processes at once, in place of the campaign's own number")
    parser.add_argument("--failures", type=Path, default=Path("torture_failures"))
    options = parser.parse_args()
    tallies: list[Tally] = []
    with suppress(KeyboardInterrupt):  # what was found until then is printed
        run(options, tallies)
    print(table(tallies))
    failed = sum(tally.failed for tally in tallies)
    if failed:
        print(f"{failed} cases failed; see {options.failures}, again with --seed {options.seed} --case CAMPAIGN:NUMBER")
    return int(failed > 0)


def run(options: argparse.Namespace, tallies: list[Tally]) -> None:
    """Run the campaigns one after the other, and add what they came to."""
    for module, numbers in selected(options):
        tally = Tally(module.__name__.rpartition(".")[2], options.seed, options.failures.resolve())
        tallies.append(tally)
        with tempfile.TemporaryDirectory(prefix="torture-") as folder:
            from torture.workers import work

            work(module, numbers, Path(folder), options.seed, tally.add, options.workers)
        tally.seconds = time.monotonic() - tally.begun


if __name__ == "__main__":
    sys.exit(main())
