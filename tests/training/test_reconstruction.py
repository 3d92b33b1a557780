"""Cameras of bare photographs: which folders have none, what is written, clear words where it fails."""

from __future__ import annotations

import builtins
import os

import numpy as np
import pytest
from _datasets import save, simple_colmap

from meshsplats.errors import MissingDependencyError
from meshsplats.training.reconstruction import bare_photographs, find_cameras


def photographs(folder, count):
    for i in range(count):
        save(folder / f"p{i}.png", np.random.default_rng(i).integers(0, 256, (40, 60, 3)).astype(np.uint8))
    return folder


def test_bare_photographs_lie_in_the_folder_or_in_images(tmp_path):
    folder = photographs(tmp_path / "a", 3)
    (folder / "notes.txt").write_text("x")
    assert [path.name for path in bare_photographs(folder)] == ["p0.png", "p1.png", "p2.png"]
    photographs(tmp_path / "b" / "images", 2)
    assert len(bare_photographs(tmp_path / "b")) == 2
    assert bare_photographs(simple_colmap(tmp_path / "c")) == []
    assert bare_photographs(tmp_path / "none") == []


def test_too_few_photographs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="2 photographs without cameras; at least 3"):
        find_cameras(photographs(tmp_path, 2))


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "pycolmap":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"meshsplats\[photos\]"):
        find_cameras(photographs(tmp_path, 3))


def test_photographs_that_do_not_match_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    folder = photographs(tmp_path / "noise", 3)
    with pytest.raises(ValueError, match=r"of 3 photographs match each other, at least 3 must"):
        find_cameras(folder)
    assert sorted(os.listdir(folder)) == ["p0.png", "p1.png", "p2.png"]
