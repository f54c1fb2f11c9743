"""What is to be seen of a run: in a file, and on a page that is served on loopback only."""

import os
import resource
import subprocess
import sys
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from browser import Browser
from refusal import refusal
from typer.testing import CliRunner

import fgloc
from fgloc.cli import app
from fgloc.config import Config, load_config
from fgloc.errors import OutputError
from fgloc.runner import RunResult
from fgloc.sensors.maps import load_map
from fgloc.types import Decision, Estimate, Finding, Mode, Trajectory
from fgloc.view import scene as scenes
from fgloc.view.page import Page, PrivatePage
from fgloc.view.scene import write_rrd

rerun = pytest.importorskip("rerun")
SAMPLE = Path(fgloc.__file__).parent.parent / "datasets" / "samples" / "first_run"
PROGRAM = Path(sys.executable).with_name("rerun")
NS = 10**9


def estimate(k, mode=Mode.OK, truth_off=0.0):
    """Along x, with sightings of two landmarks of the sample."""
    seen = [
        Decision(k, k * NS, "corners", i, 1.0, 1.0, 8, weight, reason)
        for i, weight, reason in ((3, 1.0, ""), (5, 0.0, "gate"))
    ]
    return Estimate(k * NS, np.array([0.5 * k, truth_off, 0.1]), np.diag([4e-4, 1e-4, 1e-4]), mode, tuple(seen))


