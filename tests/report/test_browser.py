"""A page in headless Chromium: it opens without a complaint, and mouse, keys, legend and slider do what they should."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from worlds import browser, synthetic_run
from worlds.browser import Page
from worlds.synthetic_run import Errors, circle, scenario

from nav.samples import Status
from testbed.record.recorder import Recorder
from testbed.report import page as report
from testbed.report.run import Run
from testbed.sensors.faults import FaultTruth

pytestmark = [
    pytest.mark.ci,
    pytest.mark.skipif(browser.program() is None, reason="there is no Chromium on this machine to open a page in"),
]
PICTURES = Path(__file__).parent / "pictures"
BLOCK = 5  # pixels of these whose mean is compared: fonts and edges differ from machine to machine
WHOLE = "document.documentElement.dataset.state == 'whole'"
PANEL = "page.panels[0]"


@pytest.fixture(scope="module")
def tab() -> Iterator[Page]:
    with browser.opened() as tab:
        yield tab


def write(dataset: Any, path: Path) -> Path:
    """The page of a run, without its figures."""
    run = Run(dataset)
    path.write_text(report.render("run.html", figures=[], **report.content(run, {})), "utf-8")
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    recorder = Recorder(None, scenario(120.0), 1)
    recorder.faults([FaultTruth("jump", "barometer", "height", "step", 80.0, 90.0, 3.0, "m")])
    recorder.event(20.0, "info", "something happened")
    recorder.event(75.0, "warning", "something went wrong")
    own = {"ins": Errors(), "dead_reckoning": Errors(drift_mps=300.0)}
    synthetic_run.record(recorder, circle(120.0), own, ((40.0, 70.0),))
    return write(recorder.dataset(), tmp_path_factory.mktemp("page") / "report.html")


@pytest.fixture(scope="module")
def desktop(tab: Page, flight: Path) -> Page:
    """The page on a desktop."""
    tab.size(1400, 1000)
    tab.dark(False)
    tab.open(flight, "document.documentElement.dataset.state")
    return tab


@pytest.fixture
def opened(desktop: Page) -> Page:
    """The same as when it was opened, with its first panel in sight."""
    desktop.run("[...page.seen.hidden].forEach(page.toggle)")
    desktop.run("page.setStretch(0, 120)")
    desktop.run(f"{PANEL}.element.scrollIntoView({{block: 'center'}})")
    desktop.until(f"{PANEL}.inSight && {PANEL}.figure.x_range.end == 120")
    return desktop


def frame(tab: Page, panel: str = PANEL) -> tuple[float, float, float, float]:
    """Left, top, width and height of a plot's frame on the screen."""
    left, top, width, height = tab.run(
        f"(() => {{ const box = {panel}.plot.getBoundingClientRect(), own = {panel}.view.frame.bbox;"
        " return [box.left + own.left, box.top + own.top, own.width, own.height] })()"
    )
    return left, top, width, height


def stretch(tab: Page) -> tuple[float, float]:
    start, end = tab.run("[page.seen.start, page.seen.end]")
    return start, end


@pytest.mark.slow
def test_it_opens_without_a_complaint_and_makes_every_panel(opened: Page) -> None:
    opened.until(WHOLE)
    assert opened.run("page.panels.every((panel) => panel.view)")
    assert opened.run("page.panels.length") > 30
    assert opened.complaints == []
    assert opened.run("performance.getEntriesByType('resource').length") == 0


def test_hovering_tells_values_with_units(opened: Page) -> None:
    left, top, width, height = frame(opened)
    opened.mouse("mouseMoved", left + width / 4, top + height / 2)
    opened.until("document.querySelector('.tip').textContent.includes('ins')")
    assert opened.run("page.seen.cursor") == pytest.approx(30.0, abs=0.3)
    rows = opened.run("[...document.querySelectorAll('.tip div')].map((row) => row.textContent)")
    assert rows[0].startswith(opened.run("page.seen.cursor.toFixed(1)") + " s")
    assert [row[:3] for row in rows[1:]] == ["ins", "dea"]
    assert all(row.endswith(" m") for row in rows[1:])
    opened.until(f"{PANEL}.told.textContent.includes(' m')")
    assert opened.complaints == []


