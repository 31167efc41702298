"""README and manual: every command and every block of code is run, and what is generated is whole.

A page is one session: its blocks are run in their order in an empty folder, and a block with a title is saved under it
first; one that defines a class is run by the scenario that names it. Runs are shortened by `shortened`; what can't be
run here is in `NOT_RUN`, with the reason, and is parsed.
"""

from __future__ import annotations

import importlib.util
import os
import re
import runpy
import shlex
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, Literal, NamedTuple, get_args, get_origin

import pytest
import typer
import yaml

import testbed.__main__ as cli
from testbed import Scenario, run
from testbed.schema import Section
from testbed.sensors.imu import ALLAN_PEAK
from testbed.sensors.units import MG

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.glob("*.md"))]
SHORT_S, LIVE_S = 10, 2  # of a run, and of one in real time
DENIED = [[4, 6]]  # in place of the windows of denial

# Commands by their beginning, and why they are parsed only.
NOT_RUN = {
    "make": "installs or runs everything",
    "mavproxy.py": "a ground station, in an environment of its own: tests/clients",
    "testbed campaign": "each starts processes for seconds: tests/many/test_campaign.py",
    "testbed denied": "takes minutes: tests/denied",
    "testbed check": "flies in processes, for minutes without names: tests/many, tests/test_shipped.py",
    "testbed run loiter_gnss_outage --px4": "waits for PX4: tests/bridges/test_px4.py",
    "testbed run loiter_gnss_outage --ardupilot": "waits for ArduPilot: tests/bridges/test_ardupilot.py",
    "testbed run take_off --px4": "waits for PX4: tests/bridges/test_piloted.py",
    "testbed run take_off --ardupilot": "waits for ArduPilot: tests/bridges/test_piloted.py",
    "testbed papers": "takes minutes: tests/papers",
    "testbed view": "opens a browser: tests/report/test_compare.py",
    "python scenarios/sweep_outage.py": "flies half an hour",
}
NOT_RUN_FILES = {
    "mavsdk_client.py": "needs MAVSDK, in an environment of its own: tests/clients/test_mavsdk.py",
    "external_filter.py": "reads what external.py tells it, and is run by that",
}


DONE: set[str] = set()  # Python that has been run on another page


def module(path: Path) -> ModuleType:
    """A file as a module."""
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    made = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = made  # where dataclasses look
    spec.loader.exec_module(made)
    return made


GENERATE = module(DOCS / "_generate.py")


class Block(NamedTuple):
    """One fenced block of a page."""

    language: str
    title: str
    text: str


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, examples among them."""
    text = GENERATE.with_examples(page.read_text("utf-8"))
    found = re.findall(r'^```(\w*)(?: title="([^"]+)")?\n(.*?)^```$', text, re.DOTALL | re.MULTILINE)
    return [Block(*block) for block in found]


ALL = [(page, block) for page in PAGES for block in blocks(page)]
LINES = [
    shlex.split(line, comments=True) for _, block in ALL if block.language == "sh" for line in block.text.splitlines()
]
COMMANDS = list(dict.fromkeys(tuple(line[1:]) for line in LINES if line[0] == "testbed"))


def not_run(line: Sequence[str]) -> bool:
    """Whether a command is one of `NOT_RUN`."""
    return any(tuple(line[: len(start)]) == start for start in (tuple(start.split()) for start in NOT_RUN))


def parsed(command: Sequence[str]) -> dict[str, Any]:
    """What the command line makes of a command."""
    group: Any = typer.main.get_command(cli.app)
    name, *arguments = cli._explicit(command)
    context = group.get_command(group.make_context("testbed", [name]), name).make_context(name, arguments)
    return dict(context.params)


def shortened(command: Sequence[str]) -> list[str]:
    """A run of ten seconds, its windows of denial within them; without figures."""
    name = command[1]
    if name.endswith(".nc"):
        return [*command, "--no-report"]
    given = parsed(command)
    changes = [f"duration_s={LIVE_S if given['realtime'] else SHORT_S}"]
    for sensor, section in Scenario.load(name, given["overrides"] or ()).sensors.items():
        if getattr(section, "denied", ()):
            changes.append(f"sensors.{sensor}.denied={DENIED}")
    return [*command, "--no-report", *(part for change in changes for part in ("--set", change))]


def test_there_is_nothing_that_is_not_looked_at() -> None:
    assert {block.language for _, block in ALL} <= {"sh", "python", "toml", "text"}
    texts = [GENERATE.with_examples(page.read_text("utf-8")) for page in PAGES]
    assert sum(len(re.findall(r"^```", text, re.MULTILINE)) for text in texts) == 2 * len(ALL)
    assert {command[0] for command in COMMANDS} >= {
        "scenarios",
        "run",
        "check",
        "export",
        "campaign",
        "papers",
        "watch",
    }
    assert all(line[0] in ("testbed", "python", "make", "mavproxy.py") for line in LINES)
    for start in NOT_RUN:
        assert any(not_run(line) and " ".join(line).startswith(start) for line in LINES), start


@pytest.mark.ci
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_page_works(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    # As who can say testbed, can say python.
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.chdir(tmp_path)
    whole = [block.text for source in (page, DOCS / "scenarios.md") for block in blocks(source) if is_whole(block)]
    for block in blocks(page):
        if block.title:
            Path(block.title).write_text(block.text, "utf-8")
        if block.language == "toml":
            Scenario.parse(block.text if is_whole(block) else f"{whole[0]}\n{block.text}", path=tmp_path / "block.toml")
        elif block.language == "python":
            code = compile(block.text, str(page), "exec")
            runs = block.title not in NOT_RUN_FILES and "class " not in block.text and block.text not in DONE
            if runs:
                DONE.update([] if block.title else [block.text])
                exec(code, {"__name__": "__main__"})
                assert capsys.readouterr().out
        elif block.language == "sh":
            for line in block.text.splitlines():
                run_line(shlex.split(line, comments=True), monkeypatch)
                capsys.readouterr()


def is_whole(block: Block) -> bool:
    """Whether it is a whole scenario, not a part of one."""
    return block.language == "toml" and block.text.startswith("title")


def run_line(line: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Run a command here, shortened; parse it if it is one of `NOT_RUN`."""
    if line[0] == "python" and not not_run(line):
        runpy.run_path(line[1], run_name="__main__")
    if line[0] != "testbed":
        return
    if not_run(line):
        given = parsed(line[1:])
        for name in given.get("names") or filter(None, [given.get("scenario")]):
            Scenario.load(name, given.get("overrides") or ())
        return
    command = shortened(line[1:]) if line[1] == "run" else line[1:]
    monkeypatch.setattr(sys, "argv", ["testbed", *command])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    assert not ended.value.code, command


