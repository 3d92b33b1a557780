"""Cameras of bare photographs: structure from motion by pycolmap, saved beside the photographs."""

from __future__ import annotations

import errno
import json
import os
import shutil
import sqlite3
import tempfile
import warnings
from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import write_bytes, write_text
from meshsplats.datasets.image_files import Shelf
from meshsplats.datasets.layouts import find_layout, image_folders, unread_cameras
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.images.reading import load_image, read_exif, read_header
from meshsplats.training.likeness import ALL_UP_TO, alike_pairs
from meshsplats.training.poses import find_poses
from meshsplats.training.suspects import shortened

CAMERAS, POINTS = "transforms.json", "sparse_points.ply"
"""Files beside the photographs."""
MAX_SIDE = 1600
"""Longest side of the images in which features are found, in pixels."""
DOUBLED_BELOW = 1400
"""Images are doubled before the search for features if their longest side is shorter: larger ones have
enough. A phone's 50 photographs, 1600 pixels high: 39 processor s for features in place of 101, 72 for pairs
in place of 100, and places as exact."""
DOUBLED_UP_TO = 100
"""Photographs of which images are doubled, at most: many hold together without. 292 of a room, 800 x 533:
58 processor s for features in place of 196, 61 for pairs in place of 297, 68 for poses, and places within
0.14 % of their spread in the median, 0.4 % at most."""
MAX_FEATURES = 3000
"""Features of an image: matching takes the square of that for each pair."""
FEWEST = 3
"""Photographs that must find their place."""
NEEDS = "photographs without cameras need the library pycolmap: pip install 'meshsplats[photos]'"


def bare_photographs(folder: Path) -> list[Path]:
    """The image files in ``folder``/images or ``folder``/input, else in ``folder`` itself, sorted; none for a
    data set that has cameras."""
    if not folder.is_dir() or find_layout(folder) is not None:
        return []
    for name in image_folders(folder):
        if found := Shelf(folder / name).images():
            return [folder / name / image for image in found]
    return []


def ensure_cameras(
    folder: Path, *, replacing: bool = False, say: Callable[[str], None] = lambda text: None
) -> Path | None:
    """Finds the cameras of the photographs in ``folder`` if it has none. Returns the file of its cameras if
    they are not of ``find_cameras``.

    Raises FileFormatError if cameras that are not read belong to the photographs, unless ``replacing`` them:
    estimated ones would have another frame, without a word. Otherwise errors are those of ``find_cameras``.
    """
    if not bare_photographs(folder):
        layout = find_layout(folder)
        return None if layout is None or layout.source == folder / CAMERAS else layout.source
    if not replacing and (there := unread_cameras(folder)):
        raise FileFormatError(f"{folder}: {there}; ``estimate_cameras`` finds cameras in their place")
    find_cameras(folder, say)
    return None


def find_cameras(folder: Path, say: Callable[[str], None] = lambda text: None) -> None:
    """Finds the cameras of the photographs in ``folder`` (``bare_photographs``) and writes
    ``transforms.json`` and ``sparse_points.ply`` there, as nerfstudio has them, whole or not at all.

    ``say`` is called with a line about each stage. Takes minutes.

    Raises:
        MissingDependencyError: pycolmap is not installed.
        ValueError: fewer than ``FEWEST`` photographs, or so few that match each other.
        FileExistsError: ``sparse_points.ply`` is there already.
        OSError: the folder cannot be written.

    Warns with a DataWarning about photographs that found no place, and about places that contradict matches.
    """
    photographs = bare_photographs(folder)
    if len(photographs) < FEWEST:
        raise ValueError(
            f"{folder}: {len(photographs)} photographs without cameras; at least {FEWEST} are needed, some"
            " thirty for a good result"
        )
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{folder}: no permission to write the cameras beside the photographs")
    if (folder / POINTS).exists():
        raise FileExistsError(
            errno.EEXIST,
            "is in the place of the points that come with the cameras: move it away",
            str(folder / POINTS),
        )
    try:
        import pycolmap
    except ImportError:
        raise MissingDependencyError(NEEDS) from None
    place = photographs[0].parent
    prefix = f"{place.name}/" if place != folder else ""
    sizes = {(header.width, header.height) for header in map(read_header, photographs)}
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory(prefix="meshsplats-") as work:
        database = os.path.join(work, "database.db")
        images = _for_pycolmap(photographs, Path(work))
        place = images[0].parent
        mode = pycolmap.CameraMode.SINGLE if len(sizes) == 1 else pycolmap.CameraMode.PER_IMAGE
        say(f"finding the cameras of {len(photographs)} photographs: features")
        pycolmap.extract_features(
            database,
            place,
            [path.name for path in images],  # else all images in folders below, too
            camera_mode=mode,
            device=pycolmap.Device.cpu,
            **_feature_options(pycolmap, max(max(size) for size in sizes), len(images)),
        )
        _match(pycolmap, Path(database), [path.name for path in images], say)
        poses = find_poses(pycolmap, Path(database), place, Path(work), len(images), say)
    count = 0 if poses is None else poses.model.num_reg_images()
    if poses is None or count < FEWEST:
        raise ValueError(
            f"{folder}: {count} of {len(photographs)} photographs match each other, at least {FEWEST} must."
            " Photographs must overlap by two thirds, be sharp, and show a subject with texture that does not"
            " move"
        )
    best = poses.model
    named = {image.name: path.name for image, path in zip(images, photographs, strict=True)}
    placed = {named[image.name] for image in best.images.values() if image.has_pose}
    lost = [path.name for path in photographs if path.name not in placed]
    if lost:
        warnings.warn(
            f"{folder}: {len(lost)} of {len(photographs)} photographs match no others and are left out:"
            f" {shortened(lost)}",
            DataWarning,
            stacklevel=2,
        )
    if poses.doubtful:
        suspects = shortened([named[name] for name in poses.suspects()])
        warnings.warn(
            f"{folder}: some cameras may be wrong: {len(poses.contradicting):,} pairs of photographs that"
            f" match contradict them, most of {suspects}."
            " Photographs between those of such a pair help, or the cameras of another program",
            DataWarning,
            stacklevel=2,
        )
    cameras = json.dumps(_transforms(best, prefix, named), indent=1) + "\n"
    write_bytes(folder / POINTS, _points(best))
    try:
        write_text(folder / CAMERAS, cameras)
    except BaseException:
        (folder / POINTS).unlink(missing_ok=True)
        raise
    say(f"cameras of {count} photographs and {len(best.points3D):,} points: {folder / CAMERAS}")


