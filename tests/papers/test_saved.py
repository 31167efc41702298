"""The table of the documentation: what it says, where it is written, and that texts quote it as it is."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from testbed import data, papers
from testbed.data import data_dir
from testbed.errors import UserError
from testbed.papers import saved
from testbed.papers.draws import Draws
from testbed.score.claims import EXACT, MEDIAN, Claim

ROOT = Path(__file__).parent.parent.parent
QUOTE = re.compile(r"-?\d[\d.e+-]* \([-\d.e+inf]+ to [-\d.e+inf]+\)")
VALUES = np.arange(100.0)


CLAIMS = [
    Claim("error | largest", "m", "10", VALUES, 90.0).record(),
    Claim("ours", "", "", [3.0], 2.0, statistic=EXACT).record(),
]


def test_a_page_has_every_claim_and_how_it_was_drawn() -> None:
    page = saved.page({"A toy": CLAIMS}, Draws(7, 100))
    assert "`testbed papers --save --draw 7 --runs 100`" in page
    assert "1 claims of the papers: 1 met" in page
    assert f"| error \\| largest [m] | 10 | {MEDIAN.of(VALUES)} | median of 100 | ≤ 90 | met |" in page
    assert "## A toy: what it does not claim" in page
    assert "| ours |  | 3 | exact | ≤ 2 | missed |" in page


@pytest.fixture
def checkout(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkout with an output folder that has all papers but the last."""
    for folder in ("docs", "scenarios/papers", "out"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.setattr(saved, "data_dir", lambda name: tmp_path / name)
    monkeypatch.setattr(data, "data_dir", lambda name: tmp_path / name)
    for paper in papers.find([]).values():
        for figure in paper.figures:
            (tmp_path / "out" / figure).write_bytes(b"picture")
    papers.keep(dict.fromkeys(papers.IDS[:-1], CLAIMS), Draws(7, 50), tmp_path / "out" / papers.RESULTS)
    return tmp_path


def test_table_and_figures_go_into_the_checkout(checkout: Path) -> None:
    papers.keep({papers.IDS[-1]: CLAIMS}, Draws(7, 50), checkout / "out" / papers.RESULTS)
    path = saved.save(checkout / "out")
    assert path == checkout / "docs" / saved.TABLE
    assert all(f"## {paper.title}" in path.read_text("utf-8") for paper in papers.find([]).values())
    assert (checkout / "scenarios" / "papers" / "cui2022.png").read_bytes() == b"picture"


def test_papers_that_are_not_judged_with_the_same_draws_are_named(checkout: Path) -> None:
    with pytest.raises(UserError, match="zhu2020 not judged yet: testbed papers zhu2020 --draw 7 --runs 50 --save"):
        saved.save(checkout / "out")
    papers.keep({papers.IDS[-1]: CLAIMS}, Draws(8, 50), checkout / "out" / papers.RESULTS)
    with pytest.raises(UserError, match="cheng2020, cui2022, jiang2021, zhou2025 not judged yet"):
        saved.save(checkout / "out")
    assert not (checkout / "docs" / saved.TABLE).exists()


def test_without_a_checkout_nothing_is_saved(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(saved, "data_dir", lambda name: tmp_path / name)
    monkeypatch.setattr(data, "data_dir", lambda name: tmp_path / name)
    with pytest.raises(UserError, match="is missing: --save is for a checkout"):
        saved.require_checkout()


def test_the_table_is_of_the_draw_that_is_drawn_when_nobody_says() -> None:
    text = (ROOT / "docs" / saved.TABLE).read_text("utf-8")
    assert f"--draw {papers.RECORDED_DRAW} --runs 100`" in text
    for paper in papers.find([]).values():
        assert f"## {paper.title}\n" in text
        for figure in paper.figures:
            assert (data_dir("scenarios") / "papers" / figure).is_file()


@pytest.mark.parametrize("page", ["README.md", "docs/papers.md"])
def test_texts_quote_the_table_as_it_is(page: str) -> None:
    table = (ROOT / "docs" / saved.TABLE).read_text("utf-8")
    quoted = QUOTE.findall((ROOT / page).read_text("utf-8"))
    assert [quote for quote in quoted if quote not in table] == []
    assert page == "README.md" or len(quoted) > 10
