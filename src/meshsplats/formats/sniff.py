"""Recognises files by their content, for all readers."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from meshsplats._common.foreign import foreign, foreign_archive
from meshsplats._common.words import command_line
from meshsplats.errors import FileFormatError
from meshsplats.formats import splat_formats
from meshsplats.formats.content import Container, Content
from meshsplats.formats.mesh_formats import mesh_format
from meshsplats.formats.splat_formats import SplatFormat, listed, zipped_suffixes
from meshsplats.formats.splat_paths import files_named

_UNREAD: dict[Container | None, str] = {
    "gzip": "a gzip file, but not SPZ; unpack it first",
    "lfs": "a Git LFS pointer, not the file itself, which 'git lfs pull' brings",
}
_SPLATV = b"\x4b\x67\0\0"


class UnreadSplats(FileFormatError):
    """Splats of a known kind that is not read, or a file in their place, such as a Git LFS pointer."""


def content_of(path: Path) -> Content:
    """The content of a file; of a zip archive with a single file of splats, that of this file. To be closed.

    Raises UnreadSplats if there are several in the archive.
    """
    content = Content(path)
    try:
        found = _members(content) if content.is_archive else []
        if len(found) > 1:
            some = ", ".join(found[:4]) + (", ..." if len(found) > 4 else "")
            raise UnreadSplats(
                f"{path}: {len(found)} files of splats in one archive ({some}): unpack it, and give one"
            )
        return content.inside(found[0]) if found else content
    except BaseException:
        content.close()
        raise


def _members(content: Content) -> list[str]:
    """The files with splats in a zip archive; none if it is of a format of its own."""
    try:
        archive = content.archive
    except FileFormatError:  # broken: the reader says so
        return []
    if archive.is_sog or content.name.endswith(".usdz"):
        return []
    return [name for name in archive.named(zipped_suffixes()) if _is_splats(content.inside(name))]


def _is_splats(content: Content) -> bool:
    """Whether a file in an archive is splats, or so broken that only its reader can tell."""
    for kind in splat_formats.FORMATS:
        if kind.zipped and (kind.has_signature or content.name.endswith(kind.zipped)):
            try:
                if kind.reader.matches(content) and kind.reader.holds_splats(content):
                    return True
            except FileFormatError:
                return True
    return False


def splat_format(content: Content) -> SplatFormat:
    """The splat format of ``content``; its reader may still refuse it, or find a mesh.

    Raises:
        UnreadSplats: the kind is known, but not read.
        FileFormatError: the file is something else; the message says what, if that is clear.
    """
    content.refuse_empty()
    for kind in splat_formats.FORMATS:
        if kind.has_signature and kind.reader.matches(content):
            return kind
    if content.is_archive:
        raise _archive_refusal(content)
    if what := _unread(content):
        raise UnreadSplats(f"{content.path}: {what}")
    if content.container == "json":
        raise FileFormatError(
            f"{content.path}: a JSON file that is neither SOG nor glTF; expected {_expected()}"
        )
    for kind in splat_formats.FORMATS:
        if not kind.has_signature and kind.reader.matches(content):
            return kind
    raise _refusal(content)


def _archive_refusal(content: Content) -> FileFormatError:
    """The error for a zip archive in which nothing is read."""
    names = content.archive.names
    if packed := content.archive.named((".sog",)):
        return UnreadSplats(
            f"{content.path}: a zip archive with {packed[0][:200]!r} in it: unpack it, and give that"
        )
    if what := foreign_archive(content.path, names):
        return FileFormatError(f"{content.path}: {what}")
    found = ", ".join(sorted(names)[:5])[:200] or "nothing"
    return FileFormatError(
        f"{content.path}: a zip archive without meta.json is no SOG file, and no"
        f" {listed(zipped_suffixes())} is in it (it holds {found})"
    )


def _expected() -> str:
    return f"a file of splats ({listed(splat_formats.splat_suffixes())})"


def _unread(content: Content) -> str:
    """What splats are of a known format that is not read, and what to do with them; empty for others."""
    path, text = content.path, content.json_text
    command = command_line(["npx", "@playcanvas/splat-transform", path.name, f"{path.stem}.ply"])
    convert = f"convert it first: {command}"
    if content.head[:4] == _SPLATV or content.name.endswith(".splatv"):
        return (
            ".splatv files, of splats that move, are not read here; the .ply that they are made of is"
            " (Spacetime Gaussians)"
        )
    if text and content.name.endswith((".lcc", ".lcc2")):
        return f"LCC2 scenes are not read here; {convert}"
    return ""


def _refusal(content: Content) -> FileFormatError:
    """The error for a file that is of no splat format."""
    path = content.path
    if content.name.endswith(".splat"):
        return UnreadSplats(
            f"{path}: named .splat, but not records of 32 bytes of splats: position, positive scales,"
            f" colour and rotation (it has {path.stat().st_size:,} bytes)"
        )
    if content.container == "html":
        return UnreadSplats(f"{path}: {_page(path)}")
    if content.container in _UNREAD:
        return UnreadSplats(f"{path}: {_UNREAD[content.container]}")
    if not content.is_obj and (what := foreign(path, content.head)):
        return UnreadSplats(f"{path}: {what}")
    return FileFormatError(
        f"{path}: not a splat file of a known format, it begins with {content.head[:8]!r};"
        f" expected {_expected()}"
    )


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

    Some kinds of file may hold either splats or a mesh: .ply, .glb and .gltf, and zip archives (.sog, .npz).
    """
    if path.is_dir():
        return "splats"
    with content_of(path) as content:
        if content.member is None and content.is_archive and _holds_arrays(content):
            return "mesh"
        try:
            kind = splat_format(content)
        except UnreadSplats:
            raise
        except FileFormatError:
            return _without_splats(content)
        if not kind.has_signature and _is_marked_mesh(content):
            return "mesh"
        return "splats" if kind.reader.holds_splats(content) else "mesh"


