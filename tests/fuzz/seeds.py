"""Small good files of every splat format, from which the fuzzer starts."""

from __future__ import annotations

import gzip
import importlib.util
import io
import json
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import _splat_encoders as encode
import numpy as np
from _splat_files import Table, random_splats, splat_table, write_ply

from meshsplats import FileFormatError, load_gaussians, save_gaussians
from meshsplats.formats.sniff import identify

Change = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Seed:
    """A splat or mesh file, or a folder of files."""

    name: str
    files: dict[str, bytes]
    opened: str
    """The path given to the reader, relative to the folder of the files."""
    inside: Callable[[bytes, Change], bytes] | None = None
    """Applies a change to the data inside a compressed file."""
    load: Callable[[Path], object] = load_gaussians
    """The reader under test."""
    slow: bool = False
    """Fuzzed only when asked for by name."""
    errors: tuple[type[Exception], ...] = (FileFormatError, OSError)
    """What the reader may raise."""
    changed: tuple[str, ...] = ()
    """Files that are changed; empty: all."""


def _ply(name: str, encoding: str, degree: int, tables: bool, away: float = 0.0) -> Seed:
    faces = [Table("face", [("uchar", "int", "v")], [[[0, 1, 2]], [[0, 1, 2, 3]], [[]]])] if tables else []
    values = random_splats(5, degree=degree)
    types = {"x": "double", "opacity": "double"} if tables else {}
    if away:
        values["x"], types = values["x"].astype(np.float64) + away, {"x": "double"}
    with tempfile.TemporaryDirectory() as folder:
        path = write_ply(Path(folder) / "a.ply", [*faces, splat_table(values, types)], encoding)
        return Seed(name, {"a.ply": path.read_bytes()}, "a.ply")


def _moving_ply(name: str, *columns: str) -> Seed:
    """Splats that move, with what a header may say of them besides."""
    values = random_splats(40, degree=0)
    values |= {column: values["x"] for column in columns}
    notes = [Table(note, [("uchar", note)], [[1]]) for note in ("up_axis", "chirality", "color_space")]
    comments = ["Exported from Brush", "Vertical axis: 0 -0.6 0.8", "SplatRenderMode: mip"]
    with tempfile.TemporaryDirectory() as folder:
        path = write_ply(Path(folder) / "a.ply", [splat_table(values), *notes], comments=comments)
        return Seed(name, {"a.ply": path.read_bytes()}, "a.ply")


def in_gzip(data: bytes, change: Change) -> bytes:
    return gzip.compress(change(gzip.decompress(data)), mtime=0)


