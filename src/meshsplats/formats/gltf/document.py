"""Parser of glTF 2.0 files: JSON, buffers, accessors.

Nothing is trusted: every index and offset is compared with the length of its target, and nothing is allocated
beyond what the bytes of the file justify.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
import warnings
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from meshsplats._common.json_files import can_be_named
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.formats._validation import Budget
from meshsplats.formats.gltf.meshopt import decoded_attributes, decoded_triangles

_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_MAX_JSON_TOKENS = 4_000_000
"""Limit of brackets and commas, which make parsed JSON large. Real files have thousands."""
_READABLE = {
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "EXT_meshopt_compression",
    "KHR_texture_transform",
    "KHR_texture_basisu",
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "EXT_texture_avif",
    "KHR_lights_punctual",
    "KHR_materials_variants",
    "KHR_xmp_json_ld",
}
MESHOPT = "EXT_meshopt_compression"
_COMPRESSED = {"KHR_draco_mesh_compression", "KHR_meshopt_compression"}


class GltfDocument:
    """A `.glb` file or, if it begins with a brace, a `.gltf` file.

    Raises:
        FileFormatError: the file is broken, or requires an extension that is neither known nor among
            ``also_known``.
    """

    def __init__(self, path: Path, also_known: frozenset[str] = frozenset()) -> None:
        self.path = path
        self._also_known = also_known
        self.budget = Budget(path)
        self._chunk: memoryview | None = None
        with open(path, "rb") as file:
            data = memoryview(file.read())
        self.json = self._parse(self._json_chunk(data) if bytes(data[:4]) == b"glTF" else data)
        asset = self.json.get("asset")
        version = asset.get("version") if isinstance(asset, dict) else None
        if not isinstance(version, str) or version.split(".")[0] != "2":
            raise self.error(f"not a glTF 2 file: its asset version is {str(version)[:20]!r}, expected '2.0'")
        self._refuse_extensions()
        self._arrays: dict[str, list[dict[str, Any]]] = {}
        self._buffers: dict[int, memoryview] = {}
        self._unpacked: dict[int, memoryview] = {}
        self.unflagged: set[str] = set()
        """Attributes of which a warning has said that ``floats`` takes them for fractions."""

    def uses(self, extension: str) -> bool:
        """Whether the file names the extension among those that it uses."""
        used = self.json.get("extensionsUsed", [])
        return isinstance(used, list) and extension in used

    def error(self, message: str) -> FileFormatError:
        """An error about this file, for the caller to raise."""
        return FileFormatError(f"{self.path}: {message}")

    # -- structure

    def items(self, kind: str) -> list[dict[str, Any]]:
        """The top-level array ``kind`` ("meshes", "nodes" ...), empty where it is absent."""
        if kind not in self._arrays:  # each is checked once: every reference to an entry asks for it
            self._arrays[kind] = self.objects(self.json.get(kind, []), kind)
        return self._arrays[kind]

    def objects(self, value: object, what: str) -> list[dict[str, Any]]:
        """``value``, an array of objects. FileFormatError for anything else; ``what`` names it."""
        if not isinstance(value, list) or not all(isinstance(x, dict) for x in value):
            raise self.error(f"{what} must be an array of objects")
        return value

    def item(self, kind: str, index: object, what: str) -> dict[str, Any]:
        """Entry ``index`` of the top-level array ``kind``; ``what`` names the object that refers to it."""
        found = self.items(kind)
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(found):
            raise self.error(f"{what} refers to index {str(index)[:20]} of {len(found)} {kind}")
        return found[index]

    def whole(self, owner: dict[str, Any], key: str, what: str, default: int | None = None) -> int:
        """The integer >= 0 at ``key``."""
        value = owner.get(key, default)
        if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 1 << 53:
            raise self.error(f"{what} needs a whole number {key!r}, got {str(value)[:20]}")
        return value

    def numbers(self, value: object, length: int, what: str) -> np.ndarray:
        """An array of ``length`` finite numbers, float64."""
        if (
            isinstance(value, list)
            and len(value) == length
            and all(isinstance(x, (int, float)) and abs(x) < 1e300 for x in value)
        ):
            return np.array(value, np.float64)
        raise self.error(f"{what} must be {length} numbers, got {str(value)[:60]}")

    # -- binary data

    def view_bytes(self, index: object, what: str) -> tuple[memoryview, int | None]:
        """Bytes of a buffer view and its stride, None where the elements are packed."""
        view = self.item("bufferViews", index, what)
        extensions = dict_or_empty(view.get("extensions"))
        if _COMPRESSED & extensions.keys():
            raise self.compressed()
        stride = view.get("byteStride")
        if stride is not None and not 4 <= self.whole(view, "byteStride", "a buffer view") <= 252:
            raise self.error(f"byteStride of buffer view {index} must be 4 to 252, got {stride}")
        if MESHOPT not in extensions:
            return self._part(view, index), stride
        assert isinstance(index, int)
        if index not in self._unpacked:
            self._unpacked[index] = self._unpack(dict_or_empty(extensions[MESHOPT]), index)
        return self._unpacked[index], stride

    def _part(self, view: dict[str, Any], index: object) -> memoryview:
        """The bytes that a ``view`` names in a buffer."""
        buffer = self._buffer(self.whole(view, "buffer", "a buffer view"))
        offset = self.whole(view, "byteOffset", "a buffer view", 0)
        length = self.whole(view, "byteLength", "a buffer view")
        if offset + length > len(buffer):
            raise self.error(
                f"buffer view {index} ends at byte {offset + length:,} of a buffer of {len(buffer):,}"
            )
        return buffer[offset : offset + length]

    def _unpack(self, packed: dict[str, Any], index: int) -> memoryview:
        """What meshopt has compressed."""
        data = bytes(self._part(packed, index))
        count, stride = (self.whole(packed, key, "a compressed view") for key in ("count", "byteStride"))
        mode, wanted = packed.get("mode"), packed.get("filter", "NONE")
        known = mode in ("ATTRIBUTES", "TRIANGLES") and wanted == "NONE"
        if not known or data[:1] not in (b"\xa0", b"\xe1"):
            raise self.compressed()
        if mode == "TRIANGLES" and stride not in (2, 4):
            raise self.error(f"compressed indices must have 2 or 4 bytes, got {stride}")
        if mode == "ATTRIBUTES" and (stride % 4 or not 4 <= stride <= 256):
            raise self.error(f"compressed elements must have 4, 8, ... 256 bytes, got {stride}")
        self.budget.spend(count * stride, "a compressed buffer view")
        try:
            if mode == "ATTRIBUTES":
                found = decoded_attributes(data, count, stride)
            else:
                found = decoded_triangles(data, count).astype(f"<u{stride}")
        except (ValueError, IndexError) as error:
            raise self.error(f"compressed buffer view {index} is broken: {error}") from None
        return found.reshape(-1).view(np.uint8).data

    def accessor(self, index: object, what: str) -> np.ndarray:
        """(count, columns) array of the stored type: a view into the file's bytes, or an array of its own
        where the accessor is sparse."""
        accessor = self.item("accessors", index, what)
        dtype = _COMPONENTS.get(self.whole(accessor, "componentType", what))
        columns = _COLUMNS.get(str(accessor.get("type")))
        if dtype is None or columns is None:
            raise self.error(
                f"{what} has type {str(accessor.get('type'))[:20]} of components"
                f" {accessor['componentType']}, expected numbers or vectors"
            )
        count = self.whole(accessor, "count", what)
        if "sparse" in accessor:
            return self._sparse(accessor, dtype, (count, columns), what)
        if "bufferView" not in accessor:
            raise self.error(f"{what} has an accessor without data")
        return self._elements(accessor, dtype, (count, columns), what)

    def _sparse(self, accessor: dict[str, Any], dtype: str, shape: tuple[int, int], what: str) -> np.ndarray:
        """The elements of an accessor that stores some of them apart from the others, or from zeros."""
        sparse = dict_or_empty(accessor["sparse"])
        indices, values = (dict_or_empty(sparse.get(name)) for name in ("indices", "values"))
        count = self.whole(sparse, "count", what)
        kind = _COMPONENTS.get(self.whole(indices, "componentType", what), "")
        if kind[1:2] != "u":
            raise self.error(f"{what} needs sparse indices that are unsigned integers")
        rows = self._elements(indices, kind, (count, 1), what)[:, 0]
        if count and rows.max() >= shape[0]:
            raise self.error(f"sparse indices of {what} run up to {rows.max()} of {shape[0]:,}")
        self.budget.spend(shape[0] * shape[1] * np.dtype(dtype).itemsize, what)
        result = np.zeros(shape, dtype)
        if "bufferView" in accessor:
            result[:] = self._elements(accessor, dtype, shape, what)
        result[rows] = self._elements(values, dtype, (count, shape[1]), what)
        return result

    def _elements(self, held: dict[str, Any], dtype: str, shape: tuple[int, int], what: str) -> np.ndarray:
        """Array of this ``shape`` in the buffer view that ``held`` names, a view into the file's bytes."""
        count, columns = shape
        data, stride = self.view_bytes(held.get("bufferView"), what)
        offset = self.whole(held, "byteOffset", what, 0)
        element = columns * np.dtype(dtype).itemsize
        step = stride or element
        if step < element or (count and offset + (count - 1) * step + element > len(data)):
            raise self.error(
                f"{what} claims {count:,} elements of {element} bytes, every {step} bytes from"
                f" {offset:,} on, in a buffer view of {len(data):,} bytes"
            )
        strides = (step, np.dtype(dtype).itemsize)
        return np.ndarray(shape, dtype, data, offset if count else 0, strides)

    def floats(self, index: object, what: str, *, fractions: bool = False) -> np.ndarray:
        """As ``accessor``, as float32; integers become fractions of their largest value where ``normalized``.

        ``fractions``: integers of this attribute can mean nothing else (section 3.7.2.1 of the specification,
        and KHR_mesh_quantization): without the flag they are fractions too, with a DataWarning.
        """
        values = self.accessor(index, what)
        self.budget.spend(4 * values.size, what)
        result = values.astype(np.float32)
        if values.dtype.kind not in "iu":
            return result
        flag = self.item("accessors", index, what).get("normalized") is True
        if flag or fractions:
            result /= np.float32(np.iinfo(values.dtype).max)
            np.maximum(result, -1, out=result)
        if fractions and not flag and what not in self.unflagged:
            self.unflagged.add(what)
            warnings.warn(
                f"{self.path}: {what} has integers without the flag 'normalized', which they need; they are"
                f" read as fractions of {np.iinfo(values.dtype).max:,}",
                DataWarning,
                stacklevel=4,
            )
        return result

    # -- reading

    def _json_chunk(self, data: memoryview) -> memoryview:
        """The JSON chunk of a .glb; keeps the binary chunk."""
        if len(data) < 20:
            raise self.error(f"truncated .glb file of {len(data)} bytes")
        _, version, total = struct.unpack_from("<4sII", data)
        if version != 2:
            raise self.error(f".glb container of version 2 expected, got version {version}")
        if total > len(data):
            raise self.error(f"truncated: {total:,} bytes announced, {len(data):,} present")
        at, json_chunk = 12, None
        while at + 8 <= total:
            length, kind = struct.unpack_from("<II", data, at)
            if at + 8 + length > total:
                raise self.error(f"the chunk at byte {at:,} runs past the end of the file")
            body = data[at + 8 : at + 8 + length]
            if kind == 0x4E4F534A and json_chunk is None:
                json_chunk = body
            elif kind == 0x004E4942 and self._chunk is None:
                self._chunk = body
            at += 8 + length
        if json_chunk is None:
            raise self.error("a .glb file without a JSON chunk")
        return json_chunk

    def _parse(self, text: memoryview) -> dict[str, Any]:
        raw = bytes(text)
        if sum(raw.count(c) for c in (b",", b"[", b"{")) > _MAX_JSON_TOKENS:
            raise self.error(f"the JSON part has over {_MAX_JSON_TOKENS:,} entries; refused")

        def refuse(name: str) -> float:
            raise ValueError(f"{name} is no JSON number")

        try:
            parsed = json.loads(raw, parse_constant=refuse)
        except (ValueError, RecursionError) as error:
            raise self.error(f"the JSON part cannot be read: {str(error)[:120]}") from None
        if not isinstance(parsed, dict):
            raise self.error("the JSON part must be an object")
        return parsed

    def _refuse_extensions(self) -> None:
        required = self.json.get("extensionsRequired", [])
        if not isinstance(required, list):
            raise self.error("extensionsRequired must be an array")
        if any(e in _COMPRESSED for e in required if isinstance(e, str)):
            raise self.compressed()
        unknown = [
            str(e)[:60]
            for e in required
            if not isinstance(e, str) or not (_known(e) or e in self._also_known)
        ]
        if unknown:
            raise self.error(f"needs the glTF extension {unknown[0]}, which is not supported")

    def compressed(self) -> FileFormatError:
        """The error for compression that this reader does not support."""
        return self.error(
            "glTF compressed in this way (Draco, meshopt with filters) is not supported; decompress it first:"
            " npx @gltf-transform/cli copy in.glb out.glb"
        )

    def _buffer(self, index: int) -> memoryview:
        if index in self._buffers:
            return self._buffers[index]
        buffer = self.item("buffers", index, "a buffer view")
        uri = buffer.get("uri")
        if uri is None:
            if index != 0 or self._chunk is None:
                raise self.error(f"buffer {index} has neither data nor URI")
            data = self._chunk
        elif not isinstance(uri, str):
            raise self.error(f"the URI of buffer {index} must be a string")
        else:
            data = self.uri_bytes(uri, f"buffer {index}")
        length = self.whole(buffer, "byteLength", "a buffer")
        if length > len(data):
            raise self.error(f"buffer {index} should have {length:,} bytes, has {len(data):,}")
        self._buffers[index] = data[:length]
        return self._buffers[index]

    def uri_bytes(self, uri: str, what: str) -> memoryview:
        """The bytes of a URI: base64 data inside it, or a file beside this one."""
        if not uri.startswith("data:"):
            return self._beside(uri)
        head, _, body = uri.partition(",")
        if not head.endswith(";base64"):
            raise self.error(f"the data URI of {what} is not base64")
        try:
            return memoryview(base64.b64decode(body))
        except (binascii.Error, ValueError):
            raise self.error(f"the data URI of {what} is broken") from None

    def _beside(self, uri: str) -> memoryview:
        """A file that a .gltf file refers to. It must lie in the folder of the .gltf file or below."""
        folder = Path(os.path.realpath(self.path)).parent
        name = unquote(uri)
        if ":" in uri or "\\" in name or os.path.isabs(name):
            raise self.error(f"refers to {uri[:80]!r} outside its folder; refused")
        if not can_be_named(folder / name):
            raise self.error(f"refers to {uri[:80]!r}, which is no name of a file; refused")
        target = Path(os.path.realpath(folder / name))
        if folder not in target.parents:
            raise self.error(f"refers to {uri[:80]!r} outside its folder; refused")
        if not target.is_file():
            raise self.error(f"its file {uri[:80]!r} is missing")
        self.budget.extend(target.stat().st_size)
        return memoryview(target.read_bytes())


def _known(extension: str) -> bool:
    return extension in _READABLE or extension.startswith("KHR_materials_")


def dict_or_empty(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
