"""Cached kernels go when a source that they may contain has changed."""

import os

from nav._jit import _forget_stale


def test_kernels_are_forgotten_with_any_source_they_may_contain(tmp_path):
    forget = _forget_stale.__wrapped__
    folder, kernels = tmp_path / "folder", tmp_path / "kernels"
    for place in (folder, kernels):
        place.mkdir()
        (place / "module.py").write_text("a = 1\n")
    index = folder / "__pycache__" / "module.f-1.py311.nbi"
    forget(folder, kernels)
    index.write_bytes(b"")
    forget(folder, kernels)
    assert index.exists()
    for changed in (folder / "module.py", kernels / "module.py"):
        index.write_bytes(b"")
        os.utime(changed, ns=(1, 1))
        forget(folder, kernels)
        assert not index.exists()


def test_a_folder_that_cannot_be_written_to_is_left(tmp_path):
    (tmp_path / "module.py").write_text("a = 1\n")
    (tmp_path / "__pycache__").write_text("a file in the way of the folder")
    _forget_stale.__wrapped__(tmp_path, tmp_path)
