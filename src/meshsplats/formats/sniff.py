"""Recognises files by their content, for all readers."""

from __future__ import annotations

import errno
import os
import re
import zipfile
import zlib
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal, cast

from meshsplats.errors import FileFormatError
from meshsplats.formats._gzipped import GzippedFile
from meshsplats.formats.gltf.splats import has_splats
from meshsplats.formats.ply.compressed_splats import is_compressed_splat
from meshsplats.formats.ply.header import PlyHeader, read_header
from meshsplats.formats.ply.splats import is_float_splat
from meshsplats.formats.splats.dot_splat import is_dot_splat
from meshsplats.formats.splats.spz import is_spz

Container = Literal["ply", "zip", "glb", "usd", "json", "array", "gzip", "lfs", "html"]
SplatFormat = Literal["ply", "compressed.ply", "splat", "spz", "sog", "streamed sog", "gltf"]

_SIGNATURES: dict[Container, re.Pattern[bytes]] = {
    "ply": re.compile(rb"ply[ \t]*[\r\n]"),
    "zip": re.compile(rb"PK(\x03\x04|\x05\x06)"),
    "glb": re.compile(rb"glTF"),
    "usd": re.compile(rb"PXR-USDC|#usda"),
    "json": re.compile(rb"(\xef\xbb\xbf)?\s*\{"),
    "array": re.compile(rb"(\xef\xbb\xbf)?\s*\["),
    "gzip": re.compile(rb"\x1f\x8b"),
    "lfs": re.compile(rb"version https://git-lfs"),
    "html": re.compile(rb"\s*<(!doctype html|html)", re.IGNORECASE),
}
_UNREAD: dict[Container | None, str] = {
    "gzip": "a gzip file, but not SPZ; unpack it first",
    "lfs": "a Git LFS pointer, not the file itself, which 'git lfs pull' brings",
    "html": "a web page, not the file itself: did the download ask for a login?",
}
_SOG_SECTIONS = (b'"means"', b'"quats"', b'"sh0"')
_EXPECTED = "a .ply (float or compressed), .splat, .spz, .sog or .glb file with splats"


class UnreadSplats(FileFormatError):
    """Splats of a known kind that is not read, or a file in their place, such as a Git LFS pointer."""


class Content:
    """A file and the format of its first bytes."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with open(path, "rb") as file:
                self.head = file.read(4096)
        except PermissionError:
            if path.is_dir():  # on Windows
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path)) from None
            raise
        matching = (name for name, pattern in _SIGNATURES.items() if pattern.match(self.head))
        self.container: Container | None = next(matching, None)

    @cached_property
    def ply_header(self) -> PlyHeader:
        """The header of a PLY file. FileFormatError if it is broken."""
        with self.open() as file:
            return read_header(file, self.path)

    @cached_property
    def is_gzipped_ply(self) -> bool:
        """Whether the file is a gzipped PLY file."""
        if self.container != "gzip":
            return False
        try:
            return _SIGNATURES["ply"].match(zlib.decompressobj(31).decompress(self.head, 64)) is not None
        except zlib.error:
            return False

    def open(self) -> BinaryIO:
        """The opened file; a gzipped PLY file is unpacked while it is read."""
        return cast(BinaryIO, GzippedFile(self.path)) if self.is_gzipped_ply else open(self.path, "rb")

    @property
    def is_text(self) -> bool:
        return b"\0" not in self.head

    @property
    def is_obj(self) -> bool:
        """Whether the file is Wavefront `.obj`. The format has no signature: its name or a vertex decides."""
        named = self.path.suffix.lower() == ".obj"
        return self.is_text and (named or re.search(rb"(^|\n)v[ \t]+[-+.\d]", self.head) is not None)

    def refuse_empty(self) -> None:
        if not self.head:
            raise FileFormatError(f"{self.path}: the file is empty")

    def splat_format(self) -> SplatFormat:
        """The splat format of the file; its reader may still refuse it, or find a mesh.

        Raises:
            UnreadSplats: the kind is known, but not read.
            FileFormatError: the file is something else; the message says what, if that is clear.
        """
        path, name = self.path, self.path.name.lower()
        convert = f"convert it first: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        self.refuse_empty()
        if self.container == "ply" or self.is_gzipped_ply:
            # A mesh is left to the float reader, which says what is missing.
            return "compressed.ply" if is_compressed_splat(self.ply_header) else "ply"
        if is_spz(self.head):
            return "spz"
        if self.container == "zip":
            return "sog"
        if self.container == "glb":
            return "gltf"
        if self.container == "json":
            return self._json_format(convert)
        if name.endswith(".ksplat"):
            raise UnreadSplats(f"{path}: .ksplat files are not read here; {convert}")
        with open(path, "rb") as file:
            if is_dot_splat(file):
                return "splat"
        if name.endswith(".splat"):
            raise UnreadSplats(
                f"{path}: named .splat, but not records of 32 bytes whose rotations are unit quaternions"
                f" (it has {path.stat().st_size:,} bytes)"
            )
        if self.container in _UNREAD:
            raise UnreadSplats(f"{path}: {_UNREAD[self.container]}")
        raise FileFormatError(
            f"{path}: not a splat file of a known format, it begins with {self.head[:8]!r};"
            f" expected {_EXPECTED}"
        )

    def _json_format(self, convert: str) -> SplatFormat:
        """The format of a JSON file by the words in it; its reader parses it."""
        with open(self.path, "rb") as file:
            text = file.read(8 << 20)
        if all(name in text for name in _SOG_SECTIONS):  # some name their generator in an asset, as glTF does
            return "sog"
        if b'"lodLevels"' in text:
            return "streamed sog"
        if b'"asset"' in text:
            return "gltf"
        named = self.path.suffix.lower() in (".lcc", ".lcc2")
        if named or (b'"splats"' in text and b'"totalLevel"' in text):
            raise UnreadSplats(f"{self.path}: .lcc scenes are not read here; {convert}")
        if b'"means"' in text:
            return "sog"
        raise FileFormatError(f"{self.path}: a JSON file that is neither SOG nor glTF; expected {_EXPECTED}")


def identify(path: Path) -> Literal["splats", "mesh", "cameras"]:
    """The kind of data at ``path``, by its content. Raises FileFormatError if it is none of the three.

    Four kinds of file may hold either splats or a mesh: .ply, .glb and .gltf, and zip archives (.sog, .npz).
    """
    if path.is_dir():
        return "splats"
    content = Content(path)
    try:
        found: SplatFormat | None = content.splat_format()
    except UnreadSplats:
        raise
    except FileFormatError:
        found = None
    if found == "ply":
        return "splats" if is_float_splat(content.ply_header) else "mesh"
    if content.container == "usd":
        return "mesh"
    if content.container == "zip":
        return "mesh" if _holds_arrays(path) else "splats"
    if found == "gltf":
        return "splats" if has_splats(path) else "mesh"
    if content.is_obj:
        return "mesh"
    if found is not None:
        return "splats"
    if content.is_text and content.container in ("json", "array"):
        return "cameras"
    content.refuse_empty()
    raise FileFormatError(
        f"{path}: neither splats, a mesh nor cameras of a known format; it begins with {content.head[:8]!r}"
    )


def _holds_arrays(path: Path) -> bool:
    """Whether a zip archive is an .npz."""
    if path.suffix.lower() == ".usdz":  # its reader says what to do
        return True
    try:
        with zipfile.ZipFile(path) as archive:
            return any(name.endswith(".npy") for name in archive.namelist())
    except (zipfile.BadZipFile, ValueError, OSError):
        # Broken: the name decides which reader says so.
        return path.suffix.lower() == ".npz"
