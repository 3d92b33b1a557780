"""Photographs from a video: sharp frames, evenly spread over what the camera saw."""

from __future__ import annotations

import hashlib
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from meshsplats._common.foreign import VIDEO_SUFFIXES, frames_of, is_a_video
from meshsplats._common.json_files import read_json
from meshsplats._common.words import plural
from meshsplats._files.atomic import may_write_in, patiently, write_json
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.images.reading import MAX_PIXELS
from meshsplats.images.writing import save_image
from meshsplats.training.hdr import as_srgb, is_hdr

FRAMES_PER_SECOND = 2.0
FEWEST_FRAMES, MOST_FRAMES = 40, 120
"""Frames by default: so many per second, but not fewer or more than these. The time for their cameras grows
faster than their number."""
IMAGES = "images"
"""Folder of the frames in that of a video."""
RECORD = "video.json"
"""File beside it: the name of the video, and what tells it from others."""
RECORD_BYTES = 1 << 16
END_BYTES = 1 << 20
LOOK_SIDE, MOTION_SIDE = 480, 64
"""Longest side of a frame as it is searched for edges, and sides of the picture that motion is told by."""
STILL = 0.05
"""Motion that every frame counts at least, as a share of the mean: in a video that stands still, time
decides."""
LONG = 600.0
"""Seconds. Of longer videos, only key frames are looked at, one in a second or in ten: to decode all takes
too long."""
SAID_EVERY = 10.0
"""Seconds after which it is said how far the look at a video has come."""
RGB_MATRIX = "ITU601"
"""Matrix that is asked for: older versions of PyAV heed a frame's own only if it is another. RGB has none."""
WIDEST = 4
"""Sides of a pixel have a ratio of so much, at most. Beyond it, the file is taken to be wrong."""
DEINTERLACER = "estdif"
"""FFmpeg's filter of interlaced frames: of one frame alone, as frames that are taken are far from each
other."""
NEEDS = 'videos need the library PyAV: pip install "meshsplats[video]"'


class Frames(NamedTuple):
    """What is known of the n frames of a video, in order."""

    sharpness: np.ndarray
    """(n,) mean square of the Laplacian of the grey values."""
    motion: np.ndarray
    """(n,) how much each frame differs from the one before, 0 for the first: roughly proportional to the
    distance that the camera moves between close frames."""
    seconds: float
    """Length of the video."""


def is_video(path: Path) -> bool:
    """Whether ``path`` is a file with the suffix of a video, or of no known kind that begins like one."""
    return path.is_file() and (path.suffix.lower() in VIDEO_SUFFIXES or is_a_video(path))


def photographs_of(
    path: Path, frames: int | None = None, say: Callable[[str], None] = lambda text: None
) -> Path:
    """The folder of photographs at ``path``: of a video, one beside it, NAME-frames, which is made by
    ``save_frames`` with so many ``frames`` unless it is there; else ``path`` itself.

    Raises ValueError for ``frames`` without a video, FileFormatError for another number of them than are
    there, and for those of another video; otherwise errors are those of ``save_frames``.
    """
    if not is_video(path):
        if frames is not None:
            raise ValueError(f"a number of frames is for a video, and {path} is none")
        return path
    folder = frames_of(path)
    if not (folder / IMAGES).is_dir():
        save_frames(path, folder, frames, say)
        return folder
    record, wanted = folder / RECORD, None
    if record.is_file():
        made_of = read_json(record, RECORD_BYTES)
        wanted = made_of.get("wanted") if isinstance(made_of, dict) else None
        if not isinstance(made_of, dict) or made_of.get("sha256") != _digest(path):
            name = made_of.get("name") if isinstance(made_of, dict) else None
            raise FileFormatError(
                f"{folder} has the frames of another video ({name}): give {path.name} another name, or remove"
                " the folder"
            )
    there = len(list((folder / IMAGES).glob("*.jpg")))
    if frames not in (None, there, wanted):
        raise FileFormatError(
            f"{folder} has {there} frames, not {frames}: remove it, or keep them: leave out ``frames``"
        )
    say(f"the {there} frames of {path.name} that are in {folder}")
    return folder


