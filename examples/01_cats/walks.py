"""Both filters on the measured recording's third placement, at three walks: what of the difference is the walk?

Run `make demo` first: it fetches the recording and fits the map. The truth is not known here; errors are against the
centred 30 s average of the gyro, whose own noise (59, 66 and 75 deg/h rms on x, y and z) is in every number.

    python examples/01_cats/walks.py
"""

from __future__ import annotations

from demo import DEG_H, HERE, PLACEMENTS, recording
from noise_by_likelihood import fit_noise
from rich.console import Console
from rich.table import Table
from rich.text import Text

from driftlab.config import Config, load_config
from driftlab.evaluation.scores import over_axes, score
from driftlab.filtering.run import Run
from driftlab.filtering.segment import RunLog, joined
from driftlab.recordings.epochs import epochs
from driftlab.recordings.screening import read
from fusion_core.chunk import concatenate
from fusion_core.faults import Faults
from fusion_core.units import Quantity

WALKS = {"a third": 1 / 3.3, "declared": 1.0, "3.3 times": 3.3}  # of the declared walk


def with_walk(config: Config, walk: tuple[float, ...]) -> Config:
    """Return the config with another walk of the gyro's bias (rad/s/sqrt(s), one an axis)."""
    gyro = config.filter.gyro
    quantities = tuple(Quantity(value, f"{value!r} rad/s/sqrt(s)") for value in walk)
    gyro = gyro.model_copy(update={"bias": gyro.bias.model_copy(update={"walk": quantities})})
    return config.model_copy(update={"filter": config.filter.model_copy(update={"gyro": gyro})})


def main() -> None:
    """Run both filters at every walk and print one table."""
    table = Table(title="CATS placement 3, deg/h, rms over the axes", title_justify="left")
    for heading in ("filter", "walk", "[deg/h/sqrt(s)] x, y, z", "whole", "predicted 10 min", "to the end"):
        table.add_column(Text(heading), justify="left" if heading in ("filter", "walk") else "right", no_wrap=True)
    for name in ("no map", "standard", "tczupt"):
        file = "base" if name == "no map" else name
        config = load_config(HERE / f"{file}.yaml", f"{recording()}{PLACEMENTS[2]}")
        stream = concatenate(list(epochs(read(config, Faults()), config.filter.update_interval)))
        declared = float(config.filter.gyro.bias.walk)
        likely = tuple((declared * fit_noise(config, [stream])["gyro"].walk).tolist())
        for label, walk in {**{k: (declared * f,) * 3 for k, f in WALKS.items()}, "likely": likely}.items():
            estimates = joined(Run(with_walk(config, walk), RunLog()).over([stream]))
            found = score(estimates, None, ("x", "y", "z"))
            errors = (found.filter_whole, found.coast["10 min"], found.coast["to the end"])
            cells = [f"{over_axes(error) / DEG_H:.1f}" for error in errors]
            walks = ", ".join(f"{value / DEG_H:.2g}" for value in walk)
            table.add_row(name, label, walks, *cells, end_section=label == "likely")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
