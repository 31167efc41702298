"""The page of the papers: claims with their drawings, in a browser."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from worlds import browser

from testbed import papers
from testbed.papers import page as pages
from testbed.papers import saved
from testbed.papers.draws import Draws
from testbed.results import REPORT
from testbed.score.claims import EXACT, Claim

VALUES = np.linspace(1.0, 2.0, 100)
CLAIMS = [
    Claim("error <largest>", "m", "3", VALUES, 3.0).record(),
    Claim("too large", "m", "0.1", VALUES, 0.1).record(),
    Claim("nothing at all", "", "0", [0.0], 0.0, statistic=EXACT).record(),
]


def test_a_drawing_has_the_bound_in_its_middle() -> None:
    within, beyond, nothing = (pages.drawn(record) for record in CLAIMS)
    assert within is not None
    assert beyond is not None
    assert within.low < within.value < within.high < 50.0
    assert within.value == pytest.approx(50 + 50 * np.log(1.5 / 3) / np.log(pages.REACH), abs=0.5)
    assert beyond.value == 100.0
    assert nothing is None
    assert pages.drawn({**CLAIMS[0], "interval": [None, None]}) == within._replace(low=0.0, high=100.0)
    assert pages.drawn({**CLAIMS[0], "ours": None}) is None


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A folder in which one paper was judged."""
    papers.keep({papers.IDS[0]: CLAIMS}, Draws(7, 100), tmp_path / papers.RESULTS)
    return tmp_path


def test_what_was_judged_is_on_the_page(folder: Path) -> None:
    text = saved.show(folder).read_text("utf-8")
    assert "error &lt;largest&gt; [m]" in text
    assert "draw 7, 100 draws" in text
    assert text.count("<svg") == 2


@pytest.mark.ci
@pytest.mark.skipif(browser.program() is None, reason="there is no Chromium on this machine to open a page in")
def test_a_verdict_can_be_left_out(folder: Path) -> None:
    saved.show(folder)
    with browser.opened() as tab:
        tab.size(1400, 1000)
        tab.open(folder / REPORT)
        shown = "[...document.querySelectorAll('tr[data-verdict]')].filter(row => row.offsetHeight).length"
        assert tab.run(shown) == 3
        tab.run("document.querySelector('button[data-verdict=missed]').click()")
        assert tab.run(shown) == 2
        tab.run("document.querySelector('button[data-verdict=missed]').click()")
        assert tab.run(shown) == 3
        assert tab.run("document.querySelector('circle').getBoundingClientRect().width") > 3
