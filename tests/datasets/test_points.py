"""Points of data sets: COLMAP's binary and text files, the .ply of a transforms.json; broken files."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
from _datasets import simple_colmap

from meshsplats.datasets.points import load_points
from meshsplats.errors import FileFormatError

POSITIONS = np.array([[0.5, -1, 2], [3, 4, 5.25]])
COLORS = np.array([[255, 0, 10], [1, 2, 3]], np.uint8)


def binary(tracks=(3, 1)) -> bytes:
    data = struct.pack("<Q", len(POSITIONS))
    for i, (place, color, track) in enumerate(zip(POSITIONS, COLORS, tracks, strict=True)):
        data += struct.pack("<Q3d3BdQ", i, *place, *map(int, color), 0.5, track) + bytes(8 * track)
    return data


def text() -> str:
    rows = ["# 3D point list"]
    for i, (place, color) in enumerate(zip(POSITIONS, COLORS, strict=True)):
        rows.append(" ".join(map(str, [i, *place, *color, 0.5, *[0, 1] * (3 - 2 * i)])))
    return "\n".join(rows) + "\n"


def nerfstudio(folder, named="points.ply") -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist(), "fl_x": 5.0, "w": 8, "h": 8}
    folder.mkdir()
    (folder / "transforms.json").write_text(json.dumps({"ply_file_path": named, "frames": [frame]}))


@pytest.mark.parametrize(
    ("name", "content"), [("points3D.bin", binary()), ("points3D.txt", text().encode())], ids=["bin", "txt"]
)
def test_colmaps_points_are_read(tmp_path, name, content):
    folder = simple_colmap(tmp_path)
    assert load_points(folder) is None
    (folder / "sparse" / "0" / name).write_bytes(content)
    found = load_points(folder)
    assert np.array_equal(found.positions, POSITIONS)
    assert np.array_equal(found.colors, COLORS)
    assert found.views.tolist() == [3, 1]


def test_points_without_tracks_count_as_seen(tmp_path):
    folder = simple_colmap(tmp_path)
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(binary((0, 0)))
    assert load_points(folder).views.tolist() == [3, 3]


def test_the_points_that_a_transforms_file_names_are_read(tmp_path):
    nerfstudio(tmp_path / "scene")
    assert load_points(tmp_path / "scene") is None
    head = ["ply", "format ascii 1.0", "element vertex 2"]
    head += [f"property float {axis}" for axis in "xyz"]
    head += [f"property uchar {name}" for name in ("red", "green", "blue")]
    rows = [" ".join(map(str, [*p, *c])) for p, c in zip(POSITIONS, COLORS, strict=True)]
    (tmp_path / "scene" / "points.ply").write_text("\n".join([*head, "end_header", *rows]) + "\n")
    found = load_points(tmp_path / "scene")
    assert np.array_equal(found.positions, POSITIONS)
    assert np.array_equal(found.colors, COLORS)


def test_no_path_leaves_the_folder(tmp_path):
    nerfstudio(tmp_path / "scene", "../points.ply")
    with pytest.raises(FileFormatError, match="only files inside"):
        load_points(tmp_path / "scene")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("points3D.bin", binary()[:-1], "ends within the images of point 1"),
        ("points3D.bin", binary()[:60], "truncated"),
        ("points3D.bin", struct.pack("<Q", 10**12), "says it holds"),
        ("points3D.bin", b"", "truncated"),
        ("points3D.txt", b"1 2 3\n", "line 1: a point is"),
        ("points3D.txt", b"1 nan 2 3 4 5 6 0.5\n", "not finite"),
    ],
)
def test_broken_points_are_refused(tmp_path, name, content, message):
    folder = simple_colmap(tmp_path)
    (folder / "sparse" / "0" / name).write_bytes(content)
    with pytest.raises(FileFormatError, match=message):
        load_points(folder)


def test_a_folder_that_is_no_data_set_has_none(tmp_path):
    assert load_points(tmp_path) is None
