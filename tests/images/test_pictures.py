"""Image files, read back by Pillow."""

from __future__ import annotations

import io
import struct

import numpy as np
import pytest
from PIL import Image, ImageFont

from meshsplats.errors import FileFormatError
from meshsplats.images.reading import load_image, read_shot
from meshsplats.images.writing import (
    CAPTION,
    GAP,
    amplified_error,
    encode_array,
    encode_depth_png,
    encode_image,
    save_animation,
    save_image,
    straight_rgba,
    strip,
    to_bytes,
)

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("kind", [2, 7, 11, 12])
def test_a_broken_tiff_is_an_error_of_its_file(tmp_path, kind):
    """Pillow raises a TypeError where the place of the pixels is no whole number."""
    path = tmp_path / "a.tif"
    Image.new("RGB", (9, 8)).save(path)
    data = path.read_bytes()
    changed = data.replace(struct.pack("<HH", 273, 4), struct.pack("<HH", 273, kind))
    assert changed != data
    path.write_bytes(changed)
    for read in (load_image, read_shot):
        with pytest.raises(FileFormatError, match=r"a\.tif: a broken image: "):
            read(path)


def test_bytes_are_rounded():
    values = np.array([-0.5, 0, 0.49 / 255, 0.51 / 255, 127.4 / 255, 127.6 / 255, 1, 7])
    assert to_bytes(values).tolist() == [0, 0, 0, 1, 127, 128, 255, 255]
    with pytest.raises(ValueError, match="not finite"):
        to_bytes(np.array([np.nan]))


@pytest.mark.parametrize("suffix", [".png", ".WEBP"])
@pytest.mark.parametrize("channels", [3, 4])
def test_an_image_comes_back(tmp_path, suffix, channels):
    stored = RNG.integers(0, 256, (5, 7, channels))
    path = tmp_path / f"a{suffix}"
    save_image(path, stored / 255)
    with Image.open(path) as image:
        assert image.format == suffix[1:].upper()
        assert image.mode == ("RGB", "RGBA")[channels - 3]
        np.testing.assert_array_equal(np.asarray(image), stored)
    np.testing.assert_array_equal(load_image(path), stored)
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", [".jpg", ".jpeg"])
def test_jpeg_is_close(tmp_path, suffix):
    stored = np.tile(np.linspace(0, 1, 64)[:, None, None], (1, 48, 3)) * [1, 0.5, 0.2]
    save_image(tmp_path / f"a{suffix}", stored)
    shown = load_image(tmp_path / f"a{suffix}")
    assert shown.shape == (64, 48, 3)
    assert np.abs(shown / 255 - stored).max() < 0.02


@pytest.mark.parametrize(
    ("name", "shape", "words"),
    [
        ("a.png", (5, 7), r"shape \(h, w, 3\) or \(h, w, 4\), got \(5, 7\)"),
        ("a.jpg", (5, 7, 4), r"JPEG images must have shape \(h, w, 3\), got"),
        ("a.bmp", (5, 7, 3), "written as .png, .jpg, .jpeg, .webp, got 'a.bmp'"),
        ("a", (5, 7, 3), "written as"),
    ],
)
def test_images_of_other_shapes_and_names_are_refused(tmp_path, name, shape, words):
    with pytest.raises(ValueError, match=words):
        save_image(tmp_path / name, np.zeros(shape))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", [np.uint8, np.int64])
def test_bytes_are_not_taken_for_values_from_0_to_1(tmp_path, kind):
    with pytest.raises(TypeError, match=f"from 0 to 1, got {kind.__name__}: divide bytes by 255"):
        save_image(tmp_path / "x.png", np.full((2, 2, 3), 128, kind))
    with pytest.raises(ValueError, match="from 0 to 1, got up to 128: divide bytes by 255"):
        save_image(tmp_path / "x.png", np.full((2, 2, 3), 128, kind).astype(np.float32))
    assert not list(tmp_path.iterdir())
    glint = np.full((4, 4, 3), 0.5)
    glint[0, 0] = 40
    save_image(tmp_path / "x.png", glint)


def test_splats_far_brighter_than_white_are_white():
    bright = np.full((4, 4, 3), 20.0)
    assert strip([bright]).max() == 1
    assert encode_image("x.png", bright) == encode_image("x.png", np.ones((4, 4, 3)))


def test_straight_alpha_composes_to_the_same_image():
    """Over any background: straight * alpha + background * (1 - alpha) is the image rendered on it."""
    alpha = RNG.uniform(0, 1, (6, 5)).astype(np.float32)
    alpha[0] = 0
    color = RNG.uniform(0, 1, (6, 5, 3)).astype(np.float32)
    rgba = straight_rgba(color * alpha[..., None], alpha)
    np.testing.assert_allclose(rgba[1:, :, :3], color[1:], atol=1e-5)
    np.testing.assert_array_equal(rgba[0], 0)
    np.testing.assert_array_equal(rgba[..., 3], alpha)


def test_depth_png():
    depth = np.array([[0, 1e-9, 2.5], [4.99, 5.0, 1e9]])
    with Image.open(io.BytesIO(encode_depth_png(depth, 0.5))) as image:
        np.testing.assert_array_equal(np.asarray(image), [[0, 1, 5], [10, 10, 65535]])
    with pytest.raises(ValueError, match="unit"):
        encode_depth_png(depth, 0)


def test_array():
    read = np.load(io.BytesIO(encode_array(np.eye(2))), allow_pickle=False)
    np.testing.assert_array_equal(read, np.eye(2))