def _in_archive(data: bytes, change: Change) -> bytes:
    """One of the files changed, which one depends on the others' sizes; the archive around them whole."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    changed = {name: change(content) for name, content in files.items()}
    chosen = sorted(files)[sum(map(len, changed.values())) % len(files)]
    return encode.bundle(files | {chosen: changed[chosen]})


def _zstandard_seeds() -> list[Seed]:
    """SPZ 4, where the package zstandard is installed; each stream is compressed again after its change."""
    if importlib.util.find_spec("zstandard") is None:
        return []
    import zstandard

    compress = zstandard.ZstdCompressor().compress
    extensions = bytes([3, 0, 0xBE, 0xAD, 4, 0, 0, 0, 4, 0, 0, 0])
    whole = encode.spz4(_VALUES, compress, flags=3, extensions=extensions)

    def inside(_: bytes, change: Change) -> bytes:
        return encode.spz4(_VALUES, lambda stream: compress(change(stream)))

    return [Seed("spz-4", {"a.spz": whole}, "a.spz", inside)]


def _usd_seeds() -> list[Seed]:
    """USD, where usd-core is installed; and what of it is read without that: the tokens of a binary file."""
    if importlib.util.find_spec("pxr") is None:
        return []
    text = encode.usda(_VALUES)
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.usda").write_text(text)
        cloud = load_gaussians(Path(folder) / "a.usda")
        save_gaussians(cloud, Path(folder) / "a.usdc")
        save_gaussians(cloud, Path(folder) / "a.usdz")
        binary, package = ((Path(folder) / name).read_bytes() for name in ("a.usdc", "a.usdz"))
    return [
        Seed("usd-tokens", {"a.usdc": binary}, "a.usdc", load=identify),
        Seed("splat-usda", {"a.usda": text.encode()}, "a.usda", slow=True),
        Seed("splat-usdc", {"a.usdc": binary}, "a.usdc", slow=True),
        Seed("splat-usdz", {"a.usdz": package}, "a.usdz", slow=True),
    ]


_VALUES = random_splats(9, degree=1)
_SPZ = {version: encode.spz(_VALUES, version, extensions=bytes(8), flags=2) for version in (1, 2, 3)}
_GLB = encode.gltf(encode.splat_accessors(_VALUES), nodes=[{"mesh": 0, "scale": [1, 2, 3]}])
_STREAMED = encode.streamed_sog(
    {"a": _VALUES}, [{0: ("a", 0, 4)}, {0: ("a", 5, 4)}], environment="a/meta.json"
)
_BOX = {"boundingVolume": {"box": [0, 0, 0, 9, 0, 0, 0, 9, 0, 0, 0, 9]}, "geometricError": 1}
_TILES = {
    "asset": {"version": "1.1"},
    "root": _BOX
    | {
        "refine": "ADD",
        "content": {"uri": "a.glb"},
        "transform": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1],
    }
    | {"children": [_BOX | {"content": {"uri": "in/sub.json"}}]},
}
_TILESET = {
    "tileset.json": json.dumps(_TILES).encode(),
    "a.glb": _GLB,
    "in/sub.json": json.dumps(
        {"asset": {"version": "1.0"}, "root": _BOX | {"contents": [{"uri": "b.glb"}]}}
    ).encode(),
    "in/b.glb": encode.gltf(spz_data=_SPZ[3]),
}

SEEDS = [
    _ply("ply", "binary_little_endian", 1, False),
    _ply("ply-lists", "binary_big_endian", 0, True),
    _ply("ply-ascii", "ascii", 0, True),
    _moving_ply(
        "ply-spacetime",
        *("trbf_center", "trbf_scale", *(f"motion_{i}" for i in range(9)), *(f"omega_{i}" for i in range(4))),
    ),
    _moving_ply("ply-4d", "t", "scale_t_0", *(f"rot_r_{i}" for i in range(4))),
    _ply("ply-far", "binary_little_endian", 0, False, away=5e6),
    Seed("compressed-ply", {"a.ply": encode.compressed_ply(_VALUES)}, "a.ply"),
    Seed("ksplat", {"a.ksplat": encode.ksplat(_VALUES, 1, sections=2)}, "a.ksplat"),
    Seed("splat", {"a.splat": encode.dot_splat(_VALUES)}, "a.splat"),
    *(Seed(f"spz-{version}", {"a.spz": data}, "a.spz", in_gzip) for version, data in _SPZ.items()),
    *_zstandard_seeds(),
    Seed("sog", {"a.sog": encode.bundle(encode.sog(_VALUES))}, "a.sog", _in_archive),
    Seed("sog-folder", encode.sog(_VALUES), "."),
    Seed("sog-folder-1", encode.sog(_VALUES, version=1), "meta.json"),
    Seed("sog-streamed", _STREAMED, "."),
    Seed("lcc", encode.lcc(random_splats(9, degree=3)), "meta.lcc"),
    Seed("splat-glb", {"a.glb": _GLB}, "a.glb"),
    Seed("splat-gltf", {"a.gltf": encode.gltf(encode.splat_accessors(_VALUES), kind="gltf")}, "a.gltf"),
    Seed("splat-tileset", _TILESET, "."),
    Seed("spz-glb", {"a.glb": encode.gltf(spz_data=_SPZ[3])}, "a.glb"),
    *_usd_seeds(),
]
