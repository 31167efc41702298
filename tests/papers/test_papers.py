"""The papers' claims: verdicts, jobs in processes of their own, results on disk, and the command."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from testbed import papers, run
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.many.check import judge
from testbed.papers import Job, Paper
from testbed.papers.draws import Draws
from testbed.score.claims import EXACT, MEAN, Claim

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


def claim(ours: Any, bound: float, **keys: Any) -> Claim:
    return Claim("error", "m", "10", ours, bound, **keys)


def square(x: float) -> float:
    return x * x


def toy(drawn: list[Path]) -> Paper:
    return Paper(
        "A toy",
        ("toy.png",),
        lambda draws: [Job(square, (float(seed),)) for seed in reversed(draws.seeds)],
        lambda results: [claim(results, 4.0, statistic=MEAN), claim(results[:1], 4.0, statistic=EXACT)],
        lambda results, out: drawn.append(out / f"{len(results)}.png"),
    )


@pytest.mark.ci
def test_results_come_in_the_order_of_the_jobs(tmp_path: Path) -> None:
    drawn: list[Path] = []
    told: list[float] = []
    claims = papers.reproduce({"toy": toy(drawn)}, Draws(0, 3), tmp_path, lambda fraction, text: told.append(fraction))
    assert [np.asarray(one.ours).tolist() for one in claims["toy"]] == [[9.0, 4.0, 1.0], [9.0]]
    assert [one.verdict for one in claims["toy"]] == ["open", "missed"]
    assert drawn == [tmp_path / "3.png"]
    assert sorted(set(told)) == pytest.approx([0.0, 1 / 3, 2 / 3, 1.0])
    assert told == sorted(told)
    stored = papers.stored(tmp_path / papers.RESULTS)
    assert stored is not None
    draws, found = stored
    assert draws == Draws(0, 3)
    assert found["toy"][0]["ours"] == pytest.approx(14 / 3)
    assert [row["verdict"] for row in found["toy"]] == ["open", "missed"]


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
