"""`driftlab live --web`: a run on a real pty, seen in a browser; unplugged, plugged in again, and ended."""

import json
import re
import signal
import subprocess
import sys
import threading
from pathlib import Path
from urllib.request import urlopen

import pytest
from bench import live_bench, paced, unit_frames
from playwright.sync_api import expect
from typer.testing import CliRunner

from driftlab.cli import PORT, app

DRIFTLAB = Path(sys.executable).with_name("driftlab")
RATE = 100
expect.set_options(timeout=60_000)


@pytest.fixture
def bench(tmp_path):
    with live_bench(tmp_path, RATE) as found:
        yield found


class Running:
    """A live run with its page, and the device that sends to it."""

    def __init__(self, folder, device, *args):
        command = [DRIFTLAB, "live", "live.yaml", "--out", "out", *args]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        self.run = subprocess.Popen(command, cwd=folder, text=True, **pipes)
        self.url = re.fullmatch(r"page: (http://127\.0\.0\.1:\d+/)\n", self.run.stderr.readline())[1]
        self.device, self.stop, self.thread = device, threading.Event(), None

    def send(self, frames):
        self.stop.clear()
        self.thread = paced(self.device, frames, RATE, self.stop)

    def pause(self):
        self.stop.set()
        if self.thread is not None:
            self.thread.join()

    def status(self):
        with urlopen(f"{self.url}status.json") as answer:
            return json.load(answer)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.pause()
        self.run.kill()
        self.run.communicate()


def words(page):
    return page.locator("#words")


def rows(page):
    """Return the number of points of the first panel's curve."""
    return page.evaluate("document.querySelector('figure.chart').chart.content.x?.[0]?.length || 0")


def grown(page, before):
    while (found := rows(page)) <= before:
        page.wait_for_timeout(100)
    return found


def test_a_device_is_seen_in_two_tabs_unplugged_plugged_in_again_and_ended(bench, opened):
    folder, device = bench
    frames = unit_frames(600, RATE)
    with Running(folder, device, "--web", "0", "--record", "raw.h5") as running:
        page, other = opened(running.url, wait=False), opened(running.url, width=390, dark=True, wait=False)
        expect(page.locator("#why")).to_have_text("nothing came so far")
        running.send(frames)
        for each in (page, other):
            expect(words(each)).to_have_text("at rest")
            grown(each, 3)
        device_path = str(device.path)
        running.pause()
        expect(words(page)).to_have_text(re.compile(r"no data for \d+ s"))
        # nothing comes any more: what is shown is what the status says
        status = running.status()
        for k, (bias, sigma) in enumerate(zip(status["bias_rad_s"], status["sigma_rad_s"], strict=True)):
            shown = page.locator(f"[data-bias='{k}']")
            expect(shown).to_have_text(f"{bias * 206264.80624709636:,.2f} deg/h")
            expect(shown.locator("+ dd")).to_have_text(f"± {sigma * 206264.80624709636:,.2f} deg/h, one sigma")
        expect(page.locator("#samples")).to_have_text(f"{status['samples']:,} in all")
        expect(page.locator("#nis")).to_have_text(f"{status['nis_per_component']:.2f}")
        assert status["no_data_s"] > 2
        assert status["level"] == "bad"
        device.unplug()
        for each in (page, other):
            expect(words(each)).to_have_text(re.compile(r"no data for \d+ s"))
            expect(each.locator("#why")).to_have_text(f"unplugged, waiting for {device_path}")
        before = rows(page)
        device.plug()
        running.send(frames[len(frames) // 2 :])
        for each in (page, other):
            expect(words(each)).to_have_text("at rest")
            grown(each, before)
            expect(each.locator("#lines")).to_contain_text("times that the connection was lost: 1")
        running.run.send_signal(signal.SIGTERM)
        for each in (page, other):
            expect(words(each)).to_have_text("finished")
            expect(each.locator("#how")).to_have_text("Finished, results are in out")
            each.close()
        running.pause()
        assert running.run.wait(timeout=60) == 0
    assert (folder / "out" / "report.html").exists()
    problems = [text for text in opened.problems if "ERR_CONNECTION_RE" not in text]  # the server has ended
    opened.problems[:] = problems


def test_a_run_that_fails_says_so_on_its_page(bench, opened):
    with Running(*bench, "--web", "0", "--duration", "4 s") as running:
        page = opened(running.url, wait=False)
        expect(words(page)).to_have_text("ended with an error")
        expect(page.locator("#found li")).to_have_text(re.compile("not one sample came in .* check that the device"))
        page.close()
        assert running.run.wait(timeout=60) == 1
    opened.problems[:] = [text for text in opened.problems if "ERR_CONNECTION_RE" not in text]


def test_a_map_that_cannot_be_fitted_is_told_with_the_results(bench, opened):
    folder, device = bench
    fit = ["--fit-map", "m.json", "--kind", "spline"]
    with Running(folder, device, "--web", "0", "--duration", "5 s", *fit) as running:
        page = opened(running.url, wait=False)
        running.send(unit_frames(120, RATE))
        expect(words(page)).to_have_text("ended with an error")
        expect(page.locator("#found li").first).to_have_text(re.compile("T moves by only 0.00 K"))
        page.close()
        assert running.run.wait(timeout=60) == 1
    assert (folder / "out" / "report.html").exists()
    assert not (folder / "m.json").exists()
    opened.problems[:] = [text for text in opened.problems if "ERR_CONNECTION_RE" not in text]


def test_json_goes_with_a_page_and_a_killed_run_is_missed(bench, opened):
    folder, device = bench
    with Running(folder, device, "--json", "--web", "0") as running:
        page = opened(running.url, wait=False)
        running.send(unit_frames(120, RATE))
        expect(words(page)).to_have_text("at rest")
        running.run.kill()
        expect(words(page)).to_have_text("connection to driftlab lost, trying again")
        page.close()
    assert all("ERR_CONNECTION_RE" in text for text in opened.problems)
    opened.problems.clear()


def test_the_lines_of_json_are_alone_on_standard_output(bench):
    folder, _ = bench
    command = [DRIFTLAB, "live", "live.yaml", "--json", "--web", "0", "--duration", "3 s"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert [json.loads(line)["samples"] for line in done.stdout.splitlines()]
    assert done.stderr.startswith("page: http://127.0.0.1:")


@pytest.mark.parametrize(("args", "port"), [
    (["--web", "live.yaml"], PORT), (["live.yaml", "--web"], PORT), (["live.yaml", "--web", "--json"], PORT),
    (["live.yaml", "--web", "8765"], 8765), (["--web", "8765", "live.yaml"], 8765), (["live.yaml", "--web=0"], 0),
    (["live.yaml"], None),
])  # fmt: skip
def test_the_port_may_be_left_out(bench, monkeypatch, args, port):
    asked = []

    class Refused(Exception):
        pass

    def served(run, number, _):
        asked.append(number)
        raise Refused

    monkeypatch.chdir(bench[0])
    monkeypatch.setattr("driftlab.commands.live.served", served)
    assert isinstance(CliRunner().invoke(app, ["live", *args]).exception, Refused)
    assert asked == [port]


def test_a_port_that_is_taken_is_told(bench):
    import socket

    folder, _ = bench
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        command = [DRIFTLAB, "live", "live.yaml", "--web", port]
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert done.stderr == (
        f"driftlab: --web {port}: the port cannot be had (Address already in use); name another, or 0 for any that is "
        "free\n"
    )