def result(n=250):
    """A run whose truth lies 3 cm beside it."""
    stamps = np.arange(1, n + 1) * NS
    estimates = [estimate(k) for k in range(1, n + 1)]
    poses = np.array([e.pose for e in estimates])
    return RunResult(
        Trajectory(stamps, poses, np.array([e.cov for e in estimates])),
        tuple(Mode.LOST if k > n // 2 else Mode.OK for k in range(n)),
        tuple(d for e in estimates for d in e.decisions),
        {},
        {},
        (Finding("test", "to know."),),
        np.zeros(n),
        1.0,
        truth=Trajectory(stamps, poses + np.array([0.0, 0.03, 0.0])),
        landmarks=load_map(SAMPLE / "map.yaml"),
        config=Config.model_validate({"truth": {"max_gap_s": 2.0}}),
    )


def printed(path):
    """All that rerun's own program reads in a file."""
    return subprocess.run([PROGRAM, "rrd", "print", "-vvv", path], capture_output=True, text=True, check=True).stdout


def test_a_run_is_written_whole(tmp_path):
    path = tmp_path / "new" / "run.rrd"
    write_rrd(result(), path)
    subprocess.run([PROGRAM, "rrd", "verify", path], check=True, capture_output=True)
    text = printed(path)
    for entity in (
        "/map/markers",
        "/map/robot",
        "/map/covariance",
        "/map/path/2",
        "/map/truth/0",
        "/map/sightings/rejected",
    ):
        assert entity in text, entity
    assert {"LOST", "OK", "to know."} <= {word for word in ("LOST", "OK", "to know.") if word in text}
    assert list(path.parent.iterdir()) == [path]


def test_the_error_is_that_against_the_truth(tmp_path):
    sent = {}

    class Stream:
        def send_blueprint(self, blueprint):
            pass

        def set_time(self, timeline, timestamp):
            self.now = timestamp

        def log(self, entity, what, static=False):
            sent.setdefault(entity, []).append(what)

    scene = scenes.Scene(Stream(), max_gap_s=1.5)
    for k in (1, 2, 5):
        scene.add_truth(k * NS, np.array([0.5 * k, 0.03, 0.1]))
    for k in (2, 3, 5):  # the truth of 3 s lies in a gap
        scene.add(estimate(k))
    errors = [float(s.scalars.as_arrow_array()[0].as_py()) for s in sent["position/error"]]
    assert errors == pytest.approx([0.03, 0.03])
    sigmas = [float(s.scalars.as_arrow_array()[0].as_py()) for s in sent["position/sigma"]]
    assert sigmas == pytest.approx([0.02] * 3)


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    (tmp_path / "file").write_text("")
    with refusal(OutputError, tmp_path / "file"):
        write_rrd(result(3), tmp_path / "file" / "run.rrd")


def test_on_a_full_disk_the_error_says_so_and_nothing_is_left(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (4000, before[1]))
    try:
        with refusal(OutputError, tmp_path / "run.rrd"):
            write_rrd(result(100), tmp_path / "run.rrd")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert not list(tmp_path.iterdir())


def test_without_rerun_the_remedy_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(OutputError, match=r"pip install 'fgloc\[view\]'"):
        scenes.new_stream()


def test_one_file_is_of_one_bag():
    done = CliRunner().invoke(app, ["smooth", "a", "b", "--out", "x", "--rrd", "y.rrd"])
    assert (done.exit_code, "one bag" in done.stderr) == (1, True)


def listening(pid):
    """Addresses on which a process's group listens, as /proc has them."""
    addresses = set()
    for process in [p for p in Path("/proc").iterdir() if p.name.isdigit()]:
        try:
            if os.getpgid(int(process.name)) != pid:
                continue
            sockets = {os.readlink(f) for f in (process / "fd").iterdir()}
        except OSError:
            continue
        for table in ("tcp", "tcp6"):
            for line in Path(f"/proc/net/{table}").read_text().splitlines()[1:]:
                fields = line.split()
                if fields[3] == "0A" and f"socket:[{fields[9]}]" in sockets:
                    addresses.add(fields[1].split(":")[0])
    return addresses


def test_the_page_is_on_loopback_and_may_connect_nowhere_else(monkeypatch):
    """Nor does it ask a proxy that the environment names for what is on this machine."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    for name in ("http_proxy", "HTTP_PROXY", "all_proxy"):
        monkeypatch.setenv(name, "http://127.0.0.1:9")
    for name in ("no_proxy", "NO_PROXY"):
        monkeypatch.delenv(name, raising=False)
    with Page() as page:
        assert page.url.startswith("http://127.0.0.1:")
        assert listening(page._server.pid) == {"0100007F"}  # 127.0.0.1, and no other
        with direct.open(page.url) as answer:
            assert b"re_viewer" in answer.read()
            policy = answer.headers["Content-Security-Policy"]
        assert "connect-src 'self' data: blob: http://127.0.0.1:*" in policy
        with pytest.raises(urllib.error.HTTPError, match="404"):
            direct.open(f"{page.url.split('?')[0]}nothing.js")
        pid = page._server.pid
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_taken_port_is_an_error():
    first = PrivatePage(1)
    try:
        with pytest.raises(OutputError, match=rf"\b{first.port}\b"):
            Page(first.port)
    finally:
        first.close()


def coloured(picture):
    """Share of pixels that are neither grey nor white: the path, lines and curves."""
    return float((np.ptp(picture.astype(int), axis=2) > 60).mean())


@pytest.mark.slow
def test_the_page_shows_the_run_in_a_browser(tmp_path):
    """Of the sample: the map with path and sightings, and the curves."""
    landmarks = load_map(SAMPLE / "map.yaml")
    with Page() as page:
        scene = page.scene(load_config(SAMPLE / "robot.yaml").truth.max_gap_s)
        scene.add_map(landmarks)
        for k in range(1, 30):
            scene.add_truth(k * NS, np.array([0.1 * k, 0.05, 0.0]))
            scene.add(estimate(k, Mode.OK if k < 15 else Mode.LOST))
        with Browser(tmp_path, page.url) as browser:
            picture = browser.screenshot(lambda p: coloured(p) > 0.01, 90.0)
    assert coloured(picture) > 0.01
    assert coloured(picture[100:600, :700]) > 0.002  # the map at the left
    assert coloured(picture[:, 750:]) > 0.005  # curves and modes at the right
    assert all(host.startswith("127.0.0.1") for host in browser.asked), browser.asked
