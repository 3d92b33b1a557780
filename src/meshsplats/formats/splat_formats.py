"""The table of splat formats: whatever depends on which formats there are, follows from it.

A new format is one module, with a ``READER`` (``reading.FormatReader``), and one line in ``FORMATS``. The
modules are imported when they are first used, so that names alone cost nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from meshsplats.formats.reading import FormatReader
    from meshsplats.formats.writing import FormatWriter


@dataclass(frozen=True)
class SplatFormat:
    """A format of splat files."""

    name: str
    """As ``info`` and messages say it."""
    suffixes: tuple[str, ...]
    """How names of its files end; others may share them. The content decides when a file is read."""
    module: str
    """The module below ``meshsplats.formats`` that holds its ``READER``."""
    description: str
    """For the table in docs/files.md."""
    in_memory: str
    """What of a file is in memory while it is read in blocks; for the table in docs/tiles.md."""
    zipped: tuple[str, ...] = ()
    """Suffixes that are looked for in zip archives."""
    folder_file: str = ""
    """Name of the file that a folder of this format is read by."""
    y_up: bool = False
    """Whether y points up in its files; ``half_turn`` then leads to y down."""
    half_turn: Literal["x", "z"] = "x"
    """Axis of the half turn from y up to y down."""
    takes: tuple[str, ...] = ()
    """Which of the options 'time' and 'activated' of ``load_gaussians`` have a meaning for it."""
    has_signature: bool = True
    """False: files without a mark, which are tried last."""
    writer_module: str = ""
    """The module below ``meshsplats.formats`` that holds its ``WRITER``; empty: it is not written."""
    written: tuple[str, ...] = ()
    """Suffixes of the files that are written."""
    written_as: str = ""
    """For the table in docs/files.md."""

    @cached_property
    def reader(self) -> FormatReader:
        """What reads its files."""
        found: FormatReader = import_module(f"meshsplats.formats.{self.module}").READER
        return found

    @cached_property
    def writer(self) -> FormatWriter:
        """What writes its files, if it is written."""
        found: FormatWriter = import_module(f"meshsplats.formats.{self.writer_module}").WRITER
        return found


FORMATS: tuple[SplatFormat, ...] = (
    SplatFormat(
        "ply",
        (".ply", ".ply.gz"),
        "ply.splats",
        "float `.ply` of 3DGS, 2DGS, SuGaR, GaMeS-flat, Mip-Splatting and others: any property order,"
        " spherical harmonics of degree 0 to 3, ASCII or binary of either byte order, also gzipped; Spacetime"
        " and 4D Gaussians at one instant",
        "a block",
        zipped=(".ply",),
        takes=("activated", "time"),
        writer_module="ply.splats",
        written=(".ply",),
        written_as="`.ply` as the 3DGS code lays it out",
    ),
    SplatFormat(
        "compressed.ply",
        (".compressed.ply", ".compressed.ply.gz"),
        "ply.compressed_splats",
        "PlayCanvas compressed `.ply`",
        "a block",
        zipped=(".ply",),
        writer_module="ply.compressed_writer",
        written=(".compressed.ply",),
        written_as="`.compressed.ply`",
    ),
    SplatFormat(
        "ksplat",
        (".ksplat",),
        "splats.ksplat",
        "`.ksplat`",
        "a block",
        has_signature=False,
    ),
    SplatFormat(
        "splat",
        (".splat",),
        "splats.dot_splat",
        "`.splat`",
        "a block",
        zipped=(".splat",),
        has_signature=False,
        writer_module="splats.dot_splat",
        written=(".splat",),
        written_as="`.splat`",
    ),
    SplatFormat(
        "spz",
        (".spz",),
        "splats.spz",
        "SPZ",
        "a block; attributes lie one after the other and are unpacked side by side, in versions 1 to 3 twice",
        zipped=(".spz",),
        y_up=True,
        writer_module="splats.spz_writer",
        written=(".spz",),
        written_as="`.spz` (versions 3 and 4)",
    ),
    SplatFormat(
        "sog",
        (".sog",),
        "splats.sog",
        "SOG",
        "24 bytes a splat: an image can only be unpacked as a whole",
        folder_file="meta.json",
        writer_module="splats.sog_writer",
        written=(".sog",),
        written_as="`.sog`",
    ),
    SplatFormat(
        "streamed sog",
        (),
        "splats.streamed_sog",
        "streamed SOG (`lod-meta.json`, the finest level)",
        "one part at a time",
        folder_file="lod-meta.json",
    ),
    SplatFormat(
        "lcc",
        (".lcc",),
        "splats.lcc",
        "LCC of XGRIDS (the finest level)",
        "a block",
        folder_file="meta.lcc",
    ),
    SplatFormat(
        "3d tiles",
        (),
        "gltf.splat_tilesets",
        "3D Tiles of splats (`tileset.json`, the finest tiles)",
        "one tile at a time",
        folder_file="tileset.json",
    ),
    SplatFormat(
        "gltf",
        (".glb", ".gltf"),
        "gltf.splats",
        "glTF with KHR_gaussian_splatting",
        "the whole file",
        y_up=True,
        half_turn="z",
        writer_module="gltf.splats_writer",
        written=(".glb",),
        written_as="`.glb` with KHR_gaussian_splatting",
    ),
    SplatFormat(
        "usd",
        (".usdc", ".usda", ".usd", ".usdz"),
        "usd.splats",
        "USD with ParticleField3DGaussianSplat",
        "the whole file",
        y_up=True,
        writer_module="usd.splats_writer",
        written=(".usdc", ".usda", ".usd", ".usdz"),
        written_as="`.usdc`, `.usda`, `.usdz` with ParticleField3DGaussianSplat",
    ),
)
"""The formats, in the order of the documents. The first one that matches a file counts."""


def splat_suffixes() -> tuple[str, ...]:
    """How the names of splat files end, wherever names decide: which files of a folder are read."""
    return _shortest([suffix for format_ in FORMATS for suffix in format_.suffixes])


def written_suffixes() -> tuple[str, ...]:
    """How the names of splat files that can be written end."""
    return tuple(suffix for format_ in FORMATS for suffix in format_.written)


def format_to_write(name: str) -> SplatFormat | None:
    """The format that the ``name`` of a file asks for, by the longest suffix; None if none is written so."""
    found = [(suffix, f) for f in FORMATS for suffix in f.written if name.lower().endswith(suffix)]
    return max(found, key=lambda pair: len(pair[0]))[1] if found else None


def written_ending(name: str) -> str:
    """The ending of the ``name`` of a file without its first dot, of two parts where a format has two:
    'compressed.ply'."""
    suffixes = [s for s in written_suffixes() if name.lower().endswith(s)]
    return max(suffixes, key=len, default="." + name.lower().rpartition(".")[2])[1:]


def taken_by(option: str) -> str:
    """The suffixes of the formats that take an ``option`` of ``save_gaussians``, in words."""
    return listed(tuple(s for f in FORMATS if f.written and option in f.writer.takes for s in f.written))


def zipped_suffixes() -> tuple[str, ...]:
    """How the names of splat files in zip archives end."""
    return _shortest([suffix for format_ in FORMATS for suffix in format_.zipped])


def double_suffixes() -> tuple[str, ...]:
    """Suffixes of two or more parts, such as '.ply.gz'."""
    return tuple(suffix for format_ in FORMATS for suffix in format_.suffixes if suffix.count(".") > 1)


def folder_files() -> tuple[str, ...]:
    """Names of the files that folders are read by."""
    return tuple(format_.folder_file for format_ in FORMATS if format_.folder_file)


def listed(suffixes: tuple[str, ...], last: str = "or") -> str:
    """'.ply, .spz or .splat'."""
    return f"{', '.join(suffixes[:-1])} {last} {suffixes[-1]}" if len(suffixes) > 1 else "".join(suffixes)


def y_up_suffixes() -> tuple[str, ...]:
    """Suffixes of the formats whose y axis points up."""
    return tuple(suffix for format_ in FORMATS if format_.y_up for suffix in format_.suffixes)


def _shortest(suffixes: list[str]) -> tuple[str, ...]:
    """``suffixes`` without repetitions and without those that end in another one."""
    found = dict.fromkeys(suffixes)
    return tuple(s for s in found if not any(s != other and s.endswith(other) for other in found))
