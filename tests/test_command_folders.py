"""Folders that commands write into: what is replaced, kept, continued."""

from __future__ import annotations

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.chains import TABLE, begin_folder, check_folder
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, view_names
from meshsplats.renders.frames import remove_older


def test_a_folder_becomes_a_chain_where_nothing_is_lost(tmp_path):
    folder = tmp_path / "chain"
    check_folder(folder)
    unfinished = begin_folder(folder)
    with pytest.raises(FileNotFoundError, match=r"nothing to resume in .*chain\.partial"):
        check_folder(folder, resume=True)
    (unfinished / CONFIGURATION).touch()
    with pytest.raises(FileExistsError, match=r"chain\.partial is left from an earlier run"):
        check_folder(folder)
    check_folder(folder, resume=True)
    check_folder(folder, replace_old=True)
    folder.mkdir()
    with pytest.raises(FileExistsError, match=f"holds no {TABLE}"):
        check_folder(folder, replace_old=True)
    (folder / TABLE).touch()
    check_folder(folder, replace_old=True)
    with pytest.raises(FileExistsError):
        check_folder(folder)


def test_a_chain_begins_in_an_empty_folder(tmp_path):
    unfinished = begin_folder(tmp_path / "chain")
    for name in (CONFIGURATION, "level_0.glb"):
        (unfinished / name).touch()
    assert begin_folder(tmp_path / "chain") == unfinished
    assert list(unfinished.iterdir()) == []
    (unfinished / "mine.txt").touch()
    with pytest.raises(FileExistsError, match="not of this command"):
        begin_folder(tmp_path / "chain")
    assert (unfinished / "mine.txt").exists()


def test_older_images_go_where_records_name_them(tmp_path):
    camera = ms.Camera(np.eye(4), 50, 50, 32, 32, 64, 64)
    older = {*view_names(3), *view_names(3, "depth", ".npy"), "turntable.gif"}
    for name in older | {"view_0003.png", "mine.png"}:
        (tmp_path / name).touch()
    ms.save_cameras([camera] * 3, tmp_path / CAMERAS)
    remove_older(tmp_path, [])
    assert all((tmp_path / name).exists() for name in older), "no record of the command"
    (tmp_path / CONFIGURATION).write_text('command = "render"\n[options]\n')
    remove_older(tmp_path, [tmp_path / "view_0000.png"])
    left = {path.name for path in tmp_path.iterdir()} - {CAMERAS, CONFIGURATION}
    assert left == {"view_0000.png", "view_0003.png", "mine.png"}
