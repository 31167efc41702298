"""What five papers claim, and what comes out here: ``testbed papers``. One module for each paper, and `misprints`.

A paper gives jobs, each one run or replay of some `Draws` with its seed, which are worked off in parallel; from their
results it concludes its claims (`testbed.papers.claims` has how they are judged) and draws its figures. The scenarios
lie in ``scenarios/papers``, each with its assumptions; where and how a motion goes is drawn (`testbed.papers.draws`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from testbed.data import data_dir
from testbed.errors import UserError
from testbed.many import pool
from testbed.papers.claims import Claim, Verdict
from testbed.papers.draws import Draws
from testbed.results import write_result
from testbed.scenario import Scenario

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.many.progress import Tell

RESULTS = "papers.json"
RECORDED_DRAW = 0  # of the table in the documentation, and what is drawn when nobody says
IDS = ("cheng2020", "cui2022", "jiang2021", "zhou2025", "zhu2020")


class Job(NamedTuple):
    """One piece of work for a process of its own: ``work(*arguments)``; both must be picklable."""

    work: Callable[..., Any]
    arguments: tuple[Any, ...]


@dataclass(frozen=True, slots=True)
class Paper:
    """One paper: its jobs, what it concludes from their results (in the order of the jobs), and its figures: their
    names, and what draws them into a folder.
    """

    title: str
    figures: tuple[str, ...]
    jobs: Callable[[Draws], Sequence[Job]]
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


def reproduce(
    papers: Mapping[str, Paper], draws: Draws, out: Path, tell: Tell | None = None
) -> dict[str, Sequence[Claim]]:
    """Work off the jobs of all ``papers`` on every core, conclude, draw; `RESULTS` and figures go to ``out``."""
    jobs = [(name, k, job) for name, paper in papers.items() for k, job in enumerate(paper.jobs(draws))]
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
    found: dict[str, Any] = {"draw": draws.number, "runs": draws.runs}
    found |= {name: [claim.record() for claim in own] for name, own in claims.items()}
    write_result(out / RESULTS, json.dumps(found, indent=1).encode())
    return claims


def _work(task: tuple[str, int, Job], tell: Callable[[float], None]) -> Any:
    """Called on a worker."""
    job = task[2]
    return job.work(*job.arguments)


def tables(title: str, claims: Sequence[Claim]) -> Iterator[Table]:
    """Every claim of a paper in a row, and what it doesn't claim in a table of its own."""
    from rich.table import Table

    colours = {Verdict.MET: "green", Verdict.MISSED: "red", Verdict.OPEN: "yellow"}
    for heading, own in parted(title, claims):
        table = Table(*COLUMNS, title=heading, title_justify="left")
        for claim in own:
            *cells, verdict = row(claim)
            said = verdict.replace(claim.verdict, f"[{colours.get(claim.verdict, 'cyan')}]{claim.verdict}[/]", 1)
            table.add_row(*(cell.replace("[", r"\[") for cell in cells), said)
        yield table


COLUMNS = ("quantity", "paper", "ours, with its 95 % interval", "statistic", "bound", "verdict")


def counted(claims: Mapping[str, Sequence[Claim]]) -> str:
    """How many of the papers' claims have which verdict."""
    every = [claim.verdict for own in claims.values() for claim in own if claim.paper]
    parts = ", ".join(f"{every.count(verdict)} {verdict}" for verdict in Verdict if verdict in every)
    return f"{len(every)} claims of the papers: {parts}"


def parted(title: str, claims: Sequence[Claim]) -> Iterator[tuple[str, list[Claim]]]:
    """(heading, claims) of those of the paper, and of the rest."""
    for heading, own in (
        (title, [claim for claim in claims if claim.paper]),
        (f"{title}: what it does not claim", [claim for claim in claims if not claim.paper]),
    ):
        if own:
            yield heading, own


def row(claim: Claim) -> tuple[str, ...]:
    """A claim in `COLUMNS`."""
    return (
        f"{claim.quantity} [{claim.unit}]" if claim.unit else claim.quantity,
        claim.paper,
        str(claim.interval),
        claim.statistic.name if claim.draws == 1 else f"{claim.statistic.name} of {claim.draws}",
        f"{'≥' if claim.at_least else '≤'} {claim.bound:.3g}",
        f"{claim.verdict}: {claim.why}" if claim.why else claim.verdict.value,
    )
