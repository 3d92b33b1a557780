"""Recognises files by their content, for all readers."""

from __future__ import annotations

import errno
import os
import re
import zlib
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal, cast

from meshsplats._foreign import foreign
from meshsplats.errors import FileFormatError
from meshsplats.formats._gzipped import GzippedFile
from meshsplats.formats._zipped import Archive, ZippedFile
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
}
_SPLATV = b"\x4b\x67\0\0"
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
        self.container = _container(self.head)
        self.member: str | None = None
        """The name of the only file with splats in a zip archive; the content is then that of this file."""
        if self.container == "zip" and (found := _only_member(path)) is not None:
            self.member = found
            with self.open() as inner:
                self.head = inner.read(4096)
            self.container = _container(self.head)

    @cached_property
    def ply_header(self) -> PlyHeader:
        """The header of a PLY file. FileFormatError if it is broken."""
        with self.open() as file:
            return read_header(file, self.path)

    @cached_property
    def is_gzipped_ply(self) -> bool:
        """Whether the file is a gzipped PLY file."""
        if self.container != "gzip" or self.member is not None:
            return False
        try:
            return _SIGNATURES["ply"].match(zlib.decompressobj(31).decompress(self.head, 64)) is not None
        except zlib.error:
            return False

    def open(self) -> BinaryIO:
        """The opened file; a gzipped PLY file, and one in a zip archive, is unpacked while it is read."""
        if self.member is not None:
            return cast(BinaryIO, ZippedFile(self.path, self.member))
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
        path, name = self.path, (self.member or self.path.name).lower()
        convert = f"convert it first: npx @playcanvas/splat-transform {path.name} {path.stem}.ply"
        self.refuse_empty()
        if self.container == "ply" or self.is_gzipped_ply:
            # A mesh is left to the float reader, which says what is missing.
            return "compressed.ply" if is_compressed_splat(self.ply_header) else "ply"
        if is_spz(self.head):
            return "spz"
        if self.container == "zip":
            return self._zip_format()
        if self.container == "glb":
            return "gltf"
        if self.container == "json":
            return self._json_format(convert)
        if self.head[:4] == _SPLATV or name.endswith(".splatv"):
            raise UnreadSplats(
                f"{path}: .splatv files, of splats that move, are not read here; the .ply that they are made"
                " of is (Spacetime Gaussians)"
            )
        if name.endswith(".ksplat"):
            raise UnreadSplats(f"{path}: .ksplat files are not read here; {convert}")
        with self.open() as file:
            if is_dot_splat(file):
                return "splat"
        if name.endswith(".splat"):
            raise UnreadSplats(
                f"{path}: named .splat, but not records of 32 bytes whose rotations are unit quaternions"
                f" (it has {path.stat().st_size:,} bytes)"
            )
        if self.container == "html":
            raise UnreadSplats(f"{path}: {_page(path)}")
        if self.container in _UNREAD:
            raise UnreadSplats(f"{path}: {_UNREAD[self.container]}")
        if not self.is_obj and (what := foreign(path, self.head)):
            raise UnreadSplats(f"{path}: {what}")
        raise FileFormatError(
            f"{path}: not a splat file of a known format, it begins with {self.head[:8]!r};"
            f" expected {_EXPECTED}"
        )

    def _zip_format(self) -> SplatFormat:
        """The format of an archive without a single file of splats: SOG, if its meta.json is there."""
        try:
            archive = Archive(self.path)
        except FileFormatError:  # broken: the reader says so
            return "sog"
        if archive.has_meta:
            return "sog"
        raise archive.refusal()

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


def _container(head: bytes) -> Container | None:
    return next((name for name, pattern in _SIGNATURES.items() if pattern.match(head)), None)


def _only_member(path: Path) -> str | None:
    """The only file with splats in a zip archive; None if it has none, or is of a format of its own.
    FileFormatError if it has several."""
    try:
        archive = Archive(path)
    except FileFormatError:  # broken: the reader says so
        return None
    if archive.has_meta:
        return None
    found = [name for name in archive.candidates() if _is_splats(path, name)]
    if len(found) > 1:
        some = ", ".join(found[:4]) + (", ..." if len(found) > 4 else "")
        raise UnreadSplats(
            f"{path}: {len(found)} files of splats in one archive ({some}): unpack it, and give one"
        )
    return found[0] if found else None


def _is_splats(path: Path, name: str) -> bool:
    """Whether a file in an archive is splats, or so broken that only its reader can tell."""
    with ZippedFile(path, name) as zipped:
        file = cast(BinaryIO, zipped)
        head = file.read(4096)
        file.seek(0)
        if _container(head) != "ply":
            return is_spz(head) or (name.lower().endswith(".splat") and is_dot_splat(file))
        try:
            header = read_header(file, path)
        except FileFormatError:
            return True
        return is_compressed_splat(header) or is_float_splat(header)


def _page(path: Path) -> str:
    """What an HTML file is."""
    with open(path, "rb") as file:
        text = file.read(1 << 20).lower()
    if b'name="generator" content="meshsplats' in text:
        return "a page of 'meshsplats view', for browsers: give the file that it was made of"
    if b"supersplat" in text or b"playcanvas" in text:
        return "a page of SuperSplat's viewer: export the splats there as .ply or .sog"
    return "a web page, not the file itself: did the download ask for a login?"


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
        if _holds_arrays(path):
            return "mesh"
        if found is None:
            content.splat_format()  # says what it is
        return "splats"
    if found == "gltf":
        return "splats" if has_splats(path) else "mesh"
    if content.is_obj:
        return "mesh"
    if found is not None:
        return "splats"
    if content.is_text and content.container in ("json", "array"):
        return "cameras"
    content.refuse_empty()
    if what := foreign(path, content.head):
        raise FileFormatError(f"{path}: {what}")
    raise FileFormatError(
        f"{path}: neither splats, a mesh nor cameras of a known format; it begins with {content.head[:8]!r}"
    )


def _holds_arrays(path: Path) -> bool:
    """Whether a zip archive is an .npz."""
    if path.suffix.lower() == ".usdz":  # its reader says what to do
        return True
    try:
        return any(name.endswith(".npy") for name in Archive(path).names)
    except FileFormatError:
        # Broken: the name decides which reader says so.
        return path.suffix.lower() == ".npz"
