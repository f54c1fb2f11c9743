"""A page on loopback that shows a live run, served by rerun's own server as a process beside this one."""

from __future__ import annotations

import os
import socket
import subprocess
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import quote

from fgloc.errors import OutputError
from fgloc.view.private import HOST, PrivatePage
from fgloc.view.scene import Scene, import_rerun, new_stream

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
        """What is shown; ``max_gap_s`` as `Scene` has it."""
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
