""".ksplat: the format of the three.js viewer GaussianSplats3D (mkkellogg, MIT), compression levels 0 to 2.

A header of 4096 bytes, a header of 1024 bytes for each section, and the sections: sizes of the buckets that
are not full, centres of the buckets, records. Level 0 has floats, levels 1 and 2 half floats and positions of
16 bits around the centre of a bucket; harmonics are floats, half floats or bytes. There is no mark; a file is
recognised by its name, or by headers that add up to its length.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from functools import partial
from typing import BinaryIO, NamedTuple

import numpy as np

from meshsplats.errors import FileFormatError
from meshsplats.formats.content import Content
from meshsplats.formats.reading import FormatReader, Reading
from meshsplats.formats.splats._cloud_builder import Fill, SplatReader, SplatRows
from meshsplats.scene.gaussians import constant_harmonics
from meshsplats.scene.origin import SAMPLE

_HEADER, _SECTION = 4096, 1024
_AT_ONCE = 1 << 16
_SCALE_RANGE = (1, 32767, 32767)
"""Steps of a position from the centre of a bucket to its border, by level, where a section names none."""
_REST = (0, 3, 8, 15)
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
"""Of positions, of scales and rotations, and of harmonics, by level."""
_FARTHEST_HARMONIC = 1.5
"""Of level 2, where the header names no range."""


class _Header(NamedTuple):
    sections: int
    splats: int
    level: int
    harmonics: tuple[float, float]
    """Values of the bytes 0 and 255."""


class _Section(NamedTuple):
    """Where the parts of a section lie in the file, and how to read them."""

    splats: int
    record: np.dtype
    degree: int
    capacity: int
    """Splats in a full bucket."""
    full: int
    """Count of full buckets, the first ones."""
    partial_at: int
    partials: int
    """Place and count of the sizes of the other buckets."""
    buckets: int
    bucket_bytes: int
    step: float
    """Of positions."""
    steps: int
    """From the centre of a bucket to its border."""
    end: int
    """Where the next section begins."""

    @property
    def centers_at(self) -> int:
        return self.partial_at + 4 * self.partials

    @property
    def records_at(self) -> int:
        return self.centers_at + self.bucket_bytes * self.buckets


def _matches(content: Content) -> bool:
    """Whether it is named so, or its headers promise exactly the bytes that it has."""
    if content.name.endswith(".ksplat"):
        return True
    if content.head[:1] != b"\0" or len(content.head) < _HEADER:
        return False
    try:
        with content.open() as file:
            length = file.seek(0, io.SEEK_END)
            sections = _sections(file, _header(file, content.path, length), content.path, length)
    except FileFormatError:
        return False
    return bool(sections) and sections[-1].end == length


def _open(content: Content, file: BinaryIO, _: Reading) -> SplatReader:
    """The splats of an opened file; errors as ``load_gaussians``."""
    where = content.path
    length = file.seek(0, io.SEEK_END)
    header = _header(file, where, length)
    sections = _sections(file, header, where, length)
    count = sum(section.splats for section in sections)
    if count != header.splats:
        raise FileFormatError(
            f"{where}: its sections hold {count:,} splats, its header says {header.splats:,}"
        )
    degree = max((section.degree for section in sections), default=0)
    chunks = partial(_chunks, file, sections, header, where)
    positions = partial(_sample, file, sections, where)
    return SplatReader(count, (degree + 1) ** 2, "3dgs", where, chunks, positions, float32=header.level == 0)


def _header(file: BinaryIO, where: object, length: int) -> _Header:
    raw = _bytes(file, 0, 44, where)
    major, minor, sections, splats, level, low, high = struct.unpack("<BB2xI8xIH14xff", raw)
    if (major, minor) != (0, 1):
        raise FileFormatError(f"{where}: .ksplat of version {major}.{minor}; known is 0.1")
    if level >= len(_TYPES):
        raise FileFormatError(f"{where}: .ksplat of compression level {level}; known are 0 to 2")
    if length < _HEADER + _SECTION * sections:
        raise FileFormatError(
            f"{where}: headers of {sections:,} sections take {_HEADER + _SECTION * sections:,} bytes, the"
            f" file has {length:,} (truncated?)"
        )
    if not (np.isfinite(low) and np.isfinite(high)):
        raise FileFormatError(f"{where}: a range of harmonics that is not finite")
    return _Header(sections, splats, level, (low or -_FARTHEST_HARMONIC, high or _FARTHEST_HARMONIC))


def _sections(file: BinaryIO, header: _Header, where: object, length: int) -> list[_Section]:
    """The sections that hold splats. FileFormatError if one does not fit the file."""
    found = []
    at = _HEADER + _SECTION * header.sections
    for i in range(header.sections):
        raw = _bytes(file, _HEADER + _SECTION * i, 42, where)
        splats, room, capacity, buckets, block, bucket_bytes, steps, full, partials, degree = struct.unpack(
            "<4IfH2xI4xIIH", raw
        )
        if degree >= len(_REST):
            raise FileFormatError(f"{where}: section {i} has harmonics of degree {degree}, expected 0 to 3")
        position, half, rest = _TYPES[header.level]
        record = np.dtype(
            [
                ("position", position, 3),
                ("scale", half, 3),
                ("rotation", half, 4),
                ("color", "u1", 4),
                ("sh", rest, 3 * _REST[degree]),
            ]
        )
        steps = steps or _SCALE_RANGE[header.level]
        step = block / 2 / steps
        section = _Section(
            *(splats, record, degree, capacity, full, at, partials, buckets, bucket_bytes, step, steps),
            end=at + 4 * partials + bucket_bytes * buckets + record.itemsize * room,
        )
        packed = header.level > 0
        fits = splats <= room and section.end <= length and full * capacity <= max(room, splats)
        if not fits or (packed and splats and (bucket_bytes != 12 or not np.isfinite(step) or not buckets)):
            raise FileFormatError(
                f"{where}: section {i} of {splats:,} splats in {buckets:,} buckets does not fit the file of"
                f" {length:,} bytes (truncated?)"
            )
        at = section.end
        if splats:
            found.append(section)
    return found


def _bytes(file: BinaryIO, at: int, count: int, where: object) -> bytes:
    file.seek(at)
    found = file.read(count)
    if len(found) < count:
        raise FileFormatError(f"{where}: truncated: {count} bytes are needed at {at:,}")
    return found


def _bucket_of(file: BinaryIO, section: _Section, where: object) -> np.ndarray:
    """(n,) the bucket that each splat of the section lies in."""
    whole = min(section.full * section.capacity, section.splats)
    sizes = np.frombuffer(_bytes(file, section.partial_at, 4 * section.partials, where), "<u4")
    ends = np.cumsum(sizes, dtype=np.uint64)
    left = np.searchsorted(ends, np.arange(section.splats - whole), side="right")
    first = np.arange(whole) // max(section.capacity, 1)
    bucket = np.concatenate([first, section.full + left]).astype(np.int64)
    if len(bucket) and bucket.max() >= section.buckets:
        raise FileFormatError(
            f"{where}: splats of bucket {bucket.max():,}, where there are {section.buckets:,}"
        )
    return bucket


def _parts(
    file: BinaryIO, sections: list[_Section], where: object
) -> Iterator[tuple[_Section, np.ndarray, np.ndarray]]:
    """Records of each part of a section, and their positions (m, 3) float64."""
    for section in sections:
        packed = section.record["position"].base.kind == "u"
        centers, bucket = np.empty((0, 3)), np.empty(0, np.int64)
        if packed:
            raw = _bytes(file, section.centers_at, 12 * section.buckets, where)
            centers = np.frombuffer(raw, "<f4").reshape(-1, 3).astype(np.float64)
            bucket = _bucket_of(file, section, where)
        for start in range(0, section.splats, _AT_ONCE):
            m = min(_AT_ONCE, section.splats - start)
            size = section.record.itemsize
            records = np.frombuffer(
                _bytes(file, section.records_at + size * start, size * m, where), section.record
            )
            places = records["position"].astype(np.float64)
            if packed:
                places = (places - section.steps) * section.step + centers[bucket[start : start + m]]
            yield section, records, places


def _sample(file: BinaryIO, sections: list[_Section], where: object) -> np.ndarray:
    """(k, 3) every so many-th position."""
    step = max(1, sum(section.splats for section in sections) // SAMPLE)
    parts = [places[::step].copy() for _, _, places in _parts(file, sections, where)]
    return np.concatenate([np.empty((0, 3)), *parts])


def _chunks(
    file: BinaryIO, sections: list[_Section], header: _Header, where: object, origin: np.ndarray
) -> Iterator[tuple[int, Fill]]:
    for section, records, places in _parts(file, sections, where):
        yield len(records), partial(_fill, records, places - origin, section.degree, header)


def _fill(records: np.ndarray, places: np.ndarray, degree: int, header: _Header, rows: SplatRows) -> None:
    rows.means[:] = places
    scales = records["scale"].astype(np.float32)
    rows.scales[:] = np.where(scales < 0, np.nan, scales)  # no deviation is negative
    rows.quaternions[:] = records["rotation"]
    color = records["color"] / np.float32(255)
    rows.opacities[:] = color[:, 3]
    rows.sh[:, 0] = constant_harmonics(color[:, :3])
    rows.sh[:, 1:] = 0
    stored = records["sh"].astype(np.float32)
    if records["sh"].dtype.kind == "u":
        low, high = header.harmonics
        stored = np.float32(low) + stored / np.float32(255) * np.float32(high - low)
    first = 0
    for band in range(1, degree + 1):
        # All of red first, then green and blue, band by band.
        width = 2 * band + 1
        values = stored[:, first : first + 3 * width].reshape(-1, 3, width)
        rows.sh[:, band * band : (band + 1) ** 2] = values.transpose(0, 2, 1)
        first += 3 * width


READER = FormatReader(_matches, _open)
