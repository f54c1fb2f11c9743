"""A page on loopback that shows a live run, served by rerun's own server as a process beside this one."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.error import URLError
from urllib.parse import quote
from urllib.request import ProxyHandler, build_opener

from fgloc.errors import OutputError
from fgloc.view.scene import Scene, import_rerun, new_stream

# --- The page without any other machine -------------------------------------------------------------------------------

HOST = "127.0.0.1"
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "  # the page is script and WebAssembly in one
    f"connect-src 'self' data: blob: http://{HOST}:*"
)
_direct = build_opener(ProxyHandler({}))  # a proxy of the environment does not reach this machine's loopback
_PASSED = ("Content-Type", "Content-Encoding", "Content-Length")


class PrivatePage:
    """Passes on the files of a page that is served on loopback, with a content security policy.

    Without it rerun's viewer sends usage statistics to its makers and asks other servers for fonts and news.
    """

    def __init__(self, source_port: int, port: int = 0) -> None:
        """Serve on loopback what is at ``source_port``; ``port`` 0: a free one.

        Raises:
            OSError: the port is taken.
        """

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                try:
                    with _direct.open(f"http://{HOST}:{source_port}{self.path}") as answer:
                        content = answer.read()
                        passed = {name: answer.headers[name] for name in _PASSED if name in answer.headers}
                except URLError:  # no such file, or the server has ended
                    self.send_error(404)
                    return
                self.send_response(200)
                for name, value in passed.items():
                    self.send_header(name, value)
                self.send_header("Content-Security-Policy", _POLICY)
                self.end_headers()
                self.wfile.write(content)

            def log_message(self, format: str, *args: object) -> None:
                """Log nothing: the library does not print."""

        self._server = ThreadingHTTPServer((HOST, port), Handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="fgloc-page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the server."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()


# --- The server -------------------------------------------------------------------------------------------------------

_START_S = 15.0
_MEMORY = "256MB"  # of the past that a browser which comes late still gets


class Page:
    """The server, and the stream that goes into it. Close it, or use it in a ``with``.

    Attributes:
        url: of the page.
    """

    def __init__(self, port: int = 0) -> None:
        """Start the server; ``port`` 0: a free one.

        It listens on loopback only, and neither it nor the page in the browser connects to any other machine.

        Raises:
            OutputError: rerun is not installed, or its server does not start.
        """
        import_rerun()
        self._folder = tempfile.TemporaryDirectory(prefix="fgloc-view-")
        program = _program()
        data_port, page_port = _free_port(), _free_port()
        environment = {**os.environ, "XDG_CONFIG_HOME": self._folder.name, "XDG_DATA_HOME": self._folder.name}
        options = ["--bind", HOST, "--port", str(data_port), "--web-viewer-port", str(page_port)]
        quiet: dict[str, Any] = {"env": environment, "stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
        try:
            subprocess.run([program, "analytics", "disable"], stderr=subprocess.DEVNULL, check=True, **quiet)
            self._server = subprocess.Popen(
                [program, "--serve-web", *options, "--server-memory-limit", _MEMORY],
                stderr=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C is for this process, which then ends the server
                **quiet,
            )
        except (OSError, subprocess.CalledProcessError) as error:
            self._folder.cleanup()
            raise OutputError(
                f"{program}: rerun's server does not start ({error}); install fgloc[view] anew"
            ) from error
        source = f"rerun+http://{HOST}:{data_port}/proxy"
        self._wait_for(data_port, page_port)
        try:
            self._page = PrivatePage(page_port, port)
        except OSError as error:
            self._end()
            raise OutputError(f"port {port} cannot be served ({error.strerror}); choose another one") from error
        self.url = f"http://{HOST}:{self._page.port}/?url={quote(source, safe='')}"
        self._stream = new_stream()
        self._stream.connect_grpc(source)

    def __enter__(self) -> Page:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def scene(self, max_gap_s: float) -> Scene:
        """Scene that draws on this page; ``max_gap_s`` as `Scene` has it."""
        return Scene(self._stream, max_gap_s)

    def close(self) -> None:
        """End the server."""
        self._stream.disconnect()
        self._page.close()
        self._end()

    def _end(self) -> None:
        self._server.kill()  # it has nothing to save
        self._server.wait()
        self._folder.cleanup()

    def _wait_for(self, *ports: int) -> None:
        deadline = time.monotonic() + _START_S
        for port in ports:
            while not _answers(port):
                if self._server.poll() is not None or time.monotonic() > deadline:
                    self._end()
                    raise OutputError(f"rerun's server does not listen on {HOST}:{port}; is the port taken?")
                time.sleep(0.02)


def _program() -> Path:
    """Rerun's program itself: the script of that name starts it as a process of its own, which is harder to end."""
    package = find_spec("rerun_cli")
    folders = [] if package is None else package.submodule_search_locations or []
    names = ("rerun", "rerun.exe", "Rerun.app/Contents/MacOS/Rerun")
    program = next((file for folder in folders for name in names if (file := Path(folder) / name).is_file()), None)
    if program is None:
        raise OutputError("rerun has no viewer here; install it anew: pip install 'fgloc[view]'")
    return program


def _free_port() -> int:
    with socket.socket() as free:
        free.bind((HOST, 0))
        return int(free.getsockname()[1])


def _answers(port: int) -> bool:
    with socket.socket() as client:
        client.settimeout(0.2)
        return client.connect_ex((HOST, port)) == 0
