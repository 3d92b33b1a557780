"""Textures of PLY meshes, as MeshLab and programs of photogrammetry write them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np

from meshsplats.errors import DataWarning
from meshsplats.formats._beside import file_beside, shown_name, warn_of_missing
from meshsplats.formats._validation import Budget
from meshsplats.formats.ply.faces import read_corner_values, read_faces
from meshsplats.formats.ply.header import PlyHeader, read_header
from meshsplats.formats.ply.table import POSITION, FloatTable
from meshsplats.scene.base_mesh import Texture
from meshsplats.scene.origin import choose_origin

_OF_CORNERS, _NUMBER = "texcoord", "texnumber"
_OF_VERTICES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))


def ply_textures(
    path: Path, read: Callable[[Path], np.ndarray], override: Texture | None = None
) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...]] | None:
    """Texture coordinates (m, 3, 2) float32, v down, and texture index (m,) int32, -1 for none, of each
    triangle in the order of ``read_mesh_ply``; and the textures, which comments TextureFile name. None for a
    file without coordinates or without textures.

    ``override`` is a texture for all triangles. A DataWarning says what is missing or not read.
    FileFormatError for a name that leads out of the folder of ``path``, and for broken files.
    """
    with open(path, "rb") as file:
        header = read_header(file, path)
        names = [text[len("TextureFile ") :] for text in header.comments if text.startswith("TextureFile ")]
        if not (names or override):
            return None
        found = _coordinates(file, header, path)
    if found is None:
        return None
    uv, number = found
    uv[..., 1] = 1 - uv[..., 1]
    if override is None:
        index, textures = _images(names, number, path, read)
    else:
        index, textures = np.zeros(len(uv), np.int32), (override,)
    complete = np.isfinite(uv).all(axis=(1, 2))
    return np.nan_to_num(uv, posinf=0, neginf=0), np.where(complete, index, -1).astype(np.int32), textures


def _coordinates(file: BinaryIO, header: PlyHeader, path: Path) -> tuple[np.ndarray, np.ndarray] | None:
    """Texture coordinates (m, 3, 2) float32, v up, and number of the texture (m,) of each triangle. None
    without any, and with a DataWarning where they are not read."""
    face, vertex = header.element("face"), header.element("vertex")
    if face is None or vertex is None:
        return None
    if any(p.name == _OF_CORNERS and p.is_list for p in face.properties):
        found = read_corner_values(file, header, face, _OF_CORNERS, (_NUMBER,), path)
        if found is None or found[0].shape[1] != 6:
            warnings.warn(
                f"{path}: texture coordinates are read of triangles in binary files alone; left out",
                DataWarning,
                stacklevel=5,
            )
            return None
        with np.errstate(over="ignore"):
            uv = found[0].astype(np.float32).reshape(-1, 3, 2)
        return uv, found[1].get(_NUMBER, np.zeros(len(uv), np.int64))
    columns = next((pair for pair in _OF_VERTICES if all(n in vertex.names for n in pair)), None)
    if columns is None:
        return None
    budget = Budget(path)
    budget.spend(20 * vertex.count, "texture coordinates")
    table = FloatTable(file, header, vertex, (*POSITION, *columns), path)
    table.origin = choose_origin(table.sample())
    at = [table.names.index(name) for name in (*POSITION, *columns)]
    values = np.concatenate([chunk[:, at] for chunk in table.chunks()])
    faces, _ = read_faces(file, header, face, (), values[:, :3], budget, path)
    return values[faces, 3:], np.zeros(len(faces), np.int64)


def _images(
    names: list[str], number: np.ndarray, path: Path, read: Callable[[Path], np.ndarray]
) -> tuple[np.ndarray, tuple[Texture, ...]]:
    """(m,) int32 texture of each face, -1 for none, by its ``number`` among ``names``; and those textures."""
    index, missing = np.full(len(number), -1, np.int32), list[str]()
    textures, known = list[Texture](), dict[str, int]()
    for i in np.unique(number[(number >= 0) & (number < len(names))]).tolist():
        if names[i] not in known:
            image = file_beside(path, names[i].encode())
            known[names[i]] = len(textures) if image.is_file() else -1
            if image.is_file():
                textures.append(Texture(read(image)))
            else:
                missing.append(shown_name(names[i].encode()))
        index[number == i] = known[names[i]]
    warn_of_missing(path, missing, 5)
    return index, tuple(textures)
