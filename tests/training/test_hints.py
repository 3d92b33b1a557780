"""Photographs that a search for cameras passes over are named, and so is why it fails."""

from __future__ import annotations

import re
import sqlite3
import warnings
from contextlib import closing

import numpy as np
import pytest
from _datasets import save, simple_colmap

from meshsplats.datasets.folder import load_dataset
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.training import reconstruction
from meshsplats.training.hints import matching_images, warn_of_inner_folders, why_none
from meshsplats.training.reconstruction import bare_photographs, ensure_cameras, find_cameras


def pictures(folder, names):
    for i, name in enumerate(names):
        save(folder / name, np.random.default_rng(i).integers(0, 256, (40, 60, 3)).astype(np.uint8))
    return folder


def test_photographs_in_folders_inside_are_named(tmp_path):
    folder = pictures(tmp_path, ["a.jpg", "b.jpg", "c.JPG"])
    pictures(folder / "more", ["d.jpg", "e.JPG"])
    pictures(folder / "trip/day2", ["f.jpg"])
    with pytest.warns(
        DataWarning,
        match=r"more photographs in more/ \(2\), trip/day2/ \(1\), .*: if they show the same subject, move",
    ):
        warn_of_inner_folders(bare_photographs(folder))


@pytest.mark.parametrize(
    "name",
    [
        "thumbs/a.jpg",  # the same, smaller
        "previews/x.jpg",
        "masks/x.jpg",
        "Depth/x.jpg",
        "renders/x.png",  # of another kind than the photographs
        "images_4/x.jpg",
        "walk-frames/images/0001.jpg",
        "mesh-evaluation/x.jpg",
        "mesh-compare/x.jpg",
        "mesh-images/x.jpg",
        "renders/x.jpg",
        "alpha/x.jpg",
        "cam_masks/x.jpg",
        "deleted/x.jpg",
    ],
)
def test_other_images_inside_are_no_photographs(tmp_path, name):
    folder = pictures(tmp_path, ["a.jpg", "b.jpg", "c.jpg", name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_inner_folders(bare_photographs(folder))


def test_results_inside_are_no_photographs(tmp_path):
    """Of any name, folders in which a command left its configuration."""
    folder = pictures(tmp_path, ["a.png", "b.png", "c.png", "best/x.png", "best/strips/y.png"])
    (folder / "best/config.toml").write_text("")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warn_of_inner_folders(bare_photographs(folder))


def test_a_search_names_them_before_it_begins(tmp_path, monkeypatch):
    folder = pictures(tmp_path, ["a.jpg", "b.jpg", "c.jpg", "more/d.jpg"])
    monkeypatch.setattr(reconstruction, "_imported", lambda: 1 / 0)
    with pytest.warns(DataWarning, match=r"more/ \(1\)"), pytest.raises(ZeroDivisionError):
        find_cameras(folder)


def test_folders_of_a_phone_are_all_named(tmp_path):
    pictures(tmp_path / "DCIM", [f"10{i}APPLE/IMG_{i}.JPG" for i in range(2)])
    for folder in (tmp_path / "DCIM", tmp_path):
        with pytest.raises(FileFormatError, match=r"100APPLE/ and \S*101APPLE/: give one of these, or move"):
            load_dataset(folder)
    pictures(tmp_path / "DCIM", [f"{i}APPLE/x.JPG" for i in range(102, 110)])
    with pytest.raises(FileFormatError, match=r"100APPLE/, 101APPLE/, 102APPLE/ \.\.\.: give one"):
        load_dataset(tmp_path / "DCIM")


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ({(1, 2): 400, (2, 3): 15, (1, 4): 14}, r"3 of 5 photographs match each other, but .*: walk around"),
        ({(1, 2): 400, (2, 3): 14}, r"0 of 5 photographs match each other, at least 3 must\. .*overlap"),
        ({}, r"0 of 5 photographs match each other, at least 3 must"),
    ],
)
def test_matches_tell_a_camera_that_stood_still(tmp_path, pairs, message):
    with closing(sqlite3.connect(tmp_path / "database.db")) as connection:
        connection.execute("create table two_view_geometries (pair_id integer, rows integer)")
        rows = [(one * (2**31 - 1) + other, count) for (one, other), count in pairs.items()]
        connection.executemany("insert into two_view_geometries values (?, ?)", rows)
        connection.commit()
    assert re.match(message, why_none(0, matching_images(tmp_path / "database.db"), 5, 3))


@pytest.mark.slow
def test_a_camera_that_stood_still_is_told_to_walk(tmp_path):
    pytest.importorskip("pycolmap")
    rng = np.random.default_rng(0)
    texture = np.kron(rng.integers(0, 256, (20, 30, 3)), np.ones((8, 8, 1))).astype(np.int64)
    for i in range(4):  # the same but for noise
        noisy = np.clip(texture + rng.integers(-3, 4, texture.shape), 0, 255)
        save(tmp_path / f"p{i}.png", noisy.astype(np.uint8))
    with pytest.raises(ValueError, match=r"4 of 4 photographs match each other.* no parallax.*: walk around"):
        find_cameras(tmp_path, threads=1)


def test_photographs_without_a_camera_in_a_model_are_counted(tmp_path):
    folder = simple_colmap(tmp_path, 3)
    said: list[str] = []
    assert ensure_cameras(folder, say=said.append) is not None
    assert said == []
    pictures(folder / "images", ["extra.png"])
    ensure_cameras(folder, say=said.append)
    (line,) = said
    assert line.startswith("1 of 4 photographs have no camera in ")
    assert line.endswith(", and are left out: extra.png")


def test_a_folder_that_may_not_be_written_says_what_to_do(tmp_path, monkeypatch):
    pictures(tmp_path, ["a.jpg", "b.jpg", "c.jpg"])
    monkeypatch.setattr("meshsplats.training.reconstruction.may_write_in", lambda folder: False)
    with pytest.raises(PermissionError, match="copy the folder to where you may write"):
        find_cameras(tmp_path)


# ---- What a folder without cameras is


def test_photographs_come_before_the_video_of_one(tmp_path):
    pictures(tmp_path, [f"IMG_000{i}.JPG" for i in range(1, 4)])
    (tmp_path / "IMG_0001.MOV").touch()
    with pytest.raises(FileFormatError, match="of photographs without, 'meshsplats train' finds the cameras"):
        load_dataset(tmp_path)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ((), r": no photographs in it \(\.png \.jpg .*\.heic.*\): it holds nothing; no data set"),
        (("notes.txt",), r": no photographs in it .*: it holds notes\.txt; "),
        (("a.jxl", "b.jxl"), r": a\.jxl in it is an image of a kind that is not read: convert it"),
        (
            ("images/a.jxl", "images/b.jp2"),
            r": images/ holds images of kinds that are not read \(a\.jxl, b\.jp2\)",
        ),
        (("walk.mp4",), r": walk\.mp4 in it is a video"),
    ],
)
def test_what_is_there_is_said_first(tmp_path, files, message):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(FileFormatError, match=message):
        load_dataset(tmp_path)
