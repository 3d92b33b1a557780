"""Splat files in zip archives, as downloads often come: read in place, nothing is unpacked to the disk."""

from __future__ import annotations

import io
import os
import zipfile
from pathlib import Path
from typing import Any, BinaryIO, cast

from meshsplats._common.foreign import BROKEN_ZIP, open_member
from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget

MAX_META_BYTES = 4 << 20
"""Of the meta.json of a SOG file."""
_PIECE = 1 << 20
_MAX_TRIED = 64
"""Of files that are named like splats, only this many are opened to see whether they are."""


class BoundedReader(io.BufferedReader):
    """An archive, opened. Refuses a single read beyond 16 MiB: a zip directory of that size is an attack, and
    what is in an archive is read piece by piece."""

    _limit = 1 << 24

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))

    def read(self, size: int | None = -1) -> bytes:
        # BufferedReader would allocate ``size`` bytes even where the file ends earlier.
        left = os.fstat(self.fileno()).st_size - self.tell()
        wanted = left if size is None or size < 0 else min(size, left)
        if wanted > self._limit:
            raise zipfile.BadZipFile("its directory is absurdly large")
        return super().read(max(wanted, 0))


class Archive:
    """A zip archive, opened; its directory is read once."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._raw = BoundedReader(path)
        try:
            self._zip = zipfile.ZipFile(self._raw)
        except BROKEN_ZIP as error:
            self._raw.close()
            raise FileFormatError(f"{path}: a broken zip archive (truncated?): {error}") from None
        named = [name for name in self._zip.namelist() if not name.endswith("/")]
        self.names = [name for name in named if not _is_hidden(name)]
        """Of the files in it, without those that macOS adds."""

    def close(self) -> None:
        self._zip.close()
        self._raw.close()

    @property
    def meta(self) -> str | None:
        """The name of the meta.json that is least deep in it; None without one. SOG files have it."""
        found = [name for name in self.names if name.rsplit("/", 1)[-1] == "meta.json"]
        return min(found, key=lambda name: (name.count("/"), name), default=None)

    @property
    def is_sog(self) -> bool:
        """Whether it has the meta.json of a SOG file, or one that cannot be unpacked: the reader says so."""
        try:
            return self.meta is not None and b'"means"' in self.bytes(self.meta, MAX_META_BYTES)
        except FileFormatError:
            return True

    def named(self, suffixes: tuple[str, ...]) -> list[str]:
        """The files in it whose names end in one of ``suffixes``; not too many."""
        return [name for name in self.names if name.lower().endswith(suffixes)][:_MAX_TRIED]

    def open(self, name: str) -> BinaryIO:
        """A file in it, unpacked while it is read; not beyond the archive's own being open."""
        return cast(BinaryIO, ZippedFile(self._zip, self.path, name))

    def bytes(self, name: str, limit: int) -> bytes:
        """The whole of a file in it, at most ``limit`` bytes; else FileFormatError."""
        pieces, left = [], limit + 1
        try:
            with open_member(self._zip, name) as file:
                while left and (piece := file.read(min(left, _PIECE))):
                    pieces.append(piece)
                    left -= len(piece)
        except BROKEN_ZIP as e:
            raise FileFormatError(f"{self.path}: cannot unpack {name[:60]!r}: {str(e)[:120]}") from None
        if not left:
            raise FileFormatError(f"{self.path}: {name[:60]!r} unpacks to over {limit:,} bytes; refused")
        return b"".join(pieces)


def _is_hidden(name: str) -> bool:
    return any(part == "__MACOSX" or (part.startswith(".") and part != "..") for part in name.split("/"))


class ZippedFile(io.RawIOBase):
    """The unpacked bytes of a file in an archive, to be read mainly from the front to the back.

    Decompression bombs are refused by the size that the archive states, beyond which nothing is unpacked.
    """

    def __init__(self, archive: zipfile.ZipFile, path: Path, name: str) -> None:
        self._where = f"{path}: {name[:200]!r}"
        self._at_end = False
        self._file: Any = io.BytesIO()
        try:
            self._file = open_member(archive, name)
            self._length = archive.getinfo(name).file_size
            Budget(path).spend(self._length, f"{name[:200]!r} in it")
        except (KeyError, *BROKEN_ZIP) as error:
            if isinstance(error, FileFormatError):
                raise
            raise FileFormatError(f"{self._where} cannot be unpacked: {str(error)[:120]}") from None

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._length if self._at_end else self._file.tell()

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        place = {io.SEEK_SET: 0, io.SEEK_CUR: self.tell(), io.SEEK_END: self._length}[whence] + offset
        self._at_end = place == self._length  # where readers go for the length alone: nothing is unpacked
        if self._at_end:
            return place
        if place < self._file.tell():
            self._guarded(self._file.seek, 0)
        while (left := place - self._file.tell()) > 0 and self._guarded(self._file.read, min(left, _PIECE)):
            pass
        return self._file.tell()

    def read(self, size: int | None = -1) -> bytes:
        left = self._length - self.tell()
        left = left if size is None or size < 0 else min(size, left)
        pieces = []
        while left > 0 and (piece := self._guarded(self._file.read, min(left, _PIECE))):
            pieces.append(piece)
            left -= len(piece)
        return b"".join(pieces)

    def readinto(self, buffer: Any) -> int:
        if self._at_end:
            return 0
        view = memoryview(buffer).cast("B")
        return self._guarded(self._file.readinto, view[: min(len(view), _PIECE)])

    def close(self) -> None:
        if not self.closed:
            self._file.close()
        super().close()

    def _guarded(self, read: Any, argument: Any) -> Any:
        try:
            return read(argument)
        except BROKEN_ZIP as error:
            raise FileFormatError(f"{self._where} cannot be unpacked: {str(error)[:120]}") from None
