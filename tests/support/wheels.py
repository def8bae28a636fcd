"""Distributions for the tests: wheels made of a text or two, installed by pip into a folder of their own."""

import subprocess
import sys
import zipfile
from pathlib import Path


def wheel(folder, name, version, files, points):
    """Write the wheel of a distribution: `files` by path, `points` are its entry points for plugins."""
    plain = name.replace("-", "_")
    info = f"{plain}-{version}.dist-info"
    content = dict(files) | {
        f"{info}/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
        f"{info}/WHEEL": "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": "[fusion_core]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()),
    }
    content[f"{info}/RECORD"] = "".join(f"{path},,\n" for path in (*content, f"{info}/RECORD"))
    path = Path(folder) / f"{plain}-{version}-py3-none-any.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in content.items():
            archive.writestr(name, text)
    return path


def install(site, wheels):
    """Install wheels into the folder `site`, without a network."""
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--disable-pip-version-check"]
    subprocess.run([*pip, "--upgrade", "--target", site, *wheels], check=True)
