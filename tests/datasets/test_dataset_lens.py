"""Camera models against COLMAP's own values, and images undistorted to what a pinhole sees."""

from __future__ import annotations

import math

import numpy as np
import pytest
from _datasets import pinhole_rays, sky
from PIL import Image

from meshsplats._core.resampling import resample
from meshsplats.datasets.lens import MODELS, Lens, pinholes, undistort
from meshsplats.datasets.photo_file import PhotoFile
from meshsplats.datasets.views import ImageCache

# Where pycolmap 4.2.1 puts the point (0.6, -0.4, 1.6) on an image of 640 x 480.
TRUTH = [
    ("SIMPLE_PINHOLE", (500, 321, 238), (508.5, 113.0)),
    ("PINHOLE", (500, 510, 321, 238), (508.5, 110.5)),
    ("SIMPLE_RADIAL", (500, 321, 238, -0.1), (504.691406, 115.539062)),
    ("RADIAL", (500, 321, 238, -0.1, 0.03), (504.923492, 115.384338)),
    ("OPENCV", (500, 510, 321, 238, -0.1, 0.03, 0.002, -0.003), (504.00943, 113.553588)),
    ("OPENCV_FISHEYE", (500, 510, 321, 238, -0.02, 0.01, 0.004, -0.003), (496.586338, 118.60129)),
    (
        "FULL_OPENCV",
        (500, 510, 321, 238, -0.1, 0.03, 0.002, -0.003, 0.01, 0.02, -0.01, 0.005),
        (503.348574, 114.00297),
    ),
    ("FOV", (500, 510, 321, 238, 0.8), (510.347832, 109.243475)),
    ("SIMPLE_RADIAL_FISHEYE", (500, 321, 238, -0.05), (495.578675, 121.614217)),
    ("RADIAL_FISHEYE", (500, 321, 238, -0.05, 0.02), (495.691931, 121.538713)),
    (
        "THIN_PRISM_FISHEYE",
        (500, 510, 321, 238, -0.1, 0.03, 0.002, -0.003, 0.01, 0.02, 0.003, -0.004),
        (493.645272, 120.418335),
    ),
    (
        "RAD_TAN_THIN_PRISM_FISHEYE",
        (500, 510, 321, 238)  # noqa: RUF005
        + (-0.05, 0.02, -0.01, 0.004, 0.003, -0.002, 0.002, -0.003, 0.001, -0.002, 0.003, -0.001),
        (496.404188, 118.867993),
    ),
    ("SIMPLE_DIVISION", (500, 321, 238, -0.2), (501.445229, 117.703181)),
    ("DIVISION", (500, 510, 321, 238, -0.2), (501.445229, 115.297244)),
    ("SIMPLE_FISHEYE", (500, 321, 238), (497.157874, 120.561417)),
    ("FISHEYE", (500, 510, 321, 238), (497.157874, 118.212646)),
    ("EUCM", (500, 510, 321, 238, 0.6, 1.1), (497.27902, 118.130266)),
    ("EQUIRECTANGULAR", (640, 480), (356.54408, 204.867434)),
]  # fmt: skip
BY_MODEL = {model: parameters for model, parameters, _ in TRUTH}


@pytest.mark.parametrize(
    ("model", "parameters", "pixel"), TRUTH, ids=lambda v: v if isinstance(v, str) else ""
)
def test_point_lies_where_colmap_puts_it(model, parameters, pixel):
    lens = Lens.from_colmap(model, 640, 480, parameters)
    np.testing.assert_allclose(lens.pixels(np.array([0.6, -0.4, 1.6])), pixel, atol=2e-6)


