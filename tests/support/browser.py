"""Headless Chromium for the tests: what a page looks like."""

from __future__ import annotations

import asyncio
import base64
import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
import urllib.request

import cv2
import numpy as np
import pytest

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")


class Browser:
    """A page in headless Chromium, rendered in software; whatever it asks other machines for is in `asked`."""

    def __init__(self, folder, url, height=800, dark=False):
        if CHROMIUM is None:
            pytest.skip("no Chromium")
        self._websockets = pytest.importorskip("websockets")
        self.asked = set()
        options = ["--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        options += [f"--window-size=1200,{height}", f"--blink-settings=preferredColorScheme={0 if dark else 1}"]
        options += ["--remote-debugging-port=0", f"--user-data-dir={folder}"]
        with (folder / "log").open("w") as log:
            self._process = subprocess.Popen([CHROMIUM, *options, url], stdout=log, stderr=log, start_new_session=True)
        self._folder = folder

    def __enter__(self):
        return self

    def __exit__(self, *error):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def screenshot(self, good, timeout_s):
        """The first picture ``(h, w, 3)`` that is good, or the last one."""
        return asyncio.run(asyncio.wait_for(self._screenshot(good, timeout_s), timeout_s + 30.0))

    def run(self, script, timeout_s=30.0):
        """The value of a script's last expression."""
        return asyncio.run(asyncio.wait_for(self._run(script, timeout_s), timeout_s))

    async def _run(self, script, timeout_s):
        async with self._connected(time.monotonic() + timeout_s) as socket:
            return (await self._call(socket, 1, "Runtime.evaluate", expression=script))["result"]["value"]

    @contextlib.asynccontextmanager
    async def _connected(self, deadline):
        ports = self._folder / "DevToolsActivePort"
        while not ports.exists() and time.monotonic() < deadline:
            await asyncio.sleep(0.1)
        port = ports.read_text().split()[0]
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
            page = next(p for p in json.load(answer) if p["type"] == "page")
        async with self._websockets.connect(page["webSocketDebuggerUrl"], max_size=None) as socket:
            yield socket

    async def _screenshot(self, good, timeout_s):
        deadline = time.monotonic() + timeout_s
        async with self._connected(deadline) as socket:
            await self._call(socket, 1, "Network.enable")
            number = 2
            while True:
                answer = await self._call(socket, number, "Page.captureScreenshot", format="png")
                raw = np.frombuffer(base64.b64decode(answer["data"]), np.uint8)
                picture = cv2.imdecode(raw, cv2.IMREAD_COLOR)
                if good(picture) or time.monotonic() > deadline:
                    return picture
                number += 1
                await asyncio.sleep(1.0)

    async def _call(self, socket, number, method, **parameters):
        await socket.send(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            answer = json.loads(await socket.recv())
            if answer.get("method") == "Network.responseReceived":
                scheme, _, rest = answer["params"]["response"]["url"].partition("://")
                if scheme in ("http", "https"):
                    self.asked.add(rest.split("/")[0])
            if answer.get("id") == number:
                return answer["result"]
