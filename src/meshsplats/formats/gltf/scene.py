"""Placement of the meshes of a glTF scene: nodes, instances, skins and morph targets."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, partial
from itertools import count
from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.scene.origin import SAMPLE

INSTANCING = "EXT_mesh_gpu_instancing"
_AT_ONCE = 1 << 15
_PLACE_BYTES = 512
"""Memory of a matrix and its intermediate results, estimated."""


class Placed(NamedTuple):
    """A mesh placed in the scene."""

    mesh: dict[str, Any]
    matrix: np.ndarray
    """(4, 4) from the mesh's frame to the scene's."""
    joints: Callable[[], np.ndarray] | None = None
    """Returns (j, 4, 4), one for each joint of the skin, which replace ``matrix`` for primitives with joints
    and weights; None without a skin."""
    weights: object = None
    """Of the morph targets, as the file has them; None without any."""

    def morphed(
        self, document: GltfDocument, primitive: dict[str, Any], name: str, values: np.ndarray
    ) -> np.ndarray:
        """``values`` (v, 3) float32 of the attribute ``name`` of a primitive, moved by its morph targets."""
        targets = document.objects(primitive.get("targets", []), "targets of a primitive")
        if not targets or self.weights is None:
            return values
        weights = document.numbers(self.weights, len(targets), "weights of morph targets")
        for weight, target in zip(weights, targets, strict=True):
            if weight and name in target:
                what = f"{name} of a morph target"
                steps = document.floats(target[name], what, fractions=name == "NORMAL")
                if steps.shape != values.shape:
                    raise document.error(f"{what} must have shape {values.shape}, got {steps.shape}")
                values = values + np.float32(weight) * steps
        return values

    def mirrors(self, primitive: dict[str, Any]) -> bool:
        """Whether a primitive is there as its mirror image, whose triangles wind the other way (glTF 2.0,
        3.7.4); with a skin, whether most of its joints make one."""
        joints = self.joints if _is_skinned(dict_or_empty(primitive.get("attributes"))) else None
        matrices = self.matrix[None] if joints is None else joints()
        signs, _ = np.linalg.slogdet(matrices[:, :3, :3])
        return bool(signs.sum() < 0)

    def applied(
        self,
        skinning: Skinning | None,
        vertices: np.ndarray,
        normals: np.ndarray | None,
        origin: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """Vertices and normals (v, 3) float32 of a primitive in the scene's frame, relative to ``origin``;
        ``skinning``: that of the primitive."""
        if skinning is None and (self.matrix == np.eye(4)).all():
            return ((vertices - origin).astype(np.float32) if origin.any() else vertices), normals
        moved = np.empty_like(vertices)
        turned = None if normals is None else np.empty_like(normals)
        for start in range(0, len(vertices), _AT_ONCE):
            part = slice(start, start + _AT_ONCE)
            matrices = self.matrix[None] if skinning is None else skinning.of(part)
            linear = matrices[:, :3, :3]
            moved[part] = np.einsum("nij,nj->ni", linear, vertices[part]) + (matrices[:, :3, 3] - origin)
            if normals is not None and turned is not None:
                # Normals follow the inverse transpose or, as their length does not matter, the cofactors with
                # the sign of the determinant, by which they are divided.
                a, b, c = np.moveaxis(linear, 2, 0)
                cofactors = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=2)
                cofactors[np.einsum("ni,ni->n", a, cofactors[:, :, 0]) < 0] *= -1
                sides = np.einsum("nij,nj->ni", cofactors, normals[part])
                length = np.linalg.norm(sides, axis=1, keepdims=True)
                turned[part] = sides / np.where(length > 0, length, 1)
        return moved, turned

    def sample(self, skinning: Skinning | None, vertices: np.ndarray) -> np.ndarray:
        """(k, 3) float64: a sample of the vertices of a primitive in the scene's frame."""
        part = slice(None, None, max(1, len(vertices) // SAMPLE))
        matrices = self.matrix[None] if skinning is None else skinning.of(part)
        return np.asarray(np.einsum("nij,nj->ni", matrices[:, :3, :3], vertices[part]) + matrices[:, :3, 3])

    def skinning(self, document: GltfDocument, attributes: dict[str, Any], v: int) -> Skinning | None:
        """That of a primitive of ``v`` vertices; None without joints and weights."""
        if self.joints is not None and _is_skinned(attributes):
            return Skinning(document, attributes, self.joints(), v)
        return None


class Skinning:
    """Linear blend skinning: the matrices of a skin's joints, blended by the weights of each vertex."""

    def __init__(
        self, document: GltfDocument, attributes: dict[str, Any], joints: np.ndarray, v: int
    ) -> None:
        self._joints = joints
        self._sets: list[tuple[np.ndarray, np.ndarray]] = []
        for k in count():
            name, weights_name = f"JOINTS_{k}", f"WEIGHTS_{k}"
            if name not in attributes or weights_name not in attributes:
                break
            indices = document.accessor(attributes[name], name)
            weights = document.floats(attributes[weights_name], weights_name, fractions=True)
            if indices.shape != (v, 4) or weights.shape != (v, 4) or indices.dtype.kind != "u":
                raise document.error(
                    f"{name} and {weights_name} must be {v:,} times 4 integers and weights, got shapes"
                    f" {indices.shape} and {weights.shape}"
                )
            used = np.where(weights != 0, indices, 0)  # an index without weight may be arbitrary
            if v and used.max() >= len(joints):
                raise document.error(f"{name} runs up to {used.max()}, the skin has {len(joints)} joints")
            self._sets.append((used, weights))

    def of(self, part: slice) -> np.ndarray:
        """(n, 4, 4) for these vertices. Weights are scaled to a sum of 1; without any, the first joint
        counts."""
        indices = np.concatenate([indices[part] for indices, _ in self._sets], axis=1)
        weights = np.concatenate([weights[part] for _, weights in self._sets], axis=1).astype(np.float64)
        total = weights.sum(axis=1)
        weights[total <= 0] = np.eye(1, weights.shape[1])
        weights /= np.where(total > 0, total, 1)[:, None]
        blended = np.zeros((len(indices), 4, 4))
        for k in range(indices.shape[1]):
            blended += weights[:, k, None, None] * self._joints[indices[:, k]]
        return blended


def placed_meshes(document: GltfDocument) -> Iterator[Placed]:
    """Each mesh of the scene, once for each of its nodes and instances."""
    nodes = document.items("nodes")
    if not document.items("scenes") and not nodes:
        yield from (Placed(mesh, np.eye(4), weights=mesh.get("weights")) for mesh in document.items("meshes"))
        return
    matrices = _scene_matrices(document)
    for index, matrix in matrices.items():
        node = nodes[index]
        if "mesh" not in node:
            continue
        mesh = document.item("meshes", node["mesh"], f"node {index}")
        weights = node.get("weights", mesh.get("weights"))
        # Computed once for all primitives, and only if one needs it.
        joints = cache(partial(_joints, document, node["skin"], matrices)) if "skin" in node else None
        extensions = node.get("extensions")
        if isinstance(extensions, dict) and INSTANCING in extensions:
            for own in _instances(document, extensions[INSTANCING]):
                yield Placed(mesh, matrix @ own, weights=weights)
        else:
            yield Placed(mesh, matrix, joints, weights)


def placed_nodes(document: GltfDocument) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    """Each node of the scene and (4, 4) from its frame to the scene's."""
    nodes = document.items("nodes")
    yield from ((nodes[index], matrix) for index, matrix in _scene_matrices(document).items())


def _scene_matrices(document: GltfDocument) -> dict[int, np.ndarray]:
    """``_world_matrices`` of the file's scene, or of all nodes where it has none."""
    if not document.items("scenes"):
        return _world_matrices(document, _root_nodes(document))
    scene = document.item("scenes", document.json.get("scene", 0), "the file")
    return _world_matrices(document, _indices(document, scene.get("nodes", []), "nodes of a scene"))


def _joints(document: GltfDocument, index: Any, matrices: dict[int, np.ndarray]) -> np.ndarray:
    """(j, 4, 4) from the frame of a skinned mesh to the scene's. The transform of the mesh's own node is
    ignored (glTF 2.0, 3.7.3.3)."""
    skin = document.item("skins", index, "a node")
    indices = _indices(document, skin.get("joints"), "joints of a skin")
    if not indices:
        raise document.error("a skin needs joints")
    document.budget.spend(_PLACE_BYTES * len(indices), f"the {len(indices):,} joints of a node")
    bound = np.eye(4)[None]
    if "inverseBindMatrices" in skin:
        bound = document.floats(skin["inverseBindMatrices"], "inverseBindMatrices").astype(np.float64)
        if bound.shape[1] != 16 or len(bound) < len(indices):
            raise document.error(
                f"inverseBindMatrices must be {len(indices)} matrices of 16 numbers, got shape {bound.shape}"
            )
        bound = bound[: len(indices)].reshape(-1, 4, 4).transpose(0, 2, 1)
    outside = set(indices) - matrices.keys()
    if outside:  # in another scene, or in none
        matrices = matrices | _world_matrices(document, _root_nodes(document))
        for n in outside:
            document.item("nodes", n, "a skin or node")
            if n not in matrices:
                raise document.error(f"a cycle in the node hierarchy at node {n}")
    return np.stack([matrices[n] for n in indices]) @ bound


def _world_matrices(document: GltfDocument, roots: Sequence[int]) -> dict[int, np.ndarray]:
    """(4, 4) from the frame of each node at or below ``roots`` to the world's, depth first."""
    matrices: dict[int, np.ndarray] = {}
    stack = [(root, np.eye(4)) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = document.item("nodes", index, "a scene or node")
        if index in matrices:
            raise document.error(f"node {index} has two parents")
        matrices[index] = parent @ _local_matrix(document, node)
        children = _indices(document, node.get("children", []), "children of a node")
        stack += [(child, matrices[index]) for child in reversed(children)]
    return matrices


def _root_nodes(document: GltfDocument) -> list[int]:
    nodes = document.items("nodes")
    below = {c for n in nodes for c in _indices(document, n.get("children", []), "children of a node")}
    return [i for i in range(len(nodes)) if i not in below]


def _instances(document: GltfDocument, extension: Any) -> Iterator[np.ndarray]:
    """(4, 4) from a mesh's frame to its node's, instance by instance."""
    attributes = extension.get("attributes") if isinstance(extension, dict) else None
    if not isinstance(attributes, dict):
        raise document.error(f"{INSTANCING} needs an object 'attributes'")
    rows: dict[str, np.ndarray] = {}
    for name, columns in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3)):
        if name in attributes:
            turns = name == "ROTATION"
            rows[name] = document.floats(attributes[name], name, fractions=turns).astype(np.float64)
            if rows[name].shape[1] != columns:
                raise document.error(
                    f"{name} of instances must have {columns} columns, got {rows[name].shape}"
                )
    counts = {len(values) for values in rows.values()}
    if not rows:  # only the application's own attributes, with one value per instance
        counts = {
            document.whole(document.item("accessors", i, INSTANCING), "count", INSTANCING)
            for i in attributes.values()
        }
    if len(counts) != 1:
        raise document.error(f"{INSTANCING} needs equal counts of all attributes, got {sorted(counts)}")
    n = counts.pop()
    document.budget.spend(_PLACE_BYTES * n, f"{n:,} instances")
    for i in range(n):
        yield _matrix(
            *(rows[name][i] if name in rows else None for name in ("TRANSLATION", "ROTATION", "SCALE"))
        )


def _local_matrix(document: GltfDocument, node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return document.numbers(node["matrix"], 16, "matrix of a node").reshape(4, 4).T
    parts = (("translation", 3), ("rotation", 4), ("scale", 3))
    return _matrix(*(document.numbers(node[k], n, f"{k} of a node") if k in node else None for k, n in parts))


def _matrix(
    translation: np.ndarray | None, rotation: np.ndarray | None, scale: np.ndarray | None
) -> np.ndarray:
    """(4, 4): scale, then rotation, then translation."""
    matrix = np.eye(4) if rotation is None else rotation_matrix(rotation)
    if scale is not None:
        matrix[:3, :3] *= scale
    if translation is not None:
        matrix[:3, 3] = translation
    return matrix


def rotation_matrix(quaternion: Sequence[float] | np.ndarray) -> np.ndarray:
    """(4, 4) matrix of a unit quaternion x, y, z, w."""
    x, y, z, w = quaternion
    matrix = np.eye(4)
    matrix[:3, :3] = list(rotation_rows(w, x, y, z))
    return matrix


def _is_skinned(attributes: dict[str, Any]) -> bool:
    return {"JOINTS_0", "WEIGHTS_0"} <= attributes.keys()


def _indices(document: GltfDocument, value: object, what: str) -> list[int]:
    if not isinstance(value, list) or not all(isinstance(x, int) for x in value):
        raise document.error(f"{what} must be an array of whole numbers")
    return value
