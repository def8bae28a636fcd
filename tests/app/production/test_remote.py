"""Recordings behind URLs: the same bytes are read, and what is wrong is said of the URL."""

import subprocess
import sys
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import family
import fsspec
import pytest
from clusters import s3

from driftlab.errors import ConfigError, UnreadableFile
from driftlab.production.remote import is_url, local, look
from driftlab.production.unit import Task, key_of, work


@contextmanager
def fetched(url):
    """Give what is behind a URL as a file or folder of this machine."""
    with local([url]) as names:
        yield Path(names[url])


@pytest.fixture
def bucket():
    """Files in the memory of this process, as fsspec has it: addresses, lengths and times as of a bucket."""
    system = fsspec.filesystem("memory")
    system.pipe({"/line/0001/soak.h5": b"first", "/line/0002/soak.h5": b"second one"})
    yield system
    system.rm("/line", recursive=True)


@pytest.mark.parametrize(
    ("name", "yes"),
    [
        ("s3://line/0001/soak.h5", True),
        ("https://example.com/soak.h5::0:10", True),
        ("zip://soak.h5::file:///all.zip", True),
        ("soaks/0001.h5", False),
        ("/soaks/0001.h5::0:100", False),
        ("soak.h5::s3://", False),
    ],
)
def test_urls_are_told_from_paths(name, yes):
    assert is_url(name) is yes


def test_a_url_is_a_file_as_long_as_it_is_needed(bucket):
    with fetched("memory://line/0001/soak.h5") as path:
        assert path.name == "soak.h5"
        assert path.read_bytes() == b"first"
    assert not path.exists()
    assert not path.parent.parent.exists()


def test_names_stay_what_they_are_but_for_urls(bucket):
    names = ["soak.h5", "soak.h5::0:10", "memory://line/0001/soak.h5::5:", "memory://line/0001/soak.h5::0:5"]
    names += ["memory://line/0002/soak.h5", "soak.h5"]
    with local(names) as found:
        assert set(found) == set(names)
        assert [found[name] for name in names[:2]] == names[:2]
        copies = [Path(found[name].partition("::")[0]) for name in names[2:5]]
        assert [found[name].partition("::")[2] for name in names[2:5]] == ["5:", "0:5", ""]
        assert copies[0] == copies[1] != copies[2]
        assert [copy.read_bytes() for copy in copies] == [b"first", b"first", b"second one"]


def test_a_folder_is_a_recording_too(bucket):
    with fetched("memory://line") as path:
        assert {str(p.relative_to(path)) for p in path.rglob("*.h5")} == {"0001/soak.h5", "0002/soak.h5"}


def test_a_file_of_this_machine_is_not_copied(tmp_path):
    (tmp_path / "soak.h5").write_bytes(b"here")
    with fetched(f"file://{tmp_path}/soak.h5") as path:
        assert path == tmp_path / "soak.h5"
    assert path.exists()


def test_a_recording_inside_an_archive(tmp_path):
    import zipfile

    with zipfile.ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.writestr("a/soak.h5", b"packed")
    with local([f"zip://a/soak.h5::file://{tmp_path}/all.zip::0:10"]) as found:
        [copy] = found.values()
        assert copy.endswith("soak.h5::0:10")
        assert Path(copy.partition("::")[0]).read_bytes() == b"packed"


def test_a_look_changes_with_the_content_alone(bucket):
    url = "memory://line/0001/soak.h5"
    first = look(url)
    assert first is not None
    assert first[0] == 5
    assert look(f"{url}::0:10") == first
    bucket.pipe({"/line/0001/soak.h5": b"other"})
    assert look(url) != first


def test_what_is_wrong_is_said_of_the_url(bucket, monkeypatch):
    with pytest.raises(
        UnreadableFile, match=r"memory://line/none\.h5: is not there, or its server does not answer; name an"
    ):
        look("memory://line/none.h5")
    with pytest.raises(UnreadableFile, match=r"memory://line/none\.h5: is not there"), fetched("memory://line/none.h5"):
        pass
    with pytest.raises(
        ConfigError, match=r"carrier://x: cannot be reached \(ValueError: Protocol not known: carrier\)"
    ):
        look("carrier://x")

    def refuses(*_, **__):
        raise PermissionError("Access Denied")

    monkeypatch.setattr(type(bucket), "get_file", refuses)
    with pytest.raises(UnreadableFile, match=r"cannot be fetched \(PermissionError: Access Denied\); see to access"):
        fetched("memory://line/0001/soak.h5").__enter__()


