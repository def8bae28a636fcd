"""Every benchmark, one table each; `--short` leaves out the longest recordings."""

from __future__ import annotations

import accuracy
import end_to_end
import explain
import fleet
import growth
import roads
import streaming
from common import machine


def main() -> None:
    print(f"Measured on {machine()}.")
    for benchmark in (roads, accuracy, fleet, streaming, growth, explain, end_to_end):
        benchmark.main()


if __name__ == "__main__":
    main()
