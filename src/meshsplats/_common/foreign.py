"""Files of kinds that are not read: what they are, and what to do with them, in one sentence."""

from __future__ import annotations

import re
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import IO, NamedTuple

from meshsplats._common.words import command_line

_HEAD = 4096
"""First bytes of a file that suffice here."""
_MAX_PICKLE = 1 << 20
"""Bytes of a pickle that are searched for names; it is never unpickled."""
VIDEO_SUFFIXES = (
    *(".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm"),
    *(".3gp", ".3g2", ".mts", ".m2ts", ".ts", ".mpg", ".mpeg", ".vob"),
    *(".wmv", ".asf", ".flv", ".ogv", ".mxf"),
)
IMAGE_SUFFIXES = (
    *(".jpg", ".jpeg", ".png", ".heic", ".heif", ".avif", ".webp"),
    *(".tif", ".tiff", ".bmp", ".exr", ".dng"),
)


class _Kind(NamedTuple):
    suffixes: str
    """Ends of names, separated by blanks."""
    begins: bytes
    """Pattern of the first bytes, for files of any name; empty: the name decides."""
    what: str


_POINTS = (
    "a point cloud: its points have no size and no opacity, so they are no splats; 'meshsplats train' makes a"
    " mesh of the photographs of a scene, trainers such as Brush make splats of them"
)
_SCENE = "export it as .glb"
_PRINT = f"which is not read: {_SCENE} or .obj; 'meshsplats surface' makes .glb of splats, too"
_CODE = "which can run arbitrary code when it is loaded, and is not read"
_PICKLE = f"a pickle of Python, {_CODE}: save the splats as .ply"
_VIDEO = "a video: 'meshsplats train VIDEO -o mesh.npz' makes a mesh of its sharpest frames"
_KINDS: Sequence[_Kind] = (
    _Kind(".las .laz", rb"LASF", _POINTS),
    _Kind(".e57", rb"ASTM-E57", _POINTS),
    _Kind(".pcd", rb"#? ?\.PCD ", _POINTS),
    _Kind(".xyz .pts .ptx .asc .rcp .rcs", b"", _POINTS),
    _Kind(".fbx", rb"Kaydara FBX Binary|; FBX \d", f"an FBX scene: open it in Blender, and {_SCENE}"),
    _Kind(".blend", rb"BLENDER", f"a file of Blender: {_SCENE}"),
    _Kind(".max .ma .mb .c4d .3ds .skp .lwo .hip", b"", f"a scene of a modelling program: {_SCENE} there"),
    _Kind(".dae", rb"(<\?xml[^>]*>\s*)?<COLLADA", f"a COLLADA scene: {_SCENE}"),
    _Kind(".stl", rb"solid [^\n]*\n\s*facet|MeshSplats, millimetres", f"an STL mesh, {_PRINT}"),
    _Kind(".3mf", b"", f"a mesh for printing, {_PRINT}"),
    _Kind(".abc .x3d .wrl .step .stp .iges", b"", f"a mesh of a kind that is not read: {_SCENE} or .obj"),
    _Kind(".psht", b"", "a project of Postshot: export the splats as .ply there"),
    _Kind(".ssproj", b"", "a project of SuperSplat: export the splats as .ply there"),
    _Kind(".psx .psz .rcproj .rsproj", b"", "a project of photogrammetry: export COLMAP's format there"),
    _Kind(".splatv", b"", "splats that move, in the format of antimatter15's viewer, which is not read"),
    _Kind(".rad", b"", "splats in Spark's own format, which is not read: give the file they were made of"),
    _Kind(".safetensors", b"", "tensors: read them with safetensors, then ms.gaussians_from_tensors"),
    _Kind(".pkl .pickle", rb"\x80[\2-\5][^\0]", _PICKLE),
    _Kind(".npy", rb"\x93NUMPY", "a NumPy array, not a scene"),
    _Kind(
        ".dng .cr2 .cr3 .nef .arw .orf .raf .rw2 .raw",
        b"",
        "a raw photograph, which is not read: develop it to JPEG or TIFF first",
    ),
    _Kind(".jxl .jp2", b"", "an image of a kind that is not read: convert it to JPEG or PNG first"),
    _Kind(
        ".jpg .jpeg .png .webp .tif .tiff .bmp .gif .heic .heif .avif .exr",
        rb"\xff\xd8\xff|\x89PNG|RIFF....WEBP|II\*\0|MM\0\*|v/1\x01|....ftyp(heic|heix|mif1|avif)",
        "an image; 'meshsplats train' makes a mesh of a folder of photographs",
    ),
    _Kind(".insv .360", b"", "a video of a panoramic camera: export it with its program as a flat .mp4"),
    _Kind(
        " ".join(VIDEO_SUFFIXES),
        rb"....ftyp(isom|iso[2-6]|mp4|qt|M4V|avc1|3g[p2])|....(moov|mdat|wide)|\x1aE\xdf\xa3|RIFF....AVI |"
        rb"G.{187}G.{187}G|.{4}G.{191}G.{191}G|\0\0\x01\xba|FLV\x01|"
        rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11|\x06\x0e\x2b\x34\x02\x05\x01\x01\x0d\x01\x02|OggS.{24}\x01video|"
        rb"OggS.{24}\x80theora",
        _VIDEO,
    ),
    _Kind(
        ".rar .7z .tar .tgz .xz .bz2 .zst",
        rb"Rar!|7z\xbc\xaf|\xfd7zXZ|BZh|\x28\xb5\x2f\xfd",
        "an archive: unpack it first",
    ),
)
_MODEL = re.compile(r"(cameras|images|points3d|rigs|frames)\.(bin|txt)", re.IGNORECASE)
BROKEN_ZIP = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError),
    *(RuntimeError, OSError, ValueError),
)
"""Errors of the zip reader: broken or encrypted archives, unknown methods."""
_TORCH = (".pt", ".pth", ".ckpt")


