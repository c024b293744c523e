"""Chromium without a screen, driven by its own protocol (DevTools) over a web socket: no driver to install."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import tempfile
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-background-networking", "--disable-component-update", "--disable-default-apps", "--disable-sync",
    "--no-first-run", "--no-default-browser-check", "--disable-extensions", "--disable-dev-shm-usage", "--mute-audio",
    "--remote-debugging-port=0", "--remote-allow-origins=*",
)  # fmt: skip
START_S = 60.0


def browser_path() -> str:
    """Where the browser is; the test is skipped when there is none."""
    for name in NAMES:
        found = shutil.which(name)
        if found:
            return found
    pytest.skip("no Chromium on this machine (apt-get install chromium)")


class Page:
    """One tab: commands go out, events are kept."""

    def __init__(self, socket: Any, loop: asyncio.AbstractEventLoop) -> None:
        self._socket, self._loop = socket, loop
        self._number = 0
        self.events: list[dict[str, Any]] = []

    def command(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self._loop.run_until_complete(self._command(method, parameters))

    async def _command(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        number = self._number
        await self._socket.write_message(json.dumps({"id": number, "method": method, "params": parameters}))
        while True:
            raw = await asyncio.wait_for(self._socket.read_message(), 120.0)
            if raw is None:
                raise RuntimeError("the browser closed the connection")
            message = json.loads(raw)
            if message.get("id") == number:
                if "error" in message:
                    raise RuntimeError(f"{method}: {message['error']}")
                result: dict[str, Any] = message["result"]
                return result
            if "method" in message:
                self.events.append(message)

    def run(self, script: str) -> Any:
        """Value of an expression; promises are awaited."""
        answer = self.command("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        if "exceptionDetails" in answer:
            raise RuntimeError(json.dumps(answer["exceptionDetails"])[:2000])
        return answer["result"].get("value")

    def wait(self, condition: str, limit_s: float = 40.0) -> None:
        """Until an expression is true."""
        until = time.monotonic() + limit_s
        while not self.run(f"Boolean({condition})"):
            if time.monotonic() > until:
                raise TimeoutError(f"{condition}\n{self.errors()}")
            time.sleep(0.1)

    def open(self, url: str) -> None:
        self.command("Page.navigate", url=url)

    def resize(self, width: int, height: int, ratio: float = 1.0, *, phone: bool = False) -> None:
        self.command(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=ratio, mobile=phone
        )  # fmt: skip

    def scheme(self, name: str) -> None:
        """`light` or `dark`."""
        self.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": name}])

    def picture(self) -> bytes:
        """PNG of the tab."""
        return base64.b64decode(self.command("Page.captureScreenshot", format="png")["data"])

    def click(self, x: float, y: float) -> None:
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def key(self, key: str) -> None:
        for kind in ("keyDown", "keyUp"):
            self.command("Input.dispatchKeyEvent", type=kind, key=key)

    def errors(self) -> list[str]:
        """Errors of the console, and exceptions that nobody caught."""
        found = []
        for event in self.events:
            what = event["params"]
            if event["method"] == "Runtime.exceptionThrown":
                found.append(json.dumps(what["exceptionDetails"])[:500])
            if event["method"] == "Runtime.consoleAPICalled" and what["type"] in ("error", "assert"):
                found.append(json.dumps([a.get("value", a.get("description")) for a in what["args"]]))
            if event["method"] == "Log.entryAdded" and what["entry"]["level"] == "error":
                found.append(f"{what['entry']['text']} {what['entry'].get('url', '')}")
        return found

    def requests(self) -> list[str]:
        """Addresses that were asked for."""
        return [
            event["params"]["request"]["url"]
            for event in self.events
            if event["method"] == "Network.requestWillBeSent"
        ]


@contextmanager
def chromium(*more: str) -> Iterator[Page]:
    """A fresh browser with one tab."""
    path = browser_path()
    loop = asyncio.new_event_loop()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as profile:
        command = [path, *FLAGS, *more, f"--user-data-dir={profile}", "about:blank"]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            socket = loop.run_until_complete(_connect(Path(profile), process))
            page = Page(socket, loop)
            for domain in ("Page", "Runtime", "Log", "Network"):
                page.command(f"{domain}.enable")
            yield page
            socket.close()
        finally:
            process.terminate()
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
            loop.close()


async def _connect(profile: Path, process: subprocess.Popen[bytes]) -> Any:
    from tornado.websocket import websocket_connect

    port_file = profile / "DevToolsActivePort"
    until = time.monotonic() + START_S
    while not port_file.exists() or not port_file.read_text().strip():
        if time.monotonic() > until or process.poll() is not None:
            raise RuntimeError("the browser did not start")
        await asyncio.sleep(0.1)
    port = port_file.read_text().split()[0]
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/json/list", timeout=20) as answer:
        tabs = [tab for tab in json.load(answer) if tab["type"] == "page"]
    return await websocket_connect(tabs[0]["webSocketDebuggerUrl"], max_message_size=1 << 28)
