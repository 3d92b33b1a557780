"""glTF and GLB with splats: the extension KHR_gaussian_splatting, plain or with SPZ inside.

A primitive of points is a cloud of splats; its attributes are already activated, and nodes place it. glTF
scenes have x to the left, y up and z forward. Drafts of the extension stored log scales, recognised by
negative values, and SPZ in the axes of the glTF file.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, get_args

import numpy as np

from meshsplats._common.geometry import rotation_rows
from meshsplats.errors import DataWarning
from meshsplats.formats._display import display_cloud, say_converted
from meshsplats.formats._orientation import HALF_TURN_Z, up_quaternion
from meshsplats.formats.content import Content
from meshsplats.formats.gltf.document import GltfDocument, dict_or_empty
from meshsplats.formats.gltf.scene import placed_meshes
from meshsplats.formats.opened import Splats
from meshsplats.formats.reading import FormatReader
from meshsplats.formats.splats._cloud_builder import CloudBuilder, joined_within
from meshsplats.formats.splats.spz import spz_in_memory
from meshsplats.scene.gaussians import GaussianCloud, Kernel
from meshsplats.scene.origin import choose_origin, sampled, zero_origin

EXTENSION = "KHR_gaussian_splatting"
_COMPRESSED = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
    "KHR_spz_compression",
)
_EXTENSIONS = frozenset({EXTENSION, *_COMPRESSED})


def read_splat_gltf(path: Path, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
    """The splats of all nodes of a glTF scene, in its frame, relative to ``origin``, by default one that
    suits them; errors as ``load_gaussians``."""
    document = splat_document(path)
    placed = placed_clouds(document, strict=strict)
    if not placed:
        raise document.error(
            f"a glTF file without splats (no primitive has {EXTENSION}); load_mesh reads meshes"
        )
    if len(placed) == 1 and (own := _own(document, *placed[0])) is not None:
        return own if origin is None else own.relative_to(origin)
    if origin is None:
        few = [sampled(cloud.means) @ matrix[:3, :3].T + matrix[:3, 3] for cloud, matrix in placed]
        origin = choose_origin(np.concatenate(few))
    clouds = []
    for cloud, matrix in placed:
        try:
            moved = cloud.transformed(matrix[:3], origin=origin if origin.any() else None)
        except ValueError as error:
            raise document.error(f"a node's transform cannot be applied to splats: {error}") from None
        clouds.append(moved.relative_to(origin))
    return joined_within(clouds, document.budget)


def splat_document(path: Path) -> GltfDocument:
    """The glTF file ``path``, in which extensions of splats may be required."""
    return GltfDocument(path, also_known=_EXTENSIONS)


def names_splats(document: GltfDocument) -> bool:
    """Whether a file names the extension."""
    return any(document.uses(name) for name in _EXTENSIONS)


def has_own_frame(document: GltfDocument) -> bool:
    """Whether the file is ours and notes the frame that its splats had, in which they are read."""
    return any("meshsplats" in dict_or_empty(mesh.get("extras")) for mesh in document.items("meshes"))


def placed_clouds(document: GltfDocument, *, strict: bool) -> list[tuple[GaussianCloud, np.ndarray]]:
    """The splats of each primitive, in the frame of its node, and (4, 4) from there to the scene's."""
    return [
        (_cloud(document, primitive, strict=strict), place.matrix)
        for place in placed_meshes(document)
        for primitive in _splat_primitives(document, place.mesh)
    ]


def turn_of(up: np.ndarray | None, *, beside_meshes: bool = False) -> list[float]:
    """Unit quaternion x, y, z, w of the node of our own files, for a cloud with this ``up``;
    ``beside_meshes``: one that leads to where the node of a mesh of the same world leads."""
    up = np.array([0.0, -1.0, 0.0]) if up is None else up
    if beside_meshes:
        x, y, z, w = up_quaternion(up)
        return [y, -x, w, -z]  # after the half turn about z, the quaternion k
    return up_quaternion(HALF_TURN_Z @ up)


def _own(document: GltfDocument, cloud: GaussianCloud, matrix: np.ndarray) -> GaussianCloud | None:
    """``cloud`` with the up, origin and kernel of our own note, if its node still places it accordingly."""
    note = dict_or_empty(dict_or_empty(document.items("meshes")[0].get("extras")).get("meshsplats"))
    up, origin, kernel = note.get("up"), note.get("origin", [0, 0, 0]), note.get("kernel", cloud.kernel)
    vectors = [np.zeros(3) if v is None else np.array(v, object) for v in (up, origin)]
    if not note or any(v.shape != (3,) or not all(map(_is_number, v)) for v in vectors):
        return None
    direction, place = (HALF_TURN_Z @ v.astype(np.float64) for v in vectors)
    if kernel not in get_args(Kernel) or (up is not None and not direction.any()):
        return None
    beside = note.get("besideMeshes") is True
    x, y, z, w = turn_of(None if up is None else HALF_TURN_Z @ direction, beside_meshes=beside)
    turn = np.array(list(rotation_rows(w, x, y, z)))
    reach = max(1e-6, 1e-12 * float(np.abs(place).max()))
    moved = np.abs(matrix[:3, :3] - turn).max() > 1e-6 or np.abs(matrix[:3, 3] - turn @ place).max() > reach
    if moved:
        return None
    return replace(cloud, up=None if up is None else direction, origin=place, kernel=kernel)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and abs(value) < 1e300


