"""Files and functions stay as short as can be read at once."""

import ast
from pathlib import Path

import nav
import testbed

LONGEST_FILE, LONGEST_FUNCTION = 500, 80  # lines
# Compiled loops, which calls in between would slow down.
KERNELS = {
    "nav/ahrs/state.py:propagate",
    "nav/batch.py:follow",
    "nav/error_model.py:transition",
    "nav/strapdown.py:step",
    "testbed/sensors/increments.py:accumulate",
}


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
