"""glTF meshes as other programs write them, made for tests independently of the reader and the writer."""

from __future__ import annotations

import base64

import numpy as np

TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], "<f4")


def gltf(arrays, *, primitive=None, **more):
    """A glTF document around ``arrays`` (name, array, type, normalized): accessor i holds array i."""
    components = {"f4": 5126, "i1": 5120, "u1": 5121, "u2": 5123, "u4": 5125, "i2": 5122}
    blob, views, accessors = b"", [], []
    for array, kind, normalized in arrays:
        views.append({"buffer": 0, "byteOffset": len(blob), "byteLength": array.nbytes})
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": components[array.dtype.str[1:]],
                "count": len(array),
                "type": kind,
                "normalized": normalized,
            }
        )
        blob += array.tobytes() + b"\0" * (-array.nbytes % 4)
    uri = "data:application/octet-stream;base64," + base64.b64encode(blob).decode()
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive or {"attributes": {"POSITION": 0}}]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(blob), "uri": uri}],
    } | more


def skinned(weights=((1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0, 0)), **more):
    """A triangle whose first joint moves by 10 in x and whose second, its child, doubles. It was bound where
    the second stood at (0, 1, 0). The node that holds the mesh is somewhere else."""
    joints = np.array([[0, 1, 7, 7]] * 3, "<u2") % 2
    bound = np.stack([np.eye(4), np.eye(4)]).astype("<f4")
    bound[1, 3, 1] = -1  # column by column: the translation is in the last row
    normals = np.array([[0.6, 0.8, 0]] * 3, "<f4")
    return gltf(
        [
            (TRIANGLE, "VEC3", False),
            (normals, "VEC3", False),
            (joints, "VEC4", False),
            (np.array(weights, "<f4"), "VEC4", False),
            (bound.reshape(2, 16), "MAT4", False),
        ],
        primitive={"attributes": {"POSITION": 0, "NORMAL": 1, "JOINTS_0": 2, "WEIGHTS_0": 3}},
        nodes=[
            {"mesh": 0, "skin": 0, "scale": [100, 100, 100], "translation": [7, 7, 7]},
            {"translation": [10, 0, 0], "children": [2]},
            {"translation": [0, 1, 0], "scale": [2, 1, 2]},
        ],
        scenes=[{"nodes": [0, 1]}],
        skins=[{"joints": [1, 2], "inverseBindMatrices": 4}],
        **more,
    )


def instanced(**rows):
    kinds = {"TRANSLATION": "VEC3", "ROTATION": "VEC4", "SCALE": "VEC3"}
    arrays = [(np.array(values, "<f4"), kinds[name], False) for name, values in rows.items()]
    numbers = {name: 1 + i for i, name in enumerate(rows)}
    extension = {"EXT_mesh_gpu_instancing": {"attributes": numbers}}
    return gltf(
        [(TRIANGLE, "VEC3", False), *arrays],
        nodes=[{"mesh": 0, "translation": [0, 0, 1], "extensions": extension}],
        extensionsRequired=["EXT_mesh_gpu_instancing"],
    )