def save_frames(
    video: Path, folder: Path, count: int | None = None, say: Callable[[str], None] = lambda text: None
) -> int:
    """Writes the ``count`` best frames of ``video`` as JPEG files to ``folder``/images, whole or not at all.

    The camera path is divided into ``count`` equal parts, and the sharpest frame of each is taken. Frames are
    rotated and scaled to square pixels as players show them; interlaced ones are deinterlaced, from the
    earlier field.

    Args:
        count: number of frames; None: two per second, 40 to 120.
        say: is called with a line about each stage.

    Returns:
        The number of frames, fewer than ``count`` if the video has fewer.

    Raises:
        MissingDependencyError: PyAV is not installed.
        FileFormatError: not a video that can be read, or one of larger frames than images may have.
        FileExistsError: ``folder`` is there.
        PermissionError: nothing may be written beside it.
        ValueError: ``count`` below 2.

    Warns with a DataWarning where a video cannot be read to its end.
    """
    if count is not None and count < 2:
        raise ValueError(f"at least 2 frames are needed, got {count}")
    if not may_write_in(folder.parent):
        raise PermissionError(
            f"{folder.parent}: no permission to write the frames there; copy {video.name} to where you may"
        )
    if folder.exists():
        raise FileExistsError(f"{folder}: is there already, without frames: move it away")
    say(f"looking at the frames of {video.name}")
    frames = look_at_frames(video, say)
    chosen = choose_frames(frames, count or usual_count(frames.seconds))
    say(f"{len(chosen)} of {len(frames.sharpness):,} frames: {folder / IMAGES}")
    wanted = {int(frame): place for place, frame in enumerate(chosen)}
    # A video may have fewer frames that differ than were wanted, and the user may throw some away.
    record = {"name": video.name, "sha256": _digest(video), "wanted": count}
    stored = _stored(video)
    if is_hdr(stored.transfer, stored.primaries):
        say("the video is HDR: its colours are brought to sRGB")
    can_mend, interlaced = _can_deinterlace(), False
    with tempfile.TemporaryDirectory(prefix=f".{folder.name}-", dir=folder.parent) as beside:
        made = Path(beside) / folder.name
        (made / IMAGES).mkdir(parents=True)
        for index, frame in enumerate(_decoded(video)):
            if index in wanted:
                if frame.interlaced_frame and can_mend and not interlaced:
                    say("the video is interlaced: frames are made of one of their two fields")
                interlaced |= frame.interlaced_frame
                field = _one_field(frame, video) if frame.interlaced_frame and can_mend else frame
                pixels = _turned(_pixels(field, stored), frame.rotation)
                save_image(made / IMAGES / f"{wanted[index] + 1:04d}.jpg", pixels)
            if index == chosen[-1]:
                break
        write_json(made / RECORD, record)
        patiently(partial(made.rename, folder))
    if interlaced and not can_mend:
        warnings.warn(
            f"{video}: is interlaced, which shows as combs where it moves, and this version of PyAV has no"
            f" filter {DEINTERLACER}: deinterlace it first, with ffmpeg -vf bwdif, for one",
            DataWarning,
            stacklevel=2,
        )
    return len(chosen)


def _digest(video: Path) -> str:
    """SHA-256 of the size and of the ends of a file: videos are too large to be read whole for this."""
    size = video.stat().st_size
    found = hashlib.sha256(str(size).encode())
    with open(video, "rb") as file:
        found.update(file.read(END_BYTES))
        file.seek(max(size - END_BYTES, 0))
        found.update(file.read(END_BYTES))
    return found.hexdigest()


def usual_count(seconds: float) -> int:
    """Number of frames to take of a video of that length."""
    return int(min(max(round(FRAMES_PER_SECOND * seconds), FEWEST_FRAMES), MOST_FRAMES))


def look_at_frames(video: Path, say: Callable[[str], None] = lambda text: None) -> Frames:
    """Sharpness and motion of every frame of ``video``. ``say`` is told now and then how far it has come.
    Errors are those of ``save_frames``."""
    sharpness, motion, before = [], [], None
    first, seconds, said = None, 0.0, time.perf_counter()
    for frame in _decoded(video, warn=True):
        scale = min(1.0, LOOK_SIDE / max(frame.width, frame.height))
        size = {"width": max(1, round(scale * frame.width)), "height": max(1, round(scale * frame.height))}
        if frame.interlaced_frame:  # the combs of two fields would count as edges where the camera moves
            field = frame.reformat(width=size["width"], format="gray").to_ndarray()[::2]
            grey = field.astype(np.float32)
        else:
            grey = frame.reformat(**size, format="gray").to_ndarray().astype(np.float32)
        small = frame.reformat(width=MOTION_SIDE, height=MOTION_SIDE, format="gray").to_ndarray()
        # Exposure and contrast may change while the camera stands still.
        now = small.astype(np.float32) - small.mean(dtype=np.float32)
        now /= max(float(np.sqrt(np.square(now).mean())), 1.0)
        sharpness.append(_sharpness(grey))
        motion.append(0.0 if before is None else float(np.sqrt(np.square(now - before).mean())))
        before = now
        shown = float(frame.time or 0)
        first = shown if first is None else min(first, shown)  # recordings of broadcasts begin at hours
        seconds = max(seconds, shown - first)
        if time.perf_counter() - said >= SAID_EVERY:
            said = time.perf_counter()
            place = f"{int(seconds) // 60}:{int(seconds) % 60:02d}"
            say(f"looking at the frames of {video.name}: {len(sharpness):,} so far, to {place}")
    if len(sharpness) < 2:
        count = plural(len(sharpness), "frame")
        raise FileFormatError(f"{video}: {count} can be read, at least 2 are needed")
    return Frames(np.array(sharpness), np.array(motion), seconds)


