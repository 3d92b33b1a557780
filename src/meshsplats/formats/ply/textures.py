"""Textures of PLY meshes, as MeshLab and programs of photogrammetry write them."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np

from meshsplats.base_mesh import Texture
from meshsplats.errors import DataWarning
from meshsplats.formats._beside import file_beside, shown_name
from meshsplats.formats._validation import Budget
from meshsplats.formats.ply.faces import read_corner_values, read_faces
from meshsplats.formats.ply.header import read_header
from meshsplats.formats.ply.table import FloatTable

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
        face, vertex = header.element("face"), header.element("vertex")
        if face is None or vertex is None or not (names or override):
            return None
        columns = next((pair for pair in _OF_VERTICES if all(n in vertex.names for n in pair)), None)
        number = np.zeros(0, np.int64)
        if any(p.name == _OF_CORNERS and p.is_list for p in face.properties):
            found = read_corner_values(file, header, face, _OF_CORNERS, (_NUMBER,), path)
            if found is None or found[0].shape[1] != 6:
                warnings.warn(
                    f"{path}: texture coordinates are read of triangles in binary files alone; left out",
                    DataWarning,
                    stacklevel=4,
                )
                return None
            uv = found[0].astype(np.float32).reshape(-1, 3, 2)
            number = found[1].get(_NUMBER, number).astype(np.int64)
        elif columns is not None:
            budget = Budget(path)
            faces, _ = read_faces(file, header, face, (), budget, path)
            budget.spend(8 * vertex.count, "texture coordinates")
            table = FloatTable(file, header, vertex, columns, path)
            at = [table.names.index(name) for name in columns]
            uv = np.concatenate([chunk[:, at] for chunk in table.chunks()])[faces]
        else:
            return None
    uv[..., 1] = 1 - uv[..., 1]
    complete = np.asarray(np.isfinite(uv).all(axis=(1, 2)))
    if override is not None:
        return np.nan_to_num(uv, posinf=0, neginf=0), np.where(complete, 0, -1).astype(np.int32), (override,)
    return _with_images(uv, complete, number, names, path, read)


def _with_images(
    uv: np.ndarray,
    complete: np.ndarray,
    number: np.ndarray,
    names: list[str],
    path: Path,
    read: Callable[[Path], np.ndarray],
) -> tuple[np.ndarray, np.ndarray, tuple[Texture, ...]]:
    """``ply_textures``, of faces with the texture ``number`` (m,) among ``names``; empty: the first."""
    index, textures, missing = np.full(len(uv), -1, np.int32), list[Texture](), list[str]()
    for i, name in enumerate(names):
        image = file_beside(path, name.encode())
        if image.is_file():
            index[(number == i) if len(number) else i == 0] = len(textures)
            textures.append(Texture(read(image)))
        else:
            missing.append(shown_name(name.encode()))
    if missing:
        warnings.warn(
            f"{path}: missing: {', '.join(missing[:5])}; faces that need it have no texture",
            DataWarning,
            stacklevel=5,
        )
    return (
        np.nan_to_num(uv, posinf=0, neginf=0),
        np.where(complete, index, -1).astype(np.int32),
        tuple(textures),
    )
