"""Own files are safe, an earlier command's are replaced, and one command at a time writes into a folder."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from testbed import Scenario, run
from testbed.data import write_file
from testbed.errors import UserError
from testbed.results import (
    CAMPAIGN,
    MANIFEST,
    RECORD,
    REPORT,
    beside,
    enter,
    held,
    require_own,
    start_anew,
    write_result,
)  # fmt: skip

HOLDER = """
import sys, time
from pathlib import Path
from testbed.results import held
with held(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(60)
"""


def listed(folder: Path) -> list[str]:
    return json.loads((folder / MANIFEST).read_text("utf-8"))["files"]


def test_what_is_written_is_listed_and_goes_with_the_next_start(tmp_path: Path) -> None:
    (tmp_path / "photo.png").write_text("mine")
    for name in ("b.png", "a.png", "b.png"):
        write_result(tmp_path / name, b"1")
    assert listed(tmp_path) == ["a.png", "b.png"]
    start_anew(tmp_path, ["b.png"])
    assert {path.name for path in tmp_path.iterdir()} == {"b.png", "photo.png", MANIFEST}
    assert listed(tmp_path) == ["b.png"]
    start_anew(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["photo.png"]


def test_an_export_goes_with_what_else_was_listed_but_for_foreign_files_in_it(tmp_path: Path) -> None:
    for folder in ("old_csv", "kept_csv"):
        (tmp_path / folder).mkdir()
        write_result(tmp_path / folder / "truth.csv", b"1")
        enter(tmp_path, [folder])
    (tmp_path / "kept_csv/mine.txt").write_text("mine")
    start_anew(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["kept_csv"]
    assert [path.name for path in (tmp_path / "kept_csv").iterdir()] == ["mine.txt"]


def test_of_an_export_that_was_moved_and_linked_only_the_link_goes(tmp_path: Path) -> None:
    (tmp_path / "kept" / "run_csv").mkdir(parents=True)
    write_result(tmp_path / "kept" / "run_csv" / "truth.csv", b"1")
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run_csv").symlink_to(tmp_path / "kept" / "run_csv")
    enter(tmp_path / "run", ["run_csv"])
    start_anew(tmp_path / "run")
    assert list((tmp_path / "run").iterdir()) == []
    assert (tmp_path / "kept" / "run_csv" / "truth.csv").read_bytes() == b"1"


def test_what_somebody_writes_meanwhile_stays_and_is_listed_in_the_end(tmp_path: Path) -> None:
    for content in (b"1", b"2"):
        with beside(tmp_path, ["run.tlog", "none.tlog"]):
            (tmp_path / "run.tlog").write_bytes(content)
            start_anew(tmp_path, [RECORD])
        assert (tmp_path / "run.tlog").read_bytes() == content
        assert set(listed(tmp_path)) == {RECORD, "run.tlog"}
    (tmp_path / "mine.tlog").write_bytes(b"mine")
    with pytest.raises(UserError, match=r"there is mine\.tlog already"), beside(tmp_path, ["mine.tlog"]):
        pass
    with pytest.raises(UserError, match="no log"), beside(tmp_path, ["mine.tlog"], force=True):
        raise UserError("it is no log")
    assert "mine.tlog" not in listed(tmp_path)
    with beside(tmp_path, ["mine.tlog"], force=True):
        (tmp_path / "mine.tlog").write_bytes(b"now")
    assert "mine.tlog" in listed(tmp_path)


def test_results_of_one_command_are_not_replaced_by_anothers(tmp_path: Path) -> None:
    """A run into a campaign's folder took that away, without a word."""
    write_result(tmp_path / CAMPAIGN, b"1")
    write_result(tmp_path / REPORT, b"1")
    require_own(tmp_path, [CAMPAIGN])
    for force in (False, True):
        with pytest.raises(UserError, match="has the results of a campaign: choose another folder"):
            require_own(tmp_path, [RECORD], force)
    with pytest.raises(UserError, match="of a campaign"):
        run(Scenario.load("static_bench", {"duration_s": 1.0}), out=tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {CAMPAIGN, REPORT, MANIFEST}


def test_a_file_is_written_through_a_link_and_into_a_device(tmp_path: Path) -> None:
    target, link = tmp_path / "target.txt", tmp_path / "link.txt"
    link.symlink_to(target)
    write_file(link, b"1")
    assert (link.is_symlink(), target.read_bytes()) == (True, b"1")
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with subprocess.Popen(["cat", pipe], stdout=subprocess.PIPE) as reader:
        write_file(pipe, b"2")
        assert reader.communicate(timeout=10)[0] == b"2"
    assert pipe.is_fifo()
    link.unlink()
    link.symlink_to(link)
    for wrong, says in ((link, "can't be written"), (Path("a\0b"), "can't be written"), (tmp_path, "is a folder")):
        with pytest.raises(UserError, match=says):
            write_file(wrong, b"3")


def test_foreign_files_are_named_and_left_unless_forced(tmp_path: Path) -> None:
    for name in ("flight.png", "run.nc"):
        (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=r"there is run\.nc, flight\.png already, .*--force"):
        require_own(tmp_path, ["run.nc", "flight.png", "absent.png"])
    with pytest.raises(UserError, match=r"flight\.png already"):
        write_result(tmp_path / "flight.png", b"1")
    assert (tmp_path / "flight.png").read_text() == "mine"
    assert not (tmp_path / MANIFEST).exists()
    write_result(tmp_path / "flight.png", b"1", force=True)
    assert listed(tmp_path) == ["flight.png"]


@pytest.mark.parametrize("content", ["{", "[]", '{"files": 3}', '{"files": [3]}', '{"files": ["../outside"]}'])
def test_a_damaged_manifest_is_told_and_removes_nothing_outside(tmp_path: Path, content: str) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (tmp_path / "outside").write_text("mine")
    (folder / MANIFEST).write_text(content)
    with pytest.raises(UserError, match=rf"{MANIFEST}: is damaged: delete it"):
        start_anew(folder)
    assert (tmp_path / "outside").exists()


def test_a_folder_has_one_writer_at_a_time(tmp_path: Path) -> None:
    with held(tmp_path), pytest.raises(UserError, match="another run is writing here"), held(tmp_path):
        pass
    with held(tmp_path):
        pass
    assert not list(tmp_path.iterdir())


def test_a_writer_that_died_is_no_obstacle(tmp_path: Path) -> None:
    with subprocess.Popen([sys.executable, "-c", HOLDER, str(tmp_path)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        with pytest.raises(UserError, match="another run is writing here"), held(tmp_path):
            pass
        holder.send_signal(signal.SIGKILL)
    with held(tmp_path):
        pass


@pytest.mark.ci
def test_a_run_spares_own_files_and_knows_its_earlier_ones(tmp_path: Path) -> None:
    scenario = Scenario.load("static_bench", ["duration_s=2"])
    (tmp_path / "run.nc").write_text("mine")
    with pytest.raises(UserError, match=r"there is run\.nc already"):
        run(scenario, out=tmp_path)
    assert (tmp_path / "run.nc").read_text() == "mine"
    (tmp_path / "run.nc").unlink()
    write_result(tmp_path / "visibility.png", b"old")
    for _ in range(2):
        run(scenario, out=tmp_path)
        assert listed(tmp_path) == ["metrics.json", "run.nc"]
        assert {path.name for path in tmp_path.iterdir()} == {"metrics.json", "run.nc", MANIFEST}
    with held(tmp_path), pytest.raises(UserError, match="another run is writing here"):
        run(scenario, out=tmp_path)
