"""Joining meshes: one mesh of several, and what they must have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from meshsplats._common.arrays import joined_rows
from meshsplats.scene.origin import shared_origin
from meshsplats.scene.spherical_harmonics import TERMS

MAY_MISS = ("depth_group", "plain_colors")
"""Optional arrays that only some of the parts may have."""
_TILT = 0.5**0.5
"""Least cosine between what is up in meshes that are joined: other axes differ by 90 degrees or more."""
Mesh = TypeVar("Mesh", bound=Any)
"""``SplatMesh``, which imports this module."""


def joined_meshes(parts: Sequence[Mesh], *, same_splats: bool = False) -> Mesh:
    """``SplatMesh.joined``."""
    if not parts:
        raise ValueError("there must be at least one mesh to join")
    degree = max((part.sh_degree for part in parts), default=0)
    parts = [_with_degree(part, degree) for part in parts]
    for number, part in enumerate(parts[1:], 1):
        check_alike(parts[0], part, f"parts[{number}]")
    origin = shared_origin(part.origin for part in parts)
    parts = [part.relative_to(origin) for part in parts]
    if any(part.plain_colors is not None for part in parts):
        parts = [replace(part, plain_colors=part.plain.colors[:, :3]) for part in parts]
    first = parts[0]
    prefix = "attribute."
    arrays: dict[str, Any] = joined_rows(
        [
            {f.name: value for f in first.FIELDS if (value := getattr(part, f.name)) is not None}
            | {prefix + name: value for name, value in part.attributes.items()}
            for part in parts
        ]
    )
    arrays["up"] = first.up
    if any(part.depth_group is not None for part in parts):
        arrays["depth_group"] = _joined_groups(parts)
    if first.face_splat is not None and not same_splats:
        count = np.cumsum([0, *(part.splat_count or 0 for part in parts)])
        owners = [part.splats.of_face + start for part, start in zip(parts, count, strict=False)]
        arrays["face_splat"] = np.concatenate(owners)
    elif first.face_splat is not None:
        numbers = np.concatenate([part.splats.numbers for part in parts])
        order = np.argsort(arrays["face_splat"], kind="stable")
        rows = {"face": order, "splat": np.unique(numbers, return_index=True)[1]}
        for f in first.FIELDS:
            if f.per in rows and f.name in arrays:
                arrays[f.name] = arrays[f.name][rows[f.per]]
    attributes = {name: arrays.pop(prefix + name) for name in first.attributes}
    bindings = [part.binding for part in parts[1:] if part.binding is not None]
    binding = None if first.binding is None else first.binding.joined(bindings)
    return replace(first, **arrays, attributes=attributes, binding=binding)


def check_alike(mesh: Mesh, other: Mesh, name: str) -> None:
    """Raises ValueError, which names the ``other`` mesh, unless both can be joined; bases may differ."""
    for what in ("blending", "filter_px2", "order"):
        if (own := getattr(mesh, what)) != (theirs := getattr(other, what)):
            raise ValueError(
                f"meshes to be joined must have the same {what}: {own!r} first, {theirs!r} in {name}"
            )
    if mesh.up @ other.up < _TILT:
        raise ValueError(
            f"meshes to be joined must have about the same up: {mesh.up.tolist()} first,"
            f" {other.up.tolist()} in {name}; turn one, or give it the other's with replace(mesh, up=...)"
        )
    one, two = ({part: tuple(shape) for part, shape in _optional(m).items()} for m in (mesh, other))
    for part in sorted(one.keys() | two.keys()):
        if one.get(part) != two.get(part):
            raise ValueError(
                f"meshes to be joined must have the same arrays: {part} is {_in_words(one.get(part))}"
                f" first, {_in_words(two.get(part))} in {name}; add it, or take it out, by"
                " replace(mesh, ...)"
            )


def _with_degree(mesh: Mesh, degree: int) -> Mesh:
    """The mesh with harmonics of ``degree``, zeros where it has none; itself where there are no splats."""
    if mesh.sh_degree == degree or mesh.face_splat is None:
        return mesh
    harmonics = np.zeros((mesh.splat_count, TERMS[degree - 1], 3), np.float32)
    if mesh.harmonics is not None:
        harmonics[:, : mesh.harmonics.shape[1]] = mesh.harmonics
    return replace(mesh, harmonics=harmonics)


def _optional(mesh: Mesh) -> dict[str, tuple[int, ...]]:
    """The optional arrays but ``MAY_MISS``, attributes and binding: the shape of a row by name."""
    found = {f.name: getattr(mesh, f.name) for f in mesh.FIELDS if f.optional and f.name not in MAY_MISS}
    found |= {f"attribute {name!r}": value for name, value in mesh.attributes.items()}
    shapes = {name: value.shape[1:] for name, value in found.items() if value is not None}
    return shapes if mesh.binding is None else shapes | {"binding": ()}


def _joined_groups(parts: Sequence[Mesh]) -> np.ndarray:
    """(f,) int64 depth groups of all parts, those of each behind those of the parts before."""
    groups, first = [], 0
    for part in parts:
        own = np.full(len(part.faces), -1) if part.depth_group is None else part.depth_group.astype(np.int64)
        groups.append(np.where(own < 0, own, own + first))
        first += int(own.max(initial=-1)) + 1
    return np.concatenate(groups)


def _in_words(row: tuple[int, ...] | None) -> str:
    if row is None:
        return "missing"
    return f"{row[0]} numbers wide" if row else "there"
