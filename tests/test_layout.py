"""Files and functions stay as short as can be read at once."""

import ast
from pathlib import Path

import nav
import testbed

LONGEST_FILE, LONGEST_FUNCTION = 500, 80  # lines
HARNESS = ("testbed/feeds/", "testbed/loop/")  # where no function has more parameters than this, without a record
MOST_PARAMETERS = 6
# Compiled loops, which calls in between would slow down.
KERNELS = {
    "nav/ahrs/state.py:propagate",
    "nav/batch.py:_follow",
    "nav/error_model.py:transition",
    "nav/strapdown.py:step",
    "testbed/sensors/increments.py:accumulate",
}


def test_functions_of_the_harness_have_few_parameters() -> None:
    many = set()
    room = Path(testbed.__file__).parent
    for path in room.rglob("*.py"):
        name = path.relative_to(room.parent).as_posix()
        for node in ast.walk(ast.parse(path.read_text())) if name.startswith(HARNESS) else ():
            if isinstance(node, ast.FunctionDef):
                given = [one.arg for one in (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)]
                many |= {f"{name}:{node.name}"} if len({*given} - {"self", "cls"}) > MOST_PARAMETERS else set()
    assert not many


def test_files_and_functions_are_short() -> None:
    long_files, long_functions = set(), set()
    for room in (Path(package.__file__).parent for package in (nav, testbed)):
        for path in room.rglob("*.py"):
            text, name = path.read_text(), path.relative_to(room.parent).as_posix()
            if len(text.splitlines()) > LONGEST_FILE:
                long_files.add(name)
            for node in ast.walk(ast.parse(text)):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                    lines = node.end_lineno - node.lineno + 1
                    long_functions |= {f"{name}:{node.name}"} if lines > LONGEST_FUNCTION else set()
    assert not long_files
    assert long_functions == KERNELS
