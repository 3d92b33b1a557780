"""Compressed `.glb` for the web by the program gltfpack of the meshoptimizer project (MIT licence).

The result needs the glTF extensions EXT_meshopt_compression and KHR_mesh_quantization. Web viewers with the
meshopt decoder, such as three.js, read them; programs without it refuse the file.
"""

from __future__ import annotations

import json
import os
import shutil
import struct
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from meshsplats._origin import zero_origin
from meshsplats.errors import MissingDependencyError
from meshsplats.formats.cutting import CUTOFF
from meshsplats.formats.gltf.writer import Alpha, ColorType, turned_origin, write_glb
from meshsplats.mesh import SplatMesh

Compression = Literal["meshopt"]

_BITS = 16
"""Bits of a coordinate, the most that gltfpack has; its default of 14 moves the vertices of a scene of 100 m
by up to 3 mm."""


def write_compressed_glb(
    mesh: SplatMesh,
    path: Path,
    *,
    compression: Compression,
    lit: bool = False,
    color_type: ColorType = "uint16",
    alpha: Alpha = "blend",
    cutoff: float = CUTOFF,
) -> None:
    """Writes ``mesh`` to ``path`` with positions and colours of 16 bits, compressed.

    Concretely, a coordinate is moved by at most 0.5 / 65535 of the longest side of the bounding box. The
    arrays that only this project reads are left out, as the order of triangles changes, and harmonics, whose
    attributes the program drops: colours are plain ones.

    Raises:
        MissingDependencyError: gltfpack is missing.
        ValueError: as ``write_glb``, and for ``color_type`` 'float32'.
        RuntimeError: gltfpack fails.
    """
    if compression not in get_args(Compression):
        raise ValueError(
            f"compression must be one of {', '.join(get_args(Compression))}, got {compression!r}"
        )
    if color_type != "uint16":
        raise ValueError(f"compressed colours are of type 'uint16', got {color_type!r}; leave one out")
    program = shutil.which(os.environ.get("MESHSPLATS_GLTFPACK", "gltfpack"))
    if program is None:
        raise MissingDependencyError(
            "compression needs the program gltfpack: npm install -g gltfpack, or a binary from"
            " https://github.com/zeux/meshoptimizer/releases on the PATH or named by MESHSPLATS_GLTFPACK"
        )
    with tempfile.TemporaryDirectory(prefix="meshsplats-") as folder:
        plain, packed = Path(folder) / "plain.glb", Path(folder) / "packed.glb"
        # The program has float32 for transforms of nodes.
        local = replace(mesh.plain, origin=zero_origin())
        write_glb(local, plain, lit=lit, alpha=alpha, cutoff=cutoff, extras=False)
        precision = ["-vp", str(_BITS), "-vc", "16", "-vn", "12"]
        done = subprocess.run(
            [program, "-i", plain, "-o", packed, "-cc", *precision, "-ke", "-km", "-kn"],
            capture_output=True,
            text=True,
            stdin=subprocess.DEVNULL,
        )
        if done.returncode or not packed.is_file():
            raise RuntimeError(f"gltfpack failed with status {done.returncode}: {done.stderr.strip()[-500:]}")
        content = packed.read_bytes()
        path.write_bytes(moved_scene(content, turned_origin(mesh)) if mesh.origin.any() else content)


def moved_scene(content: bytes, translation: np.ndarray) -> bytes:
    """The `.glb` file ``content`` with the nodes of its scene below one that moves them by ``translation``
    (3,) float64."""
    length = struct.unpack_from("<I", content, 12)[0]
    document = json.loads(content[20 : 20 + length])
    for scene in document["scenes"]:
        node = {"name": "origin", "translation": translation.tolist(), "children": scene["nodes"]}
        scene["nodes"] = [len(document["nodes"])]
        document["nodes"].append(node)
    text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest
