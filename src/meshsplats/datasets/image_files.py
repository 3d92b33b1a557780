"""Photographs in a data set's folder: found without leaving it, and measured by their headers."""

from __future__ import annotations

import os
import re
import unicodedata
import warnings
from collections import Counter
from collections.abc import Container, Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath, PureWindowsPath

import numpy as np

from meshsplats._common.choices import Masks, Missing
from meshsplats._common.json_files import can_be_named
from meshsplats.datasets.lens import Lens, Pinhole, check_shape, fits, pinholes
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.datasets.views import ImageCache
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.images.reading import Header, read_header
from meshsplats.scene.camera import Camera

SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".PNG", ".JPG", ".JPEG")
"""Tried, in this order, for names without a suffix, and for smaller copies stored in another format."""
READABLE = (*dict.fromkeys(suffix.lower() for suffix in SUFFIXES), ".ppm", ".heic", ".heif", ".avif")
"""Suffixes of photographs, in letters of any case."""
UNREADABLE = (
    *(".exr", ".hdr", ".tga", ".jxl", ".jp2", ".gif", ".jfif", ".jpe"),
    *(".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2", ".raw"),
)
"""Suffixes of images that are not read."""
MAX_NAME = 1000


@dataclass(frozen=True)
class Frame:
    """A photograph as a data set's own file describes it."""

    name: str
    """Name of the view."""
    file: str
    """Path of the image in the folder, as written there."""
    lens: Lens | None
    """None if the file does not give a size and the image is missing."""
    world_to_camera: np.ndarray
    mask: str | None = None
    """Path of its mask in the folder; None: looked for in ``masks/``."""
    near: float | None = None
    """Depth of the near plane, scene units; None: as cameras have it that name none."""


def inside(folder: Path, name: str, where: str) -> Path:
    """The path of ``name`` in ``folder``. FileFormatError if it is absolute or leads out of the folder, by
    ``..`` or by a symbolic link; ``where`` begins the message."""
    clean = name.replace("\\", "/")
    if leads_out(clean):
        raise FileFormatError(
            f"{where}: names the file {name[:200]!r}; only files inside the data set's folder are read, named"
            " relative to it"
        )
    path = folder.joinpath(*PurePosixPath(clean).parts)
    if path == folder or len(clean) > MAX_NAME or not can_be_named(path):
        raise FileFormatError(f"{where}: no file can be called {name[:60]!r}: 1 to {MAX_NAME} characters")
    real, root = os.path.realpath(path), os.path.realpath(folder)
    if os.path.commonpath([real, root]) != root:
        raise FileFormatError(
            f"{where}: {name[:200]!r} is a link that leads out of the data set's folder; copy what is there"
        )
    return path


def find(folder: Path, name: str, where: str, *, other_suffix: bool = False) -> Path | None:
    """The file ``name`` in ``folder``, or None. A name without one of the known suffixes may lack it;
    ``other_suffix`` admits the same image in another format."""
    path = inside(folder, name, where)
    if path.is_file():
        return path
    known = path.suffix in SUFFIXES
    if known and not other_suffix:
        return None
    for suffix in SUFFIXES:
        candidate = path.with_suffix(suffix) if known else path.with_name(path.name + suffix)
        if candidate.is_file():
            # The link could be on this one.
            return inside(folder, str(candidate.relative_to(folder)), where)
    return None


def is_hidden(name: str) -> bool:
    """Whether a file or folder is not the user's: dot files (as macOS leaves beside each file on foreign
    disks) and the thumbnails of Windows."""
    return name.startswith(".") or name.casefold() in ("thumbs.db", "desktop.ini", "__macosx")


def leads_out(name: str) -> bool:
    """Whether the path ``name`` is absolute, or goes up by ``..``."""
    clean = name.replace("\\", "/")
    return clean.startswith("/") or bool(PureWindowsPath(clean).drive) or ".." in PurePosixPath(clean).parts


