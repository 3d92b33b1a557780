"""Surfaces for printing: STL and 3MF, in millimetres, with z up, near the origin."""

from __future__ import annotations

import warnings
import zipfile
from pathlib import Path

import numpy as np

from meshsplats._common.geometry import edge_groups
from meshsplats.errors import DataWarning
from meshsplats.formats._orientation import Z_UP_FROM_Y_UP, up_rotation
from meshsplats.scene.base_mesh import BaseMesh

_TYPES = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Types xmlns="http://schemas.openxmlformats.org/package/2006/content-types">'
    '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
    '<Default Extension="model" ContentType="application/vnd.ms-package.3dmanufacturing-3dmodel+xml"/>'
    "</Types>"
)
_RELATIONS = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships">'
    '<Relationship Target="/3D/3dmodel.model" Id="rel0"'
    ' Type="http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"/></Relationships>'
)
_MODEL = (
    '<?xml version="1.0" encoding="UTF-8"?>\n'
    '<model unit="millimeter" xml:lang="en-US"'
    ' xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    '<object id="1" type="model"><mesh><vertices>'
)


def upright(base: BaseMesh) -> np.ndarray:
    """(v, 3) float64 vertices with z up, all coordinates from 0 on."""
    turned = base.vertices.astype(np.float64) @ (Z_UP_FROM_Y_UP @ up_rotation(base.up)).T
    return turned - turned.min(axis=0)


def warn_of_gaps(vertices: np.ndarray, faces: np.ndarray) -> None:
    """DataWarning for a mesh, (n, 3) vertices and (m, 3) triangles, that is no solid: where vertices
    at one place (float32) are one, as for slicers, an edge does not have two triangles, in opposite
    directions."""
    _, index = np.unique(vertices.astype(np.float32), axis=0, return_inverse=True)
    joined = index.reshape(-1)[faces]
    order, starts = edge_groups(joined)
    ahead = np.where(joined < np.roll(joined, -1, axis=1), 1, -1).ravel()[order]
    bad = (np.diff(starts) != 2) | (np.add.reduceat(ahead, starts[:-1]) != 0)
    if bad.any():
        warnings.warn(
            f"the surface is no solid: {int(bad.sum()):,} of {len(bad):,} edges do not have two triangles,"
            " which slicers repair or refuse",
            DataWarning,
            stacklevel=3,
        )


def write_stl(base: BaseMesh, path: Path) -> None:
    """Writes the triangles of ``base`` as binary STL. DataWarning where they are no solid."""
    vertices = upright(base)
    warn_of_gaps(vertices, base.faces)
    corners = vertices[base.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    rows = np.zeros(len(corners), np.dtype([("n", "<f4", 3), ("p", "<f4", (3, 3)), ("unused", "<u2")]))
    rows["n"], rows["p"] = normals / np.where(length > 0, length, 1), corners
    with open(path, "wb") as file:
        file.write(b"MeshSplats, millimetres".ljust(80))
        file.write(np.uint32(len(rows)).astype("<u4").tobytes())
        file.write(rows.tobytes())


def _entry(name: str) -> zipfile.ZipInfo:
    """A file of a package, without a date: the same surface makes the same bytes."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry


def write_3mf(base: BaseMesh, path: Path) -> None:
    """Writes the triangles of ``base`` as a 3D Manufacturing Format package (core specification 1.3).
    DataWarning where they are no solid."""
    vertices = upright(base)
    warn_of_gaps(vertices, base.faces)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as package:
        package.writestr(_entry("[Content_Types].xml"), _TYPES)
        package.writestr(_entry("_rels/.rels"), _RELATIONS)
        with package.open(_entry("3D/3dmodel.model"), "w", force_zip64=True) as file:
            file.write(_MODEL.encode())
            line = '<vertex x="%.9g" y="%.9g" z="%.9g"/>'
            file.write((line * len(vertices) % tuple(vertices.ravel().tolist())).encode())
            file.write(b"</vertices><triangles>")
            line = '<triangle v1="%d" v2="%d" v3="%d"/>'
            file.write((line * len(base.faces) % tuple(base.faces.ravel().tolist())).encode())
            file.write(b'</triangles></mesh></object></resources><build><item objectid="1"/></build></model>')
