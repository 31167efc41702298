"""``testbed denied``: the benchmark of denied navigation."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from testbed import interrupts
from testbed.commands.shared import EXIT_FAILED, RUNS, console, output_folder, remark
from testbed.errors import UserError, printable
from testbed.results import REPORT, held, require_own

Estimators = Annotated[
    list[str] | None,
    typer.Option(
        "--estimator",
        metavar="KIND",
        help="mypackage:Mine or ./filters.py:Mine in the place of ins; repeat it to have ins, or others, beside.",
    ),
]
Draws = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        min=1,
        help="Flights of each weather: 20, 4 with --quick; five times as many, without it, of what goals are set for.",
    ),
]
Draw = Annotated[
    int | None,
    typer.Option(metavar="N", min=0, help="Seeds that no other draw has; that of the documentation."),
]
Quick = Annotated[bool, typer.Option("--quick", help="Two minutes without GNSS, and a consumer's IMU alone.")]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="Folder; runs/denied, with --quick runs/denied_quick.")]
Save = Annotated[bool, typer.Option("--save", help="Write table and figure into the documentation.")]


def denied(
    estimator: Estimators = None,
    draws: Draws = None,
    draw: Draw = None,
    quick: Quick = False,
    out: Out = None,
    save: Save = False,
) -> None:
    """Fly the benchmark of denied navigation: weather x aids x grade of the IMU x time without GNSS.

    What is finished stays in the folder; the same command carries on. Exit code 1 if a flight failed.
    """
    from testbed.denied import benchmark, goals, saved
    from testbed.denied.table import FULL, QUICK
    from testbed.many import progress
    from testbed.report import denied as report

    table = QUICK if quick else FULL
    if save and (quick or estimator):
        raise UserError("--save: the documentation has the whole table of ins: leave --quick and --estimator out")
    if save:
        saved.require_checkout()
    entered = benchmark.contestants(estimator or [], table, Path.cwd())
    folder = out or RUNS / ("denied_quick" if quick else "denied")
    number = benchmark.RECORDED_DRAW if draw is None else draw
    plan = benchmark.Plan(table, entered, folder, number, draws or table.draws)
    require_own(folder, [report.SUMMARY, report.DRAWS, REPORT])
    with (
        output_folder(folder),
        held(folder),
        interrupts.leaving(lambda: f"flights that are finished are in {folder}; the same command carries on"),
        progress.shown(console(stderr=True), "denied") as tell,
    ):
        result = benchmark.fly(plan, tell=tell)
        claims = goals.claims(result)
        cells = report.save(result, claims)
    for shown in report.tables(result, cells, claims):
        console().print(shown)
    print(printable(f"{folder / report.SUMMARY}, {report.DRAWS}, {REPORT} and figures beside it"))
    if save:
        print(printable(str(saved.save(result, cells, claims))))
    for (lane, why), count in benchmark.ended(result).items():
        remark(f"{lane} has ended in {count} flights: {why}")
    for failure in result.failures:
        remark(f"{failure.weather} seed {failure.seed}: {failure.message}")
    if result.failures:
        raise typer.Exit(EXIT_FAILED)