class ImageIndex:
    """The images below a folder, found by what people take for the same name: in letters of another case,
    with accents composed otherwise, or with another suffix of images."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._files: dict[PurePosixPath, dict[str, list[str]]] = {}
        self._folders: dict[PurePosixPath, dict[str, list[str]]] = {}

    def alike(self, name: str) -> list[str]:
        """The files, relative to the folder, that may be meant by the path ``name`` in it, sorted."""
        parts = PurePosixPath(name.replace("\\", "/")).parts
        if not parts or len(name) > MAX_NAME or ".." in parts or parts[0] == "/":
            return []
        places = [PurePosixPath()]
        for part in parts[:-1]:
            key = _fold(part)
            places = [place / found for place in places for found in self._listed(place)[1].get(key, ())]
        stem = _stem_of(parts[-1])
        return sorted(str(place / file) for place in places for file in self._listed(place)[0].get(stem, ()))

    def by_last_parts(self, name: str, images: str = "") -> list[str]:
        """As ``alike``, for the last parts of ``name``, as many as lead to a file; the last alone is looked
        for in the folder ``images``."""
        parts = PurePosixPath(name.replace("\\", "/")).parts
        tails = ["/".join(parts[i:]) for i in range(len(parts))]
        for tail in (*tails[:-1], *(f"{images}/{last}" if images else last for last in tails[-1:])):
            if found := self.alike(tail):
                return found
        return []

    def images(self) -> list[str]:
        """The names of the readable images in the folder itself, sorted."""
        listed = self._listed(PurePosixPath())[0].values()
        return sorted(name for names in listed for name in names if is_readable(name))

    def unread(self) -> list[str]:
        """The names of the images in the folder itself that are of kinds that are not read, sorted, but for
        those that are there of a kind that is, too."""
        listed = self._listed(PurePosixPath())[0].values()
        return sorted(
            name
            for names in listed
            for name in names
            if not is_hidden(name) and not any(map(is_readable, names))
        )

    def _listed(self, place: PurePosixPath) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
        """Images of a folder by their stems, and folders in it by their names, both folded."""
        if place not in self._files:
            files: dict[str, list[str]] = {}
            folders: dict[str, list[str]] = {}
            try:
                with os.scandir(self.folder / place) as entries:
                    for entry in entries:
                        if entry.is_dir():
                            folders.setdefault(_fold(entry.name), []).append(entry.name)
                        elif entry.name.lower().endswith((*READABLE, *UNREADABLE)):
                            files.setdefault(_stem_of(entry.name), []).append(entry.name)
            except OSError:
                pass
            self._files[place], self._folders[place] = files, folders
        return self._files[place], self._folders[place]


def is_readable(name: str) -> bool:
    """Whether a file's name is that of a photograph that can be read, and not hidden."""
    return name.lower().endswith(READABLE) and not is_hidden(name)


def _fold(name: str) -> str:
    return unicodedata.normalize("NFC", name).casefold()


def _stem_of(name: str) -> str:
    suffix = PurePosixPath(name).suffix
    return _fold(name[: len(name) - len(suffix)] if suffix.lower() in (*READABLE, *UNREADABLE) else name)


PhotoViews = list[tuple[Camera, PhotoFile]]
"""The views made from one photograph: one, or the six of a panorama; none if it is missing."""


