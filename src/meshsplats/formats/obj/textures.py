"""Texture coordinates of Wavefront `.obj` files, and the images that their material libraries name."""

from __future__ import annotations

from array import array
from collections.abc import Callable
from pathlib import Path

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats._beside import file_beside, shown_name, warn_of_missing
from meshsplats.formats._polygons import corner_places, cut_polygons
from meshsplats.formats.obj.mesh import corner, statements
from meshsplats.scene.base_mesh import Texture, Wrap

MAX_LIBRARY_BYTES = 16 << 20
"""A larger file of materials is refused."""
_NUMBERS_AFTER = {b"-mm": 2, b"-o": 3, b"-s": 3, b"-t": 3}
"""Most numbers that follow an option of a texture; other options have one word."""


def obj_coordinates(path: Path) -> tuple[np.ndarray, np.ndarray, list[bytes], list[bytes]] | None:
    """For each triangle, in the order of ``read_obj``: texture coordinates (m, 3, 2) float32, v down; whether
    all its corners have them (m,); the name of its material. And the names of material libraries.

    None for a file without texture coordinates. Raises FileFormatError that names the line.
    """
    positions, coordinates = array("d"), array("d")
    lengths, points, corners, materials = array("q"), array("q"), array("q"), array("q")
    names: dict[bytes, int] = {b"": 0}
    libraries: list[bytes] = []
    current = 0
    with open(path, "rb") as file:
        for number, words in statements(file.read()):
            try:
                if words[0] == b"vt":
                    coordinates.extend((float(words[1]), 1 - float(words[2]) if len(words) > 2 else 0.0))
                elif words[0] == b"v":
                    positions.extend(map(float, words[1:4]))
                elif words[0] == b"f":
                    lengths.append(len(words) - 1)
                    materials.append(current)
                    count = len(positions) // 3
                    points.extend(corner(word, count) for word in words[1:])
                    count = len(coordinates) // 2
                    corners.extend(_coordinate(word, count) for word in words[1:])
                elif words[0] == b"usemtl":
                    current = names.setdefault(b" ".join(words[1:]), len(names))
                elif words[0] == b"mtllib":
                    libraries.append(b" ".join(words[1:]))
            except (ValueError, IndexError, OverflowError):
                text = b" ".join(words)[:60].decode("latin-1")
                raise FileFormatError(f"{path}: line {number:,} cannot be read: {text!r}") from None
    if not coordinates or not lengths:
        return None
    places = corner_places(np.array(positions).reshape(-1, 3), np.array(points))
    cut, owner = cut_polygons(np.array(lengths), places)
    triangles = np.array(corners)[cut]
    uv = np.array(coordinates).reshape(-1, 2)
    if triangles.max(initial=-1) >= len(uv):
        raise FileFormatError(f"{path}: a face names texture coordinate {triangles.max() + 1} of {len(uv):,}")
    with np.errstate(over="ignore"):
        found = np.where((triangles >= 0)[..., None], uv[triangles], 0).astype(np.float32)
    complete = np.asarray((triangles >= 0).all(axis=1) & np.isfinite(found).all(axis=(1, 2)))
    ordered = sorted(names, key=names.__getitem__)
    return (
        np.nan_to_num(found, posinf=0, neginf=0),
        complete,
        [ordered[i] for i in np.array(materials)[owner]],
        libraries,
    )


def _coordinate(word: bytes, count: int) -> int:
    """0-based index of the texture coordinate in ``v/vt`` or ``v/vt/vn``; -1 without one."""
    parts = word.split(b"/")
    if len(parts) < 2 or not parts[1]:
        return -1
    number = int(parts[1])
    if number == 0 or number < -count:
        raise ValueError
    return number - 1 if number > 0 else number + count


def obj_textures(
    path: Path, libraries: list[bytes], materials: list[bytes], read: Callable[[Path], np.ndarray]
) -> tuple[np.ndarray, tuple[Texture, ...]]:
    """(m,) int32 texture index of each face, -1 for none, and the textures.

    ``materials`` has the material of each face. A DataWarning names missing libraries and images.
    FileFormatError for a name that leads out of the folder of ``path``, and for broken files.
    """
    maps: dict[bytes, tuple[bytes, Wrap]] = {}
    missing: list[str] = []
    for name in libraries:
        library = file_beside(path, name)
        if library.is_file():
            maps |= _diffuse_maps(library)
        else:
            missing.append(shown_name(name))
    textures: list[Texture] = []
    indices: dict[tuple[bytes, Wrap], int] = {}
    of_material: dict[bytes, int] = {}
    for material in dict.fromkeys(materials):
        entry = maps.get(material)
        of_material[material] = -1
        if entry is None:
            continue
        if entry not in indices:
            image = file_beside(path, entry[0])
            if not image.is_file():
                missing.append(shown_name(entry[0]))
                indices[entry] = -1
            else:
                indices[entry] = len(textures)
                textures.append(Texture(read(image), (entry[1], entry[1])))
        of_material[material] = indices[entry]
    warn_of_missing(path, missing, 4)
    return np.array([of_material[m] for m in materials], np.int32), tuple(textures)


def _diffuse_maps(library: Path) -> dict[bytes, tuple[bytes, Wrap]]:
    """Image and wrapping for each material that has a ``map_Kd``."""
    if library.stat().st_size > MAX_LIBRARY_BYTES:
        raise FileFormatError(f"{library}: a material library of over {MAX_LIBRARY_BYTES >> 20} MiB; refused")
    maps: dict[bytes, tuple[bytes, Wrap]] = {}
    material = b""
    with open(library, "rb") as file:
        for number, words in statements(file.read()):
            if words[0] == b"newmtl":
                material = b" ".join(words[1:])
            elif words[0] == b"map_Kd":
                rest, wrap = words[1:], "repeat"
                while rest and rest[0].startswith(b"-") and len(rest) > 1:
                    option, values = rest[0], _NUMBERS_AFTER.get(rest[0], 1)
                    taken = 1
                    while taken <= values and taken < len(rest) - 1 and (values == 1 or _number(rest[taken])):
                        taken += 1
                    if option == b"-clamp" and rest[1:2] == [b"on"]:
                        wrap = "clamp"
                    rest = rest[taken:]
                if not rest:
                    raise FileFormatError(f"{library}: line {number:,}: map_Kd names no image")
                maps[material] = (b" ".join(rest), wrap)  # type: ignore[assignment]
    return maps


def _number(word: bytes) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True