def archives_of_splats(folder: Path) -> list[Path]:
    """The zip archives of ``folder`` that are to be read as splats, by name: also those that are broken or
    hold several files of splats, which their reading says."""
    return [path for path in files_named(folder, (".zip",)) if _may_hold_splats(path)]


def _may_hold_splats(path: Path) -> bool:
    try:
        with Content(path) as content:
            if content.is_archive:
                content.archive  # noqa: B018 - opened: it may be broken
    except (FileFormatError, OSError):
        return True
    try:
        return identify(path) == "splats"
    except UnreadSplats:
        return True
    except FileFormatError:
        return False


def _without_splats(content: Content) -> Literal["mesh", "cameras"]:
    """As ``identify``, of a file that is of no splat format."""
    if content.is_archive:
        splat_format(content)  # says what it is
    if _is_marked_mesh(content):
        return "mesh"
    if content.is_text and content.container in ("json", "array"):
        return "cameras"
    content.refuse_empty()
    if what := foreign(content.path, content.head):
        raise FileFormatError(f"{content.path}: {what}")
    raise FileFormatError(
        f"{content.path}: neither splats, a mesh nor cameras of a known format; it begins with"
        f" {content.head[:8]!r}"
    )


def _is_marked_mesh(content: Content) -> bool:
    """Whether a mesh format recognises the file as its own. JSON and archives hold other things, too."""
    return content.container not in ("json", "zip") and mesh_format(content) is not None


def _holds_arrays(content: Content) -> bool:
    """Whether a zip archive is an .npz."""
    if content.is_usd or content.path.suffix.lower() == ".usdz":
        return not any(kind.reader.matches(content) for kind in splat_formats.FORMATS if kind.name == "usd")
    try:
        return any(name.endswith(".npy") for name in content.archive.names)
    except FileFormatError:
        # Broken: the name decides which reader says so.
        return content.path.suffix.lower() == ".npz"
