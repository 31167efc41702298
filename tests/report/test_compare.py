"""Runs on one page, and pages in a browser: `testbed compare` and `testbed view`."""

from __future__ import annotations

import json
import shutil
import webbrowser
from pathlib import Path
from typing import Any

import h5py
import pytest
from typer.testing import CliRunner
from worlds import synthetic_run
from worlds.synthetic_run import Errors, circle, scenario

import testbed.__main__ as cli
from testbed.errors import UserError
from testbed.record.recorder import Recorder
from testbed.results import METRICS, REPORT
from testbed.score import metrics

SCORED = {1: 2.0, 2: 2.5}  # of the filter before the change; it became three times as bad
METRIC = "position_horizontal_rms_m"


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two runs before a change and two after it, which are alike but for their seeds and what is said of them."""
    place = tmp_path_factory.mktemp("runs")
    made = place / "run.nc"
    recorder = Recorder(made, scenario(20.0), 1)
    synthetic_run.record(recorder, circle(20.0), {"ins": Errors(), "dead_reckoning": Errors()})
    recorder.close()
    for name, factor in (("before", 1.0), ("after", 3.0)):
        for seed, value in SCORED.items():
            folder = place / name / str(seed)
            folder.mkdir(parents=True)
            shutil.copy(made, folder / "run.nc")
            with h5py.File(folder / "run.nc", "r+") as file:
                file.attrs["seed"] = seed
            scored = {f"ins.{METRIC}": factor * value, f"dead_reckoning.{METRIC}": 9.0}
            metrics.save(scored, folder / METRICS)
    return place


def compare(*arguments: str | Path) -> str:
    said = CliRunner().invoke(cli.app, ["compare", *map(str, arguments)], catch_exceptions=False)
    assert said.exit_code == 0, said.output
    return said.output


def contents(page: Path) -> Any:
    text = page.read_text("utf-8").partition("const PAGE = ")[2].partition(";\n")[0]
    return json.loads(text)


@pytest.mark.ci
def test_folders_are_runs_that_differ_by_their_seeds(runs: Path, tmp_path: Path) -> None:
    said = compare(runs / "before", runs / "after", "--out", tmp_path / "page")
    assert "after: ins against before: ins" in said
    assert "Wilcoxon" in said
    page = (tmp_path / "page" / REPORT).read_text("utf-8")
    row = page[page.index("<tr><td>horizontal position error, RMS [m]</td>") :].partition("</tr>")[0]
    cells = [cell.partition(">")[2].partition("<")[0] for cell in row.split("<td")[1:]]
    assert cells[1:] == ["2.25", "6.75", "+200.0 %", "worse", "2", "0.5"]
    assert "Fewer than six pairs" in page
    shown = contents(tmp_path / "page" / REPORT)
    assert [one["name"] for one in shown["subjects"]] == [
        f"{name}: {one}" for name in ("before", "after") for one in ("ins", "dead_reckoning")
    ]


@pytest.mark.ci
def test_a_single_pair_has_no_significance_and_says_so(runs: Path, tmp_path: Path) -> None:
    said = compare(runs / "before/1/run.nc", runs / "after/1/run.nc", "--out", tmp_path / "page")
    assert "No significance" in said
    assert "No significance: one pair of runs" in (tmp_path / "page" / REPORT).read_text("utf-8")


@pytest.mark.ci
def test_the_estimators_of_one_run(runs: Path, tmp_path: Path) -> None:
    said = compare(runs / "after/1", "--out", tmp_path / "page")
    assert "1: dead_reckoning against 1: ins" in said
    shown = contents(tmp_path / "page" / REPORT)
    assert [one["name"] for one in shown["subjects"]] == ["ins", "dead_reckoning"]


def test_mistakes_are_told(runs: Path, tmp_path: Path) -> None:
    def told(*arguments: Path) -> str:
        with pytest.raises(UserError) as raised:
            compare(*arguments, "--out", tmp_path / "page")
        assert not (tmp_path / "page").exists()
        return str(raised.value)

    (tmp_path / "empty").mkdir()
    assert "there is no run.nc in this folder" in told(tmp_path / "empty")
    assert "no such file" in told(tmp_path / "missing/run.nc")
    assert "named twice" in told(tmp_path / "empty", tmp_path / "empty")
    shutil.copytree(runs / "before/1", tmp_path / "one")
    metrics.save({f"ins.{METRIC}": 1.0}, tmp_path / "one" / METRICS)
    assert "nothing to compare" in told(tmp_path / "one")


def test_view_opens_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []

    def browse(url: str) -> bool:
        opened.append(url)
        return len(opened) < 4

    monkeypatch.setattr(webbrowser, "open", browse)
    page = tmp_path / REPORT
    with pytest.raises(UserError, match=r"no such file: `testbed report .*run\.nc` makes it"):
        CliRunner().invoke(cli.app, ["view", str(tmp_path)], catch_exceptions=False)
    page.write_text("")
    for path in (tmp_path, tmp_path / "run.nc", page):
        assert CliRunner().invoke(cli.app, ["view", str(path)], catch_exceptions=False).exit_code == 0
    assert opened == [page.as_uri()] * 3
    with pytest.raises(UserError, match="there is no browser"):
        CliRunner().invoke(cli.app, ["view", str(tmp_path)], catch_exceptions=False)
