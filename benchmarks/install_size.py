"""Size of an installation: driftlab with what it requires, what each extra adds, and the largest packages.

Sizes are those of the files of each installed distribution, compiled bytecode included; a package is counted once,
where it is first required.
"""

from __future__ import annotations

from importlib.metadata import Distribution, PackageNotFoundError, distribution

from common import Row, show
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("excel", "ros", "dask")


def required(name: str, extra: str, found: dict[str, Distribution]) -> None:
    """Add to `found` the distribution of this name and, recursively, what it requires with this extra ("": none)."""
    for text in distribution(name).requires or ():
        requirement = Requirement(text)
        if requirement.marker is not None and not requirement.marker.evaluate({"extra": extra}):
            continue
        key = canonicalize_name(requirement.name)
        if key in found:
            continue
        try:
            found[key] = distribution(key)
        except PackageNotFoundError:
            continue  # for another system or Python
        for inner in ("", *requirement.extras):
            required(key, inner, found)


def megabytes(package: Distribution) -> float:
    """Return the size of a distribution's files in MB."""
    paths = {path.resolve() for file in package.files or () if (path := package.locate_file(file)).is_file()}
    return sum(path.stat().st_size for path in paths) / 1e6


def main() -> None:
    found: dict[str, Distribution] = {"driftlab": distribution("driftlab")}
    required("driftlab", "", found)
    sizes = {name: megabytes(package) for name, package in found.items()}
    rows = [Row(f"driftlab and the {len(found) - 1} packages that it requires", f"{sum(sizes.values()):.0f} MB")]
    largest = sorted(sizes, key=sizes.__getitem__, reverse=True)[:8]
    rows += [Row(f"of these: {name}", f"{sizes[name]:.0f} MB") for name in largest]
    for extra in EXTRAS:
        more = dict(found)
        required("driftlab", extra, more)
        added = [more[name] for name in more if name not in found]
        rows.append(Row(f"extra {extra}: {len(added)} packages more", f"{sum(map(megabytes, added)):.0f} MB"))
    show("Size of an installation", rows)


if __name__ == "__main__":
    main()