@dataclass
class PhotoLoader:
    """Turns the frames of a data set into cameras with their photographs, and counts what is missing."""

    folder: Path
    """The data set's folder, which no path may leave."""
    downscale: int
    store: ImageCache
    on_missing: Missing = "few"
    images: str = ""
    """Folder of the images in it, where names of their own lead nowhere; empty: ``folder`` itself."""
    masks: Masks = "count"
    missing: list[str] = field(default_factory=list)
    no_mask: list[str] = field(default_factory=list)
    renamed: list[str] = field(default_factory=list)
    unclear: list[str] = field(default_factory=list)
    """Masks that may be meant as they are stored or upright: of photographs taken upside down, or square."""
    _index: ImageIndex = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self._index = ImageIndex(self.folder)

    def views(self, frames: Iterable[Frame], where: str) -> list[PhotoViews]:
        """Cameras and photographs of each frame, in order."""
        self.missing, self.no_mask, self.renamed, self.unclear = [], [], [], []
        result: list[PhotoViews] = []
        frames = list(frames)
        masks = self._mask_folder(frames, where)
        labels = [f"{where}: image {frame.name[:60]!r}" for frame in frames]
        for frame, label, (full, small) in zip(frames, labels, self._files(frames, labels), strict=True):
            if frame.lens is None or (full is None and small is None):
                self.missing.append(frame.file)
                result.append([])
                continue
            path = small or full
            assert path is not None
            header = read_header(path)
            whole = header if full in (None, path) else _header(full)
            if full is not None and whole is not None and not _is_smaller(header, whole):
                path, header, small = full, whole, None  # a folder of other photographs has that name
            check_shape(frame.lens, header, path)
            width, height = header.width, header.height
            if small is None:
                width, height = (max(1, round(side / self.downscale)) for side in (width, height))
            turn = 0 if whole is None else whole.turn
            mask = self._mask(frame, full, label, masks)
            mask_turn = 0 if mask is None else self._turn_of(mask, frame.lens, whole)
            lens = frame.lens.scaled(width, height)
            taken = []
            for pinhole in pinholes(lens):
                cut_out = mask is not None and self.masks == "subject"
                has_alpha = header.has_alpha or cut_out
                photo = (frame.name, path, lens, pinhole, mask, has_alpha, self.store, cut_out)
                taken.append((_camera(frame, pinhole, label), PhotoFile(*photo, turn, mask_turn)))
            result.append(taken)
        return result

    def _files(self, frames: Sequence[Frame], labels: Sequence[str]) -> list[tuple[Path | None, Path | None]]:
        """The image of each frame and its smaller copy, if they are there: under the name that the file
        gives, else the only image that can be meant by it and by no other."""
        whole = {place for frame in frames for place in PurePosixPath(frame.file.replace("\\", "/")).parents}
        found = [
            (find(self.folder, frame.file, label), self._smaller(frame.file, label, whole))
            for frame, label in zip(frames, labels, strict=True)
        ]
        if any(full is not None for full, _ in found):
            # What was thrown away there does not come back from the smaller copies.
            found = [(full, small if full is not None else None) for full, small in found]
        lacking = [i for i, paths in enumerate(found) if paths == (None, None)]
        if not lacking:
            return found
        alike = {i: [name for name in self.alike(frames[i].file) if is_readable(name)] for i in lacking}
        claims = Counter(self.folder / names[0] for names in alike.values() if len(names) == 1)
        claims.update(full for full, _ in found if full is not None)
        for i, names in alike.items():
            if len(names) == 1 and claims[self.folder / names[0]] == 1:
                small = self._smaller(names[0], labels[i], whole)
                found[i] = inside(self.folder, names[0], labels[i]), small
                self.renamed.append(f"{frames[i].file}: {names[0]}")
        return found

    def alike(self, name: str) -> list[str]:
        """The files in the data set that may be meant by ``name``, which is not there: by its last parts, as
        many as possible, or by the last one in the folder of the images."""
        return self._index.by_last_parts(name, self.images)

    def _smaller(self, name: str, where: str, whole: Container[PurePosixPath]) -> Path | None:
        """The copy in ``images_<downscale>/``, if there is one. Folders of photographs that the data set
        names itself, ``whole``, hold no copies."""
        parts = PurePosixPath(name.replace("\\", "/")).parts
        if self.downscale == 1 or len(parts) < 2:
            return None
        for i in reversed(range(len(parts) - 1)):
            beside = PurePosixPath(*parts[:i], f"{parts[i]}_{self.downscale}")
            if beside not in whole and (self.folder / beside).is_dir():
                name = str(beside.joinpath(*parts[i + 1 :]))
                return find(self.folder, name, where, other_suffix=True)
        return None

    def _mask_folder(self, frames: Sequence[Frame], where: str) -> str:
        """The folder of the masks, empty if there is none. Warns of one that has another name."""
        folders = _folders(self.folder)
        if found := sorted((name for name in folders if name.casefold() == "masks"), reverse=True):
            return found[0]  # in small letters, if it is there twice
        paths = [PurePosixPath(frame.file.replace("\\", "/")) for frame in frames if not frame.mask]
        places, files = {path.parts[0] for path in paths if path.parts}, [path.name for path in paths]
        for name in folders:
            if "mask" not in name.casefold() or name in places:
                continue
            index = ImageIndex(self.folder / name)
            if any(index.alike(file) or index.alike(f"{file}.png") for file in files):
                text = "looks like masks of the photographs, which are read from masks/: rename it"
                warnings.warn(f"{where}: {name}/ {text}", DataWarning, stacklevel=4)
        return ""

    def masks_of(
        self, names: Sequence[str], sizes: Sequence[tuple[int, int]], where: str
    ) -> list[tuple[Path, int] | None]:
        """For each of the photographs ``names``, of these ``sizes``, its mask in ``masks/`` and the
        quarter turns after which that lies on it; None where there is none."""
        frames = [Frame(name, name, None, np.eye(4)) for name in names]
        folder = self._mask_folder(frames, where)
        found: list[tuple[Path, int] | None] = []
        for frame, (width, height) in zip(frames, sizes, strict=True):
            image = self.folder / frame.file
            mask = self._mask(frame, image, where, folder)
            lens = Lens("PINHOLE", 1, 1, 0, 0, width, height)
            found.append(None if mask is None else (mask, self._turn_of(mask, lens, read_header(image))))
        return found

    def _mask(self, frame: Frame, image: Path | None, where: str, folder: str) -> Path | None:
        if frame.mask is not None:
            found = find(self.folder, frame.mask, where)
            if found is None:
                self.no_mask.append(frame.mask)
            return found
        if not folder:
            return None
        # images/a/b.jpg has masks/a/b.jpg.png (COLMAP's way), masks/a/b.png or masks/a/b.jpg.
        names = [frame.file.replace("\\", "/")]
        names += [image.relative_to(self.folder).as_posix()] if image is not None else []
        for name in dict.fromkeys(names):  # as the file has it, and as it is
            parts = PurePosixPath(name).parts
            below = len(parts) > 1 and parts[0].casefold().startswith(("images", "input"))
            inner = PurePosixPath(folder, *(parts[1:] if below else parts))
            for candidate in (f"{inner}.png", str(inner.with_suffix(".png")), str(inner)):
                found = find(self.folder, candidate, where)
                if found is not None:
                    return found
        self.no_mask.append(str(inner))
        return None

    def _turn_of(self, mask: Path, lens: Lens, photograph: Header | None) -> int:
        """Quarter turns counter-clockwise after which the mask lies on its photograph as that is stored:
        programs that make masks turn photographs upright, and leave no EXIF data."""
        header = read_header(mask)
        if photograph is None or header.orientation != 1 or photograph.orientation not in (3, 6, 8):
            check_shape(lens, header, mask)
            return 0
        turned = replace(header, width=header.height, height=header.width)
        if photograph.orientation != 3 and not fits(lens, header) and fits(lens, turned):
            return photograph.turn
        check_shape(lens, header, mask)
        if photograph.orientation == 3 or fits(lens, turned):
            self.unclear.append(str(mask.relative_to(self.folder)))
        return 0

    def report(self, where: str, found: int, *, needed: bool = True) -> None:
        """Warns of what differs from the file. FileFormatError if images are missing, unless they may be, or
        if nothing is left, unless nothing is ``needed``."""
        refused = self.on_missing == "error" or (self.on_missing == "few" and len(self.missing) >= found)
        if not found and (needed or refused or not self.missing):
            what = "names no images" if not self.missing else f"none of its images is there{self._hint()}"
            what += "" if needed else "; ``missing`` skip goes on without them"
            raise FileFormatError(f"{where}: {what}")
        if self.missing and refused:
            remedy = "" if self.on_missing == "error" else "; ``missing`` skip leaves them out"
            raise FileFormatError(
                f"{where}: {len(self.missing)} of {found + len(self.missing)} images are missing"
                f" ({first_names(self.missing)}){self._near()}{remedy}"
            )
        near = self._near() if self.missing else ""
        for names, text in (
            (self.missing, f"images are missing{near}; their views are left out"),
            (self.renamed, "images were found under other names than the file gives, and are used"),
            (self.no_mask, "images have no mask, so all their pixels count"),
            (
                self.unclear,
                "masks are of photographs taken upside down, or of turned square ones, and are used as these"
                " are stored: if they are upright, turn them",
            ),
        ):
            if names:
                warnings.warn(
                    f"{where}: {len(names)} {text} ({first_names(names)})", DataWarning, stacklevel=2
                )

    def _hint(self) -> str:
        name = self.missing[0]
        first = PurePosixPath(name.replace("\\", "/")).parts[0]
        smaller = sorted(p.name for p in self.folder.glob("images_*") if p.is_dir())
        hint = f" (the first: {str(self.folder / name)[:300]})"
        if not (self.folder / first).is_dir() and smaller:
            factors = ", ".join(s.removeprefix("images_") for s in smaller)
            hint += f"; there are {', '.join(smaller)}: give a downscale of {factors}"
        return hint + self._near()

    def _near(self) -> str:
        """What is there in place of the first image that is missing."""
        name = PurePosixPath(self.missing[0].replace("\\", "/")).name
        near = self.alike(self.missing[0])
        if len(near) == 1 and not is_readable(near[0]):
            return f"; {near[0]} is there, but {PurePosixPath(near[0]).suffix} images are not read here"
        if len(near) == 1:
            return f"; {near[0]} is there, which another image of the file may mean, too: rename it"
        if near:
            return f"; {' and '.join(near[:3])} may both be meant: keep one of them"
        small = re.compile(r".*_[0-9]+")  # smaller copies, of what was thrown away, perhaps
        folders = [folder for folder in _folders(self.folder) if not small.fullmatch(folder)]
        elsewhere = [folder for folder in folders if ImageIndex(self.folder / folder).alike(name)]
        if elsewhere:
            return f"; {elsewhere[0]}/ has an image of that name: name that folder 'images'"
        return ""


