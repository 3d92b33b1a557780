"""Cameras of bare photographs: structure from motion by pycolmap, saved beside the photographs."""

from __future__ import annotations

import errno
import json
import signal
import sqlite3
import tempfile
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.json_files import read_json
from meshsplats._common.words import plural
from meshsplats._core.library import thread_count
from meshsplats._files.atomic import may_write_in, together, write_bytes, write_text
from meshsplats.datasets.image_files import ImageIndex, inside
from meshsplats.datasets.layouts import find_layout, image_folders, unread_cameras
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.formats.outputs import PREVIEW
from meshsplats.images.reading import Shot
from meshsplats.training.feature_masks import FeatureMasks
from meshsplats.training.hints import (
    matching_images,
    say_what_has_no_camera,
    warn_of_inner_folders,
    why_none,
)
from meshsplats.training.likeness import ALL_UP_TO, alike_pairs, in_sequence
from meshsplats.training.poses import find_poses
from meshsplats.training.pycolmap_input import by_lens, for_pycolmap, needs_copy, read_shots
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
TRIED = "estimated_from"
"""Key of ``CAMERAS`` that marks the file as ours: the photographs that cameras were looked for, also those
that found no place."""
FEWEST = 3
"""Photographs that must find their place."""
NEEDS = 'photographs without cameras need the library pycolmap: pip install "meshsplats[photos]"'


def bare_photographs(folder: Path) -> list[Path]:
    """The image files in ``folder``/images or ``folder``/input, else in ``folder`` itself, sorted; none for a
    data set that has cameras."""
    return [] if not folder.is_dir() or find_layout(folder) is not None else _photographs(folder)


def _photographs(folder: Path) -> list[Path]:
    for name in image_folders(folder):
        paths = [folder / name / image for image in ImageIndex(folder / name).images()]
        if found := [path for path in paths if not _is_preview(path)]:
            return found
    return []


def _tried(cameras: Path) -> set[str] | None:
    """The photographs that ``find_cameras`` looked at, whose file ``cameras`` is; None for that of another
    program."""
    content = read_json(cameras)
    names = content.get(TRIED) if isinstance(content, dict) else None
    return set(map(str, names)) if isinstance(names, list) else None


def _is_preview(path: Path) -> bool:
    """Whether the image was drawn of a result that lies beside it."""
    end = f".{PREVIEW}"
    return path.name.endswith(end) and path.with_name(path.name.removesuffix(end)).exists()


def ensure_cameras(
    folder: Path,
    *,
    replacing: bool = False,
    say: Callable[[str], None] = lambda text: None,
    threads: int | None = None,
) -> Path | None:
    """Finds the cameras of the photographs in ``folder`` if it has none, or ``replacing`` those that
    ``find_cameras`` found. Returns the file of its cameras if they are not of ``find_cameras``.

    Raises FileFormatError if cameras that are not read belong to the photographs, unless ``replacing`` them:
    estimated ones would have another frame, without a word. Otherwise errors are those of ``find_cameras``.

    Warns with a DataWarning about photographs that were added since the cameras were found.
    """
    layout = find_layout(folder)
    if layout is not None:
        tried = _tried(layout.source) if layout.source == folder / CAMERAS else None
        if tried is None:
            say_what_has_no_camera(layout, say)
            return layout.source
        added = [path for path in _photographs(folder) if path.relative_to(folder).as_posix() not in tried]
        if replacing:
            find_cameras(folder, say, threads, replacing=True)
        elif added:
            warnings.warn(
                f"{folder}: {len(added)} photographs were added since the cameras were found, and are left"
                f" out: {shortened([path.name for path in added])}; ``estimate_cameras`` finds those of all",
                DataWarning,
                stacklevel=2,
            )
        return None
    if not bare_photographs(folder):
        return None
    if not replacing and (there := unread_cameras(folder)):
        raise FileFormatError(f"{folder}: {there}; ``estimate_cameras`` finds cameras in their place")
    find_cameras(folder, say, threads)
    return None