def test_a_copy_that_was_cut_is_refused(bucket, monkeypatch):
    monkeypatch.setattr(type(bucket), "get_file", lambda _, name, path: Path(path).write_bytes(b"fir"))
    with pytest.raises(UnreadableFile, match=r"memory://line/0001/soak\.h5: 3 bytes came of 5; fetch it again"):
        fetched("memory://line/0001/soak.h5").__enter__()


def test_the_extra_is_named_where_it_is_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "fsspec", None)
    with pytest.raises(ConfigError, match=r"fsspec is not installed.*; pip install 'driftlab\[dask\]'"):
        look("s3://line/soak.h5")


def test_a_unit_in_a_bucket_is_done_as_one_here(bucket, tmp_path):
    family.write(tmp_path / "soak.h5", family.soak(family.deal(1)[0], hours=1.0))
    bucket.pipe("/line/0003/soak.h5", (tmp_path / "soak.h5").read_bytes())
    config = (Path(family.__file__).parent / "family.yaml").read_text()
    here = Task("0003", recordings={"calibration": ("soak.h5",)}, config=config, folder=str(tmp_path), page=True)
    there = replace(here, recordings={"calibration": ("memory://line/0003/soak.h5",)})
    assert key_of(here) == key_of(there)
    ours, theirs = (work(task) for task in (here, there))
    said = theirs.record.model_dump_json()
    assert theirs.record.state == "done"
    assert said.count("memory://line/0003/soak.h5") == 2
    assert "driftlab-" not in said
    other = {"seconds", "recordings", "coast_of"}
    assert ours.record.model_dump_json(exclude=other) == theirs.record.model_dump_json(exclude=other)
    assert ours.files["unit.npz"] == theirs.files["unit.npz"]
    assert set(ours.files) == set(theirs.files)
    for name in theirs.files:
        assert b"/driftlab-" not in theirs.files[name], name


def test_a_unit_that_is_not_in_the_bucket_is_a_record_that_says_so(bucket):
    config = (Path(family.__file__).parent / "family.yaml").read_text()
    done = work(Task("0004", recordings={"calibration": ("memory://line/0004/soak.h5",)}, config=config))
    assert done.record.state == "failed"
    assert done.record.error.startswith("memory://line/0004/soak.h5: is not there")
    assert done.record.recordings == {"calibration": [{"name": "memory://line/0004/soak.h5"}]}


def test_nothing_is_loaded_for_paths():
    code = (
        "import sys; from driftlab.production.remote import local\n"
        "with local(['a.h5', 'b.h5::0:1']) as found: print(found, 'fsspec' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "{'a.h5': 'a.h5', 'b.h5::0:1': 'b.h5::0:1'} False"


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


def test_a_real_server(tmp_path):
    pytest.importorskip("aiohttp")
    (tmp_path / "soak.h5").write_bytes(b"served" * 1000)
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path)))
    Thread(target=server.serve_forever, daemon=True).start()
    url = f"http://127.0.0.1:{server.server_port}/soak.h5"
    try:
        with fetched(f"{url}?key=1") as path:
            assert path.name == "soak.h5"
            assert path.read_bytes() == b"served" * 1000
        first = look(url)
        with pytest.raises(UnreadableFile, match=r"none\.h5: is not there"):
            look(url.replace("soak", "none"))
    finally:
        server.shutdown()
        server.server_close()
    assert first is None or first[0] == 6000
    with pytest.raises(UnreadableFile, match="or its server does not answer"):
        look(url)


def test_a_real_bucket(tmp_path):
    """moto serves the API of S3; s3fs asks it as it asks the real one."""
    with s3(tmp_path) as system:
        system.mkdir("line")
        system.pipe({"line/0001/soak.h5": b"first", "line/0002/soak.h5": b"second one"})
        with local(["s3://line/0001/soak.h5::0:5", "s3://line/0002/soak.h5"]) as found:
            copies = [Path(name.partition("::")[0]).read_bytes() for name in found.values()]
            assert copies == [b"first", b"second one"]
        before = look("s3://line/0001/soak.h5")
        system.pipe("line/0002/soak.h5", b"another")
        assert look("s3://line/0001/soak.h5") == before
        system.pipe("line/0001/soak.h5", b"other")
        assert look("s3://line/0001/soak.h5") != before
        with pytest.raises(UnreadableFile, match="is not there"):
            look("s3://line/0003/soak.h5")
        with pytest.raises(UnreadableFile, match=r"cannot be fetched|is not there"):
            look("s3://other/0001/soak.h5")