def _folders(folder: Path) -> list[str]:
    """Names of the folders in ``folder`` that are not hidden, sorted."""
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir() and not is_hidden(entry.name))


def first_names(names: Sequence[str]) -> str:
    """The first of ``names``, and whether there are more."""
    return ", ".join(names[:3]) + (" ..." if len(names) > 3 else "")


def _camera(frame: Frame, pinhole: Pinhole, where: str) -> Camera:
    matrix = np.eye(4)
    matrix[:3] = pinhole.rotation @ frame.world_to_camera[:3]
    lens = {key: getattr(pinhole, key) for key in ("fx", "fy", "cx", "cy", "width", "height")}
    try:
        return Camera(matrix, **lens, near=frame.near, name=frame.name + pinhole.suffix)
    except ValueError as error:
        raise FileFormatError(f"{where}: {error}") from None


def _header(photograph: Path) -> Header | None:
    """Of a photograph whose smaller copy may be used; None for one that cannot be read, as it need not be."""
    try:
        return read_header(photograph)
    except (FileFormatError, MissingDependencyError):
        return None


def _is_smaller(copy: Header, photograph: Header) -> bool:
    return copy.width * copy.height < photograph.width * photograph.height


def split(taken: Sequence[PhotoViews], test_every: int) -> tuple[list[PhotoViews], list[PhotoViews]]:
    """Train and test: every n-th, which are sorted by name, is for testing, from the first on. Missing ones
    count: where a photograph is thrown away, the others stay on their side."""
    if not test_every:
        return list(taken), []
    test = [views for i, views in enumerate(taken) if i % test_every == 0]
    return [views for i, views in enumerate(taken) if i % test_every], test
