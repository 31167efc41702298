"""What a page to look around in costs: to make it, to keep it, and to open it."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import xarray
from bench.measure import Effort, Missing, Row, cpu_seconds, wall_seconds
from bench.runs import main_scenario
from worlds import browser, synthetic_run
from worlds.synthetic_run import Errors

from testbed.loop import loop
from testbed.report import page
from testbed.report.run import Run

HOURS_S = 3 * 3600


def pages(effort: Effort) -> Iterator[Row]:
    """Pages of the main scenario and of three hours: to make (without PNGs), size, and to open in headless Chromium."""
    yield from _page("main scenario", loop.run(main_scenario(effort)).dataset, 2.0, effort)
    own = {"ins": Errors(), "dead_reckoning": Errors(drift_mps=3.0)}
    yield from _page("three hours", synthetic_run.dataset(effort.count(HOURS_S), estimators=own), 4.0, effort)


def _page(what: str, dataset: xarray.DataTree, opens_s: float, effort: Effort) -> Iterator[Row]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.html"

        def make() -> None:
            path.write_text(page.render("run.html", figures=[], **page.content(Run(dataset), {})), "utf-8")

        yield Row(f"page of {what}: to make, CPU", tuple(cpu_seconds(make) for _ in range(effort.rounds)), "s")
        yield Row(f"page of {what}: size", (path.stat().st_size / 1e6,), "MB", at_most=8.0)
        if browser.program() is None:
            raise Missing("no Chromium on this machine to open a page in")
        with browser.opened() as tab:
            tab.size(1400, 900)
            seconds = [
                wall_seconds(lambda: tab.open(path, "document.documentElement.dataset.state"))
                for _ in range(effort.rounds)
            ]
        yield Row(f"page of {what}: to open, wall", tuple(seconds), "s", at_most=opens_s)