def test_dragging_zooms_all_plots_and_a_double_click_shows_the_whole(opened: Page) -> None:
    left, top, width, height = frame(opened)
    opened.drag(left + width / 4, top + height / 2, left + width / 2, top + height / 2)
    opened.until("page.seen.end < 119")
    np.testing.assert_allclose(stretch(opened), (30.0, 60.0), atol=1.0)
    opened.until("page.panels.filter((p) => p.view && p.inSight).every((p) => p.figure.x_range.end == page.seen.end)")
    assert opened.run("page.panels.filter((panel) => panel.view && panel.inSight).length") > 1
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            opened.mouse(kind, left + width / 2, top + height / 2, "left", clickCount=count)
    opened.until("page.seen.end == 120")
    assert opened.complaints == []


def test_the_wheel_zooms_with_ctrl_and_scrolls_without(opened: Page) -> None:
    left, top, width, height = frame(opened)
    before = opened.run("scrollY")
    opened.mouse("mouseWheel", left + width / 2, top + height / 2, deltaX=0, deltaY=-120, modifiers=2)
    opened.until("page.seen.end < 119.9")
    start, end = stretch(opened)
    assert (start + end) / 2 == pytest.approx(60.0, abs=1.0)
    assert opened.run("scrollY") == before
    opened.mouse("mouseWheel", left + width / 2, top + height / 2, deltaX=0, deltaY=-120)
    opened.until(f"scrollY < {before}")
    assert stretch(opened) == (start, end)


@pytest.mark.slow
def test_the_axis_is_made_for_what_is_shown(opened: Page) -> None:
    panel = "page.panels.find(({spec}) => spec.title == 'position error north')"
    opened.run(f"{panel}.element.scrollIntoView()")
    opened.until(f"{panel}.view && {panel}.inSight")
    assert opened.run(f"{panel}.beyond") == [1]  # 9 km off beside one that is right
    near = opened.run(f"{panel}.figure.y_range.end")
    opened.run("page.toggle(0)")
    opened.until(f"{panel}.figure.y_range.end > 1000")
    assert near < 100
    opened.run("page.toggle(0)")
    opened.run("page.setStretch(80, 110)")
    opened.until(f"{panel}.figure.x_range.start == 80")
    assert opened.run(f"{panel}.figure.y_range.end") < near


def test_the_legend_hides_an_estimator_everywhere(opened: Page) -> None:
    x, y = opened.run(
        "(() => { const box = document.querySelector('.legend button').getBoundingClientRect();"
        " return [box.left + box.width / 2, box.top + box.height / 2] })()"
    )
    visible = "page.panels.filter((p) => p.inSight).flatMap((p) => p.parts).filter(([of, r]) => of == 0 && r.visible)"
    opened.until(f"{visible}.length > 1")
    opened.click(x, y)
    opened.until(f"{visible}.length == 0")
    assert opened.run("document.querySelector('.legend button').ariaPressed") == "false"
    assert not opened.run("page.planes[0].parts.some(([of, renderer]) => of == 0 && renderer.visible)")
    assert "ins" not in opened.run(f"{PANEL}.values().map(([, name]) => name)")
    opened.key("1")
    opened.until(f"{visible}.length > 1")
    opened.key("b")
    opened.until("!page.panels.some((p) => p.inSight && p.parts.some(([, r, band]) => band && r.visible))")
    assert opened.complaints == []


def test_the_slider_moves_cursor_ellipses_and_readings(opened: Page) -> None:
    reach = "Math.max(...page.planes[1].around.data.x[0])"
    claimed = {20: 1.0, 69: 1.0 + 0.2 * 29}  # sigma of ins [m]
    for t, sigma in claimed.items():
        opened.run(f"(s => (s.value = {t}, s.dispatchEvent(new Event('input'))))(document.querySelector('.slider'))")
        opened.until(f"page.seen.cursor == {t} && Math.abs({reach} - {2.4477 * sigma}) < 0.02")
    assert opened.run("document.querySelector('.now').textContent") == "69.0 s (1:09)"
    assert opened.run("page.planes[0].here.data.x.length") == 3  # truth and two estimates
    assert opened.run(f"{PANEL}.cursor.style.transform") != ""


