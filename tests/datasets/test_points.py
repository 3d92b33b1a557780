"""Points of data sets: COLMAP's binary and text files, the .ply of a transforms.json; broken files."""

from __future__ import annotations

import json
import struct
import tracemalloc

import numpy as np
import pytest
from _datasets import simple_colmap

from meshsplats.datasets import points as reader
from meshsplats.datasets.points import load_points
from meshsplats.errors import DataWarning, FileFormatError

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


@pytest.mark.parametrize("size", [51, 52, 90, 200])
def test_points_that_lie_across_blocks_are_read(tmp_path, monkeypatch, size):
    """Also where the images of a point are longer than a block."""
    monkeypatch.setattr(reader, "_BLOCK_BYTES", size)
    folder = simple_colmap(tmp_path)
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(binary((50, 2)))
    found = load_points(folder)
    assert np.array_equal(found.positions, POSITIONS)
    assert np.array_equal(found.colors, COLORS)
    assert found.views.tolist() == [50, 2]


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        ("float", [[1, 0, 0.5], [0.2, 0.4, 0.6]]),
        ("double", [[1, 0, 0.5], [0.2, 0.4, 0.6]]),
        ("float", [[255, 0, 127.5], [51, 102, 153]]),
        ("ushort", [[65535, 0, 32768], [13107, 26214, 39321]]),
    ],
)
def test_colours_have_the_range_of_their_type(tmp_path, kind, values):
    nerfstudio(tmp_path / "scene")
    head = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    head += [f"property {kind} {name}" for name in ("red", "green", "blue")]
    rows = [" ".join(map(str, [*p, *c])) for p, c in zip(POSITIONS, values, strict=True)]
    (tmp_path / "scene" / "points.ply").write_text("\n".join([*head, "end_header", *rows]) + "\n")
    assert load_points(tmp_path / "scene").colors.tolist() == [[255, 0, 127], [51, 102, 153]]


@pytest.mark.parametrize("name", ["points3D.bin", "points3D.txt"])
def test_many_points_take_little_memory(tmp_path, monkeypatch, name):
    """Not much more than they have in the end, however many images show them."""
    monkeypatch.setattr(reader, "_BLOCK_BYTES", 1 << 16)
    count, size = 20_000, 24 + 3 + 8
    folder = simple_colmap(tmp_path)
    if name.endswith("bin"):
        row = np.frombuffer(binary((100, 0))[8 : 8 + 51 + 800], np.uint8)
        content = struct.pack("<Q", count) + np.tile(row, count).tobytes()
    else:
        content = (text().splitlines()[1] + "\n").encode() * count
    (folder / "sparse" / "0" / name).write_bytes(content)
    tracemalloc.start()
    found = load_points(folder)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert len(found.positions) == count
    assert (found.positions == POSITIONS[0]).all()
    assert peak < 5 * count * size + 6 * reader._BLOCK_BYTES


def test_more_points_than_the_limit_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reader, "MAX_POINTS", 1)
    folder = simple_colmap(tmp_path)
    for name, content in (("points3D.txt", text().encode()), ("points3D.bin", binary())):
        (folder / "sparse" / "0" / name).write_bytes(content)
        with pytest.raises(FileFormatError, match="more than 1 points"):
            load_points(folder)


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
    (tmp_path / "points.ply").write_text("none")
    with pytest.warns(DataWarning, match="are not in the folder, and are left out"):
        assert load_points(tmp_path / "scene") is None


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("points3D.bin", binary()[:-1], "ends within the images of point 1"),
        ("points3D.bin", binary()[:60], "truncated"),
        ("points3D.bin", struct.pack("<Q", 10**12), "says it holds"),
        ("points3D.bin", b"", "truncated"),
        (
            "points3D.bin",
            binary()[:51] + struct.pack("<Q", 2**62) + binary()[59:],
            "ends within the images of point 0",
        ),
        ("points3D.bin", binary()[:100], "truncated"),
        ("points3D.txt", b"1 2 3\n", "line 1: a point is"),
        ("points3D.txt", b"1 2 3 4 5 6 7 0.5" + b" 1 2" * 1_100_000, "line 1: a point is"),
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
