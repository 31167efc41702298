"""What five papers claim, and what comes out here: ``testbed papers``. One module for each paper, and `misprints`.

A paper gives jobs, each one run or replay with its seed, which are worked off in parallel; from their results it
concludes its claims and draws its figures. The scenarios lie in ``scenarios/papers``, each with its assumptions.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from testbed.data import data_dir
from testbed.errors import UserError
from testbed.many import pool
from testbed.results import write_result
from testbed.scenario import Scenario

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.many.progress import Tell

RESULTS = "papers.json"
IDS = ("cheng2020", "cui2022", "jiang2021", "zhou2025", "zhu2020")


class Job(NamedTuple):
    """One piece of work for a process of its own: ``work(*arguments)``; both must be picklable."""

    work: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Claim:
    """One figure of a paper beside ours.

    ``paper`` is what it prints, as text; ``ours`` the same quantity from each seed, judged by its median or, with
    ``worst``, by its worst; ``bound`` what ours must keep, at most or, with ``at_least``, at least. Within ``target``
    it is better than the paper. Where the paper's figure can't be had, ``impossible`` says why, and ``bound`` holds for
    what can.
    """

    quantity: str
    unit: str
    paper: str
    ours: Sequence[float]
    bound: float
    at_least: bool = False
    worst: bool = False
    target: float | None = None
    impossible: str = ""

    @property
    def value(self) -> float:
        """What is judged; NaN when there is none."""
        if not len(self.ours):
            return float("nan")
        if not self.worst:
            return float(np.median(self.ours))
        return float(np.min(self.ours) if self.at_least else np.max(self.ours))

    @property
    def verdict(self) -> str:
        """met, beaten, impossible or missed."""
        if not self._keeps(self.bound):
            return "missed"
        if self.impossible:
            return "impossible"
        return "beaten" if self.target is not None and self._keeps(self.target) else "met"

    def _keeps(self, bound: float) -> bool:
        return self.value >= bound if self.at_least else self.value <= bound

    def record(self) -> dict[str, Any]:
        """The claim for `RESULTS`."""
        spread = [float(np.min(self.ours)), float(np.max(self.ours))] if len(self.ours) else []
        return {
            "quantity": self.quantity,
            "unit": self.unit,
            "paper": self.paper,
            "ours": self.value if len(self.ours) else None,
            "spread": spread,
            "seeds": len(self.ours),
            "at least" if self.at_least else "at most": self.bound,
            "verdict": self.verdict,
            "because": self.impossible,
        }


@dataclass(frozen=True, slots=True)
class Paper:
    """One paper: its jobs, what it concludes from their results (in the order of the jobs), and its figures."""

    title: str
    jobs: Callable[[], Sequence[Job]]
    conclude: Callable[[Sequence[Any]], Sequence[Claim]]
    draw: Callable[[Sequence[Any], Path], None]


def scenario(name: str, overrides: Sequence[str] = ()) -> Scenario:
    """The scenario ``scenarios/papers/<name>.toml``."""
    return Scenario.load(data_dir("scenarios") / "papers" / f"{name}.toml", overrides)


def find(ids: Sequence[str]) -> dict[str, Paper]:
    """The papers of these names, all without. Raises UserError when there is no such paper."""
    for name in ids:
        if name not in IDS:
            raise UserError(f"{name}: there is no such paper: choose from {', '.join(IDS)}")
    return {name: import_module(f"testbed.papers.{name}").PAPER for name in ids or IDS}


def reproduce(papers: Mapping[str, Paper], out: Path, tell: Tell | None = None) -> dict[str, Sequence[Claim]]:
    """Work off the jobs of all ``papers`` on every core, conclude, draw; `RESULTS` and figures go to ``out``."""
    jobs = [(name, k, job) for name, paper in papers.items() for k, job in enumerate(paper.jobs())]
    results: dict[str, dict[int, Any]] = {name: {} for name in papers}
    done = 0

    def say(now: pool.Standing[tuple[str, int, Job]]) -> None:
        if tell is not None:
            flying = ", ".join(dict.fromkeys(name for (name, _, _), _ in now.running))
            tell(done / len(jobs), f"{done} of {len(jobs)} jobs  {flying}")

    with pool.opened(len(jobs)) as crew:
        for one in crew.work(_work, jobs, say):
            if one.error is not None:
                raise one.error
            name, k, _ = one.task
            results[name][k] = one.result
            done += 1
            say(pool.Standing([(one.task, 1.0)], 1))
    claims = {}
    for name, paper in papers.items():
        in_order = [results[name][k] for k in sorted(results[name])]
        claims[name] = paper.conclude(in_order)
        paper.draw(in_order, out)
    found = {name: [claim.record() for claim in own] for name, own in claims.items()}
    write_result(out / RESULTS, json.dumps(found, indent=1).encode())
    return claims


def _work(task: tuple[str, int, Job], tell: Callable[[float], None]) -> Any:
    """Called on a worker."""
    job = task[2]
    return job.work(*job.arguments)


def table(title: str, claims: Sequence[Claim]) -> Table:
    """Every claim in a row: quantity, the paper's value, ours with its spread over the seeds, verdict."""
    from rich.table import Table

    rows = Table("quantity", "paper", "ours", "spread", "bound", "verdict", title=title, title_justify="left")
    colours = {"met": "green", "beaten": "green", "impossible": "yellow", "missed": "red"}
    for claim in claims:
        spread = f"{min(claim.ours):.3g} … {max(claim.ours):.3g}" if len(claim.ours) > 1 else ""
        verdict = f"[{colours[claim.verdict]}]{claim.verdict}[/]"
        because = f", because {claim.impossible}" if claim.impossible else ""
        what = f"{claim.quantity} [{claim.unit}]" if claim.unit else claim.quantity
        bound = f"{'≥' if claim.at_least else '≤'} {claim.bound:.3g}"
        rows.add_row(what.replace("[", r"\["), claim.paper, f"{claim.value:.3g}", spread, bound, verdict + because)
    return rows
