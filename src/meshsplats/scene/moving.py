"""Moving meshes: vertices to new positions, and all of a mesh by an affine map."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from meshsplats._common.arrays import checked_array
from meshsplats._common.geometry import affine_parts
from meshsplats.errors import DataWarning, warn_of_data
from meshsplats.scene.origin import loses_detail, lost_by_rounding, sampled
from meshsplats.scene.spherical_harmonics import moved_harmonics, turned_harmonics

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

_ALIKE = 1e-6
"""Largest difference between the stretches of a similarity, relative."""
Mesh = TypeVar("Mesh", bound=Any)
"""``SplatMesh``, which imports this module."""


def moved_mesh(mesh: Mesh, vertices: ArrayLike, normals: ArrayLike | None, binding: Any) -> Mesh:
    """``SplatMesh.moved``."""
    given, vertices = vertices, checked_array("vertices", vertices, np.float32, (len(mesh.vertices), 3))
    warn_of_data(lost_by_rounding("vertices", given))
    harmonics = mesh.harmonics
    old = mesh.normals if normals is None else None
    if old is not None or harmonics is not None:
        splats = mesh.splats
        rotations = splats.rotations(mesh.vertices, vertices)
        normals = normals if old is None else splats.turned(old, rotations)
        harmonics = None if harmonics is None else turned_harmonics(harmonics, rotations)
    return replace(mesh, vertices=vertices, normals=normals, harmonics=harmonics, binding=binding)


def transformed_mesh(mesh: Mesh, matrix: ArrayLike, origin: ArrayLike | None) -> Mesh:
    """``SplatMesh.transformed``."""
    a, shift = affine_parts(np.asarray(matrix))
    point, some = a @ mesh.origin + 0.0, sampled(mesh.vertices)
    if origin is not None:
        given = checked_array("origin", origin, np.float64, (3,))
        point, shift = given, shift + (point - given)
        warn_of_data(lost_by_rounding("vertices", some @ a.T + shift))
    elif shift.any() and loses_detail(some @ a.T, shift):
        point, shift = point + shift, np.zeros(3)
    u, stretch, vt = np.linalg.svd(a)
    mirrors = np.linalg.det(a) < 0

    def mapped(points: np.ndarray) -> np.ndarray:
        return (points @ a.T + shift).astype(np.float32)  # float64 until then

    normals = mesh.normals
    if normals is not None:
        normals = normals @ np.linalg.inv(a)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    binding = mesh.binding
    if binding is not None:
        similar = stretch[0] <= stretch[2] * (1 + _ALIKE)
        lift = binding.lift * float(stretch.mean()) * (-1 if mirrors else 1)
        kept = similar or not binding.lift
        if not kept:
            warnings.warn(
                "the binding to a base is left out: its layers do not stay at right angles to a base that is"
                " stretched; pose() poses them on one",
                DataWarning,
                stacklevel=3,
            )
        binding = binding.moved(mapped(binding.base_vertices), lift) if kept else None
    return replace(
        mesh,
        vertices=mapped(mesh.vertices),
        faces=mesh.faces[:, [0, 2, 1]] if mirrors else mesh.faces,
        normals=normals,
        harmonics=None if mesh.harmonics is None else moved_harmonics(mesh.harmonics, a),
        up=u @ vt @ mesh.up,
        binding=binding,
        origin=point,
    )
