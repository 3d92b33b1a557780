"""The header of a PLY file: its elements, the layout of their rows, and where the data begin.

PLY is "The Polygon File Format" of Greg Turk, Stanford 1994. Lines end in LF, CR LF or CR; `comment` and
`obj_info` lines may stand anywhere. Nothing is allocated by a count in the header.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import BinaryIO, Literal

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.scene.origin import in_words

Encoding = Literal["ascii", "binary_little_endian", "binary_big_endian"]

MAX_HEADER_BYTES = 1 << 20
"""A header longer than this is refused; real ones have a few kilobytes."""
MAX_PROPERTIES = 4096
"""Most properties of an element."""
MAX_ELEMENTS = 256
MAX_COUNT_DIGITS = 15
"""No real file has a count of more digits."""

_DTYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "int64": "i8",
    "uint64": "u8",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}


_END = re.compile(rb"[\r\n][ \t]*end_header[ \t]*(\r\n|\n|\r[^\n])")


@dataclass(frozen=True)
class Property:
    """One column of an element."""

    name: str
    dtype: np.dtype
    """Type of the value, or of the items of a list; byte order as in the file (native for ASCII)."""
    count_dtype: np.dtype | None = None
    """Type of the length that precedes a list; None for a single value."""

    @property
    def is_list(self) -> bool:
        return self.count_dtype is not None


@dataclass(frozen=True)
class Element:
    """A table of the file: ``count`` rows of ``properties``."""

    name: str
    count: int
    properties: tuple[Property, ...]
    line: int
    """Line of the header that declares it, from 1."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the properties in file order."""
        return tuple(p.name for p in self.properties)

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(p.is_list for p in self.properties)

    @property
    def row_dtype(self) -> np.dtype:
        """Packed structured dtype of one binary row. ValueError for an element with lists."""
        if self.has_lists:
            raise ValueError(f"element {self.name!r} has list properties, its rows have no fixed size")
        return np.dtype([(p.name, p.dtype) for p in self.properties])

    @property
    def minimum_row_bytes(self) -> int:
        """Bytes of a binary row whose lists are all empty."""
        return sum(
            p.dtype.itemsize if p.count_dtype is None else p.count_dtype.itemsize for p in self.properties
        )


@dataclass(frozen=True)
class PlyHeader:
    """A parsed header; the data begin at byte ``data_offset``, in the order of ``elements``."""

    encoding: Encoding
    elements: tuple[Element, ...]
    data_offset: int
    lines: int
    """Count of header lines: the first line of ASCII data is ``lines + 1``."""
    comments: tuple[str, ...]
    obj_info: tuple[str, ...]

    def element(self, name: str) -> Element | None:
        """The element of that name, or None."""
        return next((e for e in self.elements if e.name == name), None)


def read_header(file: BinaryIO, where: object) -> PlyHeader:
    """Header of a binary file object positioned at the start; ``where`` names the file in errors.

    The position afterwards is undefined: seek to ``data_offset``. Raises FileFormatError.
    """
    head = file.read(8192)
    while not _END.search(head) and len(head) < MAX_HEADER_BYTES:
        more = file.read(8 * len(head))
        if not more:
            break
        head += more
    return parse_header(head, where)


def parse_header(head: bytes, where: object) -> PlyHeader:
    """Header held in the first bytes of a PLY file; what follows the header is ignored.

    ``where`` (the path) starts each message. Raises FileFormatError naming the line.
    """
    if not re.match(rb"ply[ \t]*[\r\n]", head):
        raise FileFormatError(
            f"{where}: not a PLY file, it begins with {head[:8]!r} and not with the line 'ply'"
        )
    newline = _line_end(head)
    encoding: Encoding | None = None
    elements: list[_Draft] = []
    comments: list[str] = []
    obj_info: list[str] = []
    number, start = 1, head.index(newline) + len(newline)
    while True:
        number += 1
        end = head.find(newline, start, MAX_HEADER_BYTES)
        if end < 0 and head[start:].strip() == b"end_header":
            end = len(head)  # a file of empty elements may end without a line end
        if end < 0:
            limit = "" if len(head) < MAX_HEADER_BYTES else f" in its first {MAX_HEADER_BYTES} bytes"
            raise FileFormatError(
                f"{where}: the PLY header has no 'end_header' line{limit} (truncated after line {number - 1})"
            )
        line = head[start:end].decode("utf-8", "replace").strip()
        start = min(end + len(newline), len(head))
        words = line.split()
        at = f"{where}: line {number}"
        keyword = words[0] if words else "comment"
        if keyword == "comment":
            comments.append(line[len("comment") :].strip())
        elif keyword == "obj_info":
            obj_info.append(line[len("obj_info") :].strip())
        elif keyword == "end_header":
            break
        elif keyword == "format":
            if encoding is not None:
                raise FileFormatError(f"{at}: a second 'format' line")
            encoding = _parse_format(words, at)
        elif encoding is None:
            raise FileFormatError(f"{at}: expected the 'format' line first, got {_quote(line)}")
        elif keyword == "element":
            elements.append(_parse_element(words, at, number))
            if any(e.name == elements[-1].name for e in elements[:-1]):
                raise FileFormatError(f"{at}: element {_quote(words[1])} is declared twice")
            if len(elements) > MAX_ELEMENTS:
                raise FileFormatError(f"{at}: more than {MAX_ELEMENTS} elements")
        elif keyword == "property":
            if not elements:
                raise FileFormatError(f"{at}: a property before the first element")
            _add_property(elements[-1], words, at, encoding)
        else:
            raise FileFormatError(f"{at}: not a PLY header line: {_quote(line)}")
    if encoding is None:
        raise FileFormatError(f"{where}: the PLY header has no 'format' line")
    return PlyHeader(
        encoding=encoding,
        elements=tuple(Element(e.name, e.count, tuple(e.properties.values()), e.line) for e in elements),
        data_offset=start,
        lines=number,
        comments=tuple(comments),
        obj_info=tuple(obj_info),
    )