def find_cameras(
    folder: Path,
    say: Callable[[str], None] = lambda text: None,
    threads: int | None = None,
    *,
    replacing: bool = False,
) -> None:
    """Finds the cameras of the photographs in ``folder`` (``bare_photographs``) and writes
    ``transforms.json`` and ``sparse_points.ply`` there, as nerfstudio has them, whole or not at all.

    ``say`` is called with a line about each stage. ``threads``: None for all processors.
    ``replacing``: both files are there, and are replaced. Takes minutes.

    Features outside of ``masks/`` do not count where these leave out what passed by (``FeatureMasks``), nor
    where they are of a subject that turns before what stands still.

    Raises:
        MissingDependencyError: pycolmap is not installed.
        ValueError: fewer than ``FEWEST`` photographs that are whole, or so few that match each other; all
            were taken from one place; most are panoramas.
        FileFormatError: photographs that are links out of the folder, which are not read as a data set; masks
            that do not fit their photographs.
        FileExistsError: ``sparse_points.ply`` is there already, unless ``replacing`` it.
        OSError: the folder cannot be written.

    Warns with a DataWarning about photographs that are broken, of kinds that are not read, in folders
    inside, panoramas, or found no place, and about places that contradict matches.
    """
    began = time.perf_counter()
    photographs = _photographs(folder) if replacing else bare_photographs(folder)
    tried = [path.relative_to(folder).as_posix() for path in photographs]
    if len(photographs) < FEWEST:
        raise ValueError(
            f"{folder}: {len(photographs)} photographs without cameras; at least {FEWEST} are needed, some"
            " thirty for a good result"
        )
    for name in tried:
        inside(folder, name, str(folder))
    if not may_write_in(folder):
        raise PermissionError(
            f"{folder}: no permission to write the cameras beside the photographs; copy the folder to where"
            " you may write"
        )
    if not replacing and (folder / POINTS).exists():
        raise FileExistsError(
            errno.EEXIST,
            "is in the place of the points that come with the cameras: move it away",
            str(folder / POINTS),
        )
    if unread := ImageIndex(photographs[0].parent).unread():
        warnings.warn(
            f"{folder}: {len(unread)} images are of kinds that are not read, and are left out:"
            f" {shortened(unread)}",
            DataWarning,
            stacklevel=2,
        )
    warn_of_inner_folders(photographs)
    pycolmap = _imported()
    say(f"looking at {len(photographs)} photographs")
    shots = _whole(folder, photographs, threads)
    photographs = list(shots)
    place = photographs[0].parent
    prefix = f"{place.name}/" if place != folder else ""
    names = [path.relative_to(folder).as_posix() for path in photographs]
    masks = FeatureMasks(folder, names, [shot.size for shot in shots.values()])
    pycolmap.logging.minloglevel = 3
    pycolmap.set_random_seed(0)
    with tempfile.TemporaryDirectory(prefix="meshsplats-") as work:
        if copied := sum(map(needs_copy, shots.values())):
            say(f"finding the cameras of {len(photographs)} photographs: copies of {copied}, as JPEG")
        images = for_pycolmap(shots, Path(work), thread_count(threads))
        place = images[0].parent
        say(f"finding the cameras of {len(photographs)} photographs: features")
        database = _matched(pycolmap, Path(work), images, list(shots.values()), masks, say, threads)
        poses = find_poses(pycolmap, database, place, Path(work), len(images), say, threads)
        matching = matching_images(database)
    count = 0 if poses is None else poses.model.num_reg_images()
    if poses is None or count < FEWEST:
        raise ValueError(f"{folder}: {why_none(count, matching, len(photographs), FEWEST)}")
    best = poses.model
    named = {image.name: path.name for image, path in zip(images, photographs, strict=True)}
    placed = {named[image.name] for image in best.images.values() if image.has_pose}
    groups = [[named[name] for name in group] for group in poses.apart]
    apart = {name for group in groups for name in group}
    outvoted = [named[name] for name in poses.outvoted]
    lost = [path.name for path in photographs if path.name not in {*placed, *apart, *outvoted}]
    for names, text in (
        (lost, "could not be registered with the others and are left out"),
        (outvoted, "were placed where most of their matches contradict it: left out"),
        *((group, "match each other, but nothing joins them to the rest: left out") for group in groups),
    ):
        if names:
            warnings.warn(
                f"{folder}: {len(names)} of {len(photographs)} photographs {text}: {shortened(names)}",
                DataWarning,
                stacklevel=2,
            )
    if poses.doubtful:
        suspects = shortened([named[name] for name in poses.suspects()])
        pairs = plural(len(poses.contradicting), "pair of photographs", "pairs of photographs")
        warnings.warn(
            f"{folder}: some cameras may be wrong: they contradict {pairs} that match, most of all"
            f" those of {suspects}. Leave these out, add photographs between them and their neighbours, or"
            " give the cameras of another program",
            DataWarning,
            stacklevel=2,
        )
    cameras = _transforms(best, prefix, named) | {TRIED: tried}
    with together():
        write_bytes(folder / POINTS, _points(best))
        write_text(folder / CAMERAS, json.dumps(cameras, indent=1) + "\n")
    made = f"cameras of {count} photographs and {len(best.points3D):,} points"
    took = f"{time.perf_counter() - began:.0f} s"
    say(f"{made}, in {took}, kept for the next time: {folder / CAMERAS}")


