"""The command line of the bench: which figures, how thoroughly; each is printed as it is measured."""

from __future__ import annotations

import argparse
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence

from bench.measure import FULL, QUICK, Effort, Missing, Row, Verdict

Measure = Callable[[Effort], Iterator[Row]]


def main(measures: Mapping[str, Measure], arguments: Sequence[str] | None = None) -> int:
    """Measure and print; the exit status: 0, 1 when a bound is missed or a measurement failed, 130 interrupted."""
    asked = _parse(measures, arguments)
    rows: list[Row] = []
    failed: list[str] = []
    status = 0
    try:
        for name in asked.only or measures:
            try:
                for row in measures[name](QUICK if asked.quick else FULL):
                    rows.append(row)
                    print(_line(row, judged=not asked.quick), flush=True)
            except Missing as missing:
                print(f"        {name}: left out, {missing}", flush=True)
            except Exception:
                failed.append(name)
                print(f"FAILED  {name}\n{traceback.format_exc()}", flush=True)
    except KeyboardInterrupt:
        print(f"interrupted; {len(rows)} figures were measured", flush=True)
        status = 130
    verdicts = {} if asked.quick else {kind: [row.what for row in rows if row.verdict is kind] for kind in Verdict}
    for kind in (Verdict.MISSED, Verdict.OPEN):
        if verdicts.get(kind):
            print(f"{kind.value}: {'; '.join(verdicts[kind])}")
    if failed:
        print(f"failed: {', '.join(failed)}")
    return status or int(bool(failed or verdicts.get(Verdict.MISSED)))


def _parse(measures: Mapping[str, Measure], arguments: Sequence[str] | None) -> argparse.Namespace:
    listed = "\n".join(f"  {name:<20} {(one.__doc__ or '').partition(chr(10))[0]}" for name, one in measures.items())
    parser = argparse.ArgumentParser(
        prog="python tests/bench",
        description="Speed, each figure as a ratio measured in one run where that is possible.",
        epilog=f"measurements:\n{listed}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--only", nargs="+", choices=measures, metavar="NAME", help="these measurements alone")
    parser.add_argument("--quick", action="store_true", help="each at a tenth of its work, without verdicts")
    return parser.parse_args(arguments)


def _line(row: Row, judged: bool) -> str:
    """Verdict, figure, value, spread of the rounds, bound, and what it was measured on."""
    spread = f"{min(row.rounds):.2f} to {max(row.rounds):.2f}" if len(row.rounds) > 1 else ""
    verdict, bound = (row.verdict.value, row.bound) if judged else ("", "")
    if row.verdict is Verdict.MISSED:
        verdict = verdict.upper()
    words = ", ".join(word for word in (spread, bound, row.detail) if word)
    return f"{verdict:<7} {row.what:<46} {row.value:8.2f} {row.unit:<12} {words}".rstrip()