PARTS = [block.text for _, block in ALL if block.language == "text" and block.text.startswith("[")]


@pytest.mark.parametrize("part", PARTS)
def test_a_part_of_a_scenario_is_one(part: str) -> None:
    """Of files that are not there, or beside what the reader has already."""
    head = 'title = "Part"\nduration_s = 60\n'
    rest = '[sensors.imu]\n[sensors.gnss]\n[[estimator]]\nname = "ins"\nkind = "ins"\naids = ["gnss"]\n'
    if "[truth]" not in part:
        head += '[truth]\nsource = "log"\nfile = "imu.csv"\n'
    if "source" not in part and "[truth]" in part:
        part = part.replace("[truth]", '[truth]\nsource = "flight"')
        rest += '[[plan]]\nleg = "straight"\nlength_m = 500\n'
    Scenario.parse(f"{head}{part}\n{rest}")


@pytest.mark.parametrize("text", [block.text for _, block in ALL if is_whole(block) and not block.title])
def test_scenario_without_a_name_flies(text: str) -> None:
    scenario = Scenario.parse(text, ["duration_s=20", "sensors.gnss.denied=[[12, 15]]"])
    result = run(scenario)
    assert all(result.metrics[f"{estimator.name}.aligned_s"] < 10 for estimator in scenario.estimator)


def test_make_targets_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    for page in PAGES:
        assert set(re.findall(r"(?:`|^)make ([a-z-]+)", page.read_text("utf-8"), re.MULTILINE)) <= targets, page


def test_scripts_take_the_arguments_that_are_shown() -> None:
    lines = [line for line in LINES if line[0] == "python" and not_run(line)]
    assert lines
    for _, path, *arguments in lines:
        module(ROOT / path).parser().parse_args(arguments)


def test_links_of_the_readme_lead_somewhere() -> None:
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.splitlines()) <= 125
    links = re.findall(r"\]\(([^)#]+)", text)
    assert links
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_figures_of_the_readme_are_those_of_the_page_that_it_cites() -> None:
    readme, page = (" ".join(path.read_text("utf-8").split()) for path in (ROOT / "README.md", DOCS / "expected.md"))
    rows: dict[str, list[str]] = {}
    for name in ("loiter_gnss_outage", "hardware_gnss_outage"):
        chapter = page[page.index(f" ## {name} ") :]
        for second in (120, 600):
            row = re.search(rf"\| ins\.outage_position_horizontal_at_{second}s_m (.*?)\| ins\.", chapter)
            assert row is not None
            rows[f"{name} {second}"] = [
                f"{float(x):.0f}" for x in re.findall(r"[\d.]+", row[1].split("%", 1)[1].split("|", 1)[1])
            ]
    clear = [rows[f"loiter_gnss_outage {second}"][0] for second in (120, 600)]
    assert f"{clear[0]} m after 120 s and {clear[1]} m after 600 s" in readme
    (a, a1, a2, a95, *_), (b, b1, b2, b95, *_) = (rows[f"hardware_gnss_outage {second}"] for second in (120, 600))
    assert f"{a} m (95 % interval {a1} to {a2}) and {b} m ({b1} to {b2})" in readme
    assert f"95 % of the runs stay below {a95} and {b95} m" in readme


