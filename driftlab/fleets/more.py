"""What is done to a unit where it is asked for: the loop, and the pages of its run and its map."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from driftlab.files.map_file import write_page
from driftlab.jobs.explain_in_memory import explained
from driftlab.reports.sheet import map_facts, sheet_of
from fusion_core.errors import FusionError
from fusion_core.host.participants import participants

if TYPE_CHECKING:
    from driftlab.config import Config
    from driftlab.fleets.coasted import Coasted
    from driftlab.fleets.own_map import Own

MISSING = "has no recordings of the roles train and holdout; name one of each in the manifest"


def loop_of(
    config: Config, calibration: Sequence[str], train: Sequence[str], holdout: Sequence[str], files: dict[str, bytes]
) -> dict[str, Any]:
    """Close the loop on the recordings of a unit, and add what it writes to `files`.

    Return its verdict and effects as `loop.json` has them, or why there are none.
    """
    if not train or not holdout:
        return {"why_not": MISSING}
    recordings = {"calibration": calibration, "train": train, "holdout": holdout}
    with tempfile.TemporaryDirectory(prefix="driftlab-") as scratch:
        out = Path(scratch) / "explained"
        try:
            found = explained(config, recordings, out, None)
        except FusionError as error:
            return {"why_not": str(error)}
        files.update({f"explained/{path.name}": path.read_bytes() for path in sorted(out.iterdir())})
    return {"verdict": found.verdict, "effects": found.summary["effects"]}


def add_pages(own: Own, run: Coasted, soaks: Sequence[str], notes: list[str], files: dict[str, bytes]) -> None:
    """Add the pages of map and run to `files`, which has the map."""
    from driftlab.reports.run import write_report
    from driftlab.reports.thermal_map import page_of

    with tempfile.TemporaryDirectory(prefix="driftlab-") as folder:
        place, page = Path(folder) / own.file, Path(folder) / "report.html"
        place.write_bytes(files[own.file])
        facts = [{**map_facts(own.fitted, own.unit, place), "file": own.file}]
        sheet = replace(sheet_of(own.config, soaks, plugins=participants(own.settings)), maps=facts)
        write_page(page, page_of(own.verdict, own.unit, notes, sheet, None))
        files["page/map.report.html"] = page.read_bytes()
        if run.result is None:
            return
        result = run.result
        config = result.config
        sheet = replace(sheet_of(config, judged=result.judged, plugins=result.summary["plugins"]), maps=facts)
        write_report(
            page, result.overview, result.summary, title=result.name, config=config.as_yaml(), model=result.model,
            sheet=sheet, fitted=own.fitted,
        )  # fmt: skip
        files["page/report.html"] = page.read_bytes()
