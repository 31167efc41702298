"""The papers' claims: verdicts, jobs in processes of their own, results on disk, and the command."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from testbed import papers, run
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.many.check import judge
from testbed.papers import Claim, Job, Paper

SCENARIOS = sorted(path.stem for path in (data_dir("scenarios") / "papers").glob("*.toml"))
LONG = {"cheng2020", "zhu2020", "zhu2020_outage"}  # to run: more than 5 s


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow if n in LONG else pytest.mark.ci]) for n in SCENARIOS]
)
def test_the_scenario_keeps_its_promises(name: str) -> None:
    shipped = papers.scenario(name)
    assert shipped.expect, "a scenario without [expect] can't fail"
    result = run(shipped)
    assert not result.failure
    rows = judge(shipped.expect, result.metrics)
    assert all(row.sound for row in rows), [str(row) for row in rows if not row.sound]


def claim(ours: Sequence[float], bound: float, **keys: Any) -> Claim:
    return Claim("error", "m", "10", ours, bound, **keys)


def test_verdicts() -> None:
    assert claim([1.0, 2.0, 9.0], 3.0).verdict == "met"
    assert claim([1.0, 2.0, 9.0], 3.0, worst=True).verdict == "missed"
    assert claim([1.0, 2.0, 9.0], 1.0, worst=True, at_least=True).verdict == "met"
    assert claim([0.5, 2.0, 9.0], 1.0, worst=True, at_least=True).verdict == "missed"
    assert claim([2.0], 3.0, target=2.0).verdict == "beaten"
    assert claim([2.1], 3.0, target=2.0).verdict == "met"
    assert claim([2.0], 3.0, target=2.5, impossible="of noise").verdict == "impossible"
    assert claim([4.0], 3.0, impossible="of noise").verdict == "missed"
    assert claim([], 3.0).verdict == "missed"
    assert claim([float("nan")], 3.0).verdict == "missed"


def square(x: float) -> float:
    return x * x


def toy(drawn: list[Path]) -> Paper:
    return Paper(
        "A toy",
        lambda: [Job(square, (x,)) for x in (3.0, 1.0, 2.0)],
        lambda results: [claim(results, 4.0, target=1.0), claim(results[:1], 4.0)],
        lambda results, out: drawn.append(out / f"{len(results)}.png"),
    )


@pytest.mark.ci
def test_results_come_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    drawn: list[Path] = []
    told: list[float] = []
    claims = papers.reproduce({"toy": toy(drawn)}, tmp_path, lambda fraction, text: told.append(fraction))
    assert [list(one.ours) for one in claims["toy"]] == [[9.0, 1.0, 4.0], [9.0]]
    assert [one.verdict for one in claims["toy"]] == ["met", "missed"]
    assert drawn == [tmp_path / "3.png"]
    assert sorted(set(told)) == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    assert told == sorted(told)
    record = json.loads((tmp_path / papers.RESULTS).read_text())["toy"]
    assert record[0]["ours"] == 4.0
    assert record[0]["spread"] == [1.0, 9.0]
    assert [row["verdict"] for row in record] == ["met", "missed"]


@pytest.mark.ci
def test_an_unknown_paper_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="newton1687: there is no such paper"):
        papers.find(["newton1687"])
    done = subprocess.run(
        [sys.executable, "-m", "testbed", "papers", "newton1687", "--out", str(tmp_path / "new")],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert "Traceback" not in done.stderr
    assert not (tmp_path / "new").exists()