@dataclass
class _Draft:
    """An element while its properties are being read; a dictionary finds repeated names."""

    name: str
    count: int
    line: int
    properties: dict[str, Property]


def _line_end(head: bytes) -> bytes:
    """The line end of the first line. CR LF counts as LF: the CR is stripped with the blanks."""
    first = min(i for i in (head.find(b"\n"), head.find(b"\r")) if i >= 0)
    return b"\n" if head[first : first + 1] == b"\n" or head[first : first + 2] == b"\r\n" else b"\r"


def _quote(text: str) -> str:
    """Text of an untrusted file for a message: short and printable."""
    return repr(text if len(text) <= 60 else text[:57] + "...")


def _parse_format(words: list[str], at: str) -> Encoding:
    known: tuple[Encoding, ...] = ("ascii", "binary_little_endian", "binary_big_endian")
    for encoding in known:
        if words[1:] == [encoding, "1.0"]:
            return encoding
    got = _quote(" ".join(words[1:]))
    raise FileFormatError(
        f"{at}: unknown PLY format {got}, known are {', '.join(known)}, each in version 1.0"
    )


def _parse_element(words: list[str], at: str, number: int) -> _Draft:
    if len(words) != 3:
        raise FileFormatError(f"{at}: expected 'element NAME COUNT', got {_quote(' '.join(words))}")
    name, count = words[1:]
    # Digits only: int() alone would take '+5', '1_000' and the digits of other scripts.
    if not (count.isascii() and count.isdecimal() and len(count) <= MAX_COUNT_DIGITS):
        raise FileFormatError(
            f"{at}: the count of element {_quote(name)} must be a whole number >= 0, got {_quote(count)}"
        )
    return _Draft(name, int(count), number, {})


def _add_property(element: _Draft, words: list[str], at: str, encoding: Encoding) -> None:
    order: Literal["<", ">", "="] = (
        ">" if encoding == "binary_big_endian" else "<" if encoding == "binary_little_endian" else "="
    )

    def dtype(name: str) -> np.dtype:
        if name not in _DTYPES:
            raise FileFormatError(f"{at}: unknown property type {_quote(name)}")
        return np.dtype(_DTYPES[name]).newbyteorder(order)

    if len(words) == 5 and words[1] == "list":
        new = Property(words[4], dtype(words[3]), dtype(words[2]))
        if new.count_dtype is not None and new.count_dtype.kind == "f":
            raise FileFormatError(
                f"{at}: the length of a list must have an integer type, got {_quote(words[2])}"
            )
    elif len(words) == 3:
        new = Property(words[2], dtype(words[1]))
    else:
        expected = "'property TYPE NAME' or 'property list COUNT_TYPE TYPE NAME'"
        raise FileFormatError(f"{at}: expected {expected}, got {_quote(' '.join(words))}")
    if new.name in element.properties:
        raise FileFormatError(f"{at}: element {_quote(element.name)} has property {_quote(new.name)} twice")
    if len(element.properties) >= MAX_PROPERTIES:
        raise FileFormatError(
            f"{at}: element {_quote(element.name)} has more than {MAX_PROPERTIES} properties"
        )
    element.properties[new.name] = new


def origin_comments(origin: np.ndarray) -> list[str]:
    """The header lines that name ``origin`` (3,); none for zeros."""
    return [f"comment meshsplats origin {in_words(origin)}"] if origin.any() else []


def origin_of_comments(comments: tuple[str, ...], where: object) -> np.ndarray | None:
    """The origin that a comment of ours names; None without one. Raises FileFormatError."""
    for comment in comments:
        words = comment.split()
        if words[:2] == ["meshsplats", "origin"]:
            try:
                origin = np.array([float(word) for word in words[2:]])
            except ValueError:
                origin = np.empty(0)
            if origin.shape != (3,) or not np.isfinite(origin).all():
                raise FileFormatError(f"{where}: an origin must be 3 finite numbers: {comment[:80]}")
            return origin
    return None
