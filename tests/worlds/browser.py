"""A headless Chromium, driven through its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import re
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from tornado.websocket import WebSocketClientConnection, websocket_connect

PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")
PATIENCE_S = 120.0  # for what takes a second where nothing else is going on


def program() -> str | None:
    """Where a Chromium is, None where there is none."""
    return next((path for path in map(shutil.which, PROGRAMS) if path), None)


class LeftError(Exception):
    """The page was left for another while it was asked."""


class Page:
    """One tab. What goes wrong in it, in the console or by an exception, is in ``complaints``."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: WebSocketClientConnection) -> None:
        self.complaints: list[str] = []
        self._served = "file:"
        self._loop, self._socket, self._last, self._loaded = loop, socket, 0, False
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.send(f"{domain}.enable")

    def send(self, method: str, **params: Any) -> dict[str, Any]:
        """Give one command of the protocol and wait for what it returns."""
        self._last += 1
        command = json.dumps({"id": self._last, "method": method, "params": params})
        return self._loop.run_until_complete(asyncio.wait_for(self._answered(command, self._last), PATIENCE_S))

    async def _answered(self, command: str, number: int) -> dict[str, Any]:
        await self._socket.write_message(command)
        while (message := await self._next()).get("id") != number:
            pass
        if "navigated" in message.get("error", {}).get("message", ""):
            raise LeftError
        assert "error" not in message, message
        return dict(message["result"])

    async def _next(self) -> dict[str, Any]:
        """The next message, heeded if it says that something happened."""
        text = await self._socket.read_message()
        assert text is not None, "the browser is gone"
        message: dict[str, Any] = json.loads(text)
        self._heed(message.get("method"), message.get("params", {}))
        return message

    def _heed(self, method: str | None, params: dict[str, Any]) -> None:
        self._loaded |= method == "Page.loadEventFired"
        if method == "Runtime.exceptionThrown":
            self.complaints.append(json.dumps(params["exceptionDetails"])[:1000])
        elif method == "Runtime.consoleAPICalled" and params["type"] in ("error", "warning", "assert"):
            self.complaints.append(json.dumps(params["args"])[:1000])
        elif method == "Log.entryAdded" and params["entry"]["level"] in ("error", "warning"):
            self.complaints.append(params["entry"]["text"])
        elif method == "Network.requestWillBeSent" and not params["request"]["url"].startswith(
            ("file:", "data:", "blob:", self._served)
        ):
            self.complaints.append(f"asked for {params['request']['url']}")

    def run(self, script: str) -> Any:
        """What an expression of JavaScript is, a promise awaited."""
        said = self.send("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in said, said["exceptionDetails"]
        return said["result"].get("value")

    def until(self, condition: str) -> None:
        """Wait until an expression of JavaScript is true, of this page or the one that takes its place."""
        script = f"new Promise((done) => (function look() {{ if ({condition}) done(); else setTimeout(look, 20) }})())"
        while True:
            try:
                self.run(script)
            except LeftError:
                continue
            return

    def open(self, page: Path | str, ready: str = "document.readyState == 'complete'") -> None:
        """Show a file, or an address, which may be asked for more, and wait until it is ``ready``."""
        self.complaints.clear()
        self._loaded = False
        self._served = page if isinstance(page, str) else "file:"
        self.send("Page.navigate", url=page if isinstance(page, str) else page.resolve().as_uri())
        while not self._loaded:
            self._loop.run_until_complete(asyncio.wait_for(self._next(), PATIENCE_S))
        self.until(ready)

    def size(self, width: int, height: int, touch: bool = False) -> None:
        """Give the window a size, and a finger in place of the mouse if ``touch``."""
        self.send("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=touch)
        self.send("Emulation.setTouchEmulationEnabled", enabled=touch)

    def dark(self, dark: bool) -> None:
        """What the reader's system prefers."""
        features = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        self.send("Emulation.setEmulatedMedia", features=features)

    def mouse(self, kind: str, x: float, y: float, button: str = "none", **more: Any) -> None:
        """One event of the mouse: mouseMoved, mousePressed, mouseReleased or mouseWheel."""
        self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button=button, **more)

    def click(self, x: float, y: float) -> None:
        """Press and release."""
        for kind in ("mousePressed", "mouseReleased"):
            self.mouse(kind, x, y, "left", clickCount=1)

    def drag(self, x: float, y: float, to_x: float, to_y: float) -> None:
        """Press, move and release."""
        self.mouse("mouseMoved", x, y)
        self.mouse("mousePressed", x, y, "left", clickCount=1)
        for share in (0.25, 0.5, 0.75, 1.0):
            self.mouse("mouseMoved", x + share * (to_x - x), y + share * (to_y - y), "left", buttons=1)
        self.mouse("mouseReleased", to_x, to_y, "left", clickCount=1)

    def key(self, key: str) -> None:
        """Press and release a key."""
        text = {"text": key} if len(key) == 1 else {}
        self.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
        self.send("Input.dispatchKeyEvent", type="keyUp", key=key)

    def picture(self, path: Path, whole: bool = False) -> None:
        """Save what is seen, or the ``whole`` page, as PNG."""
        data = self.send("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        path.write_bytes(base64.b64decode(data))

    def thumbnail(self, width: int, height: int, scale: float) -> bytes:
        """What is seen in the upper left corner of the window, made smaller, as PNG."""
        self.run("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        clip = {"x": 0, "y": self.run("scrollY"), "width": width, "height": height, "scale": scale}
        return base64.b64decode(self.send("Page.captureScreenshot", clip=clip)["data"])


@contextmanager
def opened(options: Sequence[str] = ()) -> Iterator[Page]:
    """A tab of a browser of its own, which ends with it."""
    found = program()
    assert found is not None
    loop = asyncio.new_event_loop()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        flags = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage", "--hide-scrollbars"]
        arguments = [*flags, f"--user-data-dir={folder}", "--remote-debugging-port=0", *options, "about:blank"]
        process = subprocess.Popen([found, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stderr is not None
            place = next(found for line in process.stderr if (found := re.search(r"ws://([^/]+)/", line)))[1]
            socket = loop.run_until_complete(_tab(place))
            yield Page(loop, socket)
            socket.close()
        finally:
            process.terminate()
            with suppress(subprocess.TimeoutExpired):
                process.wait(10)
            process.kill()
            process.communicate()
            loop.close()


async def _tab(place: str) -> WebSocketClientConnection:
    """A connection to the tab of the browser that listens at a place."""
    from tornado.httpclient import AsyncHTTPClient

    listed = await AsyncHTTPClient(force_instance=True).fetch(f"http://{place}/json/list")
    tab = next(one for one in json.loads(listed.body) if one["type"] == "page")
    return await websocket_connect(tab["webSocketDebuggerUrl"], max_message_size=1 << 28)