def choose_frames(frames: Frames, count: int) -> np.ndarray:
    """(at most count,) int64, increasing: the sharpest frame of each of ``count`` equal parts of the way."""
    steps = np.maximum(frames.motion, STILL * frames.motion.mean())
    if not steps.any():
        steps = np.ones_like(steps)
    way = np.cumsum(steps) - steps / 2
    part = np.minimum((way / steps.sum() * count).astype(np.int64), count - 1)
    order = np.lexsort((-frames.sharpness, part))
    return np.sort(order[np.unique(part[order], return_index=True)[1]])


def _sharpness(grey: np.ndarray) -> float:
    if min(grey.shape) < 3:
        return 0.0
    middle = grey[1:-1, 1:-1]
    laplacian = grey[:-2, 1:-1] + grey[2:, 1:-1] + grey[1:-1, :-2] + grey[1:-1, 2:] - 4 * middle
    return float(np.square(laplacian).mean())


def _decoded(video: Path, warn: bool = False) -> Iterator[Any]:
    """The frames of ``video``; with ``warn``, a DataWarning says where it cannot be read on."""
    try:
        import av
    except ModuleNotFoundError:
        raise MissingDependencyError(NEEDS) from None
    count = 0
    try:
        with av.open(str(video)) as container:
            if not container.streams.video:
                raise FileFormatError(f"{video}: has no pictures, only sound")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            width, height = _shown_size(stream.codec_context, _ratio(stream))
            if width * height > MAX_PIXELS:
                raise FileFormatError(
                    f"{video}: frames have more than {MAX_PIXELS:,} pixels, as they are shown"
                )
            if (container.duration or 0) > LONG * av.time_base:
                stream.codec_context.skip_frame = "NONKEY"
            for frame in container.decode(stream):
                yield frame
                count += 1
    except av.FFmpegError as error:
        if not count:
            cut = "; was the recording cut short?" if isinstance(error, av.InvalidDataError) else ""
            raise FileFormatError(f"{video}: not a video that can be read ({error.strerror}){cut}") from None
        if warn:
            text = f"{video}: cannot be read beyond frame {count:,} ({error.strerror})"
            warnings.warn(text, DataWarning, stacklevel=3)


class _Stored(NamedTuple):
    """How the frames of a video are stored."""

    transfer: int
    primaries: int
    """FFmpeg's numbers of the transfer function and of the primaries."""
    ratio: Fraction
    """Width of a pixel by its height."""


def _stored(video: Path) -> _Stored:
    """That of a video that was decoded."""
    import av

    with av.open(str(video)) as container:
        stream = container.streams.video[0]
        context = stream.codec_context
        return _Stored(int(context.color_trc), int(context.color_primaries), _ratio(stream))


def _ratio(stream: Any) -> Fraction:
    """Width of a pixel of ``stream`` by its height; 1 where that cannot be."""
    ratio = Fraction(stream.sample_aspect_ratio or 1)  # the file's own counts more than the codec's
    return ratio if Fraction(1, WIDEST) <= ratio <= WIDEST else Fraction(1)


def _shown_size(stored: Any, ratio: Fraction) -> tuple[int, int]:
    """Width and height of frames of ``stored``'s with square pixels: the side is stretched that is too
    short."""
    if ratio > 1:
        return round(stored.width * ratio), stored.height
    return stored.width, round(stored.height / ratio)


def _pixels(frame: Any, stored: _Stored) -> np.ndarray:
    """(h, w, 3) float32 sRGB in [0, 1] of a frame, with square pixels."""
    width, height = _shown_size(frame, stored.ratio)
    given: dict[str, Any] = {"dst_colorspace": RGB_MATRIX}
    if (width, height) != (frame.width, frame.height):
        given |= {"width": width, "height": height, "interpolation": "BICUBIC"}
    if is_hdr(stored.transfer, stored.primaries):
        rgb = frame.to_ndarray(format="rgb48le", **given)
        return as_srgb(rgb, stored.transfer, stored.primaries)
    return frame.to_ndarray(format="rgb24", **given) / np.float32(255)


def _can_deinterlace() -> bool:
    from av.filter import filters_available

    return DEINTERLACER in filters_available


def _one_field(frame: Any, video: Path) -> Any:
    """An interlaced ``frame`` of ``video`` whose second field is made of the first, which was taken at
    another time. FileFormatError where the filter does not take its pixels."""
    from av import FFmpegError
    from av.filter import Graph

    graph = Graph()
    base = frame.time_base or Fraction(1, 25)
    try:
        begin = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=base)
        middle, end = graph.add(DEINTERLACER, "mode=frame:deint=all"), graph.add("buffersink")
        begin.link_to(middle)
        middle.link_to(end)
        graph.configure()
        graph.push(frame)
        graph.push(None)
        return graph.pull()
    except FFmpegError as error:
        raise FileFormatError(
            f"{video}: is interlaced, and frames of format {frame.format.name} cannot be deinterlaced here"
            f" ({error.strerror}): deinterlace it first, for example with ffmpeg -vf bwdif"
        ) from None


def _turned(pixels: np.ndarray, degrees: float) -> np.ndarray:
    """``pixels`` (h, w, 3) turned counter-clockwise by the nearest quarter turn."""
    return np.rot90(pixels, round(degrees / 90) % 4)
