"""The page of a run in progress, served on loopback to whoever asks on this machine.

It reads the record that is being written, as anybody may, and knows nothing of the run: that neither waits for it nor
hears of it. Contents are made while somebody watches, and take no more than a share of one core.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Generator, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from markupsafe import Markup

from testbed.errors import UserError
from testbed.record.reader import load
from testbed.report import interactive, page
from testbed.report.run import Run

HOST = "127.0.0.1"
PERIOD_S = 1.0  # between two looks at the record
SHARE = 0.2  # of one core, that looking may take
SILENCE_S = 10.0  # after which a watcher is written to though there is no news: one that is gone is found out
RELOAD = Markup("new EventSource('events?').onmessage = () => location.reload();")


@dataclass(frozen=True, slots=True)
class Picture:
    """What a record had at one look: which look it was, the title of the run, and the contents of its page."""

    version: str
    title: str
    contents: dict[str, Any]

    @property
    def html(self) -> str:
        """The page."""
        script = page.script_of(self.contents)
        return page.render("live.html", title=self.title, said="", contents=self.contents, script=script)

    @property
    def message(self) -> str:
        """The contents alone, for a page that is open."""
        return json.dumps(self.contents, allow_nan=False, separators=(",", ":"))


class Live:
    """A record in the making, and those who watch it."""

    def __init__(self, record: Path) -> None:
        self.record = record
        self.picture: Picture | None = None
        self._said = f"{record}: no record yet: it comes with the first rows of a run."
        self._stamp: tuple[int, int] | None = None
        self._watchers = 0
        self._change = threading.Condition()

    def look(self) -> None:
        """Take what has been recorded since the last look; what can't be read now is left for the next one."""
        try:
            status = self.record.stat()
        except OSError:
            return
        stamp = status.st_ino, status.st_mtime_ns
        if stamp == self._stamp:
            return
        try:
            run = Run(load(self.record))
        except UserError as error:
            self._said = f"{error}."
            return
        attributes = run.dataset.attrs
        version = str(time.time_ns())
        live = {
            "version": version,
            "complete": bool(attributes["complete"]),
            "duration": float(attributes.get("duration_s", run.t[-1])),
        }
        contents = interactive.contents([interactive.Shown("", run)]) | {"live": live}
        with self._change:
            self._stamp = stamp
            self.picture = Picture(version, str(attributes.get("title", "Run")), contents)
            self._change.notify_all()

    def follow(self) -> None:
        """Look again and again, while anybody watches; never returns."""
        while True:
            with self._change:
                self._change.wait_for(lambda: self._watchers > 0)
            started = time.monotonic()
            self.look()
            time.sleep(max(PERIOD_S, (time.monotonic() - started) * (1 / SHARE - 1)))

    def html(self) -> str:
        """The page as of the last look; without one, a page that waits for it."""
        if self.picture is not None:
            return self.picture.html
        return page.render("live.html", title="A run to come", said=self._said, contents=None, script=RELOAD)

    def watch(self, version: str) -> Generator[Picture | None]:
        """Each newest picture other than that of a ``version``, and None after every while without one."""
        with self._change:
            self._watchers += 1
            self._change.notify_all()
        try:
            while True:
                with self._change:
                    self._change.wait_for(partial(self._newer, version), SILENCE_S)
                    news = self.picture if self._newer(version) else None
                if news is not None:
                    version = news.version
                yield news
        finally:
            with self._change:
                self._watchers -= 1

    def _newer(self, version: str) -> bool:
        return self.picture is not None and self.picture.version != version


@contextmanager
def served(live: Live, port: int = 0) -> Iterator[str]:
    """Serve the page of a run, while the context lasts, and give its address; port 0 is any that is free.

    Raises UserError when the port is taken.
    """
    try:
        server = ThreadingHTTPServer((HOST, port), partial(_Visit, live))
    except OSError as error:
        raise UserError(f"--port {port}: {error.strerror}: choose another, or leave it out for a free one") from None
    with server:
        threading.Thread(target=server.serve_forever, args=(0.05,), daemon=True).start()
        try:
            yield f"http://{HOST}:{server.server_port}/"
        finally:
            server.shutdown()


class _Visit(BaseHTTPRequestHandler):
    """One request: the page, or news of it as server-sent events until the visitor is gone."""

    def __init__(self, live: Live, *request: Any) -> None:
        self._live = live
        super().__init__(*request)

    def do_GET(self) -> None:
        """Answer."""
        # A page from elsewhere may have this machine's address for its own name: it is not to read a run.
        if self.headers.get("Host", "").rpartition(":")[0] not in (HOST, "localhost"):
            return self.send_error(HTTPStatus.FORBIDDEN)
        path, _, version = self.path.partition("?")
        with suppress(ConnectionError):
            if path == "/":
                content = self._live.html().encode()
                self._begin("text/html; charset=utf-8")
                self.wfile.write(content)
            elif path == "/events":
                self._begin("text/event-stream")
                self._tell(self.headers.get("Last-Event-ID") or version)
            else:
                self.send_error(HTTPStatus.NOT_FOUND)

    def log_message(self, format: str, *args: Any) -> None:
        """Nobody is told of visits."""

    def _begin(self, kind: str) -> None:
        self.send_response(HTTPStatus.OK)
        self.send_header("Content-Type", kind)
        self.send_header("Cache-Control", "no-store")
        self.end_headers()

    def _tell(self, version: str) -> None:
        with closing(self._live.watch(version)) as watch:
            for news in watch:
                text = ":\n\n" if news is None else f"id: {news.version}\ndata: {news.message}\n\n"
                self.wfile.write(text.encode())