class _SplatGltf(Splats):
    """The splats of a glTF file, which is read as a whole."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @cached_property
    def _whole(self) -> GaussianCloud:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # they come when it is read
            return read_splat_gltf(self._path, strict=False)

    def world_sample(self) -> np.ndarray:
        return sampled(self._whole.means) + self._whole.origin

    def chosen_origin(self) -> np.ndarray:
        return self._whole.origin

    def read(self, *, strict: bool, origin: np.ndarray | None = None) -> GaussianCloud:
        return read_splat_gltf(self._path, strict=strict, origin=origin)

    def blocks(self, size: int, *, strict: bool, origin: np.ndarray) -> Iterator[GaussianCloud]:
        cloud = self.read(strict=strict, origin=origin).relative_to(origin)
        for start in range(0, len(cloud), size):
            yield cloud.take(np.arange(start, min(start + size, len(cloud))))


def _matches(content: Content) -> bool:
    return content.container == "glb" or b'"asset"' in content.json_text


def _has_splats(content: Content) -> bool:
    """Whether a glTF file names the extension; a broken file raises FileFormatError."""
    return names_splats(splat_document(content.path))


def _splat_primitives(document: GltfDocument, mesh: dict[str, Any]) -> Iterator[dict[str, Any]]:
    for primitive in document.objects(mesh.get("primitives"), "primitives of a mesh"):
        if _EXTENSIONS & _object(document, primitive, "extensions").keys():
            yield primitive


def _cloud(document: GltfDocument, primitive: dict[str, Any], *, strict: bool) -> GaussianCloud:
    extensions = _object(document, primitive, "extensions")
    splatting = _object(document, extensions, EXTENSION)
    nested = extensions | _object(document, splatting, "extensions")
    for name in _COMPRESSED:
        if name in nested:
            view = _object(document, nested, name).get("bufferView")
            data, _ = document.view_bytes(view, name)
            spz = spz_in_memory(data, document.path, document.budget)
            assert spz.to_y_down is not None  # every SPZ file has axes
            cloud = spz.read(strict=strict, origin=zero_origin())
            if not _ratified(splatting):
                return cloud
            return cloud.transformed(HALF_TURN_Z @ spz.to_y_down)
    if (shape := splatting.get("kernel", "ellipse")) != "ellipse":
        warnings.warn(
            f"{document.path}: splats of the kernel {str(shape)[:40]!r}, which is not known here; they are"
            " read as Gaussians ('ellipse')",
            DataWarning,
            stacklevel=5,
        )
    attributes = _object(document, primitive, "attributes")
    means = _attribute(document, attributes, "POSITION", 3)
    count = len(means)
    stored = {
        name: _attribute(document, attributes, f"{EXTENSION}:{name}", columns, count)
        for name, columns in (("ROTATION", 4), ("SCALE", 3), ("OPACITY", 1))
    }
    sh = [_attribute(document, attributes, f"{EXTENSION}:SH_DEGREE_0_COEF_0", 3, count)]
    for degree in (1, 2, 3):
        names = [f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}" for i in range(2 * degree + 1)]
        if not any(name in attributes for name in names):
            break
        sh += [_attribute(document, attributes, name, 3, count) for name in names]
    document.budget.spend(4 * (11 + 3 * len(sh)) * count, f"{count:,} splats")
    builder = CloudBuilder(count, len(sh), document.path)
    rows = builder.next(count)
    rows.means[:] = means
    rows.quaternions[:] = stored["ROTATION"][:, [3, 0, 1, 2]]
    scales = stored["SCALE"]
    with np.errstate(over="ignore", invalid="ignore"):
        rows.scales[:] = np.exp(scales) if (scales < 0).any() else scales
    rows.opacities[:] = np.clip(stored["OPACITY"][:, 0], 0, 1)
    for i, coefficients in enumerate(sh):
        rows.sh[:, i] = coefficients
    builder.keep(rows)
    cloud = builder.finish("3dgs", strict=strict)
    if splatting.get("colorSpace") != "lin_rec709_display":
        return cloud
    say_converted(document.path)
    return display_cloud(cloud)


def _ratified(splatting: dict[str, Any]) -> bool:
    """Whether an extension object has what KHR_gaussian_splatting as ratified requires.

    Its drafts had neither property. Files of their time, such as Cesium ion's, hold SPZ in the axes of the
    glTF file, as CesiumJS reads it; the draft of the SPZ extension says that it is in SPZ's own.
    """
    return "kernel" in splatting or "colorSpace" in splatting


def _attribute(
    document: GltfDocument, attributes: dict[str, Any], name: str, columns: int, count: int | None = None
) -> np.ndarray:
    if name not in attributes:
        raise document.error(f"splats need the attribute {name}, which a primitive lacks")
    fractions = name.endswith((":ROTATION", ":OPACITY"))
    values = document.floats(attributes[name], name, fractions=fractions)
    if values.shape[1] != columns or (count is not None and len(values) != count):
        expected = f"({'n' if count is None else count}, {columns})"
        raise document.error(f"{name} must have shape {expected}, got {values.shape}")
    return values


def _object(document: GltfDocument, owner: dict[str, Any], key: str) -> dict[str, Any]:
    value = owner.get(key, {})
    if not isinstance(value, dict):
        raise document.error(f"{key} must be an object, got {str(value)[:40]}")
    return value


READER = FormatReader(_matches, lambda content, _file, _reading: _SplatGltf(content.path), _has_splats)
