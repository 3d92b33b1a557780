"""Small good files of every mesh format, from which the fuzzer starts."""

from __future__ import annotations

import base64
import importlib.util
import io
import json
import struct
import tempfile
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _gltf_meshes import instanced, skinned
from _meshes import random_mesh
from fuzz.seeds import Change, Seed

from meshsplats import BaseMesh, load_base, load_mesh, save_base, save_mesh
from meshsplats.scene.base_mesh import Texture


def _saved(name: str, suffix: str, origin=(0, 0, 0), compression=None, **more) -> Seed:
    mesh = replace(random_mesh(np.random.default_rng(0), 6, 5), origin=origin)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"m{suffix}"
        save_mesh(mesh, path, compression=compression)
        return Seed(name, {path.name: path.read_bytes()}, path.name, load=load_mesh, **more)


def _in_archive(data: bytes, change: Change) -> bytes:
    """The first arrays changed, the archive around them whole, with right sizes and check sums."""
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as new:
        for i, info in enumerate(old.infolist()):
            new.writestr(info.filename, change(old.read(info)) if i % 3 == 0 else old.read(info))
    return out.getvalue()


def _in_json(data: bytes, change: Change) -> bytes:
    """The JSON part of a .glb changed, its lengths set right."""
    (length,) = struct.unpack_from("<I", data, 12)
    text = change(data[20 : 20 + length])
    rest = data[20 + length :]
    return struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def _gltf() -> Seed:
    """Two nodes, a strip, byte colours, data URI and a file beside it."""
    positions = np.random.default_rng(1).normal(size=(4, 3)).astype("<f4").tobytes()
    colors = bytes(range(16))
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [
            {"mesh": 0, "children": [1], "scale": [1, 2, 3], "translation": [0, 0, 1]},
            {"mesh": 0, "matrix": [0, 1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 5, 0, 0, 1]},
        ],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "COLOR_0": 1}, "mode": 5, "material": 0}]}],
        "materials": [{"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 0.5, 1, 0.5]}}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5121, "count": 4, "type": "VEC4", "normalized": True},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 48},
            {"buffer": 1, "byteLength": 16, "byteStride": 4},
        ],
        "buffers": [
            {"byteLength": 48, "uri": "data:;base64," + base64.b64encode(positions).decode()},
            {"byteLength": 16, "uri": "colors.bin"},
        ],
    }
    return Seed(
        "gltf", {"m.gltf": json.dumps(document).encode(), "colors.bin": colors}, "m.gltf", load=load_mesh
    )


_OBJ = b"""# cube corner
v 0 0 0 1 0 0
v 1 0 0 0.5 .5 0
v 0 1 0 0 1e-3 0
v 0 0 1 0 0 1
vn 0 0 1
f 1//1 2//1 3//1
f 1/2 3/1 \\
 4/1 2/1
f -4 -3 -1
"""

_ASCII_PLY = b"""ply
format ascii 1.0
comment meshsplats up 0 0 1
element vertex 4
property double x
property float y
property float z
property uchar red
property uchar green
property uchar blue
property float alpha
element edge 1
property list uchar int edge_indices
element face 2
property int face_splat
property list uchar uint vertex_indices
property list uchar float texcoord
end_header
0 0 0 255 0 0 1
1 0 0 0 255 0 .5
0 1 0 0 0 255 0
1 1 0 1 2 3 1
2 0 1
4 3 0 1 2 0
5 4 0 1 3 2 2 .5 .5
"""


def _binary_polygons() -> Seed:
    """Big endian; a triangle and a quadrilateral, with a second list, after a table of lists."""
    header = (
        _ASCII_PLY.partition(b"end_header\n")[0].replace(b"ascii", b"binary_big_endian") + b"end_header\n"
    )
    rows = [struct.pack(">dffBBBf", i, i % 2, 0.5, i, 2, 3, 1) for i in range(4)]
    rows += [struct.pack(">Bii", 2, 0, 1)]
    rows += [struct.pack(">iB3IB", 4, 3, 0, 1, 2, 0), struct.pack(">iB4IB2f", 5, 4, 0, 1, 3, 2, 2, 0.5, 0.5)]
    return Seed("mesh-ply-polygons", {"m.ply": header + b"".join(rows)}, "m.ply", load=load_mesh)


def _textured(*names: str) -> dict[str, bytes]:
    """The files of a triangle with a texture, under these names."""
    pixels = np.full((2, 2, 4), 255, np.uint8)
    base = BaseMesh(
        np.eye(3), [[0, 1, 2]], uv=np.zeros((1, 3, 2)), face_texture=[0], textures=[Texture(pixels)]
    )
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            save_base(base, Path(folder) / name)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


def _textured_usd() -> list[Seed]:
    """Beside and in a package; in text, which has more ways to be wrong."""
    files = _textured("m.usda", "p.usdz")
    beside = {name: files[name] for name in ("m.usda", "m.png")}
    return [
        Seed("texture-usda", beside, "m.usda", load=load_base, slow=True),
        Seed("texture-usdz", {"p.usdz": files["p.usdz"]}, "p.usdz", load=load_base, slow=True),
    ]


_INSTANCED = instanced(TRANSLATION=[[0, 0, 0], [5, 0, 0]], SCALE=[[1, 1, 1], [1, 3, 1]])

_FAR = (5e5, 4.5e6, 100)

MESH_SEEDS = [
    _saved("npz", ".npz", inside=_in_archive),
    _saved("mesh-ply", ".ply"),
    _saved("mesh-ply-origin", ".ply", origin=_FAR),
    _saved("glb-origin", ".glb", origin=_FAR, inside=_in_json),
    _binary_polygons(),
    Seed("mesh-ply-ascii", {"m.ply": _ASCII_PLY}, "m.ply", load=load_mesh),
    _saved("glb", ".glb", inside=_in_json),
    _saved("glb-meshopt", ".glb", compression="meshopt"),
    _gltf(),
    Seed("gltf-skinned", {"m.gltf": json.dumps(skinned()).encode()}, "m.gltf", load=load_mesh),
    Seed("gltf-instanced", {"m.gltf": json.dumps(_INSTANCED).encode()}, "m.gltf", load=load_mesh),
    Seed("obj", {"m.obj": _OBJ}, "m.obj", load=load_mesh),
    Seed("texture-glb", _textured("m.glb"), "m.glb", _in_json, load=load_base),
    Seed("texture-obj", _textured("m.obj"), "m.obj", load=load_base),
    *([_saved(s[1:], s, slow=True) for s in (".usdc", ".usda")] if importlib.util.find_spec("pxr") else []),
    *(_textured_usd() if importlib.util.find_spec("pxr") else []),
]
