"""What five papers claim, and what comes out here: ``testbed papers``. One module for each paper, and `misprints`.

A paper gives jobs, each one run or replay of some `Draws` with its seed, which are worked off in parallel; from their
results it concludes its claims (`testbed.score.claims` has how they are judged) and draws its figures. The scenarios
lie in ``scenarios/papers``, each with its assumptions; where and how a motion goes is drawn (`testbed.papers.draws`).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

from testbed.data import data_dir
from testbed.errors import UserError
from testbed.many import pool
from testbed.papers.draws import Draws
from testbed.results import PAPERS, write_result
from testbed.scenario import Scenario
from testbed.score.claims import Claim, Verdict

if TYPE_CHECKING:
    from rich.table import Table

    from testbed.many.progress import Tell

RESULTS = PAPERS
RECORDED_DRAW = 770201  # of the table in the documentation, and what is drawn when nobody says
Records: TypeAlias = Sequence[Mapping[str, Any]]  # claims as `Claim.record` has them
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
    records = {name: [claim.record() for claim in own] for name, own in claims.items()}
    keep(records, draws, out / RESULTS)
    return claims


def keep(found: Mapping[str, Records], draws: Draws, path: Path) -> None:
    """Write what was found beside what other papers of the same draws have there already."""
    kept = stored(path)
    if kept is None or kept[0] != draws:
        kept = (draws, {})
    whole = {"draw": draws.number, "runs": draws.runs, "papers": {**kept[1], **found}}
    write_result(path, json.dumps(whole, indent=1).encode())


def stored(path: Path) -> tuple[Draws, dict[str, Records]] | None:
    """The draws and, by paper, the claims of a file that `reproduce` wrote; None when none can be read."""
    try:
        whole = json.loads(path.read_text("utf-8"))
        return Draws(whole["draw"], whole["runs"]), whole["papers"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _work(task: tuple[str, int, Job], tell: Callable[[float], None]) -> Any:
    """Called on a worker."""
    job = task[2]
    return job.work(*job.arguments)


COLUMNS = ("quantity", "paper", "ours, with its 95 % interval", "statistic", "bound", "verdict")


def tables(title: str, records: Records) -> Iterator[Table]:
    """Every claim of a paper in a row, and what it doesn't claim in a table of its own."""
    from rich.table import Table

    colours = {Verdict.MET: "green", Verdict.MISSED: "red", Verdict.OPEN: "yellow"}
    for heading, own in parted(title, records):
        table = Table(*COLUMNS, title=heading, title_justify="left")
        for record in own:
            *cells, said = (cell.replace("[", r"\[") for cell in row(record))
            colour = colours.get(Verdict(record["verdict"]), "cyan")
            table.add_row(*cells, f"[{colour}]{said}[/]")
        yield table


def counted(found: Mapping[str, Records]) -> str:
    """How many of the papers' claims have which verdict."""
    every = [record["verdict"] for own in found.values() for record in own if record["paper"]]
    parts = ", ".join(f"{every.count(verdict)} {verdict}" for verdict in Verdict if verdict in every)
    return f"{len(every)} claims of the papers: {parts}"


def parted(title: str, records: Records) -> Iterator[tuple[str, Records]]:
    """(heading, claims) of those of the paper, and of the rest."""
    for heading, own in (
        (title, [record for record in records if record["paper"]]),
        (f"{title}: what it does not claim", [record for record in records if not record["paper"]]),
    ):
        if own:
            yield heading, own


def row(record: Mapping[str, Any]) -> tuple[str, ...]:
    """A claim in `COLUMNS`."""
    return (
        f"{record['quantity']} [{record['unit']}]" if record["unit"] else record["quantity"],
        record["paper"],
        record["as text"],
        record["statistic"] if record["draws"] == 1 else f"{record['statistic']} of {record['draws']}",
        record["bound"],
        f"{record['verdict']}: {record['why']}" if record["why"] else record["verdict"],
    )
