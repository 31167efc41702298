"""Classes of the user's: found by their files and modules, and what is wrong with a name of one."""

import os
from pathlib import Path

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
