"""The attributes of an SPZ file, each a stream, unpacked side by side without the file in memory."""

from __future__ import annotations

import io
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.splats._spz_layout import (
    MAGIC,
    MAX_EXTENSION_BYTES,
    MAX_HEAD,
    Header,
    check_end,
    contents,
    parse_header,
    unpacking_errors,
    zstandard_modules,
)
from meshsplats.scene.origin import SAMPLE

_PIECE = 1 << 18
"""Bytes of a file that are unpacked at a time."""


class Streams(NamedTuple):
    """The attributes of an opened file."""

    header: Header
    extensions: bytes
    attributes: dict[str, Any]
    """A stream for each."""
    open_positions: Callable[[], Any]
    """Opens that of the positions once more."""
    where: Path

    def rows(self, at_once: int) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
        """Count of the splats of each part, ``at_once`` or fewer, and their bytes, (m, bytes) of each
        attribute."""
        width = {name: size // max(self.header.splats, 1) for name, size in self.header.sizes().items()}
        try:
            for start in range(0, self.header.splats, at_once):
                m = min(at_once, self.header.splats - start)
                yield (
                    m,
                    {
                        name: np.frombuffer(_exactly(s, m * width[name], name, self.where), np.uint8).reshape(
                            m, -1
                        )
                        for name, s in self.attributes.items()
                    },
                )
            for name, stream in self.attributes.items():
                # At the end of a Zstandard frame stands its checksum; gzip's was checked by the first pass.
                if isinstance(stream, _Inflater):
                    continue
                if _exactly(stream, 1, name, self.where, optional=True):
                    raise FileFormatError(
                        f"{self.where}: the stream of {name} is longer than its header says"
                    )
        finally:
            self.close()

    def positions(self, at_once: int) -> np.ndarray:
        """(k, bytes) every so many-th stored position, by a pass over the stream of positions alone."""
        header = self.header
        width, step = header.sizes()["positions"] // max(header.splats, 1), max(1, header.splats // SAMPLE)
        found = [np.empty((0, width), np.uint8)]
        stream = self.open_positions()
        try:
            for start in range(0, header.splats, at_once):
                m = min(at_once, header.splats - start)
                rows = np.frombuffer(_exactly(stream, m * width, "positions", self.where), np.uint8)
                found.append(rows.reshape(m, width)[-start % step :: step].copy())
        finally:
            stream.close()
        return np.concatenate(found)

    def close(self) -> None:
        _close(self.attributes)


def open_streams(path: Path) -> Streams:
    """The attributes of the SPZ file ``path``; errors as ``load_gaussians``.

    They lie one after the other, each of all splats. Versions 1 to 3 are one stream, which is unpacked twice:
    the first time to find where the attributes begin.
    """
    with open(path, "rb") as file:
        plain = file.read(4) == MAGIC
        file.seek(0)
        if not plain:
            header, extensions, streams = _gzip_streams(path, file)
        else:
            length = file.seek(0, io.SEEK_END)
            file.seek(0)
            header, extensions, table = contents(file.read(MAX_HEAD), length, path)
            streams = {name: _zstd_stream(path, at, packed) for name, (at, packed, _) in table.items()}
    if not header.degree and "sh" in streams:
        streams.pop("sh").close()
    again = streams["positions"].again if not plain else partial(_zstd_stream, path, *table["positions"][:2])
    return Streams(header, extensions, streams, again, path)


class _Inflater:
    """A gzip stream that begins somewhere in a file: unpacks as much as is read."""

    def __init__(self, file: BinaryIO, decompressor: Any, rest: bytes = b"") -> None:
        self._file, self._decompressor, self._rest = file, decompressor, rest

    def read(self, most: int) -> bytes:
        """Up to ``most`` bytes; none at the end. zlib.error for a broken stream."""
        found = b""
        while not found and not self._decompressor.eof:
            packed = self._rest or self._file.read(_PIECE)
            found = self._decompressor.decompress(packed, most)
            self._rest = self._decompressor.unconsumed_tail
            if not packed:
                break
        return found

    @property
    def complete(self) -> bool:
        return bool(self._decompressor.eof)

    def again(self) -> _Inflater:
        """Another reader of the same file that goes on from here."""
        file = open(self._file.name, "rb")  # noqa: SIM115 (closed by close)
        file.seek(self._file.tell())
        return _Inflater(file, self._decompressor.copy(), self._rest)

    def close(self) -> None:
        self._file.close()


class _Frame(io.RawIOBase):
    """The packed bytes of one Zstandard frame of a file."""

    def __init__(self, path: Path, at: int, length: int) -> None:
        self._file, self._left = open(path, "rb"), length  # noqa: SIM115 (closed by close)
        self._file.seek(at)

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        found = self._file.read(min(len(buffer), self._left))
        self._left -= len(found)
        buffer[: len(found)] = found
        return len(found)

    def close(self) -> None:
        self._file.close()
        super().close()


def _exactly(stream: Any, count: int, name: str, where: object, *, optional: bool = False) -> bytes:
    """``count`` bytes of the unpacked ``stream`` of an attribute; none at its end, if ``optional``."""
    parts, missing = [], count
    errors: tuple[type[BaseException], ...] = (EOFError, MemoryError, *unpacking_errors())
    while missing:
        try:
            found = stream.read(min(missing, _PIECE))
        except errors as error:
            raise FileFormatError(f"{where}: the stream of {name} is broken: {str(error)[:100]}") from None
        if not found and optional:
            break
        if not found:
            raise FileFormatError(f"{where}: the stream of {name} is truncated")
        parts.append(found)
        missing -= len(found)
    return b"".join(parts)


def _gzip_streams(path: Path, file: BinaryIO) -> tuple[Header, bytes, dict[str, Any]]:
    """Unpacks versions 1 to 3 once, without keeping them: header, extensions, and a stream for each
    attribute."""
    source = _Inflater(file, zlib.decompressobj(31))
    streams: dict[str, Any] = {}
    try:
        raw = b""
        while len(raw) < 16 and (more := source.read(16 - len(raw))):
            raw += more
        if len(raw) < 16:
            raise FileFormatError(f"{path}: truncated SPZ header of {len(raw)} bytes")
        header = parse_header(raw, range(1, 4), path)
        done = 0
        for name, size in header.sizes().items():
            streams[name] = source.again()
            left = size
            while left and (more := source.read(min(left, _PIECE))):
                left -= len(more)
            done += size - left
        extensions = b""
        while len(extensions) <= MAX_EXTENSION_BYTES and (more := source.read(_PIECE)):
            extensions += more
        check_end(header, done, extensions, source.complete, path)
    except BaseException as error:
        _close(streams)
        if isinstance(error, zlib.error):
            raise FileFormatError(f"{path}: the gzip stream is broken: {error}") from None
        raise
    return header, extensions, streams


def _close(streams: dict[str, Any]) -> None:
    for stream in streams.values():
        stream.close()


def _zstd_stream(path: Path, at: int, length: int) -> Any:
    """The unpacked bytes of the Zstandard frame at a place of the file, as a file to be read."""
    own, package = zstandard_modules(path)
    if own is not None:
        return own.ZstdFile(_Frame(path, at, length))
    decompressor = package.ZstdDecompressor(max_window_size=1 << 27)
    return decompressor.stream_reader(_Frame(path, at, length), closefd=True)