def open_member(archive: zipfile.ZipFile, name: str) -> IO[bytes]:
    """The file ``name`` in an archive, to be read. KeyError without one, else errors of ``BROKEN_ZIP``; also
    for other methods than deflate: LZMA may claim gigabytes for its dictionary."""
    info = archive.getinfo(name)
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise NotImplementedError(f"it is compressed by method {info.compress_type}, not by deflate")
    return archive.open(info)


def foreign(path: Path, head: bytes) -> str:
    """What the file ``path`` is, which begins with ``head``, and what to do with it; empty if it is unknown.
    Its name decides first, as the formats of many programs are the same inside."""
    name = path.name.lower()
    if _MODEL.fullmatch(name):
        return "a part of COLMAP's sparse model; commands take the folder of the data set with ``data``"
    if name.endswith(_TORCH):
        return checkpoint(path)
    named = (kind for kind in _KINDS if name.endswith(tuple(kind.suffixes.split())))
    begun = (kind for kind in _KINDS if kind.begins and re.match(kind.begins, head, re.DOTALL))
    kind = next(named, None) or next(begun, None)
    if kind is not None and kind.what == _VIDEO:
        # Who has done so may give the video itself as the photographs.
        return f"{_VIDEO}, and puts these into {frames_of(path).name}, the folder to give as ``data``"
    return "" if kind is None else kind.what


def is_a_video(path: Path) -> bool:
    """Whether the file ``path`` is a video by its name, or if that is of no known kind, by its first
    bytes."""
    return what_it_is(path).startswith(_VIDEO)


def frames_of(video: Path) -> Path:
    """The folder where the frames of ``video`` are put."""
    return video.with_name(f"{video.stem}-frames")


def what_it_is(path: Path) -> str:
    """As ``foreign``, for a file that may be a zip archive, too."""
    with open(path, "rb") as file:
        head = file.read(_HEAD)
    if head.startswith(b"PK\3\4"):
        try:
            with zipfile.ZipFile(path) as archive:
                return foreign_archive(path, archive.namelist())
        except BROKEN_ZIP:
            return ""
    return foreign(path, head)


def checkpoint(path: Path) -> str:
    """What to do with the checkpoint of a trainer in PyTorch's format. Nothing of it is unpickled: names of
    tensors are searched for in its bytes."""
    names = _names_in(path)
    what = f"a checkpoint of PyTorch, {_CODE}"
    if b"gauss_params" in names or path.suffix.lower() == ".ckpt":
        export = "ns-export gaussian-splat --load-config config.yml --output-dir ."
        return f"{what}; nerfstudio saves its splats as .ply: {export}"
    if b"splats" in names and b"sh0" in names:
        return f"{what}; it is gsplat's, and this saves its splats as .ply: {gsplat_export(path)}"
    if path.name.startswith("chkpnt"):
        return f"{what}; the splats of the 3DGS code are beside it: point_cloud/iteration_*/point_cloud.ply"
    return f"{what}: save the splats as .ply with the program that wrote it"


def gsplat_export(path: Path) -> str:
    """The command that saves the splats of a checkpoint of gsplat's trainer as .ply."""
    read = "torch.load(sys.argv[1], map_location='cpu', weights_only=True)['splats']"
    save = f"ms.save_gaussians(ms.gaussians_from_tensors({read}), sys.argv[2])"
    names = command_line([path, f"{path.stem}.ply"])  # from strangers, perhaps, and quoted
    return f'python -c "import sys, torch, meshsplats as ms; {save}" {names}'


def _names_in(path: Path) -> bytes:
    """The beginning of the pickle in a checkpoint."""
    try:
        if not zipfile.is_zipfile(path):
            with open(path, "rb") as file:
                return file.read(_MAX_PICKLE)
        with zipfile.ZipFile(path) as archive:
            name = next((n for n in archive.namelist() if n.endswith("data.pkl")), None)
            if name is None:
                return b""
            with open_member(archive, name) as member:
                return member.read(_MAX_PICKLE)
    except BROKEN_ZIP:
        return b""


def foreign_archive(path: Path, names: Sequence[str]) -> str:
    """What a zip archive of files ``names`` is, without splats in it; empty if that is not known."""
    if any(name.endswith("data.pkl") for name in names):
        return checkpoint(path)
    suffix = path.suffix.lower()
    if suffix in (".3mf", ".ssproj", ".psz", *_TORCH):
        return foreign(path, b"")
    images = sum(name.lower().endswith(IMAGE_SUFFIXES) for name in names)
    if images and suffix != ".sog":
        return (
            f"a zip archive with {images} images: unpack it; commands take the folder with ``data``, and"
            " 'meshsplats train' makes a mesh of it"
        )
    return ""
