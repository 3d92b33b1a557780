"""Frames of videos as photographs: sharp ones, evenly spread over the camera's way, turned as players do."""

from __future__ import annotations

import builtins
from fractions import Fraction
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from PIL import Image, ImageFilter

from meshsplats.cli import main
from meshsplats.datasets.folder import load_dataset
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.training import video as module
from meshsplats.training.photographs import PhotographOptions
from meshsplats.training.video import (
    Frames,
    choose_frames,
    is_video,
    look_at_frames,
    photographs_of,
    save_frames,
    usual_count,
)

av = pytest.importorskip(
    "av", reason="the library of videos is not installed: pip install 'meshsplats[video]'"
)

Graph = pytest.importorskip("av.filter").Graph
RATE = 10
"""Frames per second."""


def write_video(
    path: Path, frames: list[np.ndarray], rotation: int = 0, ratio: Fraction | None = None, start: int = 0
) -> Path:
    """``frames`` (h, w, 3) uint8, to be shown turned counter-clockwise by ``rotation`` degrees, with pixels
    whose width by their height is ``ratio``; the first at ``start``, in frames."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=RATE)
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt, stream.bit_rate = "yuv420p", 4_000_000
        if ratio:
            stream.codec_context.sample_aspect_ratio = ratio
        if rotation:
            stream.set_display_rotation(rotation)
        for number, frame in enumerate(frames):
            image = av.VideoFrame.from_ndarray(frame, format="rgb24")
            image.pts, image.time_base = start + number, Fraction(1, RATE)
            container.mux(stream.encode(image))
        container.mux(stream.encode())
    return path


def passing(places: list[int], blurred: set[int] = frozenset()) -> list[np.ndarray]:
    """Pictures of a wall of random squares through a window of 96 x 64 pixels, at ``places`` along it."""
    rng = np.random.default_rng(0)
    wall = np.kron(rng.integers(0, 256, (16, 200, 3), np.uint8), np.ones((4, 4, 1), np.uint8))
    frames = []
    for i, place in enumerate(places):
        image = Image.fromarray(wall[:, place : place + 96])
        frames.append(np.array(image.filter(ImageFilter.GaussianBlur(2)) if i in blurred else image))
    return frames


def place_of(path: Path) -> int:
    """Where along the wall a saved frame was taken."""
    seen = np.asarray(Image.open(path).convert("L"), float)
    walls = {
        p: np.asarray(Image.fromarray(f).convert("L"), float) for p, f in enumerate(passing(list(range(600))))
    }
    return min(walls, key=lambda place: float(np.square(walls[place] - seen).mean()))


def test_the_sharpest_frame_of_each_part_of_the_way():
    # Ways of 1 each: parts end after the third and the sixth frame.
    frames = Frames(np.array([1.0, 9, 2, 3, 3, 8, 5, 7, 6]), np.ones(9), 1.0)
    np.testing.assert_array_equal(choose_frames(frames, 3), [1, 5, 7])
    # The camera stands still during the first five frames: they are one part together, or less.
    still = Frames(np.arange(9.0), np.array([0.0, 0, 0, 0, 0, 1, 1, 1, 1]), 1.0)
    np.testing.assert_array_equal(choose_frames(still, 4), [5, 6, 7, 8])
    nothing_moves = Frames(np.arange(6.0), np.zeros(6), 1.0)
    np.testing.assert_array_equal(choose_frames(nothing_moves, 2), [2, 5])


@given(
    arrays(np.float64, st.integers(2, 40), elements=st.floats(0, 1e6)),
    st.integers(2, 50),
    st.integers(0, 2**32 - 1),
)
def test_frames_are_chosen_once_and_in_order(motion, count, seed):
    frames = Frames(np.random.default_rng(seed).random(len(motion)), motion, 1.0)
    chosen = choose_frames(frames, count)
    assert 1 <= len(chosen) <= min(count, len(motion))
    assert (np.diff(chosen) > 0).all()
    assert 0 <= chosen[0] <= chosen[-1] < len(motion)


def test_length_decides_how_many_frames_are_usual():
    assert [usual_count(seconds) for seconds in (0, 5, 30, 60, 3600)] == [40, 40, 60, 120, 120]


def test_blurred_frames_are_passed_over(tmp_path):
    blurred = set(range(60)) - set(range(3, 60, 5))
    clip = write_video(tmp_path / "walk.mp4", passing([3 * i for i in range(60)], blurred))
    frames = look_at_frames(clip)
    assert len(frames.sharpness) == 60
    assert frames.seconds == pytest.approx(5.9)
    assert set(choose_frames(frames, 12)) <= set(range(60)) - blurred


@pytest.mark.parametrize("name", ["walk.mp4", "walk.ts"])
def test_recordings_that_begin_at_hours_are_as_long_as_others(tmp_path, name):
    clip = write_video(tmp_path / name, passing([3 * i for i in range(20)]), start=3600 * RATE)
    assert look_at_frames(clip).seconds == pytest.approx(1.9)


def test_frames_are_spread_over_the_way_not_the_time(tmp_path):
    places = [0] * 40 + [8 * i for i in range(1, 41)]  # at first, the camera stands still
    clip = write_video(tmp_path / "walk.mp4", passing(places))
    assert save_frames(clip, tmp_path / "frames", 10) == 10
    found = sorted((tmp_path / "frames/images").iterdir())
    assert [path.name for path in found] == [f"{i:04d}.jpg" for i in range(1, 11)]
    seen = [place_of(path) for path in found]
    assert seen == sorted(seen)
    assert max(np.diff(seen)) <= 64  # of 320, in ten parts
    assert seen.count(0) <= 2


@pytest.mark.parametrize("degrees", [90, -90, 180])
def test_frames_are_turned_as_players_show_them(tmp_path, degrees):
    if not hasattr(av.video.stream.VideoStream, "set_display_rotation"):
        pytest.skip("this version of PyAV does not write rotations")
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:32, :48] = 255  # light to the left above
    clip = write_video(tmp_path / "phone.mov", [picture] * 4, degrees)
    save_frames(clip, tmp_path / "frames", 2)
    seen = np.asarray(Image.open(tmp_path / "frames/images/0001.jpg").convert("L"))
    # By hand: counter-clockwise, the corner to the left above comes to the left below.
    corner = {90: (slice(48, None), slice(None, 32)), -90: (slice(None, 48), slice(32, None))}
    expected = np.zeros((64, 96) if degrees == 180 else (96, 64))
    expected[corner.get(degrees, (slice(32, None), slice(48, None)))] = 255
    assert seen.shape == expected.shape
    assert np.abs(seen - expected).mean() < 8


@pytest.mark.parametrize(("ratio", "size"), [("4/3", (128, 64)), ("8/9", (96, 72)), ("1/40", (96, 64))])
@pytest.mark.parametrize("turn", [0, 90])
def test_pixels_that_are_not_square_are_stretched(tmp_path, ratio, size, turn):
    """By hand: a square of the wall is 32 pixels wide as it is stored, and so much wider as it is shown."""
    if turn and not hasattr(av.video.stream.VideoStream, "set_display_rotation"):
        pytest.skip("this version of PyAV does not write rotations")
    picture = np.zeros((64, 96, 3), np.uint8)
    picture[:, :32] = 255
    clip = write_video(tmp_path / "tape.mov", [picture] * 4, turn, Fraction(ratio))
    save_frames(clip, tmp_path / "frames", 2)
    seen = np.asarray(Image.open(tmp_path / "frames/images/0001.jpg").convert("L"))
    seen = np.rot90(seen, -turn // 90)
    assert (seen.shape[1], seen.shape[0]) == size
    expected = np.zeros(seen.shape)
    expected[:, : round(size[0] / 3)] = 255
    assert np.abs(seen - expected).mean() < 8


def write_interlaced(path: Path, fields: list[np.ndarray]) -> Path:
    """Frames of two ``fields`` (h, w, 3) each, of which each second line is taken: the even ones first."""
    frames = [np.where(np.arange(len(a))[:, None, None] % 2, b, a) for a, b in pairwise(fields)][::2]
    graph = Graph()
    height, width = frames[0].shape[:2]
    begin = graph.add_buffer(width=width, height=height, format="yuv420p", time_base=Fraction(1, RATE))
    middle, end = graph.add("setfield", "tff"), graph.add("buffersink")
    begin.link_to(middle)
    middle.link_to(end)
    graph.configure()
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg2video", rate=25, options={"flags": "+ildct+ilme"})
        stream.height, stream.width = height, width
        stream.pix_fmt, stream.bit_rate = "yuv420p", 8_000_000
        for i, picture in enumerate(frames):
            # Chroma of neighbouring lines is mixed: grey pictures have none.
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format="yuv420p")
            frame.pts, frame.time_base = i, Fraction(1, RATE)
            graph.push(frame)
            field = graph.pull()
            field.pts, field.time_base = i, Fraction(1, 25)
            container.mux(stream.encode(field))
        container.mux(stream.encode())
    return path


def combs(pixels: np.ndarray) -> float:
    return float(np.abs(pixels[1:-1] - (pixels[:-2] + pixels[2:]) / 2).mean())


@pytest.mark.parametrize("can", [True, False])
def test_of_an_interlaced_video_frames_are_one_moment(tmp_path, monkeypatch, can):
    # Columns that move by their width from field to field.
    columns = np.tile(np.where(np.arange(96) // 8 % 2, 230, 25), (64, 1)).astype(np.uint8)
    fields = [np.repeat(np.roll(columns, 8 * i, axis=1)[..., None], 3, axis=2) for i in range(12)]
    clip = write_interlaced(tmp_path / "tape.mpg", fields)
    said: list[str] = []
    monkeypatch.setattr(module, "_can_deinterlace", lambda: can)
    if can:
        save_frames(clip, tmp_path / "frames", 2, said.append)
        assert sum("video is interlaced" in line for line in said) == 1
    else:
        with pytest.warns(DataWarning, match=r"tape\.mpg: is interlaced, .* deinterlace it first"):
            save_frames(clip, tmp_path / "frames", 2)
    found = [np.asarray(Image.open(f).convert("L"), float) for f in (tmp_path / "frames/images").iterdir()]
    assert len(found) == 2
    for seen in found:
        assert seen.shape == (64, 96)
        assert (combs(seen) < 10) == can


def test_combs_of_two_fields_are_no_sharpness(tmp_path):
    smooth = np.rint(127 + 100 * np.sin(np.arange(96) / 96 * 4 * np.pi))
    fields = [np.tile(np.roll(smooth, 12 * i)[None, :, None], (64, 1, 3)).astype(np.uint8) for i in range(12)]
    still = look_at_frames(write_interlaced(tmp_path / "still.mpg", fields[:1] * 12))
    moving = look_at_frames(write_interlaced(tmp_path / "moving.mpg", fields))
    assert moving.sharpness.mean() < 3 * still.sharpness.mean()


KINDS = {"mpegts": ".ts", "asf": ".wmv", "flv": ".flv", "mxf": ".mxf", "vob": ".vob", "3g2": ".3g2"}


@pytest.mark.parametrize("kind", list(KINDS))
def test_videos_of_many_kinds_are_known_by_name_and_by_content(tmp_path, kind):
    plain = tmp_path / f"walk{KINDS[kind]}"
    codec = {"flv": "flv", "mpegts": "mpeg2video", "mxf": "mpeg2video", "vob": "mpeg2video"}.get(
        kind, "mpeg4"
    )
    with av.open(str(plain), "w", format=kind) as container:
        stream = container.add_stream(codec, rate=25)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for frame in passing([0, 5, 10, 15]):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    assert is_video(plain)
    assert len(look_at_frames(plain).sharpness) >= 3
    nameless = plain.rename(tmp_path / "walk.copy")
    assert is_video(nameless)
    (tmp_path / "walk.copy").write_bytes(b"no video")
    assert not is_video(nameless)


def test_a_video_in_the_place_of_its_frames_names_them(tmp_path):
    clip = write_video(tmp_path / "walk.mp4", passing([0, 5]))
    with pytest.raises(FileFormatError, match="puts these into walk-frames, the folder to give as data"):
        load_dataset(clip)


def test_what_is_no_video_is_refused_before_anything_is_written(tmp_path):
    (tmp_path / "noise.mp4").write_bytes(np.random.default_rng(0).bytes(4000))
    (tmp_path / "empty.mov").write_bytes(b"")
    for name in ("noise.mp4", "empty.mov"):
        with pytest.raises(
            FileFormatError, match=rf"{name}: not a video that can be read .*; was the recording cut short\?"
        ):
            photographs_of(tmp_path / name)
    with av.open(str(tmp_path / "song.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
    with pytest.raises(FileFormatError, match=r"song\.mkv: has no pictures, only sound"):
        photographs_of(tmp_path / "song.mkv")
    short = write_video(tmp_path / "short.mp4", passing([0]))
    with pytest.raises(FileFormatError, match="1 frame can be read, at least 2 are needed"):
        photographs_of(short)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "empty.mov",
        "noise.mp4",
        "short.mp4",
        "song.mkv",
    ]


def test_a_video_that_is_cut_off_gives_the_frames_before(tmp_path):
    whole = write_video(tmp_path / "walk.mkv", passing([5 * i for i in range(50)])).read_bytes()
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole[: len(whole) // 2])
    frames = look_at_frames(cut)
    assert 10 < len(frames.sharpness) < 40


def test_the_look_at_a_video_says_how_far_it_has_come(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(30)]))
    clock = iter(range(0, 1000, 4))  # four seconds for a frame
    monkeypatch.setattr(module, "time", SimpleNamespace(perf_counter=lambda: next(clock)))
    monkeypatch.setattr(module, "SAID_EVERY", 60)
    said: list[str] = []
    look_at_frames(clip, said.append)
    assert said[0] == "looking at the frames of walk.mp4: 15 so far, to 0:01"


def test_a_video_that_breaks_off_says_where(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(10)]))

    class Damaged:
        def __init__(self, name):
            self.container = av_open(name)
            self.streams, self.duration = self.container.streams, self.container.duration

        def __enter__(self):
            return self

        def __exit__(self, *_):
            self.container.close()

        def decode(self, stream):
            for i, frame in enumerate(self.container.decode(stream)):
                if i == 6:
                    raise av.FFmpegError(1, "damaged")
                yield frame

    av_open = av.open
    monkeypatch.setattr(av, "open", Damaged)
    with pytest.warns(DataWarning, match=r"walk\.mp4: cannot be read beyond frame 6 \(damaged\)"):
        assert len(look_at_frames(clip).sharpness) == 6


def test_of_a_long_video_only_key_frames_are_taken(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(60)]))
    with av.open(str(clip)) as container:
        stream = container.streams.video[0]
        keys = sum(packet.is_keyframe for packet in container.demux(stream) if packet.dts is not None)
    assert 2 < keys < 20
    monkeypatch.setattr(module, "LONG", 5.9)
    assert len(look_at_frames(clip).sharpness) == keys
    assert save_frames(clip, tmp_path / "frames", 40) <= keys
    monkeypatch.setattr(module, "LONG", 6.1)
    assert len(look_at_frames(clip).sharpness) == 60


def test_larger_frames_than_images_may_have_are_refused(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "walk.mp4", passing([0, 5]))
    monkeypatch.setattr(module, "MAX_PIXELS", 96 * 64 - 1)
    with pytest.raises(FileFormatError, match="more than 6,143 pixels"):
        photographs_of(clip)


def test_frames_that_are_larger_once_stretched_are_refused(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "wide.mov", passing([0, 5]), ratio=Fraction(2))
    monkeypatch.setattr(module, "MAX_PIXELS", 2 * 96 * 64 - 1)
    with pytest.raises(FileFormatError, match="more than 12,287 pixels, as they are shown"):
        photographs_of(clip)
    assert not (tmp_path / "wide-frames").exists()


def test_interlaced_frames_that_the_filter_does_not_take_are_named(tmp_path):
    """Those that lie on a GPU, for one."""
    kind = av.VideoFormat("vaapi", 96, 64)
    frame = SimpleNamespace(width=96, height=64, format=kind, time_base=None)
    with pytest.raises(FileFormatError, match=r"tape\.mpg: is interlaced, .* format vaapi .* deinterlace it"):
        module._one_field(frame, tmp_path / "tape.mpg")


def test_the_frames_of_a_video_are_made_once(tmp_path):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(20)]))
    said: list[str] = []
    folder = photographs_of(clip, 5, said.append)
    assert folder == tmp_path / "walk-frames"
    first = sorted((folder / "images").iterdir())
    times = [path.stat().st_mtime_ns for path in first]
    assert photographs_of(clip, None, said.append) == folder
    assert photographs_of(clip, 5) == folder
    assert [path.stat().st_mtime_ns for path in first] == times
    assert said[-1].startswith("the 5 frames of walk.mp4 that are in ")
    with pytest.raises(ValueError, match="has 5 frames, not 6: remove it"):
        photographs_of(clip, 6)
    with pytest.raises(FileExistsError):
        save_frames(clip, folder)
    with pytest.raises(ValueError, match="at least 2 frames are needed, got 1"):
        save_frames(clip, tmp_path / "other", 1)
    with pytest.raises(ValueError, match="a number of frames is for a video"):
        photographs_of(folder, 5)
    assert photographs_of(folder) == folder
    assert not is_video(folder)
    first[0].unlink()  # a blurred one
    for count in (None, 4, 5):  # the same command goes on
        assert photographs_of(clip, count) == folder


def test_a_video_of_fewer_frames_than_are_wanted_is_taken_again(tmp_path):
    clip = write_video(tmp_path / "walk.mp4", passing([0, 5, 10, 15, 20, 25]))
    folder = photographs_of(clip, 9)
    assert len(list((folder / "images").iterdir())) < 9
    assert photographs_of(clip, 9) == folder


def test_colours_are_those_of_the_matrix_that_the_video_names(tmp_path):
    """BT.709, in pictures of the size that other programs take for BT.601."""
    y, cb, cr = 63, 102, 240  # red, of 16 to 235 and 16 to 240
    path = tmp_path / "red.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=RATE)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        context = stream.codec_context
        context.colorspace = context.color_primaries = context.color_trc = 1
        context.color_range = 1
        for i in range(3):
            frame = av.VideoFrame(64, 48, "yuv420p")
            frame.colorspace, frame.color_range = 1, 1
            for plane, value in zip(frame.planes, (y + i, cb, cr), strict=True):
                plane.update(bytes([value]) * plane.buffer_size)
            frame.pts = i
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    save_frames(path, tmp_path / "frames", 2)
    seen = np.asarray(Image.open(tmp_path / "frames/images/0001.jpg"))[24, 32].astype(int)
    assert np.abs(seen - (255, 0, 0)).max() < 8


def test_frames_of_another_video_of_that_name_are_refused(tmp_path):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(20)]))
    other = write_video(tmp_path / "walk.mov", passing([3 * i for i in range(20)]))
    folder = photographs_of(clip, 5)
    with pytest.raises(
        FileFormatError, match=r"the frames of another video \(walk\.mp4\): give walk\.mov another"
    ):
        photographs_of(other)
    assert photographs_of(clip) == folder
    clip.replace(other)  # the same video
    assert photographs_of(other) == folder
    (folder / "video.json").unlink()  # made by an earlier version
    assert photographs_of(other) == folder


def test_train_takes_a_video(tmp_path, monkeypatch, capsys):
    clip = write_video(tmp_path / "walk.mp4", passing([5 * i for i in range(20)]))
    asked = []

    def no_cameras(folder, say, threads):
        asked.append(folder)
        raise ValueError("none found")

    monkeypatch.setattr("meshsplats.training.reconstruction.find_cameras", no_cameras)
    monkeypatch.setattr("meshsplats.training.reconstruction.check_library", lambda: None)
    words = ["train", str(clip), "-o", str(tmp_path / "mesh.npz")]
    assert main([*words, "--frames", "6"]) == 1
    assert asked == [tmp_path / "walk-frames"]
    assert "6 of 20 frames" in capsys.readouterr().err
    assert main([*words, "--frames", "7"]) == 1
    assert "has 6 frames, not 7" in capsys.readouterr().err


def test_what_is_needed_is_asked_before_the_look_at_a_video(tmp_path, monkeypatch):
    clip = write_video(tmp_path / "walk.mp4", passing([0, 5]))
    monkeypatch.setattr(module, "look_at_frames", lambda *given: pytest.fail("looked"))
    with monkeypatch.context() as patch:
        patch.setattr("meshsplats.training.reconstruction.find_spec", lambda name: None)
        with pytest.raises(MissingDependencyError, match=r"meshsplats\[photos\]"):
            PhotographOptions().with_cameras(clip, print)
    monkeypatch.setattr(module, "may_write_in", lambda folder: False)
    with pytest.raises(PermissionError, match="no permission to write the frames"):
        photographs_of(clip)


@pytest.mark.parametrize(
    ("option", "value", "message"),
    [
        ("--test-every", "1", "--test-every must be 0"),
        ("--downscale", "0", "--downscale must be a whole number from 1 to 64, got 0"),
        ("--frames", "1", "--frames must be at least 2, got 1"),
    ],
)
def test_wrong_options_are_refused_before_cameras_are_found(
    tmp_path, monkeypatch, capsys, option, value, message
):
    monkeypatch.setattr(PhotographOptions, "with_cameras", lambda *given, **more: pytest.fail("looked"))
    (tmp_path / "photos").mkdir()
    words = ["train", str(tmp_path / "photos"), "-o", str(tmp_path / "mesh.npz"), option, value]
    assert main(words) == 2
    assert message in capsys.readouterr().err


def test_without_its_library_the_extra_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest):
        if name == "av":
            raise ModuleNotFoundError(name)
        return real(name, *rest)

    clip = write_video(tmp_path / "walk.mp4", passing([0, 5]))
    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"meshsplats\[video\]"):
        photographs_of(clip)
    assert [path.name for path in tmp_path.iterdir()] == ["walk.mp4"]
