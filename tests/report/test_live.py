"""A page of a run in progress: it grows with the record, in a browser too, and the run knows nothing of it."""

from __future__ import annotations

import http.client
import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from typer.testing import CliRunner
from worlds import browser, synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

import testbed
from testbed import __main__ as cli
from testbed.errors import UserError
from testbed.loop.links import Progress
from testbed.record import recorder
from testbed.record.recorder import Recorder
from testbed.report.live import Live, served
from testbed.results import RECORD
from testbed.scenario import Scenario


class Stages:
    """A made-up run of two minutes that is recorded piece by piece."""

    def __init__(self, record: Path) -> None:
        self.recorder = Recorder(record, scenario(120.0), 1)
        self._truth, self._at = circle(120.0), 0
        self._errors = {"ins": Errors(), "dead_reckoning": Errors(drift_mps=3.0)}

    def until(self, t: float, denied: bool = False) -> None:
        """Record what happens up to a time."""
        rows = self._truth.rows(self._at, round(200 * t))
        synthetic_run.record(self.recorder, rows, self._errors, ((0.0, 1e3),) if denied else ())
        self._at = round(200 * t)
        self.recorder.flush()


def ask(url: str, path: str, host: str | None = None) -> http.client.HTTPResponse:
    """Ask a server for something."""
    place = urlsplit(url)
    connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=60)
    connection.request("GET", path, headers={"Host": host or place.netloc})
    return connection.getresponse()


def news(answer: http.client.HTTPResponse) -> dict[str, Any]:
    """The next contents of a stream."""
    while not (line := answer.readline()).startswith(b"data: "):
        assert line, "the stream has ended"
    return dict(json.loads(line[6:]))


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[tuple[Stages, Live, str]]:
    live = Live(tmp_path / RECORD)
    with served(live) as url:
        yield Stages(tmp_path / RECORD), live, url


def test_a_client_sees_the_run_grow(watched: tuple[Stages, Live, str]) -> None:
    stages, live, url = watched
    live.look()
    assert "no record yet" in ask(url, "/").read().decode()
    stream = ask(url, "/events")
    ends = []
    for t in (20.0, 40.0):
        stages.until(t)
        live.look()
        ends.append(news(stream))
    assert [one["end"] for one in ends] == pytest.approx([20.0, 40.0], abs=0.2)
    assert [one["live"]["complete"] for one in ends] == [False, False]
    before = live.picture
    live.look()
    assert live.picture is before  # nothing was recorded since
    late = ask(url, f"/events?{ends[0]['live']['version']}")
    assert news(late) == ends[1]  # whoever comes late, or was away, is told at once
    stages.recorder.close()
    live.look()
    assert news(stream)["live"]["complete"]
    assert "A made-up circle" in ask(url, "/").read().decode()


def test_what_is_no_record_is_told(tmp_path: Path) -> None:
    record = tmp_path / RECORD
    record.write_text("something else")
    live = Live(record)
    live.look()
    with served(live) as url:
        assert "not a record of a run" in ask(url, "/").read().decode()


def test_only_this_machine_is_answered(watched: tuple[Stages, Live, str]) -> None:
    _, _, url = watched
    assert ask(url, "/", host="example.org").status == 403
    assert ask(url, "/run.nc").status == 404
    assert urlsplit(url).hostname == "127.0.0.1"


@pytest.mark.ci
def test_a_watcher_that_is_killed_leaves_the_run_as_it_would_be(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same bits with watchers and without, though one is cut off in the midst of what it is sent."""
    flight = Scenario.load("kinematic_u_flight", ["duration_s=20"])
    testbed.run(flight, out=tmp_path / "alone", seed=5)
    monkeypatch.setattr(recorder, "FLUSH_WALL_S", 0.0)  # so that there is something to see of so short a run
    live = Live(tmp_path / "watched" / RECORD)
    pictures: set[str] = set()
    with served(live) as url:
        place = urlsplit(url)
        watcher = socket.create_connection((str(place.hostname), place.port))
        watcher.sendall(f"GET /events HTTP/1.1\r\nHost: {place.netloc}\r\n\r\n".encode())

        def watch(now: Progress) -> None:
            if len(pictures) < 3:
                live.look()
            if live.picture is not None:
                pictures.add(live.picture.version)
                watcher.close()

        testbed.run(flight, out=tmp_path / "watched", seed=5, progress=watch)
        assert len(pictures) > 1
        live.look()
        assert live.picture is not None
        assert live.picture.contents["live"]["complete"]
    assert (tmp_path / "alone" / RECORD).read_bytes() == (tmp_path / "watched" / RECORD).read_bytes()


@pytest.mark.ci
@pytest.mark.skipif(browser.program() is None, reason="there is no Chromium on this machine to open a page in")
def test_a_page_grows_and_keeps_what_was_chosen(watched: tuple[Stages, Live, str]) -> None:
    stages, live, url = watched
    shown = "page.panels.filter((panel) => panel.view && panel.inSight)"
    last = "((panel) => panel.lines[0].t[panel.lines[0].t.length - 1])"
    with browser.opened() as tab:
        tab.size(1200, 900)
        tab.open(url)
        assert "no record yet" in tab.run("document.getElementById('state').textContent")
        for t in (10.0, 30.0, 40.0):
            stages.until(t)
            live.look()
            tab.until(f"window.page && Math.abs(page.seen.end - {t}) < 0.2 && page.planes.length == 2")
            tab.until(f"{shown}.length > 1 && {shown}.every((panel) => Math.abs({last}(panel) - {t}) < 0.2)")
        assert "In progress" in tab.run("document.getElementById('state').textContent")
        assert tab.run("page.seen.cursor == page.seen.end")
        tab.run("page.toggle(1)")
        tab.run("page.setStretch(5, 15)")
        stages.until(60.0, denied=True)  # something new happens
        live.look()
        tab.until("document.querySelectorAll('.strip .denied').length > 0")
        tab.until(f"{shown}.length > 1")
        assert tab.run("[page.seen.start, page.seen.end, page.seen.hidden.has(1)]") == [5, 15, True]
        assert tab.run("document.querySelectorAll('#told tr').length") > 1
        stages.recorder.close()
        live.look()
        tab.until("document.getElementById('state').textContent.startsWith('The run is over')")
        assert tab.complaints == []


def test_what_can_not_be_watched_is_said(tmp_path: Path) -> None:
    def told(*arguments: str) -> str:
        with pytest.raises(UserError) as error:
            CliRunner().invoke(cli.app, ["view", *arguments], catch_exceptions=False)
        return str(error.value)

    assert "a page stays as it is" in told("report.html", "--live")
    assert "add --live" in told(str(tmp_path), "--port", "8000")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "choose another" in told(str(tmp_path), "--live", "--port", str(taken.getsockname()[1]))