def check_library() -> None:
    """MissingDependencyError unless what finds cameras is installed."""
    if find_spec("pycolmap") is None:
        raise MissingDependencyError(NEEDS)


def _imported() -> Any:
    """pycolmap, but not its answer to SIGTERM, which is a stack trace, and leaves temporary files behind."""
    with suppress(ImportError):
        import_module("PIL.Image")  # first: loaded after pycolmap, it ends the process where it writes PNG
    try:
        import pycolmap
    except ModuleNotFoundError:
        raise MissingDependencyError(NEEDS) from None
    if threading.current_thread() is threading.main_thread():
        handler = signal.getsignal(signal.SIGTERM)
        if handler is not None:
            signal.signal(signal.SIGTERM, handler)
    return pycolmap


def _whole(folder: Path, photographs: list[Path], threads: int | None) -> dict[Path, Shot]:
    """How ``photographs`` were taken, without those that are broken, or panoramas among flat ones."""
    shots, broken = read_shots(photographs, thread_count(threads))
    if len(shots) < FEWEST and broken:
        reason = next(iter(broken.values()))
        raise ValueError(
            f"{folder}: {len(shots)} photographs can be read, at least {FEWEST} must be; {reason}"
        )
    if broken:
        names = shortened([path.name for path in broken])
        warnings.warn(
            f"{folder}: {len(broken)} of {len(photographs)} photographs cannot be read and are left out:"
            f" {names} ({next(iter(broken.values()))})",
            DataWarning,
            stacklevel=3,
        )
    flat = {path: shot for path, shot in shots.items() if not shot.is_panorama}
    if panoramas := [path.name for path in shots if path not in flat]:
        text = (
            f"{folder}: {len(panoramas)} of {len(photographs)} photographs are panoramas, whose cameras are"
            f" not found here: {shortened(panoramas)}"
        )
        if len(flat) < max(FEWEST, len(panoramas)):
            raise ValueError(f"{text}; convert them to perspective images, such as 90-degree cube faces")
        warnings.warn(f"{text}; they are left out", DataWarning, stacklevel=3)
    return flat


def _matched(
    pycolmap: Any,
    work: Path,
    images: list[Path],
    shots: list[Shot],
    masks: FeatureMasks,
    say: Callable[[str], None],
    threads: int | None,
) -> Path:
    """COLMAP's database of ``images``, in the folder ``work``, with their features and matches."""
    names, database = [path.name for path in images], work / "database.db"
    whole = not masks or masks.are_of_a_subject()
    if not whole:
        masks.write(work / "masks", images)
    _extract(pycolmap, database, images, shots, None if whole else work / "masks", threads)
    _match(pycolmap, database, names, say, threads)
    if masks and whole and masks.surroundings_stand_still(database, images):
        say("finding the cameras: what masks leave out stands still, so features there do not count")
        masks.write(work / "masks", images)
        database = work / "masked.db"
        _extract(pycolmap, database, images, shots, work / "masks", threads)
        _match(pycolmap, database, names, say, threads)
    return database


