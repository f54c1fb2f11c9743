"""Downloads: against a server on this machine, and archives that want to leave their folder."""

from __future__ import annotations

import hashlib
import threading
import zipfile
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest
from refusal import refusal

from fgloc.errors import RecordingError
from fgloc_datasets.convert import Remote, fetch, unpack

_CONTENT = bytes(range(256)) * 300


class _Handler(BaseHTTPRequestHandler):
    hits = 0

    def do_GET(self) -> None:
        type(self).hits += 1
        if self.path == "/missing.zip":
            self.send_error(404)
            return
        self.send_response(200)
        if self.path != "/unsized.zip":
            self.send_header("Content-Length", str(len(_CONTENT) + (100 if self.path == "/cut.zip" else 0)))
        self.end_headers()
        self.wfile.write(_CONTENT)

    def log_message(self, format: str, *args: object) -> None:
        """Silence."""


@pytest.fixture
def server() -> Iterator[str]:
    _Handler.hits = 0
    with ThreadingHTTPServer(("127.0.0.1", 0), _Handler) as service:
        thread = threading.Thread(target=service.serve_forever, args=(0.01,))
        thread.start()
        yield f"http://127.0.0.1:{service.server_port}"
        service.shutdown()
        thread.join()


def test_a_file_is_fetched_checked_and_not_fetched_twice(server: str, tmp_path: Path) -> None:
    remote = Remote(f"{server}/set.zip", size=len(_CONTENT), sha256=hashlib.sha256(_CONTENT).hexdigest())
    assert fetch(remote, tmp_path / "new").read_bytes() == _CONTENT
    assert fetch(remote, tmp_path / "new") == tmp_path / "new" / "set.zip"
    assert _Handler.hits == 1
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["set.zip"]


def test_a_server_that_tells_no_length_will_do(server: str, tmp_path: Path) -> None:
    assert fetch(Remote(f"{server}/unsized.zip"), tmp_path).read_bytes() == _CONTENT


@pytest.mark.parametrize(
    ("name", "size", "sha256", "says"),
    [
        ("cut.zip", None, None, " 76900"),
        ("set.zip", 70_000, None, " 70000"),
        ("set.zip", 80_000, None, " 80000"),
        ("set.zip", None, "00" * 32, "sha256"),
        ("missing.zip", None, None, "Not Found"),
    ],
)
def test_what_is_not_as_expected_leaves_nothing(
    server: str, tmp_path: Path, name: str, size: int | None, sha256: str | None, says: str
) -> None:
    with pytest.raises(RecordingError, match=says):
        fetch(Remote(f"{server}/{name}", size, sha256), tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_fault_71_an_interrupted_download_keeps_the_old_file(server: str, tmp_path: Path) -> None:
    (tmp_path / "cut.zip").write_bytes(b"old")
    with pytest.raises(RecordingError, match="expected"):
        fetch(Remote(f"{server}/cut.zip", size=len(_CONTENT) + 100), tmp_path)
    assert (tmp_path / "cut.zip").read_bytes() == b"old"


@pytest.mark.parametrize(
    "url", ["http://example.com/set.zip", "file:///etc/passwd", "https://example.com/", "set.zip", "http://[::2]/x.zip"]
)
def test_other_addresses_are_refused(url: str, tmp_path: Path) -> None:
    with refusal(RecordingError, url, "https"):
        fetch(Remote(url), tmp_path)


def _archive(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for name, content in members.items():
            file.writestr(name, content)
    return path


def test_an_archive_is_unpacked_whole(tmp_path: Path) -> None:
    archive = _archive(tmp_path / "set.zip", {"inner/a.dat": b"1", "b.dat": b"2"})
    folder = unpack(archive, tmp_path / "deep" / "set")
    assert sorted(p.relative_to(folder).as_posix() for p in folder.rglob("*.dat")) == ["b.dat", "inner/a.dat"]
    assert [p.name for p in folder.parent.iterdir()] == ["set"]


@pytest.mark.parametrize("name", ["../out.dat", "/out.dat", "a/../../out.dat", "..\\out.dat", "C:\\out.dat"])
def test_fault_65_an_archive_cannot_write_outside(name: str, tmp_path: Path) -> None:
    archive = _archive(tmp_path / "set.zip", {"a.dat": b"1", name: b"2"})
    with refusal(RecordingError, archive, repr(name)):
        unpack(archive, tmp_path / "files" / "set")
    assert list((tmp_path / "files").iterdir()) == []
    assert not (tmp_path / "out.dat").exists()


def test_fault_65_an_archive_cannot_hold_links(tmp_path: Path) -> None:
    with zipfile.ZipFile(tmp_path / "set.zip", "w") as file:
        link = zipfile.ZipInfo("link")
        link.external_attr = 0o120777 << 16
        file.writestr(link, "/etc")
    with refusal(RecordingError, tmp_path / "set.zip", "link"):
        unpack(tmp_path / "set.zip", tmp_path / "set")


def test_a_damaged_archive_is_named(tmp_path: Path) -> None:
    archive = _archive(tmp_path / "set.zip", {"a.dat": bytes(1000)})
    archive.write_bytes(archive.read_bytes()[:-30])
    with refusal(RecordingError, archive, cause=zipfile.BadZipFile):
        unpack(archive, tmp_path / "set")