def _match(pycolmap: Any, database: Path, names: list[str], say: Callable[[str], None]) -> None:
    """Matches the features of all pairs of the images ``names``, or where these are many, of those that look
    alike."""
    count = len(names)
    # Older versions of the library have no function for given pairs.
    if count <= ALL_UP_TO or not hasattr(pycolmap, "match_image_pairs"):
        say(f"finding the cameras: {count * (count - 1) // 2:,} pairs")
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        return
    pairs = alike_pairs(_descriptors(database, names))
    say(f"finding the cameras: {len(pairs):,} pairs of photographs that look alike")
    chosen = database.parent / "pairs.txt"
    chosen.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = chosen
    pycolmap.match_image_pairs(database, pairing_options=options, device=pycolmap.Device.cpu)


def _descriptors(database: Path, names: list[str]) -> list[np.ndarray]:
    """(features, 128) uint8 for each of the images ``names`` in COLMAP's database."""
    query = "select name, rows, cols, data from descriptors join images using (image_id)"
    with closing(sqlite3.connect(database)) as connection:
        table = connection.execute(query).fetchall()
    found = {name: np.frombuffer(data, np.uint8).reshape(rows, width) for name, rows, width, data in table}
    return [found.get(name, np.zeros((0, 128), np.uint8)) for name in names]


def _feature_options(pycolmap: Any, side: int, count: int) -> dict[str, Any]:
    """Options of ``extract_features`` in the library's version, for ``count`` images of that longest
    ``side``."""
    doubled = side < DOUBLED_BELOW and count <= DOUBLED_UP_TO
    sift = {"max_num_features": MAX_FEATURES, "first_octave": -1 if doubled else 0}
    if hasattr(pycolmap, "FeatureExtractionOptions"):
        options = pycolmap.FeatureExtractionOptions()
        options.max_image_size = MAX_SIDE
        for name, value in sift.items():
            setattr(options.sift, name, value)
        return {"extraction_options": options}
    return {"sift_options": {"max_image_size": MAX_SIDE, **sift}}


def _for_pycolmap(photographs: list[Path], work: Path) -> list[Path]:
    """Files that pycolmap reads, in one folder, one for each of ``photographs``: themselves, or in the folder
    ``work`` copies where some are HEIF images, and links where names have blanks, which its lists of pairs
    do not allow."""
    heif = any(path.suffix.lower() in (".heic", ".heif") for path in photographs)
    if not heif and not any(" " in path.name or path.name.startswith("#") for path in photographs):
        return photographs
    from PIL import Image

    folder = work / "images"
    folder.mkdir()
    copies = [folder / f"{i:06d}{'.png' if heif else path.suffix}" for i, path in enumerate(photographs)]
    for path, copy in zip(photographs, copies, strict=True):
        if heif:
            pixels = load_image(path)
            Image.fromarray(pixels[..., :3]).save(copy, exif=read_exif(path), compress_level=1)
        else:
            try:
                copy.symlink_to(path.absolute())
            except OSError:  # Windows lets only some users make links
                shutil.copyfile(path, copy)
    return copies


def _transforms(model: Any, prefix: str, named: Mapping[str, str]) -> dict[str, Any]:
    """The cameras of ``model`` as in nerfstudio's file: OpenGL axes, one radial term. ``named``: the files of
    the photographs by the names of its images."""
    frames = []
    for image in sorted(model.images.values(), key=lambda image: image.name):
        if not image.has_pose:
            continue
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        matrix = np.vstack([np.asarray(pose.matrix(), np.float64), [0, 0, 0, 1]])
        world = np.linalg.inv(matrix)
        world[:3, 1:3] *= -1
        world[3] = [0, 0, 0, 1]
        camera = model.cameras[image.camera_id]
        focal, cx, cy, k1 = map(float, camera.params)  # SIMPLE_RADIAL
        lens = {"fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy, "k1": k1}
        size = {"w": int(camera.width), "h": int(camera.height)}
        frames.append(
            {"file_path": prefix + named[image.name], "transform_matrix": world.tolist(), **lens, **size}
        )
    return {"camera_model": "OPENCV", "ply_file_path": POINTS, "frames": frames}


def _points(model: Any) -> bytes:
    """The points of ``model`` as a .ply file."""
    points = list(model.points3D.values())
    rows = np.empty(len(points), np.dtype([("xyz", "<f4", 3), ("rgb", "u1", 3)]))
    for i, point in enumerate(points):
        rows[i] = (np.asarray(point.xyz), np.asarray(point.color))
    names = [*(f"float {axis}" for axis in "xyz"), *(f"uchar {name}" for name in ("red", "green", "blue"))]
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(points)}"]
    lines += [*(f"property {name}" for name in names), "end_header", ""]
    return "\n".join(lines).encode() + rows.tobytes()
