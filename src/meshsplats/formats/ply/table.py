"""Rows of one PLY element, as stored or as float32 tables, in chunks that fit the processor's cache.

Reading uses a small buffer, no memory map: the pages of the file do not count as memory of the process, and a
file that shrinks meanwhile causes a Python error instead of a bus error.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import BinaryIO

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.ply.header import Element, PlyHeader
from meshsplats.scene.origin import SAMPLE, zero_origin

CHUNK_BYTES = 1 << 20
MAX_LINE_BYTES = 1 << 18
"""The longest line of ASCII data that is read."""
POSITION = ("x", "y", "z")
"""Names of the coordinates of positions."""
_SAMPLE_RUN = 16
"""Rows that lie together in a sample of positions."""


class RowReader:
    """The rows of ``element``, whose properties must all be single values.

    The constructor finds the first row and compares the count with the size of the file before anything is
    allocated. Raises FileFormatError that names the byte, line or row.
    """

    def __init__(self, file: BinaryIO, header: PlyHeader, element: Element, where: object) -> None:
        lists = [p.name for p in element.properties if p.is_list]
        if lists:
            raise FileFormatError(
                f"{where}: element {element.name!r} has the list property {lists[0]!r}; expected single"
                " values only"
            )
        self._file, self._header, self._element, self._where = file, header, element, where
        self._size = file.seek(0, io.SEEK_END)
        self._check_minimum()
        if header.encoding != "ascii":
            self._offset = self._find_rows()
            self._check_extent()

    def __len__(self) -> int:
        return self._element.count

    def rows(self, start: int, count: int) -> np.ndarray:
        """(count,) structured array of binary rows from ``start`` on, in the byte order of the file."""
        size = self._element.minimum_row_bytes
        buffer = bytearray(count * size)
        self._read(start, memoryview(buffer))
        return np.frombuffer(buffer, self._element.row_dtype, count)

    def _read(self, start: int, into: memoryview) -> None:
        self._file.seek(self._offset + start * self._element.minimum_row_bytes)
        done = 0
        while done < len(into):
            got = self._file.readinto(into[done:])  # type: ignore[attr-defined]
            if not got:
                raise FileFormatError(f"{self._where}: the file became shorter while it was read")
            done += got

    def _check_minimum(self) -> None:
        """Refuses a count that no file of this size can hold, even if all lists are empty."""
        ascii_ = self._header.encoding == "ascii"
        left = self._size - self._header.data_offset
        for e in self._header.elements:
            # An ASCII value is a digit and a blank or line end; the last line end may be missing.
            least = e.count * (2 * len(e.properties) if ascii_ else e.minimum_row_bytes)
            if least > left + ascii_:
                raise FileFormatError(
                    f"{self._where}: the header claims {e.count:,} rows of element {e.name!r}, at least"
                    f" {least:,} bytes, but {max(left, 0):,} bytes are left for them (file truncated or count"
                    " wrong)"
                )
            left -= least
            if e is self._element and e.count and not e.properties:
                raise FileFormatError(f"{self._where}: element {e.name!r} has no properties")

    def _find_rows(self) -> int:
        """Byte offset of the first row; walks through the rows of earlier elements with lists."""
        offset = self._header.data_offset
        for e in self._header.elements:
            if e is self._element:
                break
            if e.has_lists:
                offset = _skip_list_rows(self._file, e, offset, self._where)
            else:
                offset += e.count * e.minimum_row_bytes
        return offset

    def _check_extent(self) -> None:
        e, row = self._element, self._element.minimum_row_bytes
        here = e.count * row
        left = self._size - self._offset
        if here > left:
            raise FileFormatError(
                f"{self._where}: element {e.name!r} should hold {e.count:,} rows of {row} bytes from byte"
                f" {self._offset:,}, {here:,} bytes, but the file ends after {max(left, 0):,} of them"
                " (truncated or count wrong)"
            )
        after = self._header.elements[self._header.elements.index(e) + 1 :]
        rest = left - here - sum(a.count * a.minimum_row_bytes for a in after)
        if rest < 0:
            raise FileFormatError(
                f"{self._where}: the file ends {-rest:,} bytes before the end of the elements after"
                f" {e.name!r} (truncated)"
            )
        if rest > 0 and not any(a.has_lists for a in after):
            self._file.seek(self._size - rest)
            if rest > 16 or self._file.read(rest).strip():
                raise FileFormatError(
                    f"{self._where}: {rest:,} bytes follow the last row that the header declares (rows of"
                    f" {e.name!r} have {row} bytes); its counts or properties do not fit the data"
                )


class FloatTable(RowReader):
    """The rows of an element as float32, binary or ASCII.

    ``names`` are the columns of each chunk: ``wanted`` ones at least, in any order. Positions are relative to
    ``origin``, (3,) float64, which is subtracted before they are rounded.
    """

    def __init__(
        self, file: BinaryIO, header: PlyHeader, element: Element, wanted: Sequence[str], where: object
    ) -> None:
        super().__init__(file, header, element, where)
        dtypes = {p.dtype for p in element.properties}
        self._common = dtypes.pop() if len(dtypes) == 1 else None
        uniform = self._common is not None or header.encoding == "ascii"
        self.names: tuple[str, ...] = element.names if uniform else tuple(wanted)
        self.origin = zero_origin()
        types = {p.dtype.newbyteorder("=") for p in element.properties if p.name in POSITION}
        self.positions_are_float32 = header.encoding != "ascii" and types == {np.dtype(np.float32)}
        """Whether the file has no more digits of positions than float32."""

    def sample(self) -> np.ndarray:
        """(k, 3) float64: about ``SAMPLE`` positions x, y, z, evenly spread over the file."""
        e = self._element
        if self._header.encoding == "ascii":
            return self._ascii_sample()
        starts, size = [0], e.count
        if e.count > SAMPLE:
            size = _SAMPLE_RUN
            starts = np.linspace(0, e.count - size, SAMPLE // size).astype(np.int64).tolist()
        rows = [self.rows(start, size) for start in starts]
        found = np.empty((size * len(rows), 3))
        for i, name in enumerate(POSITION):
            found[:, i] = np.concatenate([part[name] for part in rows])
        return found

    def _ascii_sample(self) -> np.ndarray:
        """Lines that cannot be read are left out: ``chunks`` says what is wrong with them."""
        e = self._element
        before = sum(a.count for a in self._header.elements[: self._header.elements.index(e)] if a.properties)
        lines = _data_lines(self._file, self._header, self._where)
        columns = [e.names.index(name) for name in POSITION]
        found = []
        for _, line in islice(lines, before, before + e.count, max(1, e.count // SAMPLE)):
            words = line.split()
            try:
                found.append([float(words[i]) for i in columns])
            except (ValueError, IndexError):
                continue
        return np.array(found, np.float64).reshape(-1, 3)

    def _placed(self, exact: np.ndarray, table: np.ndarray, names: Sequence[str]) -> np.ndarray:
        """``table``, float32, with the positions among its columns ``names`` relative to the origin.
        ``exact``: the same columns as stored."""
        for name, shift in zip(POSITION, self.origin, strict=True):
            if shift and name in names:
                i = names.index(name)
                column = exact[name] if exact.dtype.names else exact[:, i]
                table[:, i] = column.astype(np.float64) - shift
        return table

    def chunks(self) -> Iterator[np.ndarray]:
        """(m, len(names)) float32 tables of all rows in order; each is valid until the next one is requested.

        Values beyond the range of float32 become infinite.
        """
        return self._ascii_chunks() if self._header.encoding == "ascii" else self._binary_chunks()

    def _binary_chunks(self) -> Iterator[np.ndarray]:
        e, row = self._element, self._element.minimum_row_bytes
        per_chunk = max(1, CHUNK_BYTES // row)
        buffer = bytearray(min(per_chunk, e.count) * row)
        for start in range(0, e.count, per_chunk):
            m = min(per_chunk, e.count - start)
            self._read(start, memoryview(buffer)[: m * row])
            if self._common is not None:
                table = np.frombuffer(buffer, self._common, m * len(self.names)).reshape(m, -1)
                with np.errstate(over="ignore"):
                    yield self._placed(table, table.astype(np.float32, copy=False), self.names)
            else:
                rows = np.frombuffer(buffer, e.row_dtype, m)
                table = np.empty((m, len(self.names)), np.float32)
                with np.errstate(over="ignore"):
                    for i, name in enumerate(self.names):
                        table[:, i] = rows[name]
                    yield self._placed(rows, table, self.names)

    def _ascii_chunks(self) -> Iterator[np.ndarray]:
        e, width = self._element, len(self.names)
        lines = _data_lines(self._file, self._header, self._where)
        for before in self._header.elements[: self._header.elements.index(e)]:
            if not before.properties:
                continue
            for row in range(before.count):
                if next(lines, None) is None:
                    self._stop_short(before, row)
        per_chunk = max(1, CHUNK_BYTES // (16 * width))
        for start in range(0, e.count, per_chunk):
            wanted = min(per_chunk, e.count - start)
            batch = []
            for number, line in lines:
                batch.append((number, line))
                if len(batch) == wanted:
                    break
            if len(batch) < wanted:
                self._stop_short(e, start + len(batch))
            yield self._parse(batch, width)
        after = self._header.elements[self._header.elements.index(e) + 1 :]
        if not any(a.count for a in after) and (extra := next(lines, None)) is not None:
            raise FileFormatError(
                f"{self._where}: line {extra[0]}: text after the {e.count:,} rows of element {e.name!r}"
                " (count wrong)"
            )

    def _stop_short(self, element: Element, rows: int) -> None:
        raise FileFormatError(
            f"{self._where}: the file ends after {rows:,} of {element.count:,} rows of element"
            f" {element.name!r} (truncated or count wrong)"
        )

    def _parse(self, batch: list[tuple[int, str]], width: int) -> np.ndarray:
        """Parses one row per line; checks line by line only on failure, to name the bad one."""
        try:
            table = np.loadtxt([line for _, line in batch], np.float64, comments=None, ndmin=2)
        except ValueError:
            table = np.empty((0, 0))
        if table.shape != (len(batch), width):
            for number, line in batch:
                words = line.split()
                at = f"{self._where}: line {number}"
                if len(words) != width:
                    raise FileFormatError(f"{at}: expected {width} values, got {len(words)}")
                for name, word in zip(self._element.names, words, strict=True):
                    try:
                        np.loadtxt([word], np.float64, comments=None)
                    except ValueError:
                        raise FileFormatError(f"{at}: {name} is not a number: {word[:40]!r}") from None
            raise FileFormatError(f"{self._where}: line {batch[0][0]}: cannot read the rows from here on")
        with np.errstate(over="ignore"):
            return self._placed(table, table.astype(np.float32), self.names)


def _data_lines(file: BinaryIO, header: PlyHeader, where: object) -> Iterator[tuple[int, str]]:
    """Numbered lines after the header that are not blank, with any line ends."""
    file.seek(header.data_offset)
    number, rest = header.lines, b""
    while True:
        block = file.read(CHUNK_BYTES)
        # A CR LF pair may be split between two blocks: keep the CR for the next one.
        text = (rest + block).replace(b"\r\n", b"\n")
        held = b"\r" if block and text.endswith(b"\r") else b""
        parts = text[: len(text) - len(held)].replace(b"\r", b"\n").split(b"\n")
        rest = (parts.pop() if block else b"") + held
        if len(rest) > MAX_LINE_BYTES:
            raise FileFormatError(
                f"{where}: line {number + 1 + len(parts)} is longer than {MAX_LINE_BYTES:,} bytes"
            )
        for part in parts:
            number += 1
            if part and not part.isspace():
                yield number, part.decode("latin-1")
        if not block:
            return


def _skip_list_rows(file: BinaryIO, element: Element, offset: int, where: object) -> int:
    """Byte after the rows of an element with list properties that begin at ``offset``.

    Walks the rows in windows of the file. If the element has a single list, runs of rows of equal length (the
    usual case for faces) are skipped together.
    """
    size = file.seek(0, io.SEEK_END)
    window, base, done = b"", offset, 0
    while done < element.count:
        if len(window) - (offset - base) < CHUNK_BYTES // 2 and base + len(window) < size:
            file.seek(offset)
            window, base = file.read(CHUNK_BYTES), offset
        length = _list_row_bytes(element, window, offset - base)
        if length is None:  # its lists reach beyond the window
            length = _long_row_bytes(file, element, offset, size)
        if length is None or offset + length > size:
            raise FileFormatError(
                f"{where}: row {done:,} of element {element.name!r} at byte {offset:,} runs past the end of"
                " the file (truncated, or a wrong list length)"
            )
        run = _equal_rows(element, window, offset - base, length, element.count - done)
        offset, done = offset + run * length, done + run
    return offset


def _list_row_bytes(element: Element, window: bytes, at: int) -> int | None:
    """Bytes of the row at ``at``; None where the window ends before its last list length."""
    start = at
    for p in element.properties:
        if p.count_dtype is None:
            at += p.dtype.itemsize
            continue
        if at + p.count_dtype.itemsize > len(window):
            return None
        count = int(np.frombuffer(window, p.count_dtype, 1, at)[0])
        if count < 0:
            return None
        at += p.count_dtype.itemsize + count * p.dtype.itemsize
    return at - start


def _long_row_bytes(file: BinaryIO, element: Element, offset: int, size: int) -> int | None:
    """As ``_list_row_bytes``, seeking in the file for a row longer than a window; None past its end."""
    at = offset
    for p in element.properties:
        if p.count_dtype is None:
            at += p.dtype.itemsize
            continue
        if at + p.count_dtype.itemsize > size:
            return None
        file.seek(at)
        count = int(np.frombuffer(file.read(p.count_dtype.itemsize), p.count_dtype, 1)[0])
        if count < 0:
            return None
        at += p.count_dtype.itemsize + count * p.dtype.itemsize
    return at - offset


def _equal_rows(element: Element, window: bytes, at: int, length: int, most: int) -> int:
    """Count of rows from ``at`` on that share a list length; 1 if the element has several lists."""
    counts = [(i, p.count_dtype) for i, p in enumerate(element.properties) if p.count_dtype is not None]
    most = min(most, (len(window) - at) // length)
    if len(counts) != 1 or most <= 1:
        return 1
    index, dtype = counts[0]
    before = sum(p.dtype.itemsize for p in element.properties[:index])
    first = np.frombuffer(window, np.uint8, dtype.itemsize, at + before)
    run = 1
    while run < most:  # in doubling steps
        step = min(max(16, run), most - run)
        rows = np.frombuffer(window, np.uint8, step * length, at + run * length).reshape(step, length)
        same = (rows[:, before : before + dtype.itemsize] == first).all(axis=1)
        if not same.all():
            return run + int(same.argmin())
        run += step
    return run
