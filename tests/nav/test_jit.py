"""Cached kernels are good only while all that they may be made of is what it was."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from numba.core.errors import LoweringError, TypingError

import nav
from nav._jit import lean, njit
from nav.samples import Array

SCRIPT = """
from nav import earth
earth.radii(0.5)
print(sum(earth.radii.stats.cache_hits.values()), sum(earth.radii.stats.cache_misses.values()))
"""

KERNELS = {  # of a package of its own
    "__init__": "",
    "constants": "FACTOR = 2.0\nUNUSED = 5.0\n",
    "inner": "from nav._jit import njit\nfrom mine.innermost import add\n@njit\ndef double(x):\n    return add(x, x)\n",
    "innermost": "from nav._jit import njit\n@njit\ndef add(x, y):\n    return x + y\n",
    "outer": (
        "from mine import inner\nfrom mine.constants import FACTOR\nfrom nav._jit import njit\n"
        "@njit\ndef scaled(x):\n    return FACTOR * inner.double(x)\n"
    ),
    "other": "from nav._jit import njit\n@njit\ndef nothing():\n    return 0\n",
}
CALL = """
from mine.outer import scaled
print(scaled(1.0), sum(scaled.stats.cache_hits.values()), sum(scaled.stats.cache_misses.values()))
"""


@pytest.mark.ci
def test_kernels_are_good_while_all_that_they_are_made_of_is_what_it_was(tmp_path):
    """`scaled` takes a constant from one file, a kernel from another, and that one its own from a third."""
    package = tmp_path / "mine"
    package.mkdir()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(nav.__file__).parents[1])])}
    environment.pop("NUMBA_CACHE_DIR", None)

    def written(**changed):
        for name, text in (KERNELS | changed).items():
            file = package / f"{name}.py"
            if not file.exists() or file.read_text() != text:
                file.write_text(text)

    def called():
        run = subprocess.run([sys.executable, "-c", CALL], env=environment, capture_output=True, text=True, check=True)
        return run.stdout.split()

    written()
    assert called() == ["4.0", "0", "1"]
    assert called() == ["4.0", "1", "0"]
    written(other=KERNELS["other"] + "# nothing that it is made of\n")
    (package / ".#lock.py").symlink_to("nowhere")  # as editors leave them
    assert called() == ["4.0", "1", "0"]
    written(innermost=KERNELS["innermost"].replace("x + y", "x + y + 1"))
    assert called() == ["6.0", "0", "1"]
    assert called() == ["6.0", "1", "0"]
    written(innermost=KERNELS["innermost"].replace("x + y", "x + y + 1"), constants="FACTOR = 3.0\nUNUSED = 5.0\n")
    assert called() == ["9.0", "0", "1"]
    assert called() == ["9.0", "1", "0"]


INTERRUPTED = """
from numba.core.caching import IndexDataCacheFile
written, write = [], IndexDataCacheFile._open_for_write
def interrupted(self, path):
    written.append(path)
    if len(written) == 2:
        raise KeyboardInterrupt
    return write(self, path)
IndexDataCacheFile._open_for_write = interrupted
from mine.innermost import add
add(1.0, 1.0)
"""


@pytest.mark.ci
def test_interrupted_while_a_kernel_is_kept_nobody_takes_another_version_for_it(tmp_path):
    """Between the two files that are written for it, one of them is still of the version before."""
    package = tmp_path / "mine"
    package.mkdir()
    (package / "__init__.py").touch()
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), str(Path(nav.__file__).parents[1])])}
    environment.pop("NUMBA_CACHE_DIR", None)

    def run(script):
        return subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True)

    def install(factor, t):
        """With the same bytecode whatever the factor: numba's own key is the same."""
        file = package / "innermost.py"
        file.write_text(f"from nav._jit import njit\n@njit\ndef add(x, y):\n    return x + y * {factor}\n")
        os.utime(file, (t, t))

    call = "from mine.innermost import add\nprint(add(1.0, 1.0))"
    install(1.0, 1e9)
    assert run(call).stdout.split() == ["2.0"]
    install(2.0, 2e9)
    assert "KeyboardInterrupt" in run(INTERRUPTED).stderr
    install(1.0, 1e9)
    assert run(call).stdout.split() == ["2.0"]
    install(2.0, 2e9)
    assert run(call).stdout.split() == ["3.0"]
    assert run(call + "\nprint(sum(add.stats.cache_hits.values()))").stdout.split() == ["3.0", "1"]


@pytest.mark.ci
def test_nowhere_to_keep_kernels_is_said_once_and_they_are_compiled_all_the_same(tmp_path):
    """A read-only installation and no home, as in a container; also for the processes that such a one starts."""
    package = tmp_path / "nav"
    shutil.copytree(Path(nav.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    (package / "__pycache__").touch()  # no folder can be made there, not by root either
    nowhere, temporary = tmp_path / "nobody's home", tmp_path / "tmp"
    nowhere.touch()
    temporary.mkdir()
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "HOME": str(nowhere), "TMPDIR": str(temporary)}
    for name in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME"):
        environment.pop(name, None)
    script = f"{SCRIPT}\nimport subprocess, sys\nsubprocess.run([sys.executable, '-c', {SCRIPT!r}], check=True)"
    run = subprocess.run(
        [sys.executable, "-u", "-c", script], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert run.stdout.split() == ["0", "1", "1", "0"]  # the second process takes what the first has compiled
    assert run.stderr.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in run.stderr
    assert not list(temporary.iterdir())


def test_a_kernel_that_counts_no_references_may_not_make_an_array_nor_call_what_makes_one():
    """Nobody would free it."""

    @lean
    def makes(n: int) -> float:
        return float(np.zeros(n)[0])

    @njit
    def twice(v: Array) -> Array:
        return np.array([2.0 * v[0]])

    @lean
    def calls(v: Array) -> float:
        return float(twice(v)[0])

    for kernel, argument in ((makes, 3), (calls, np.ones(1))):
        with pytest.raises((TypingError, LoweringError)):
            kernel(argument)
