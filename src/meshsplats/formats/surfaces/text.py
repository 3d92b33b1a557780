"""Surfaces as Wavefront `.obj` and as `.ply`, each with its texture in a file beside."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from meshsplats._files.atomic import write_bytes
from meshsplats.formats.obj.mesh import (
    comments,
    turned_directions,
    turned_positions,
    write_obj,
    write_rows,
)
from meshsplats.formats.ply.header import origin_comments
from meshsplats.formats.ply.mesh import write_mesh_ply
from meshsplats.formats.surfaces.corners import (
    normal_file,
    plain_mesh,
    smooth_normals,
    texture_file,
    wraps_beyond_edges,
)
from meshsplats.scene.base_mesh import BaseMesh


def write_surface_obj(base: BaseMesh, path: Path, target: Path, image: str | None) -> None:
    """Writes ``base`` to ``path``, which will be ``target``; its material and its texture are beside that.
    ValueError for a texture that is to be wrapped as no `.obj` says."""
    if not base.textured:
        write_obj(plain_mesh(base), path, colored=base.colors is not None)
        return
    assert base.uv is not None
    wraps = wraps_beyond_edges(base)
    if wraps not in ({"clamp"}, {"repeat"}, set()):
        raise _not_wrapped(base, "an .obj repeats or clamps its texture along both sides")
    suffix, content = texture_file(base, image)
    material, picture = target.with_suffix(".mtl"), target.with_suffix(suffix)
    write_bytes(picture, content)
    lines = ["newmtl surface", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "d 1", "illum 1"]
    lines.append(f"map_Kd {'-clamp on ' if wraps == {'clamp'} else ''}{picture.name}")
    if base.normal_map is not None:
        kind, content = normal_file(base, image)
        relief = target.with_name(f"{target.stem}_normal{kind}")
        write_bytes(relief, content)
        lines.append(f"norm {relief.name}")
    write_bytes(material, "\n".join([*lines, ""]).encode())
    coordinates = base.uv.reshape(-1, 2).astype(np.float64)
    coordinates[:, 1] = 1 - coordinates[:, 1]
    places, index = np.unique(coordinates, axis=0, return_inverse=True)
    corner = np.stack([base.faces.ravel() + 1, index.reshape(-1) + 1, base.faces.ravel() + 1], axis=1)
    with open(path, "wb") as file:
        file.write(comments(base))
        file.write(f"mtllib {material.name}\nusemtl surface\n".encode())
        write_rows(file, "v %r %r %r\n", turned_positions(base))
        write_rows(file, "vt %.9g %.9g\n", places)
        write_rows(file, "vn %.6f %.6f %.6f\n", turned_directions(base, smooth_normals(base)))
        write_rows(file, "f %d/%d/%d %d/%d/%d %d/%d/%d\n", corner.reshape(-1, 9))


def write_surface_ply(base: BaseMesh, path: Path, target: Path, image: str | None) -> None:
    """Writes ``base`` to ``path``, which will be ``target``: as this project's meshes, or with a texture as
    MeshLab has it, with coordinates of the corners of each face, v up, and a comment TextureFile.
    ValueError for a texture that is not to be repeated."""
    if not base.textured:
        write_mesh_ply(plain_mesh(base), path, colored=base.colors is not None)
        return
    assert base.uv is not None
    if not wraps_beyond_edges(base) <= {"repeat"}:
        raise _not_wrapped(base, "programs repeat the texture of a .ply")
    suffix, content = texture_file(base, image)
    picture = target.with_suffix(suffix)
    write_bytes(picture, content)
    wide = "double" if base.origin.any() else "float"
    vertex = np.dtype([("p", "<f8" if base.origin.any() else "<f4", 3), ("n", "<f4", 3)])
    rows = np.empty(len(base.vertices), vertex)
    rows["p"], rows["n"] = base.origin + base.vertices, smooth_normals(base)
    face = np.dtype([("n", "u1"), ("index", "<i4", 3), ("m", "u1"), ("uv", "<f4", 6)])
    faces = np.empty(len(base.faces), face)
    uv = base.uv.copy()
    uv[..., 1] = 1 - uv[..., 1]
    faces["n"], faces["index"], faces["m"], faces["uv"] = 3, base.faces, 6, uv.reshape(-1, 6)
    header = [
        *("ply", "format binary_little_endian 1.0", f"comment TextureFile {picture.name}"),
        f"comment meshsplats up {' '.join(repr(float(u)) for u in base.up)}",
        *origin_comments(base.origin),
        f"element vertex {len(rows)}",
        *(f"property {wide} {name}" for name in "xyz"),
        *(f"property float n{name}" for name in "xyz"),
        f"element face {len(faces)}",
        *("property list uchar int vertex_indices", "property list uchar float texcoord", "end_header", ""),
    ]
    with open(path, "wb") as file:
        file.write("\n".join(header).encode())
        file.write(rows.tobytes())
        file.write(faces.tobytes())


def _not_wrapped(base: BaseMesh, why: str) -> ValueError:
    """That the format does not keep how the texture of ``base`` wraps."""
    return ValueError(
        f"{why}, this one has wrap {base.textures[0].wrap!r} and coordinates beyond its edges: save as"
        " .glb or .usdc"
    )
