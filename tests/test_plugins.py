"""Classes of the user's: found by their files and modules, and what is wrong with a name of one."""

import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from testbed import plugins
from testbed.errors import UserError

GROUP = "navigation_testbed.estimators"


def test_a_folder_may_have_any_name(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"pr\xf8ject")  # no UTF-8
    folder.mkdir()
    (folder / "mine.py").write_text("class Mine:\n    pass\n")
    assert plugins.load("./mine.py:Mine", folder, GROUP).__name__ == "Mine"


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        (
            "./split.py:Mine",
            "split.py can't be imported: No module named 'other_half': a file beside it is not found: ",
        ),
        (":Mine", 'names no module: give a file, such as "./filters.py:Mine", or an installed module'),
        ("./mine:Mine", 'is a path without .py: give it as "./mine.py:Mine"'),
        ("../mine:Mine", 'is a path without .py: give it as "../mine.py:Mine"'),
        (".mine:Mine", "has a dot in front: give the whole name"),
        ("./mine.py:", 'names no class: give it as "./mine.py:Mine"'),
    ],
)
def test_a_name_that_is_none_is_told_with_what_to_do(kind: str, says: str, tmp_path: Path) -> None:
    (tmp_path / "split.py").write_text("from other_half import Mine\n")
    (tmp_path / "other_half.py").write_text("class Mine:\n    pass\n")
    (tmp_path / "mine.py").write_text("class Mine:\n    pass\n")
    with pytest.raises(UserError) as told:
        plugins.load(kind, tmp_path, GROUP)
    assert says in str(told.value)


def test_the_package_of_a_broken_kind_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "theirs-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: theirs\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nbroken = their_filters:Gone\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    plugins.installed.cache_clear()
    try:
        with pytest.raises(
            UserError, match=r'^kind "broken" of the package "theirs": there is no module their_filters'
        ):
            plugins.load("broken", tmp_path, GROUP)
    finally:
        plugins.installed.cache_clear()


FILTER = """
from helper import OFFSET


class Mine:
    pass


if __name__ == "__main__":
    from tools.main import main
"""


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file, a module beside it, and a package that it imports when it is run as a program."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "tools").mkdir()
    (tmp_path / "tools/__init__.py").touch()
    (tmp_path / "tools/main.py").write_text("import sys\nsys.exit(3)\n")
    (tmp_path / "helper.py").write_text("OFFSET = 1.0\n")
    (tmp_path / "mine.py").write_text(FILTER)
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def _digest(folder: Path) -> str:
    return plugins.digest("./mine.py:Mine", folder, GROUP)


def test_what_a_class_never_ran_is_not_run(project: Path) -> None:
    before = _digest(project)
    assert not [name for name in sys.modules if name.partition(".")[0] == "tools"]
    (project / "tools/main.py").write_text("")
    assert _digest(project) != before


@pytest.mark.parametrize("where", ["elsewhere", "project/.venv/lib/site-packages", "project/dist-packages"])
def test_of_packages_elsewhere_nothing_is_watched(
    where: str, project: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    first, _, rest = where.partition("/")
    folder = project / rest if first == "project" else tmp_path_factory.mktemp(first)
    folder.mkdir(parents=True, exist_ok=True)
    monkeypatch.syspath_prepend(folder)
    (folder / "big.py").write_text("A = 1\n")
    (project / "mine.py").write_text(f"import big\n{FILTER}")
    before = _digest(project)
    (folder / "big.py").write_text("A = 2\n")
    assert _digest(project) == before


def test_a_class_and_what_it_imports_can_be_edited_while_nobody_asks_what_it_was(project: Path) -> None:
    """As in a notebook: it goes on with what is imported, which a campaign alone refuses."""
    plugins.load("./mine.py:Mine", project, GROUP)
    (project / "helper.py").write_text("OFFSET = 2.0\n")
    (project / "mine.py").write_text(f"{FILTER}\nMORE = 1\n")
    plugins.load("./mine.py:Mine", project, GROUP)
    with pytest.raises(UserError, match=r"helper.py: has been edited since it was imported: start Python anew"):
        _digest(project)


class Restless:
    """Changes what is everybody's."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def move(self, *_: object, call: int = 0) -> float:
        os.chdir(self.folder)
        np.seterr(all="raise")
        if call < 0:
            raise ValueError("no")
        return 3.0


@pytest.mark.parametrize("call", [0, -1])
def test_working_folder_and_error_state_are_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: int
) -> None:
    """Records went to where an estimator had gone, and figures ended in a FloatingPointError that it had asked for."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "elsewhere").mkdir()
    before = np.geterr()
    with suppress(ValueError):
        assert plugins.confined(Restless(tmp_path / "elsewhere").move, 1, call=call) == 3.0
    assert Path.cwd() == tmp_path
    assert np.geterr() == before


def test_a_working_folder_that_is_gone_stays_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    assert plugins.confined(lambda: 3.0) == 3.0


def test_a_file_may_change_them_while_it_is_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "restless.py").write_text(
        "import os\nimport numpy as np\nos.chdir('/')\nnp.seterr(all='raise')\nclass Mine: ...\n"
    )
    before = np.geterr()
    assert plugins.load("./restless.py:Mine", Path(), GROUP).__name__ == "Mine"
    assert (Path.cwd(), np.geterr()) == (tmp_path, before)