def test_every_model_of_colmap_is_known_under_its_number():
    assert list(MODELS) == [
        *("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FULL_OPENCV"),
        *("FOV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "THIN_PRISM_FISHEYE"),
        *("RAD_TAN_THIN_PRISM_FISHEYE", "SIMPLE_DIVISION", "DIVISION", "SIMPLE_FISHEYE", "FISHEYE", "EUCM"),
        "EQUIRECTANGULAR",
    ]
    assert set(BY_MODEL) == set(MODELS)


@pytest.mark.parametrize("model", BY_MODEL)
def test_rays_all_over_agree_with_pycolmap(model):
    pycolmap = pytest.importorskip("pycolmap")
    number = pycolmap.CameraModelId.__members__[model]
    camera = pycolmap.Camera.create_from_model_id(1, number, 500, 640, 480)
    camera.params = np.array(BY_MODEL[model], float)
    rng = np.random.default_rng(0)
    rays = np.concatenate([rng.uniform(-0.7, 0.7, (500, 2)), np.ones((500, 1))], axis=1)
    rays *= rng.uniform(0.3, 3, (500, 1))
    if model == "EQUIRECTANGULAR":
        rays = rng.normal(size=(500, 3))
    got = Lens.from_colmap(model, 640, 480, BY_MODEL[model]).pixels(rays)
    np.testing.assert_allclose(got, camera.img_from_cam(rays), atol=1e-7)


def test_axis_hits_the_principal_point():
    for model, parameters, _ in TRUTH[:-1]:
        lens = Lens.from_colmap(model, 640, 480, parameters)
        np.testing.assert_allclose(lens.pixels(np.array([0.0, 0, 2])), (321, 238), atol=1e-9, err_msg=model)


def test_points_behind_the_camera_are_not_seen():
    lens = Lens.from_colmap("OPENCV", 640, 480, BY_MODEL["OPENCV"])
    assert np.isnan(lens.pixels(np.array([0.1, 0.1, -1]))).all()
    assert np.isnan(lens.pixels(np.array([0.1, 0.1, 0.0]))).all()


def test_rays_beyond_the_fold_of_a_polynomial_are_not_seen():
    """r (1 - 0.3 r^2) is greatest at r = 1 / sqrt(0.9) and falls back to 0: rays from there on would show the
    middle of the photograph once more."""
    lens = Lens("SIMPLE_RADIAL", 300, 300, 320, 240, 640, 480, (-0.3,))
    fold = 1 / math.sqrt(0.9)
    assert lens.reach() == pytest.approx(fold, abs=2e-3)
    seen = lens.pixels(np.array([[fold - 0.01, 0, 1], [fold + 0.01, 0, 1], [1.8, 0, 1]]))
    assert np.isnan(seen[:, 0]).tolist() == [False, True, True]
    assert Lens("PINHOLE", 300, 300, 320, 240, 640, 480).reach() == math.inf


def test_a_lens_without_coefficients_is_a_pinhole():
    assert Lens("OPENCV", 300, 300, 320, 240, 640, 480, (0, 0, 0, 0)).is_pinhole
    assert not Lens("OPENCV", 300, 300, 320, 240, 640, 480, (0, 0, 1e-3, 0)).is_pinhole
    assert not Lens("OPENCV_FISHEYE", 300, 300, 320, 240, 640, 480, (0, 0, 0, 0)).is_pinhole
    assert not Lens("EQUIRECTANGULAR", 1, 1, 320, 240, 640, 480).is_pinhole


def test_scaled_keeps_where_things_are():
    lens = Lens.from_colmap("OPENCV", 640, 480, BY_MODEL["OPENCV"])
    rays = np.array([[0.2, -0.3, 1], [-0.4, 0.1, 1]])
    np.testing.assert_allclose(lens.scaled(320, 120).pixels(rays), lens.pixels(rays) * [0.5, 0.25], atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "LENSLESS"}, "unknown camera model 'LENSLESS'"),
        ({"fx": 0}, "focal lengths must be positive"),
        ({"cy": math.nan}, "must be finite"),
        ({"coefficients": (1,)}, "SIMPLE_PINHOLE has 0 coefficients .* got 1"),
    ],
)
def test_impossible_lenses_are_refused(change, message):
    fine = {"model": "SIMPLE_PINHOLE", "fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 2, "height": 2}
    with pytest.raises(ValueError, match=message):
        Lens(**(fine | change))


# ---- Images


def fisheye_directions(width: int, height: int, f: float, cx: float, cy: float) -> np.ndarray:
    """Directions that the pixels of an ideal fisheye see: theta = r / f."""
    x, y = np.meshgrid(np.arange(width) + 0.5 - cx, np.arange(height) + 0.5 - cy)
    r = np.hypot(x, y)
    theta = r / f
    s = np.where(r > 0, np.sin(theta) / np.where(r > 0, r, 1), 1 / f)
    return np.stack([x * s, y * s, np.cos(theta)], axis=-1)


def division_directions(width: int, height: int, f: float, cx: float, cy: float, k: float) -> np.ndarray:
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / f, (np.arange(height) + 0.5 - cy) / f)
    return np.stack([x, y, 1 + k * (x * x + y * y)], axis=-1)


