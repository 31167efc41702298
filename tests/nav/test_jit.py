"""Cached kernels are good only while all sources that they may contain are what they were."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import nav

SCRIPT = """
from nav import earth
earth.radii(0.5)
print(sum(earth.radii.stats.cache_hits.values()), sum(earth.radii.stats.cache_misses.values()))
"""


@pytest.mark.ci
def test_a_change_of_any_source_compiles_anew(tmp_path):
    """`radii` contains `radii_of` of its own file; a change of another file of `nav` may be one of what it contains."""
    source = Path(nav.__file__).parent
    package = tmp_path / "nav"
    shutil.copytree(source, package, ignore=shutil.ignore_patterns("__pycache__"))
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    environment.pop("NUMBA_CACHE_DIR", None)

    def hits_and_misses():
        run = subprocess.run(
            [sys.executable, "-c", SCRIPT], env=environment, cwd=tmp_path, capture_output=True, text=True, check=True
        )
        return run.stdout.split()

    assert hits_and_misses() == ["0", "1"]
    assert hits_and_misses() == ["1", "0"]
    os.utime(package / "rotation.py", ns=(1, 1))
    (package / ".#lock.py").symlink_to("nowhere")  # as editors leave them
    assert hits_and_misses() == ["0", "1"]
    assert hits_and_misses() == ["1", "0"]


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