def _extract(
    pycolmap: Any,
    database: Path,
    images: list[Path],
    shots: list[Shot],
    masks: Path | None,
    threads: int | None,
) -> None:
    """Writes the features of ``images`` to COLMAP's database, with a camera for each lens of ``shots``;
    without those outside of the ``masks`` in a folder."""
    side = int(np.median([max(shot.size) for shot in shots]))
    options = _feature_options(pycolmap, side, len(images), threads)
    if masks is not None:
        options["reader_options"] = pycolmap.ImageReaderOptions()
        options["reader_options"].mask_path = masks
    shared, alone = by_lens(shots)
    modes = pycolmap.CameraMode
    for places, mode in (*((group, modes.SINGLE) for group in shared), (alone, modes.PER_IMAGE)):
        if places:
            pycolmap.extract_features(
                database,
                images[0].parent,
                [images[i].name for i in places],  # else all images in folders below, too
                camera_mode=mode,
                device=pycolmap.Device.cpu,
                **options,
            )


def _match(
    pycolmap: Any, database: Path, names: list[str], say: Callable[[str], None], threads: int | None
) -> None:
    """Matches the features of all pairs of the images ``names``, or where these are many, of those that look
    alike."""
    count = len(names)
    given = _matching_options(pycolmap, threads)
    # Older versions of the library have no function for given pairs.
    if count <= ALL_UP_TO or not hasattr(pycolmap, "match_image_pairs"):
        say(f"finding the cameras: {count * (count - 1) // 2:,} pairs")
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu, **given)
        return
    names = in_sequence(names)
    pairs = alike_pairs(_descriptors(database, names))
    say(f"finding the cameras: {len(pairs):,} pairs of photographs that look alike")
    chosen = database.parent / "pairs.txt"
    chosen.write_bytes("".join(f"{names[i]} {names[j]}\n" for i, j in pairs).encode("utf-8"))
    options = pycolmap.ImportedPairingOptions()
    options.match_list_path = chosen
    pycolmap.match_image_pairs(database, pairing_options=options, device=pycolmap.Device.cpu, **given)


def _matching_options(pycolmap: Any, threads: int | None) -> dict[str, Any]:
    """Options of ``match_exhaustive`` and ``match_image_pairs`` in the library's version."""
    if threads is None:
        return {}
    if hasattr(pycolmap, "FeatureMatchingOptions"):
        options = pycolmap.FeatureMatchingOptions()
        options.num_threads = threads
        return {"matching_options": options}
    return {"sift_options": {"num_threads": threads}}


def _descriptors(database: Path, names: list[str]) -> list[np.ndarray]:
    """(features, 128) uint8 for each of the images ``names`` in COLMAP's database."""
    query = "select name, rows, cols, data from descriptors join images using (image_id)"
    with closing(sqlite3.connect(database)) as connection:
        table = connection.execute(query).fetchall()
    # Of an image without features, data is NULL.
    found = {
        name: np.frombuffer(data or b"", np.uint8).reshape(rows, width) for name, rows, width, data in table
    }
    return [found.get(name, np.zeros((0, 128), np.uint8)) for name in names]


def _feature_options(pycolmap: Any, side: int, count: int, threads: int | None) -> dict[str, Any]:
    """Options of ``extract_features`` in the library's version, for ``count`` images of that longest
    ``side``."""
    doubled = side < DOUBLED_BELOW and count <= DOUBLED_UP_TO
    sift = {"max_num_features": MAX_FEATURES, "first_octave": -1 if doubled else 0}
    general = {"max_image_size": MAX_SIDE} | ({} if threads is None else {"num_threads": threads})
    if hasattr(pycolmap, "FeatureExtractionOptions"):
        options = pycolmap.FeatureExtractionOptions()
        for place, values in ((options, general), (options.sift, sift)):
            for name, value in values.items():
                setattr(place, name, value)
        return {"extraction_options": options}
    return {"sift_options": {**general, **sift}}


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