def test_events_lead_there_by_key_mark_and_table(opened: Page) -> None:
    opened.run("page.setCursor(0)")
    opened.until("page.seen.cursor == 0")
    opened.key("n")
    opened.until("page.seen.cursor == 20")
    start, end = stretch(opened)
    assert 0 <= start <= 20 < end <= 60
    opened.run("[...document.querySelectorAll('[data-t]')].find((one) => one.dataset.t == 75).click()")
    opened.until("page.seen.cursor == 75")
    opened.key("n")
    opened.until("page.seen.cursor == 80")  # the fault
    assert "step" in opened.run("document.querySelector('.strip .mark.fault').title")
    opened.key("p")
    opened.until("page.seen.cursor == 75")
    opened.key("0")
    opened.until("page.seen.end == 120")
    opened.key("ArrowRight")
    opened.until("page.seen.cursor > 75")


@pytest.mark.slow
def test_hovering_over_the_map_moves_the_cursor(opened: Page) -> None:
    opened.run("page.planes[0].element.scrollIntoView({block: 'center'})")
    x, y = opened.run(
        "(() => { const plane = page.planes[0], own = plane.view.frame.bbox, box = plane.plot.getBoundingClientRect();"
        " const {x_range: x, y_range: y} = plane.figure, {t, n, e} = plane.truths[0];"
        " const k = [...t.keys()].find((k) => t[k] >= 30);"
        " return [box.left + own.left + own.width * (e[k] - x.start) / (x.end - x.start),"
        " box.top + own.top + own.height * (y.end - n[k]) / (y.end - y.start)] })()"
    )
    opened.mouse("mouseMoved", x, y)
    opened.until("Math.abs(page.seen.cursor - 30) < 1.5")
    assert opened.complaints == []


@pytest.mark.slow
def test_it_fits_a_phone_where_a_finger_scrolls(tab: Page, flight: Path) -> None:
    tab.size(390, 844, touch=True)
    tab.dark(True)
    tab.open(flight, "document.documentElement.dataset.state")
    tab.run(f"{PANEL}.element.scrollIntoView()")
    tab.until(f"{PANEL}.view")
    assert tab.run("document.documentElement.scrollWidth") <= 390
    assert tab.run(f"{PANEL}.figure.toolbar.tools.length") == 0
    assert tab.run("document.getElementById('bar').offsetHeight") < 844 / 3
    ground = tab.run(f"[getComputedStyle(document.body).backgroundColor, {PANEL}.figure.background_fill_color]")
    assert ground == ["rgb(22, 25, 29)", "#16191D"]
    tab.dark(False)
    tab.until(f"{PANEL}.figure.background_fill_color == '#FFFFFF'")
    assert tab.complaints == []


@pytest.mark.slow
def test_paper_shows_every_plot_in_light_colours(opened: Page) -> None:
    opened.dark(True)
    opened.until(WHOLE)
    opened.run("dispatchEvent(new Event('beforeprint'))")
    opened.until("document.querySelector('img.paper')")
    assert opened.run("document.querySelectorAll('img.paper').length == page.panels.length + page.planes.length")
    assert opened.run(f"{PANEL}.figure.background_fill_color") == "#FFFFFF"
    # The line of truth is black on white there, though it is white on black on the screen.
    airspeed = "page.panels.find(({spec}) => spec.title == 'true airspeed')"
    shades = opened.run(
        f"(async () => {{ const image = {airspeed}.element.querySelector('img.paper'); await image.decode();"
        " const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight), own = canvas.getContext('2d');"
        " own.drawImage(image, 0, 0); const {left, top, width, height} = " + airspeed + ".view.frame.bbox;"
        " const ratio = image.naturalWidth / " + airspeed + ".view.bbox.width;"
        " const {data} = own.getImageData(ratio * left + 4, ratio * top + 4, ratio * width - 8, ratio * height - 8);"
        " let dark = 0; for (let k = 0; k < data.length; k += 4) dark += data[k] + data[k + 1] + data[k + 2] < 150;"
        " return dark / (data.length / 4) })()"
    )
    assert 0.001 < shades < 0.2
    opened.run("dispatchEvent(new Event('afterprint'))")
    opened.until(f"{PANEL}.figure.background_fill_color == '#16191D'")
    assert opened.run("document.querySelectorAll('img.paper').length") == 0
    assert opened.complaints == []


