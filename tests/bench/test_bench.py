"""The bench itself, with stubs instead of measurements."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from bench.command import main
from bench.measure import FULL, QUICK, Effort, Missing, Row, Verdict, cpu_seconds, need, ratios

HERE = Path(__file__).parent


def two_rows(effort: Effort) -> Iterator[Row]:
    """One with a bound, one without."""
    yield Row("bounded", (1.0, 1.1, 1.2)[: effort.rounds], at_most=2.0, detail=f"{effort.count(100)} steps")
    yield Row("shown only", (3.0,), "s")


def broken(effort: Effort) -> Iterator[Row]:
    """Fails after its first figure."""
    yield Row("before the failure", (1.0,))
    raise ZeroDivisionError("what went wrong")


def interrupted(effort: Effort) -> Iterator[Row]:
    """Ctrl-C after its first figure."""
    yield Row("before the interrupt", (1.0,))
    raise KeyboardInterrupt


def over(effort: Effort) -> Iterator[Row]:
    """Misses its bound."""
    yield Row("too slow", (2.5, 2.6), at_most=2.0)


def without_peer(effort: Effort) -> Iterator[Row]:
    """Compares with what isn't there."""
    need("no_such_package")
    yield Row("never", (1.0,))


STUBS = {one.__name__: one for one in (two_rows, broken, interrupted, over, without_peer)}


@pytest.mark.parametrize(
    ("row", "verdict"),
    [
        (Row("", (1.0, 1.9), at_most=2.0), Verdict.KEPT),
        (Row("", (0.92, 1.03, 0.95), at_most=1.0), Verdict.OPEN),
        (Row("", (2.1, 2.9), at_most=2.0), Verdict.MISSED),
        (Row("", (4.1, 5.0), at_least=4.0), Verdict.KEPT),
        (Row("", (3.9, 5.0), at_least=4.0), Verdict.OPEN),
        (Row("", (3.9,), at_least=4.0), Verdict.MISSED),
        (Row("", (float("nan"),), at_most=4.0), Verdict.MISSED),
        (Row("", (1.0, 9.0)), Verdict.NONE),
    ],
)
def test_the_rounds_decide_between_kept_missed_and_open(row: Row, verdict: Verdict) -> None:
    assert row.verdict is verdict


def test_rows_without_a_bound_are_printed_beside_those_with_one(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(STUBS, ["--only", "two_rows"]) == 0
    bounded, shown = capsys.readouterr().out.splitlines()
    assert " ".join(bounded.split()) == "kept bounded 1.10 x 1.00 to 1.20, at most 2, 100 steps"
    assert " ".join(shown.split()) == "shown only 3.00 s"


def test_a_measurement_that_raises_costs_no_other_its_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(STUBS, ["--only", "broken", "two_rows"]) == 1
    out = capsys.readouterr().out
    assert out.index("before the failure") < out.index("what went wrong") < out.index("bounded")
    assert out.endswith("failed: broken\n")


def test_an_interrupt_keeps_what_was_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(STUBS, ["--only", "over", "interrupted", "two_rows"]) == 130
    out = capsys.readouterr().out
    assert "before the interrupt" in out
    assert "bounded" not in out
    assert out.endswith("interrupted; 2 figures were measured\nmissed: too slow\n")


def test_each_figure_is_printed_as_it_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    def second(effort: Effort) -> Iterator[Row]:
        assert "bounded" in capsys.readouterr().out
        yield Row("after", (1.0,))

    assert main({"two_rows": two_rows, "second": second}, []) == 0


def test_quick_is_a_tenth_of_the_work_without_verdicts(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(STUBS, ["--quick", "--only", "two_rows", "over"]) == 0
    out = capsys.readouterr().out
    assert "10 steps" in out
    assert not any(word in out for word in ("kept", "missed", "MISSED", "at most"))
    work = [effort.share * (1 + effort.rounds) for effort in (QUICK, FULL)]  # and the warm-up
    assert work[0] <= 0.1 * work[1]


def test_a_missed_bound_is_the_exit_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(STUBS, ["--only", "over"]) == 1
    assert "MISSED  too slow" in capsys.readouterr().out


def test_a_peer_that_is_not_installed_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(Missing, match="no_such_package not installed"):
        need("numpy", "no_such_package")
    assert main(STUBS, ["--only", "without_peer"]) == 0
    assert "without_peer: left out, no_such_package not installed" in capsys.readouterr().out


def test_processor_time_counts_the_processes_that_were_started() -> None:
    spin = "import time\nwhile time.process_time() < 0.3: pass"
    assert cpu_seconds(lambda: subprocess.run([sys.executable, "-c", spin], check=True)) >= 0.3
    assert ratios((2.0, 9.0), (1.0, 3.0)) == (2.0, 3.0)


@pytest.mark.ci
def test_the_command_lists_its_measurements_and_refuses_others() -> None:
    asked = subprocess.run([sys.executable, HERE, "--only", "nonsense"], capture_output=True, text=True)
    assert asked.returncode == 2
    assert "invalid choice: 'nonsense'" in asked.stderr
    assert "growth" in asked.stderr