def test_installing_without_make_is_what_make_does() -> None:
    made = (ROOT / "Makefile").read_text("utf-8")
    made = made.replace("$(PYTHON)", "python3").replace("$(BIN)", "$(VENV)/bin").replace("$(VENV)", ".venv")
    recipe = re.sub(r" --(quiet|disable-pip-version-check|no-compile)", "", made).splitlines()
    (told,) = [block.text for block in blocks(DOCS / "tutorial.md") if "venv" in block.text]
    assert [line for line in told.splitlines() if f"\t{line}" not in recipe] == []


def test_factors_between_the_terms_of_other_tools_and_ours() -> None:
    page = (DOCS / "sensors.md").read_text("utf-8")
    mgal, hour = 1e-5, 3600
    factors = (1, hour, mgal / MG, 1 / MG)  # to 1 sigma; and to the floor of the Allan deviation
    for factor in (*(ALLAN_PEAK * one for one in factors), *factors[1:]):
        assert re.search(rf" × {factor:.4g} \|".replace(".", r"\."), page), factor


def test_the_manual_lists_its_pages() -> None:
    config = yaml.safe_load((ROOT / "mkdocs.yml").read_text("utf-8"))
    listed = [page for chapter in config["nav"] for pages in chapter.values() for one in pages for page in one.values()]
    assert sorted(listed) == sorted(page.name for page in DOCS.glob("*.md"))


# --- what is generated


def sections(section: type[Section] = Section) -> Iterator[type[Section]]:
    """All sections that a scenario may have; of those with others below them, these."""
    for below in section.__subclasses__():
        known = getattr(sys.modules.get(below.__module__), below.__name__, None) is below  # not one of a test's
        if known and re.match(r"testbed\.(motion|sensors|estimators|scenario)\b", below.__module__):
            yield from sections(below) if below.__subclasses__() else [below]


ELSEWHERE = "testbed.motion.aircraft"  # envelope.toml


def test_every_key_is_in_the_reference_and_says_what_it_is() -> None:
    tables = GENERATE.scenario_tables()
    told = {(table.model, row.key) for table in tables for row in table.rows}
    there = {
        (section.__name__, key)
        for section in sections()
        if section.__module__ != ELSEWHERE
        for key, field in section.model_fields.items()
        if not (get_origin(field.annotation) is Literal and len(get_args(field.annotation)) == 1)
    }
    assert there - told == set()
    assert len(there) > 200
    assert [(table.model, row.key) for table in tables for row in table.rows if not row.description] == []
    assert [(table.heading, row.key) for table in tables for row in table.rows if not row.type or not row.default] == []
    page = GENERATE.scenario_reference()
    assert all(f"| `{key}` |" in page for _, key in told)


def test_every_grade_has_a_source() -> None:
    for kind, config in GENERATE.sensor_sections().items():
        text = GENERATE.grade_tables()[kind]
        for name in GENERATE._grade_names(config):
            assert name == "perfect" or f"* `{name}`: " in text, (kind, name)


def test_every_recorded_variable_is_explained() -> None:
    rows = re.findall(r"^\| `.*$", GENERATE.record_format(), re.MULTILINE)
    assert len(rows) > 80
    assert [row for row in rows if row.endswith("|  |")] == []


def test_what_pages_ask_for_is_generated() -> None:
    asked = {name for page in PAGES for name in GENERATE.PLACEHOLDER.findall(page.read_text("utf-8"))}
    assert asked == set(GENERATE.PARTS)
    for name in asked - {"record_format", "aircraft_modes"}:  # the first has a test of its own, the second flies
        assert len(GENERATE.PARTS[name]()) > 100, name


def test_the_recipe_for_a_sensor_names_every_file() -> None:
    page = (DOCS / "extending.md").read_text("utf-8")
    recipe = page[page.index("## A built-in sensor") : page.index("## A leg")]
    named = set(re.findall(r"`((?:nav|testbed)/[\w/]+\.py)`", recipe))
    own = {"testbed/sensors/lidar.py", "nav/aids/lidar.py"}
    assert own < named
    sources = [path for room in ("nav", "testbed") for path in (ROOT / room).rglob("*.py")]
    knows = re.compile(r"StarTracker|StarSample|StarAid|star_tracker|star_attitude")
    found = {str(path.relative_to(ROOT)) for path in sources if knows.search(path.read_text("utf-8"))}
    assert named - own == {path for path in found if "papers" not in path and not path.endswith("/star_tracker.py")}
