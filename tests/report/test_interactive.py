"""What a page to look around in shows: every kind of run has its panels, no peak is lost, and pages stay small."""

from __future__ import annotations

import base64
import json
import re
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

from nav.samples import Array, Outcome, Status
from testbed.record.recorder import Recorder
from testbed.report import interactive, style
from testbed.report.interactive import Shown, arrays, contents, embed
from testbed.report.run import Run
from testbed.sensors.faults import FaultTruth

DENIED = ((40.0, 70.0),)
CHAPTERS = ["Size of the errors", "Consistency", "Flight", "Errors and claims", "Innovations", "Biases"]


def shown(**kind: Any) -> dict[str, Any]:
    return contents([Shown("", Run(synthetic_run.dataset(**kind)))])


@cache
def outage() -> dict[str, Any]:
    bad = Errors(drift_mps=300.0)
    return shown(duration_s=80.0, estimators={"ins": Errors(), "dead_reckoning": bad}, denied=DENIED)


def numbers(page: dict[str, Any], place: list[int]) -> Array:
    every = np.frombuffer(base64.b64decode(page["numbers"]), "<f4")
    return every[place[0] : sum(place)]


def panels(page: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {panel["title"]: panel for chapter in page["chapters"] for panel in chapter["panels"]}


def test_all_that_figures_show_has_a_panel() -> None:
    page = outage()
    assert [chapter["title"] for chapter in page["chapters"]] == CHAPTERS
    assert [subject["name"] for subject in page["subjects"]] == ["ins", "dead_reckoning"]
    [window] = page["windows"]
    np.testing.assert_allclose(window, DENIED[0], atol=1.1)
    own = panels(page)
    assert own["position NEES / 3"]["bounds"][0] < 1 < own["position NEES / 3"]["bounds"][1]
    assert own["position error north"]["unit"] == "m"
    assert {line["of"] for line in own["height above ellipsoid"]["lines"]} == {-1, 0, 1}
    assert own["gnss_position innovation / σ"]["gate"] > 0
    assert [len(one["y"]) for one in own["gnss_position innovation / σ"]["dots"]] == [3, 3]
    assert len(page["map"]["tracks"]) == 2
    assert page["map"]["sigmas"] == pytest.approx(2.4477, abs=1e-4)
    for panel in own.values():
        for line in panel["lines"]:
            t = numbers(page, line["t"])
            assert len(t) == line["y"][1] > 2
            assert (np.diff(t) >= 0).all()


def test_errors_are_those_of_the_run() -> None:
    run = Run(synthetic_run.dataset(duration_s=60.0))
    page = contents([Shown("", run)])
    [line] = panels(page)["position error east"]["lines"]
    e = run.errors["ins"]
    at = np.searchsorted(e.t, numbers(page, line["t"]) - 1e-3)
    np.testing.assert_allclose(numbers(page, line["y"]), e.position[at, 1], atol=1e-5)
    half = numbers(page, line["band"]["half"])
    at = np.searchsorted(e.t, numbers(page, line["band"]["t"]) - 1e-3)
    np.testing.assert_allclose(half, 3 * e.sigma_position[at, 1], rtol=1e-6)
    [track] = page["map"]["tracks"]
    at = np.searchsorted(e.t, numbers(page, track["t"]) - 1e-3)
    np.testing.assert_allclose(numbers(page, track["error"][0]), e.position[at, 0], atol=1e-5)


def test_innovations_that_were_not_used_say_why() -> None:
    run = synthetic_run.dataset(120.0, {"ins": Errors(aligned_after=0.0)})
    reports = run["estimators/ins/innovations/barometer"]
    t = reports["sample_time"].values
    rows = (t >= 20.0) & (t < 30.0)
    reports["outcome"].values[rows], reports["weight"].values[rows] = Outcome.ISOLATED, 0.0
    page = contents([Shown("", Run(run))])
    [own] = panels(page)["barometer innovation / σ"]["dots"]
    [part] = own["not_used"]
    assert page["outcomes"][part["outcome"]]["name"] == "sensor isolated"
    np.testing.assert_allclose(numbers(page, part["t"]), t[rows])
    assert own["refused"] == pytest.approx(np.mean(rows))
    assert not ((numbers(page, own["t"]) >= 20.0) & (numbers(page, own["t"]) < 30.0)).any()


def test_attitude_alone_has_no_panels_of_position() -> None:
    run = synthetic_run.dataset(duration_s=60.0)
    own = run["estimators/ins"]
    own["status"].values[:] |= Status.ATTITUDE_ONLY
    for name in ("lat", "lon", "h", "v_n"):
        own[name].values[:] = np.nan
    page = contents([Shown("", Run(run))])
    titles = panels(page)
    assert "attitude error about north" in titles
    assert not any("position error" in title or "velocity error" in title for title in titles)
    assert page["map"]["tracks"] == []
    assert len(page["map"]["truths"]) == 1


def test_an_unknown_reference_is_a_gap() -> None:
    run = synthetic_run.dataset(duration_s=60.0)
    for name in ("lat", "lon", "h", "v_n", "q_nb", "airspeed", "wind_n"):
        run[f"truth/{name}"].values[:] = np.nan
    page = contents([Shown("", Run(run))])
    assert json.dumps(page, allow_nan=False)
    assert not np.isfinite(numbers(page, page["map"]["truths"][0]["n"])).any()
    [line] = panels(page)["height above ellipsoid"]["lines"]
    assert line["of"] == 0
    assert np.isfinite(numbers(page, line["y"])).sum() > 0.9 * line["y"][1]
    assert "true airspeed" not in panels(page)


@pytest.mark.parametrize(
    "kind",
    [
        {"duration_s": 0.0},
        {"duration_s": 6.0},
        {"duration_s": 20.0, "estimators": {}},
        {"duration_s": 20.0, "estimators": {"ins": Errors(aligned_after=1e9)}},
        {"duration_s": 60.0, "estimators": {"ins": Errors(nan_from=40.0)}},
        {"duration_s": 60.0, "gnss": False},
    ],
)
def test_short_and_broken_runs_have_a_page(kind: dict[str, Any]) -> None:
    page = shown(**kind)
    assert page["end"] > page["start"]
    assert json.dumps(page, allow_nan=False)
    assert "true airspeed" in panels(page)


def test_runs_beside_each_other_keep_their_names_and_colours() -> None:
    runs = [Run(synthetic_run.dataset(duration_s=length)) for length in (60.0, 80.0)]
    page = contents([Shown("before", runs[0]), Shown("after", runs[1])])
    assert [subject["name"] for subject in page["subjects"]] == ["before: ins", "after: ins"]
    assert [subject["light"] for subject in page["subjects"]] == [*style.COLOURS[:2]]
    assert page["end"] == 80.0
    truth = [line["name"] for line in panels(page)["true airspeed"]["lines"]]
    assert truth == ["before: truth", "after: truth"]


def test_a_line_keeps_its_peaks_and_there_are_fewer_points_for_more_estimators() -> None:
    t = np.arange(50_000.0)
    y = np.zeros(t.size)
    y[23_456], y[30_001] = 7.0, -9.0
    kept = {}
    for count in (1, 8):
        own = arrays.Arrays(count)
        line = own.line(t, y)
        values = np.frombuffer(base64.b64decode(own.text()), "<f4")
        thinned = values[line["y"][0] : sum(line["y"])]
        assert {7.0, -9.0} <= set(thinned.tolist())
        kept[count] = len(thinned)
    assert kept[8] < kept[1] <= 2.1 * arrays.MOST
    assert arrays.Arrays(100).bins == arrays.FEWEST


@pytest.mark.slow
def test_a_page_stays_below_eight_megabytes_however_many_estimators() -> None:
    names = [f"ins_{k}" for k in range(8)]
    made = scenario(400.0)  # longer ones have as many points
    made.estimator = [SimpleNamespace(name=name, imu="imu", recorded=(name,)) for name in names]
    recorder = Recorder(None, made, 1)
    synthetic_run.record(recorder, circle(400.0), {name: Errors() for name in names}, DENIED)
    page = contents([Shown("", Run(recorder.dataset()))])
    [line] = panels(page)["true airspeed"]["lines"]
    assert line["t"][1] < 0.5 * 4000
    assert len(interactive.script(page)) < 8e6


def test_what_32_bits_cannot_hold_is_a_gap_and_the_same_is_kept_once() -> None:
    own = arrays.Arrays(1)
    place = own.add(np.array([1.0, np.inf, 1e300, 2.0]))
    assert own.add(np.array([1.0, np.nan, np.nan, 2.0])) == place
    assert np.isnan(np.frombuffer(base64.b64decode(own.text()), "<f4")[1:3]).all()


def test_text_cannot_end_the_script() -> None:
    recorder = Recorder(None, scenario(60.0), 1)
    recorder.faults([FaultTruth("</script><!--", "gnss", "", "dropout", 10.0, 20.0, np.nan, "")])
    recorder.event(1.0, "info", "</script><script>alert(1)</script>")
    synthetic_run.record(recorder, circle(60.0), {"ins": Errors()})
    page = contents([Shown("", Run(recorder.dataset()))])
    assert page["events"][0]["text"] == "</script><script>alert(1)</script>"
    text = interactive.script(page)
    assert "</script" not in text.lower()
    assert "<!--" not in text


def test_scripts_ask_nobody_else_for_anything() -> None:
    own = "".join(path.read_text("utf-8") for path in Path(embed.STATIC).iterdir())
    assert not re.search(r"https?://|@import|import\(", own)