CASES = {
    "fisheye": (
        Lens("SIMPLE_FISHEYE", 90, 90, 79, 62, 160, 120),
        fisheye_directions(160, 120, 90, 79, 62),
    ),
    "barrel": (
        Lens("SIMPLE_DIVISION", 110, 110, 81, 58, 160, 120, (-0.15,)),
        division_directions(160, 120, 110, 81, 58, -0.15),
    ),
    "pincushion": (
        Lens("SIMPLE_DIVISION", 110, 110, 81, 58, 160, 120, (0.15,)),
        division_directions(160, 120, 110, 81, 58, 0.15),
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_undistorted_image_is_what_a_pinhole_sees(case):
    lens, directions = CASES[case]
    (pinhole,) = pinholes(lens)
    image, seen = undistort(sky(directions).astype(np.float32), lens, pinhole)
    want = sky(pinhole_rays(160, 120, lens.fx, lens.fy, lens.cx, lens.cy))
    assert seen[30:-30, 30:-30].all()
    # Bilinear values of these waves are within 0.002; half a pixel beside them is 0.03 off.
    assert np.abs(image - want)[seen].max() < 2.5e-3
    assert (image[~seen] == 0).all()
    # A pincushion photograph has its corners drawn out, a pinhole of the same focal length sees less than it.
    assert seen.all() == (case != "pincushion")


def test_bytes_are_rounded_not_cut():
    lens, directions = CASES["fisheye"]
    exact = undistort(sky(directions).astype(np.float32) * 255, lens, pinholes(lens)[0])[0]
    whole = undistort(np.rint(sky(directions) * 255).astype(np.uint8), lens, pinholes(lens)[0])[0]
    assert whole.dtype == np.uint8
    error = whole - exact
    assert abs(error.mean()) < 0.02
    assert np.abs(error).max() < 1.01


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_values_between_pixels_by_hand(kind):
    image = np.array([[[0, 40], [100, 80]], [[200, 0], [60, 8]]], kind)
    points = np.array(
        [[0, 0], [1, 0], [0.25, 0], [0.5, 0.5], [1, 1], [-0.5, 2], [np.nan, 0], [1.75, 0], [2, 1]], np.float32
    )
    want = [(0, 40), (100, 80), (25, 50), (90, 32), (60, 8), (200, 0), (0, 0), (100, 80), (60, 8)]
    np.testing.assert_array_equal(resample(image, points), np.array(want, kind))
    want[-2:] = (25, 50), (200, 0)  # the first column follows the last one
    np.testing.assert_array_equal(resample(image, points, wraps=True, threads=2), np.array(want, kind))


def means_of(pixels: np.ndarray, factor: int) -> np.ndarray:
    height, width = (side // factor for side in pixels.shape[:2])
    return pixels.reshape(height, factor, width, factor, -1).mean(axis=(1, 3))


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("factor", [2, 3, 5])
def test_photographs_are_not_made_smaller_before_they_are_undistorted(factor, kind):
    """Either blurs: one after the other loses a quarter of the finest detail."""
    fine = np.random.default_rng(0).integers(0, 256, (240, 300, 3), np.uint8)
    whole = Lens("SIMPLE_RADIAL", 250, 250, 150, 120, 300, 240, (-0.05,))
    small = whole.scaled(300 // factor, 240 // factor)
    want = means_of(undistort(fine.astype(np.float32), whole, pinholes(whole)[0])[0], factor)
    image, seen = undistort(fine.astype(kind), small, pinholes(small)[0])
    assert image.dtype == kind
    inner = slice(3, -3), slice(3, -3)
    assert seen[inner].all()
    twice = undistort(means_of(fine, factor), small, pinholes(small)[0])[0]
    errors = [np.sqrt(np.square(found - want)[inner].mean()) for found in (image, twice)]
    assert errors[0] < 0.75 * errors[1]
    assert image[inner].std() > 1.15 * twice[inner].std()
    assert image[seen].mean() == pytest.approx(
        want[seen].mean(), abs=0.5
    )  # no pixel beside the border is dark
    assert image[seen].min() > 0


def test_panoramas_are_not_made_smaller_before_either():
    small = Lens("EQUIRECTANGULAR", 1, 1, 130, 65, 260, 130)
    side = pinholes(small)[2]  # the back: its middle is the seam
    x, y = np.meshgrid(2 * np.pi * (np.arange(520) + 0.5) / 520 - np.pi, np.arange(260) + 0.5)
    y = np.pi * (y / 260 - 0.5)
    panorama = sky(np.stack([np.cos(y) * np.sin(x), np.sin(y), np.cos(y) * np.cos(x)], axis=-1))
    image, seen = undistort(panorama.astype(np.float32), small, side)
    rays = pinhole_rays(65, 65, side.fx, side.fy, side.cx, side.cy) @ side.rotation
    assert seen.all()
    assert np.abs(image - sky(rays)).max() < 8e-3


@pytest.mark.parametrize("mask", ["none", "counts", "subject"])
def test_a_large_photograph_with_a_lens_keeps_its_alpha_and_mask(tmp_path, mask):
    y, x = np.mgrid[:480, :640]
    disc = np.hypot(x - 320, y - 240) < 150
    pixels = np.where(disc[..., None], (200, 100, 50), (0, 255, 0)).astype(np.uint8)  # clear ones are green
    light = (255 * disc).astype(np.uint8)
    if mask == "none":
        pixels = np.dstack([pixels, light])
    Image.fromarray(pixels).save(tmp_path / "photo.png")
    size = (640, 480) if mask == "counts" else (320, 240)
    Image.fromarray(light).resize(size, Image.Resampling.NEAREST).save(tmp_path / "mask.png")
    lens = Lens("SIMPLE_RADIAL", 100, 100, 40, 30, 80, 60, (-0.05,))
    file = None if mask == "none" else tmp_path / "mask.png"
    cut_out = mask == "subject"
    photo = PhotoFile(
        "", tmp_path / "photo.png", lens, pinholes(lens)[0], file, not file, ImageCache(0), cut_out
    )
    image = photo.load()
    assert image.color.shape == (60, 80, 3)
    if mask == "counts":
        assert image.alpha is None
        assert not image.mask[:8].any()
        assert image.mask.sum() == pytest.approx(np.pi * 18.75**2, rel=0.15)
        assert (image.color[image.mask] == (200, 100, 50)).all()
        return
    alpha = image.alpha.astype(np.float32)
    assert alpha.sum() == pytest.approx(np.pi * 18.75**2, rel=0.05)
    part = (alpha > 0.1) & (alpha < 0.9)
    assert part.sum() > 40
    if mask == "none":  # the mask is coarser than the photograph, which is green beside it
        colors = image.color[part] / alpha[part, None]
        assert np.abs(colors - np.array([200, 100, 50]) / 255).max() < 0.03


def test_a_lens_is_worked_out_once_for_all_its_photographs(monkeypatch):
    asked = []
    pixels = Lens.pixels
    monkeypatch.setattr(Lens, "pixels", lambda lens, rays: asked.append(1) or pixels(lens, rays))
    lenses = [Lens("SIMPLE_RADIAL", 90, 90, 80, 60, 160, 120, (k,)) for k in (0.1, 0.1, 0.1, 0.2)]
    photo = np.random.default_rng(0).integers(0, 256, (120, 160, 3), np.uint8)
    images = [undistort(photo, lens, pinholes(lens)[0])[0] for lens in lenses]
    assert len(asked) == 2
    np.testing.assert_array_equal(images[0], images[2])
    assert (images[0] != images[3]).any()


def test_six_sides_of_a_panorama():
    width, height = 260, 130  # the middle column of the back lies on the seam
    lens = Lens("EQUIRECTANGULAR", 1, 1, width / 2, height / 2, width, height)
    x, y = np.meshgrid((np.arange(width) + 0.5) / width - 0.5, (np.arange(height) + 0.5) / height - 0.5)
    longitude, latitude = 2 * np.pi * x, np.pi * y
    directions = np.stack(
        [np.cos(latitude) * np.sin(longitude), np.sin(latitude), np.cos(latitude) * np.cos(longitude)],
        axis=-1,
    )
    panorama = sky(directions).astype(np.float32)
    ahead = {}
    for side in pinholes(lens):
        assert (side.width, side.height, side.fx, side.cx) == (65, 65, 32.5, 32.5)
        image, seen = undistort(panorama, lens, side)
        rays = pinhole_rays(65, 65, side.fx, side.fy, side.cx, side.cy) @ side.rotation
        assert seen.all()
        # Rows at the poles have no neighbour beyond, where half a row is lost.
        assert np.abs(image - sky(rays)).max() < (8e-3 if side.suffix not in ("/up", "/down") else 0.05)
        ahead[side.suffix] = side.rotation[2].round(9).tolist()
    # OpenCV axes: right is +x, down is +y.
    assert ahead == {
        "/front": [0, 0, 1],
        "/right": [1, 0, 0],
        "/back": [0, 0, -1],
        "/left": [-1, 0, 0],
        "/up": [0, -1, 0],
        "/down": [0, 1, 0],
    }
