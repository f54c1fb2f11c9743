"""Rerun's page, kept from reporting to anyone: the browser is told to connect to this machine only."""

from __future__ import annotations

import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.error import URLError
from urllib.request import urlopen

HOST = "127.0.0.1"
_POLICY = (
    "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; "  # the page is script and WebAssembly in one
    f"connect-src 'self' data: blob: http://{HOST}:*"
)
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
                    with urlopen(f"http://{HOST}:{source_port}{self.path}") as answer:
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
                """Nothing: the library does not print."""

        self._server = ThreadingHTTPServer((HOST, port), Handler)
        self._server.daemon_threads = True
        self.port = int(self._server.server_address[1])
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), name="fgloc-page", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End."""
        self._server.shutdown()
        self._thread.join()
        self._server.server_close()
