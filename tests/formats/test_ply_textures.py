"""Textures of PLY files, as other programs write them."""

from __future__ import annotations

import struct
import warnings

import numpy as np
import pytest
from PIL import Image

from meshsplats import load_base
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats import base_meshes

UV = [(0.25, 0.75), (0.5, 0.5), (0.75, 0.25)]
"""Of three corners, v up."""
DOWN = [[0.25, 0.25], [0.5, 0.5], [0.75, 0.75]]


def images(folder, *names):
    for i, name in enumerate(names):
        Image.new("RGB", (4, 4), (10 * i, 100, 0)).save(folder / name)


def head(encoding, vertex, face, *comments, faces=1):
    lines = ["ply", f"format {encoding} 1.0", *(f"comment {text}" for text in comments)]
    lines += [
        "element vertex 3",
        *(f"property {line}" for line in ("float x", "float y", "float z")),
    ]
    lines += [f"property float {name}" for name in vertex]
    lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return "\n".join([*lines, *(f"property {line}" for line in face), "end_header\n"]).encode()


def of_vertices(path, names=("s", "t"), *, encoding="binary_little_endian", comments=("TextureFile a.png",)):
    """A triangle whose vertices have coordinates."""
    rows = [(i == 1, i == 2, 0, *UV[i]) for i in range(3)]
    if encoding == "ascii":
        text = "".join(" ".join(map(str, map(float, row))) + "\n" for row in rows) + "3 0 1 2\n"
        data = text.encode()
    else:
        end = "<" if "little" in encoding else ">"
        data = b"".join(struct.pack(end + "5f", *row) for row in rows) + struct.pack(end + "B3i", 3, 0, 1, 2)
    path.write_bytes(head(encoding, names, (), *comments) + data)
    return path


def of_corners(path, numbers=(), *, corners=3, comments=("TextureFile a.png", "TextureFile b.png")):
    """Triangles whose corners have coordinates, and texture ``numbers``."""
    face = ["list uchar float texcoord", *(["int texnumber"] if numbers else [])]
    data = b"".join(struct.pack("<3f", i == 1, i == 2, 0) for i in range(3))
    for number in numbers or (None,):
        flat = [value for pair in UV[:corners] for value in pair]
        data += struct.pack("<B3iB", 3, 0, 1, 2, len(flat)) + struct.pack(f"<{len(flat)}f", *flat)
        data += b"" if number is None else struct.pack("<i", number)
    path.write_bytes(head("binary_little_endian", (), face, *comments, faces=len(numbers) or 1) + data)
    return path


@pytest.mark.parametrize("names", [("s", "t"), ("u", "v"), ("texture_u", "texture_v")])
@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_coordinates_of_vertices(tmp_path, names, encoding):
    images(tmp_path, "a.png")
    base = load_base(of_vertices(tmp_path / "m.ply", names, encoding=encoding))
    np.testing.assert_allclose(base.uv, [DOWN])
    assert base.face_texture.tolist() == [0]
    assert base.textures[0].pixels[0, 0].tolist() == [0, 100, 0, 255]


def test_coordinates_of_corners_and_several_textures(tmp_path):
    images(tmp_path, "a.png", "b.png")
    base = load_base(of_corners(tmp_path / "m.ply", (1, 0, 7, -1)))
    np.testing.assert_allclose(base.uv, [DOWN] * 4)
    assert base.face_texture.tolist() == [1, 0, -1, -1]
    assert base.textures[1].pixels[0, 0, 0] == 10
    assert load_base(of_corners(tmp_path / "m.ply")).face_texture.tolist() == [0]
    (tmp_path / "a.png").unlink()
    with pytest.warns(DataWarning, match=r"missing: a\.png; faces that need it have no texture"):
        base = load_base(of_corners(tmp_path / "m.ply", (1, 0)))
    assert base.face_texture.tolist() == [0, -1]


def test_a_given_image_needs_no_name_in_the_file(tmp_path):
    images(tmp_path, "other.png")
    path = of_vertices(tmp_path / "m.ply", comments=())
    assert not load_base(path).textured
    assert load_base(path, texture=tmp_path / "other.png").face_texture.tolist() == [0]
    bare = of_vertices(tmp_path / "n.ply", ("a", "b"))
    assert not load_base(bare).textured
    with pytest.raises(ValueError, match="has no texture coordinates"):
        load_base(bare, texture=tmp_path / "other.png")


def test_what_is_not_read_is_said_and_nothing_outside_is_opened(tmp_path):
    images(tmp_path, "a.png")
    inner = tmp_path / "inner"
    inner.mkdir()
    with pytest.raises(FileFormatError, match=r"refers to '\.\./a\.png' outside its folder"):
        load_base(of_vertices(inner / "m.ply", comments=("TextureFile ../a.png",)))
    with pytest.warns(DataWarning, match="texture coordinates are read of triangles in binary files alone"):
        assert not load_base(of_corners(tmp_path / "m.ply", corners=2)).textured
    path = of_vertices(tmp_path / "m.ply")
    path.write_bytes(path.read_bytes().replace(struct.pack("<f", 0.75), struct.pack("<f", np.nan)))
    assert not load_base(path).textured


def test_properties_of_other_kinds_than_usual_are_no_numbers_of_textures(tmp_path):
    images(tmp_path, "a.png", "b.png")
    path = tmp_path / "m.ply"
    whole = b"property int texnumber"
    for other in (b"property list uchar uchar texnumber", b"property float texnumber"):
        rest = struct.pack("<B3B", 3, 1, 1, 1) if b"list" in other else b""
        content = of_corners(path, (1,)).read_bytes().replace(whole, other)
        path.write_bytes(content[:-4] + rest if rest else content)
        assert load_base(path).face_texture.tolist() == [0]
    # A value named as the list of vertices may be, too, which has the other name.
    face = ["list uchar int vertex_index", "list uchar float texcoord"]
    data = b"".join(struct.pack("<3f", i == 1, i == 2, 0) for i in range(3)) + struct.pack("<i", 5)
    data += struct.pack("<B3i", 3, 0, 1, 2) + struct.pack("<B6f", 6, *np.ravel(UV))
    named = head("binary_little_endian", (), face, "TextureFile a.png")
    path.write_bytes(named.replace(b"list uchar int vertex_indices", b"int vertex_indices") + data)
    np.testing.assert_allclose(load_base(path).uv, [DOWN])


def test_one_image_is_read_once_and_those_of_no_face_never(tmp_path, monkeypatch):
    images(tmp_path, "a.png", "b.png")
    read = []
    monkeypatch.setattr(
        base_meshes, "read_texture", lambda path: read.append(path.name) or np.zeros((1, 1, 4), np.uint8)
    )
    comments = ["TextureFile a.png"] * 5000 + ["TextureFile b.png"]
    base = load_base(of_corners(tmp_path / "m.ply", (7, 9), comments=comments))
    assert read == ["a.png"]
    assert base.face_texture.tolist() == [0, 0]


def test_coordinates_beyond_float32_are_none(tmp_path):
    images(tmp_path, "a.png")
    path = of_vertices(tmp_path / "m.ply", encoding="ascii")
    path.write_bytes(path.read_bytes().replace(b"0.75", b"1e300"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        assert not load_base(path).textured
