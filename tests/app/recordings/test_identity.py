import os
import subprocess

import pytest

from driftlab.recordings import identity as module
from driftlab.recordings.identity import beforehand, identity, of_source, sha256
from fusion_core.errors import UnreadableFile
from fusion_plugins.sources.hdf5 import Hdf5
from fusion_plugins.sources.rosbag import Rosbag


def test_the_hash_of_a_folder_is_that_of_its_list_of_hashes(tmp_path):
    """A ROS 2 bag is a folder: moved elsewhere it is the same recording, and with one byte changed it is another."""
    bag = tmp_path / "bag"
    bag.mkdir()
    (bag / "metadata.yaml").write_text("version: 9\n")
    (bag / "bag_0.mcap").write_bytes(bytes(1000))
    listed = subprocess.run(
        "LC_ALL=C; for f in *; do sha256sum $f; done | sha256sum", shell=True, cwd=bag, capture_output=True, text=True
    )
    assert sha256(bag) == listed.stdout.split()[0]
    found = identity(f"{bag}::10:20")
    assert found == {"name": f"{bag}::10:20", "bytes": 1011, "sha256": sha256(bag)}
    source = Rosbag(path=bag, channels={"time": {"path": "/imu"}})
    assert of_source(source)["sha256"] == sha256(bag)
    moved = bag.rename(tmp_path / "other")
    assert identity(str(moved))["sha256"] == found["sha256"]
    (moved / "bag_0.mcap").write_bytes(bytes(999) + b"\1")
    assert identity(str(moved))["sha256"] != found["sha256"]


def test_a_hash_begins_beforehand_unless_the_file_is_a_hole(tmp_path, monkeypatch):
    hashed = []
    monkeypatch.setattr(module, "sha256", hashed.append)
    for name, length in (("rows.h5", 0), ("hole.h5", 1 << 30)):
        path = tmp_path / name
        path.write_bytes(bytes(range(256)) * 64)
        if length:
            os.truncate(path, length)
        beforehand(Hdf5(path=path, channels={"time": {"path": "t"}}))()
    assert hashed == [tmp_path / "rows.h5"]


@pytest.mark.parametrize("name", ["-", "-::10:20"])
def test_of_standard_input_which_is_not_kept_the_name_is_all(name):
    assert identity(name) == {"name": name}


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UnreadableFile, match=r"none.bag: cannot be read"):
        identity(str(tmp_path / "none.bag"))
