"""A motion flown in its own process is the same motion."""

import dataclasses
import os
import signal
import time

import numpy as np
import pytest

from testbed.errors import UserError
from testbed.motion.ahead import Ahead
from testbed.motion.table import TruthBlock

RATE_HZ = 100.0


class Counting:
    """A motion of which every value is the number of the row; it ends, or breaks, after ``last`` rows."""

    def __init__(self, last=10**9, error=None):
        self.rate_hz, self.failure, self.tick, self.last, self.error = RATE_HZ, "", 0, last, error

    def advance(self, ticks):
        if self.error is not None and self.tick + ticks > self.last:
            raise self.error
        rows = min(ticks, self.last - self.tick)
        block = TruthBlock.empty(self.tick, rows)
        for name in ("t", "v_n", "q_nb"):
            column = getattr(block, name)
            column[:] = np.arange(self.tick, self.tick + rows).reshape(-1, *[1] * (column.ndim - 1))
        self.tick += rows
        self.failure = "out of rows" if rows < ticks else ""
        return block

    def activity(self):
        return f"row {self.tick}"


@pytest.fixture
def ahead():
    made = []

    def make(source, chunk=50, ticks=230):
        made.append(Ahead(lambda: source, RATE_HZ, chunk, ticks))
        return made[-1]

    yield make
    for one in made:
        one.close()


def everything(source, ticks, asked):
    blocks = []
    while ticks and len(block := source.advance(min(asked, ticks))):
        blocks.append(block)
        ticks -= len(block)
    return blocks


@pytest.mark.parametrize("asked", [7, 50, 1000])
def test_rows_are_those_of_the_source(ahead, asked):
    blocks = everything(ahead(Counting()), 230, asked)
    assert [block.tick for block in blocks] == list(np.cumsum([0, *map(len, blocks)])[:-1])
    whole = Counting().advance(230)
    for f in dataclasses.fields(TruthBlock):
        if f.name != "tick":
            joined = np.concatenate([getattr(block, f.name) for block in blocks])
            np.testing.assert_array_equal(joined, getattr(whole, f.name))


def test_the_end_and_its_reason_come_over(ahead):
    source = ahead(Counting(last=120))
    assert source.advance(50).tick == 0
    assert source.activity() == "row 50"
    assert source.failure == ""
    assert sum(map(len, everything(source, 180, 50))) == 70
    assert source.failure == "out of rows"
    assert len(source.advance(50)) == 0


def test_an_error_is_raised_where_the_rows_are_wanted(ahead):
    source = ahead(Counting(last=60, error=UserError("no more")))
    assert len(source.advance(50)) == 50
    with pytest.raises(UserError, match="no more") as caught:
        source.advance(50)
    assert "in advance" in caught.value.__notes__[0]  # where it happened


class Unsent(RuntimeError):
    """As JSBSim's exceptions, which say that they are of a module that there is not."""


Unsent.__module__ = "_no_such_module"


def test_an_error_that_cannot_be_sent_comes_as_text(ahead):
    source = ahead(Counting(last=10, error=Unsent("no axis type")))
    with pytest.raises(RuntimeError, match="Unsent: no axis type") as caught:
        source.advance(50)
    assert "in advance" in caught.value.__notes__[0]


def test_a_dead_process_is_noticed(ahead):
    source = ahead(Counting(), ticks=10**6)
    os.kill(source._process.pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="died"):
        everything(source, 10**6, 50)


def test_nobody_is_left_behind():
    source = Ahead(Counting, RATE_HZ, 50, 10**6)
    source.advance(50)
    source._blocks.close()  # as when whoever listens is killed
    deadline = time.monotonic() + 10.0
    while source._process.is_alive() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert source._process.exitcode == 0