def moving_square(count: int = 6, side: int = 24, channels: int = 3) -> list[np.ndarray]:
    frames = []
    for i in range(count):
        frame = np.full((side, side, channels), 255, np.uint8)
        frame[4:12, 2 * i : 2 * i + 8, :3] = (200, 40, 10)
        frames.append(frame)
    return frames


@pytest.mark.parametrize("suffix", [".webp", ".gif", ".png"])
def test_animation(tmp_path, suffix):
    path = tmp_path / f"turn{suffix}"
    save_animation(path, iter(moving_square()), fps=20)
    with Image.open(path) as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (6, (24, 24), 0)
        image.seek(3)
        frame = np.asarray(image.convert("RGB")).astype(int)
        assert image.info["duration"] == 50
    assert np.abs(frame[8, 10] - (200, 40, 10)).max() < 30
    assert frame[8, 4].min() > 220
    assert frame[20, 20].min() > 250


@pytest.mark.parametrize(("suffix", "unit"), [(".webp", 1), (".gif", 10), (".png", 1)])
@pytest.mark.parametrize("fps", [10, 12, 15, 24, 30, 50])
def test_animations_last_as_long_as_asked(tmp_path, suffix, unit, fps):
    """GIF stores hundredths of a second, and 30 frames a second are 33.3 ms each."""
    path = tmp_path / f"a{suffix}"
    save_animation(path, moving_square(), fps=fps)
    with Image.open(path) as image:
        lasts = 0.0
        for k in range(image.n_frames):
            image.seek(k)
            image.load()  # of WebP, the duration is known after the image
            lasts += image.info["duration"]
    assert lasts == pytest.approx(6 * 1000 / fps, abs=unit / 2 + 1e-6)


def test_gif_keeps_the_background(tmp_path):
    """256 colours for thousands: those of the image may shift a little, the plain background must not."""
    frame = np.full((64, 64, 3), (250, 253, 251), np.uint8)
    frame[:16] -= RNG.integers(0, 6, (16, 64, 3), np.uint8)  # shades that are nearly the background's
    frame[16:32] -= RNG.integers(0, 200, (16, 64, 3), np.uint8)
    save_animation(tmp_path / "a.gif", [frame, frame[:, ::-1]])
    with Image.open(tmp_path / "a.gif") as image:
        for i in range(2):
            image.seek(i)
            shown = np.asarray(image.convert("RGB"))
            np.testing.assert_array_equal(shown[32:], frame[32:])


def test_animation_is_brought_to_size_and_keeps_alpha(tmp_path):
    frames = moving_square(3, 100, 4)
    frames[0][50:, :, 3] = 0
    save_animation(tmp_path / "t.webp", frames, max_side=50)
    with Image.open(tmp_path / "t.webp") as image:
        assert image.size == (50, 50)
        alpha = np.asarray(image.convert("RGBA"))[..., 3]
    assert (alpha[30:].max(), alpha[:20].min()) == (0, 255)


@pytest.mark.parametrize(
    ("name", "options", "frames", "words"),
    [
        ("a.mp4", {}, moving_square(2), "written as"),
        ("a.gif", {"fps": 0}, moving_square(2), "fps"),
        ("a.gif", {"fps": 60}, moving_square(2), "50 frames a second at most"),
        ("a.gif", {}, [], "at least one"),
        ("a.gif", {}, moving_square(2, 24, 4), "no translucency"),
    ],
)
def test_animations_that_cannot_be(tmp_path, name, options, frames, words):
    with pytest.raises(ValueError, match=words):
        save_animation(tmp_path / name, frames, **options)
    assert not list(tmp_path.iterdir())


def test_strip():
    a, b = RNG.uniform(0, 1, (2, 4, 90, 3)).astype(np.float32)
    plain = strip([a, b])
    assert plain.shape == (4 + 2 * GAP, 2 * 90 + 3 * GAP, 3)
    np.testing.assert_array_equal(plain[GAP:-GAP, GAP : GAP + 90], a)
    np.testing.assert_array_equal(plain[GAP:-GAP, 2 * GAP + 90 : -GAP], b)
    assert plain[:GAP].min() == plain[:, :GAP].min() == 1
    titled = strip([a, b], ["one", "two"])
    np.testing.assert_array_equal(titled[CAPTION:-GAP, GAP : GAP + 90], a)
    assert titled[:CAPTION, :90].min() < 0.5  # there is text over each image
    assert titled[:CAPTION, 100:].min() < 0.5
    with pytest.raises(ValueError, match="one shape"):
        strip([a, b[:3]])


@pytest.mark.parametrize("name", ["load_default", "load_default_imagefont"])
def test_captions_in_any_script(name, monkeypatch):
    """Pillow without FreeType, or before version 10.1, has a font of Latin letters only."""
    if not hasattr(ImageFont, name):
        pytest.skip(f"this Pillow has no {name}")
    monkeypatch.setattr(ImageFont, "load_default", getattr(ImageFont, name))
    titled = strip([np.ones((4, 90, 3))], ["méthode Ω"])
    assert titled[:CAPTION].min() < 0.5


def test_amplified_error():
    a = np.array([[[0.5, 0.5, 0.5]]], np.float32)
    b = np.array([[[0.6, 0.5, 0.1]]], np.float32)
    np.testing.assert_allclose(amplified_error(a, b, 4), [[[0.4, 0, 1]]], atol=1e-6)
