"""The price of looking for steps everywhere in a line: the table in `driftlab/spc/change_points.py`.

Largest T of normal values that are all alike, by the search that is in use: its quantiles at 10, 1 and 0.1 %.
Takes ten minutes.
"""

import numpy as np

from driftlab.spc.change_points import TAILS, strongest

SIZES = {10: 60_000, 14: 60_000, 20: 60_000, 35: 40_000, 60: 40_000, 100: 40_000, 200: 30_000, 400: 20_000,
         1000: 10_000, 2500: 5_000}  # fmt: skip


def main() -> None:
    rng = np.random.default_rng(20)
    for n, repeats in SIZES.items():
        found = [max(one[0] for one in strongest(rng.normal(size=n), np.ones(n))) for _ in range(repeats)]
        print(f"    {n}: ({', '.join(f'{v:.2f}' for v in np.quantile(found, 1 - np.array(TAILS)))}),", flush=True)


if __name__ == "__main__":
    main()
