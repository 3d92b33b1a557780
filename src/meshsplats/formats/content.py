"""A file, or one inside a zip archive, and what its first bytes are."""

from __future__ import annotations

import errno
import os
import re
import stat
import zlib
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, Literal, cast

from meshsplats.errors import FileFormatError
from meshsplats.formats._gzipped import GzippedFile
from meshsplats.formats._zipped import Archive
from meshsplats.formats.ply.header import PlyHeader, read_header

Container = Literal["ply", "zip", "glb", "usd", "json", "array", "gzip", "lfs", "html"]

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

_ADDRESS = re.compile(r"([a-z][a-z0-9+]+):/+(.+)", re.IGNORECASE)
"""Of the web, as a path has it: with one of the slashes."""


def refuse_stream(path: Path) -> None:
    """FileFormatError if ``path`` is a pipe, a socket or a device: these can be read once, and readers open
    their files several times; FileNotFoundError if it is an address, of which nothing is downloaded."""
    try:
        mode = path.stat().st_mode
    except OSError:
        if address := _ADDRESS.match(path.as_posix()):
            said = f"{address[1]}://{address[2]}"
            wanted = "an address, not a file: download what it names, and give the path of that"
            raise FileNotFoundError(errno.ENOENT, wanted, said) from None
        return  # opening it says what is wrong
    kinds = {stat.S_ISFIFO: "a pipe", stat.S_ISSOCK: "a socket", stat.S_ISCHR: "a device"}
    for is_kind, what in kinds.items():
        if is_kind(mode):
            raise FileFormatError(
                f"{path}: {what}, not a file: it can be read only once; give - as the input of the command,"
                " and redirect it to standard input"
            )


class Content:
    """A file and the format of its first bytes; to be closed if it is a zip archive.

    Args:
        path: the file.
        member: name of a file in the zip archive ``path``, whose content is meant.
        archive: that archive, opened.
    """

    def __init__(self, path: Path, member: str | None = None, archive: Archive | None = None) -> None:
        self.path, self.member = path, member
        self._archive = archive
        refuse_stream(path)
        try:
            with self.open_raw() as file:
                self.head = file.read(4096)
        except PermissionError:
            if path.is_dir():  # on Windows
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path)) from None
            raise
        except FileNotFoundError:
            if path.is_symlink():
                lost = f"a link to {os.readlink(path)}, which does not exist"
                raise FileNotFoundError(errno.ENOENT, lost, os.fspath(path)) from None
            raise
        self.container = next((name for name, p in _SIGNATURES.items() if p.match(self.head)), None)

    def __enter__(self) -> Content:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the zip archive that it is or lies in."""
        if self._archive is not None:
            self._archive.close()
            self._archive = None

    @property
    def archive(self) -> Archive:
        """The zip archive that it is, opened at the first use. FileFormatError if it is broken."""
        if self._archive is None:
            self._archive = Archive(self.path)
        return self._archive

    @property
    def is_archive(self) -> bool:
        """Whether it is a zip archive."""
        return self.container == "zip"

    def inside(self, member: str) -> Content:
        """The content of a file in the archive. Both are closed together."""
        return Content(self.path, member, self.archive)

    @property
    def name(self) -> str:
        """Of the file that is meant, in lower case."""
        return (self.member or self.path.name).lower()

    @cached_property
    def ply_header(self) -> PlyHeader:
        """The header of a PLY file. FileFormatError if it is broken."""
        with self.open() as file:
            return read_header(file, self.path)

    @property
    def is_ply(self) -> bool:
        """Whether it is a PLY file, be it gzipped."""
        return self.container == "ply" or self.is_gzipped_ply

    @cached_property
    def is_gzipped_ply(self) -> bool:
        """Whether the file is a gzipped PLY file."""
        if self.container != "gzip" or self.member is not None:
            return False
        try:
            return _SIGNATURES["ply"].match(zlib.decompressobj(31).decompress(self.head, 64)) is not None
        except zlib.error:
            return False

    @cached_property
    def json_text(self) -> bytes:
        """The beginning of a JSON file, in which words are looked for; empty for others."""
        if self.container != "json":
            return b""
        with self.open() as file:
            return file.read(8 << 20)

    def open(self) -> BinaryIO:
        """The opened file; a gzipped PLY file, and one in a zip archive, is unpacked while it is read."""
        return cast(BinaryIO, GzippedFile(self.path)) if self.is_gzipped_ply else self.open_raw()

    def open_raw(self) -> BinaryIO:
        """The opened file, or one in a zip archive."""
        return open(self.path, "rb") if self.member is None else self.archive.open(self.member)

    @cached_property
    def usd_layer(self) -> str | None:
        """Name of the USD file that a .usdz package is read by, its first; None for what is no package."""
        if not self.is_archive or self.member is not None:
            return None
        try:
            first = next(iter(self.archive.names), "")
        except FileFormatError:
            return None
        return first if first.lower().endswith((".usd", ".usdc", ".usda")) else None

    @property
    def is_usd(self) -> bool:
        """Whether it is a USD file, or a package of one."""
        return self.container == "usd" or self.usd_layer is not None

    def open_usd(self) -> BinaryIO:
        """The opened USD file, or the one that a package is read by."""
        return self.open_raw() if self.usd_layer is None else self.archive.open(self.usd_layer)

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
