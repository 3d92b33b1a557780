"""Folders that commands write into: what is replaced, kept, continued."""

from __future__ import annotations

import json

import numpy as np
import pytest

import meshsplats as ms
from meshsplats.formats.outputs import CAMERAS, CONFIGURATION, view_names
from meshsplats.operations.chains import TABLE, begin_folder, check_folder
from meshsplats.renders.frames import remove_older


def write_table(folder):
    """That of a chain of one level."""
    numbers = ("splats", "triangles", "bytes", "screen_size", "views", "psnr", "seconds")
    table = {
        "splats": 1,
        "look": "area",
        "samples": 1,
        "levels": [dict.fromkeys(numbers, 1) | {"file": "0.npz"}],
    }
    (folder / TABLE).write_text(json.dumps(table), "utf-8")


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
    write_table(folder)
    check_folder(folder, replace_old=True)
    with pytest.raises(FileExistsError):
        check_folder(folder)
    check_folder(folder, resume=True)  # as for a run that was to replace it


@pytest.mark.parametrize("finished", [False, True])
@pytest.mark.parametrize("left", ["", "folder", "record"])
def test_the_way_that_a_message_names_is_open(tmp_path, finished, left):
    """Whatever lies there: following each message leads to a run that may begin."""
    folder, unfinished = tmp_path / "chain", tmp_path / "chain.partial"
    for start in ({}, {"resume": True}, {"replace_old": True}):
        if finished:
            folder.mkdir(exist_ok=True)
            write_table(folder)
        if left:
            unfinished.mkdir(exist_ok=True)
        if left == "record":
            (unfinished / CONFIGURATION).touch()
        how, said = dict(start), []
        for _ in range(4):
            try:
                check_folder(folder, **how)
                break
            except OSError as error:
                said.append(str(error))
            if "remove it" in said[-1]:
                unfinished.rmdir()
            if "leave out resume" in said[-1]:
                how = {}
            elif "resume continues it" in said[-1]:
                how = {"resume": True}
            elif "replace_old" in said[-1] or "``force``" in said[-1]:
                how = {"replace_old": True}
        else:
            pytest.fail(f"{start}: {said}")


def test_a_folder_of_something_else_is_not_to_be_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    for replace_old in (False, True):
        with pytest.raises(FileExistsError, match=r"give another folder$"):
            check_folder(tmp_path / "mine", replace_old=replace_old)


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
