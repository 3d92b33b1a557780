"""Gzipped files, unpacked while they are read."""

from __future__ import annotations

import gzip
import io
import zlib
from pathlib import Path
from typing import Any

from meshsplats.errors import FileFormatError
from meshsplats.formats._validation import Budget

_PIECE = 1 << 20


class GzippedFile(gzip.GzipFile):
    """The unpacked bytes of a gzipped file, to be read from the front to the back.

    Its length is known after one pass over it, which refuses decompression bombs. Raises FileFormatError for
    a broken stream.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "rb")
        self._path = path
        self._length: int | None = None

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        if whence != io.SEEK_END:
            return super().seek(offset, whence)
        if self._length is None:
            budget = Budget(self._path)
            length = super().seek(0)
            while piece := self.read(_PIECE):
                length += len(piece)
                budget.spend(len(piece), "its gzip stream")
            self._length = length
        return super().seek(self._length + offset)

    def read(self, size: int | None = -1) -> bytes:
        return self._guarded(super().read, size)

    def readinto(self, buffer: Any) -> int:
        return self._guarded(super().readinto, buffer)

    def _guarded(self, read: Any, argument: Any) -> Any:
        try:
            return read(argument)
        except (OSError, EOFError, zlib.error) as error:
            raise FileFormatError(f"{self._path}: the gzip stream is broken: {error}") from None