@pytest.mark.parametrize("name", ["desktop", pytest.param("phone_dark", marks=pytest.mark.slow)])
def test_it_looks_as_it_did(tab: Page, flight: Path, tmp_path: Path, name: str) -> None:
    """Small pictures, compared block by block: what they tell is where and in which colours things are."""
    phone = name == "phone_dark"
    size = (390, 844) if phone else (1400, 1000)
    tab.size(*size, touch=phone)
    tab.dark(phone)
    tab.open(flight, "document.documentElement.dataset.state")
    tab.run("page.toggle(1)")
    tab.run("document.getElementById('bar').scrollIntoView()")
    tab.until("page.planes.every(({view}) => view) && page.panels.every(({inSight, view}) => !inSight || view)")
    seen = tmp_path / f"{name}.png"
    seen.write_bytes(tab.thumbnail(*size, 0.25))
    told = f"look at {seen}, and copy it to {PICTURES} if it is as it should be"
    assert (PICTURES / seen.name).exists(), told
    before, now = (
        np.asarray(Image.open(path).convert("RGB").reduce(BLOCK), float) for path in (PICTURES / seen.name, seen)
    )
    assert before.shape == now.shape, told
    apart = np.abs(before - now).max(axis=2)
    assert apart.mean() < 4, told
    assert (apart > 30).mean() < 0.008, told


def only_attitude() -> Any:
    run = synthetic_run.dataset(duration_s=60.0)
    own = run["estimators/ins"]
    own["status"].values[:] |= Status.ATTITUDE_ONLY
    for name in ("lat", "lon", "h", "v_n"):
        own[name].values[:] = np.nan
    return run


def unknown_reference() -> Any:
    run = synthetic_run.dataset(duration_s=60.0)
    for name in ("lat", "lon", "h", "v_n", "q_nb", "airspeed"):
        run[f"truth/{name}"].values[:] = np.nan
    return run


@pytest.mark.slow
@pytest.mark.parametrize(
    "made",
    [
        lambda: synthetic_run.dataset(duration_s=0.0),
        lambda: synthetic_run.dataset(duration_s=3.0, estimators={}),
        lambda: synthetic_run.dataset(duration_s=60.0, gnss=False, estimators={"ins": Errors(nan_from=40.0)}),
        only_attitude,
        unknown_reference,
    ],
    ids=["one row", "no estimator", "turns NaN", "attitude only", "unknown reference"],
)
def test_odd_runs_open_without_a_complaint(tab: Page, tmp_path: Path, made: Any) -> None:
    tab.size(1000, 3000)
    tab.open(write(made(), tmp_path / "report.html"), WHOLE)
    assert tab.run("page.panels.every((panel) => panel.view)")
    tab.key("ArrowRight")
    assert tab.complaints == []


@pytest.mark.slow
def test_the_map_is_grey_where_a_reference_is_silent(tab: Page, tmp_path: Path) -> None:
    """That of a log goes with the fixes: there was no grey but in the legend."""
    silent = synthetic_run.dataset(60.0, {"ins": Errors()}, denied=((20.0, 30.0),))
    inside = (silent["truth/time"].values > 20.0) & (silent["truth/time"].values < 30.0)
    for axis in ("lat", "lon", "h"):
        silent[f"truth/{axis}"].values[inside] = np.nan
    grey = "page.planes[0].figure.renderers.find((one) => one.glyph.line_width?.value == 11)"
    tab.open(write(silent, tmp_path / "report.html"), WHOLE)
    places = tab.run(f"(() => {{ const {{ x, y }} = {grey}.data_source.data; return [[...x], [...y]] }})()")
    known = np.array([[np.nan if one is None else one for one in axis] for axis in places], float).T
    known = known[np.isfinite(known).all(axis=1)]
    assert len(known) >= 0.9 * inside.sum()
    assert np.ptp(known, axis=0).max() > 1.0  # m


@pytest.mark.slow
@pytest.mark.parametrize(("off", "shown"), [(600.0, True), (4000.0, False)])
def test_the_map_opens_at_estimates_that_went_astray(tab: Page, tmp_path: Path, off: float, shown: bool) -> None:
    """One that was led away left it at the top; one that is lost does not make the flight a dot."""
    led = synthetic_run.dataset(60.0, {"ins": Errors()})  # on a circle of 800 m
    led["estimators/ins/lat"].values[300:] += off / 6.36e6
    tab.open(write(led, tmp_path / "report.html"), WHOLE)
    highest = tab.run("Math.max(...page.planes[0].tracks[0].n.filter(Number.isFinite))")
    assert (tab.run("page.planes[0].figure.y_range.end") > highest) == shown
    assert tab.run("page.planes[0].figure.y_range.end - page.planes[0].figure.y_range.start") < 5000
