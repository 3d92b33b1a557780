"""The table of mesh formats: whatever depends on which formats there are, follows from it.

A new format is one module, with a ``CODEC``, and one line in ``MESH_FORMATS``. The modules are imported when
they are first used, so that names alone cost nothing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib import import_module
from pathlib import PurePath
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pathlib import Path

    import numpy as np

    from meshsplats.formats.content import Content
    from meshsplats.scene.mesh import SplatMesh


@dataclass(frozen=True)
class FileSize:
    """What the size of a file is estimated from."""

    mesh: SplatMesh
    suffix: str
    held: int
    """Bytes of the arrays that the format stores beyond positions, colours and triangles."""
    compressed: bool
    copies: bool
    """Whether all triangles are listed twice."""


@dataclass(frozen=True)
class MeshCodec:
    """What the module of a mesh format offers."""

    matches: Callable[[Content], bool]
    """Whether the content is of this format, by its first bytes; ``read`` may still refuse it."""
    read: Callable[[Path, np.ndarray | None], SplatMesh]
    """The mesh in a file, relative to an origin or to one of its own choice."""
    write: Callable[..., None]
    """Writes a mesh to a file, with the options of ``save_mesh`` that the format ``takes``."""
    expected_bytes: Callable[[FileSize], int]
    """Estimated size of a file, for the message about a full disk."""


@dataclass(frozen=True)
class MeshFormat:
    """A format of mesh files."""

    name: str
    suffixes: tuple[str, ...]
    """How names of its files end; others may share them. The content decides when a file is read."""
    module: str
    """The module below ``meshsplats.formats`` that holds its ``CODEC``."""
    written: tuple[str, ...]
    """Suffixes of the files that are written."""
    written_as: str
    """For the table in docs/files.md."""
    own: bool = False
    """Whether files are for this project, which renders with a low-pass filter, and keep every array exactly;
    else they are for other programs."""
    keeps: tuple[str, ...] = ()
    """What is read again of 'binding' and 'harmonics'."""
    takes: tuple[str, ...] = ()
    """Which options of ``save_mesh`` have a meaning for it."""

    @cached_property
    def codec(self) -> MeshCodec:
        """What reads and writes its files."""
        found: MeshCodec = import_module(f"meshsplats.formats.{self.module}").CODEC
        return found


MESH_FORMATS: tuple[MeshFormat, ...] = (
    MeshFormat(
        "npz", (".npz",), "npz", (".npz",), "`.npz` (exact)", own=True, keeps=("binding", "harmonics")
    ),
    MeshFormat("ply", (".ply",), "ply.mesh", (".ply",), "`.ply` (exact)", own=True, keeps=("harmonics",)),
    MeshFormat(
        "gltf",
        (".glb", ".gltf"),
        "gltf.mesh",
        (".glb",),
        "`.glb` (linear colours of 16 bits, [harmonics](viewers.md#view-dependent-colours) of 8;"
        " unlit, or lit with `--lit`)",
        keeps=("binding", "harmonics"),
        takes=("lit", "color_type", "alpha", "compression", "order", "harmonics"),
    ),
    MeshFormat(
        "usd",
        (".usdc", ".usda", ".usd", ".usdz"),
        "usd.mesh",
        (".usdc", ".usda", ".usd"),
        "`.usdc`, `.usda`, `.usd` (linear colours, harmonics; unlit, or lit with `--lit`)",
        keeps=("harmonics",),
        takes=("lit",),
    ),
    MeshFormat("obj", (".obj",), "obj.mesh", (".obj",), "`.obj` (without opacity and harmonics)"),
)
"""The formats, in the order of the documents. The first one that matches a file counts."""


def mesh_format(content: Content) -> MeshFormat | None:
    """The format of a file; None if it is of none."""
    return next((kind for kind in MESH_FORMATS if kind.codec.matches(content)), None)


def mesh_format_to_write(name: str | PurePath) -> MeshFormat | None:
    """The format that the ``name`` of a file asks for; None if no mesh is written so."""
    suffix = PurePath(name).suffix.lower()
    return next((kind for kind in MESH_FORMATS if suffix in kind.written), None)


def mesh_suffixes() -> tuple[str, ...]:
    """How the names of mesh files end, wherever names decide: which files of a folder are read."""
    return tuple(suffix for kind in MESH_FORMATS for suffix in kind.suffixes)


def written_mesh_suffixes(option: str | None = None) -> tuple[str, ...]:
    """How the names of mesh files that can be written end; of those that take an ``option`` of ``save_mesh``,
    if one is given."""
    kinds = [kind for kind in MESH_FORMATS if option is None or option in kind.takes]
    return tuple(suffix for kind in kinds for suffix in kind.written)


def takes(name: str | PurePath, option: str) -> bool:
    """Whether a mesh that is written to the file ``name`` takes this option of ``save_mesh``."""
    kind = mesh_format_to_write(name)
    return kind is not None and option in kind.takes


def keeps(name: str | PurePath, part: str) -> bool:
    """Whether a mesh that is written to the file ``name`` has this ``part`` when it is read again."""
    kind = mesh_format_to_write(name)
    return kind is not None and part in kind.keeps


def formats_in_words() -> str:
    """For the help of commands: '.npz or .ply, which keep everything; .glb, .usdc, .obj'."""
    own = " or ".join(kind.written[0] for kind in MESH_FORMATS if kind.own)
    return f"{own}, which keep everything; {', '.join(k.written[0] for k in MESH_FORMATS if not k.own)}"
