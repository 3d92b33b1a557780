"""Views, images and their memory; hostile image files; splats as a data set; real photographs."""

from __future__ import annotations

import json
import struct
import zlib
from contextlib import nullcontext
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from _datasets import save, simple_colmap, write_colmap
from _local import make_link, shared_data
from PIL import Image

import meshsplats as ms
from meshsplats import draw_splats
from meshsplats.cameras.framing import front_axes, scene_bounds
from meshsplats.cameras.placing import has_surroundings, inside_cameras, outside_cameras, target_of
from meshsplats.cameras.trajectories import look_at
from meshsplats.cli import main
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.photo_file import _resized
from meshsplats.datasets.splat_targets import TRAINING_SAMPLES, splat_dataset, splat_views
from meshsplats.datasets.views import View, ViewImage
from meshsplats.demo_scene import make_scene
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.images.reading import read_header, read_shot
from meshsplats.rendering.previews import save_preview
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.viewpoints.sheet import contact_sheet


def cloud_at(points: np.ndarray, scale: float = 0.02) -> GaussianCloud:
    n = len(points)
    turns = np.tile([1.0, 0, 0, 0], (n, 1))
    rng = np.random.default_rng(0)
    return GaussianCloud(points, turns, np.full((n, 3), scale), np.full(n, 0.9), rng.normal(size=(n, 4, 3)))


# ---- Images


def test_bytes_and_floats_over_a_background():
    red = np.zeros((2, 3, 3), np.uint8)
    red[..., 0] = 51
    half = np.full((2, 3), 51, np.uint8)
    np.testing.assert_allclose(ViewImage(red, half).over((0, 0, 1))[1, 2], (0.2, 0, 0.8), atol=1e-6)
    np.testing.assert_allclose(ViewImage(red).over((0, 0, 1))[1, 2], (0.2, 0, 0), atol=1e-6)
    floats = ViewImage(np.full((2, 3, 3), 0.25, np.float16), np.full((2, 3), 0.5, np.float16))
    assert floats.over((1, 0, 0)).dtype == np.float32
    np.testing.assert_array_equal(floats.over((1, 0, 0))[0, 0], (0.75, 0.25, 0.25))


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ((np.zeros((2, 3), np.uint8),), "color must have shape"),
        ((np.zeros((2, 3, 3)),), "type uint8, float16 or float32, got .* float64"),
        ((np.zeros((2, 3, 3), np.uint8), np.zeros((3, 2), np.uint8)), "alpha must have shape"),
        ((np.zeros((2, 3, 3), np.uint8), np.zeros((2, 3), np.float32)), "alpha must have .* type of color"),
        ((np.zeros((2, 3, 3), np.uint8), None, np.zeros((2, 3), np.uint8)), "mask must have .* bool"),
    ],
)
def test_images_check_themselves(arrays, message):
    with pytest.raises(ValueError, match=message):
        ViewImage(*arrays)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
def test_colours_that_are_not_times_alpha_are_refused(kind):
    white = 255 if kind == np.uint8 else 1
    alpha = np.tile(np.linspace(-0.2, 1, 64).clip(0), (8, 1))
    straight = np.broadcast_to([0.3, 0.4, 0.5], (8, 64, 3))
    for brightness in (1, 6):  # as of splats that are brighter than white
        ViewImage(
            np.minimum(straight * brightness * alpha[..., None] * white, 255).astype(kind),
            (alpha * white).astype(kind),
        )
    with pytest.raises(ValueError, match=r"color must be premultiplied .*: give color \* alpha\[..., None\]"):
        ViewImage((straight * white).astype(kind), (alpha * white).astype(kind))


def test_colours_on_black_that_spread_beyond_their_alpha_are_taken():
    alpha = np.zeros((64, 64), np.uint8)
    alpha[19:45, 19:45] = 255
    with BytesIO() as file:
        Image.fromarray(np.repeat(alpha[..., None], 3, axis=2)).save(file, "JPEG", quality=50)
        color = np.array(Image.open(file))
    assert color[alpha == 0].max() > 10
    ViewImage(color, alpha)
    resized = Image.fromarray(alpha.astype(np.float32) / 255).resize((14, 14), Image.Resampling.LANCZOS)
    shares = np.array(resized)
    assert (shares < -0.01).mean() > 0.1
    ViewImage(np.repeat(shares[..., None], 3, axis=2), shares)


def test_floats_from_0_to_255_are_refused():
    with pytest.raises(
        ValueError, match="color must hold values from 0 to 1, got up to 200: divide bytes by 255"
    ):
        ViewImage(np.full((8, 8, 3), 200, np.float32))


def test_views_of_splats_may_be_far_brighter_than_white(tmp_path):
    cloud = cloud_at(np.random.default_rng(0).normal(size=(400, 3)), 0.3)
    cloud = replace(cloud, sh=cloud.sh + 62 * (np.arange(4) == 0)[None, :, None])
    cameras = [look_at((0, 0, z), (0, 0, 0), width=16, height=16) for z in (-1.5, 1.5)]
    image = splat_dataset(cloud, cameras=cameras, test=1, width=16).train[0].load()
    assert np.median(image.color) > 16
    for scene in (cloud, ms.convert(cloud)):
        assert save_preview(scene, tmp_path / "a.png", cameras[0])
    assert contact_sheet(cloud, cameras).max() == 1


def test_a_view_checks_that_its_image_has_the_cameras_size():
    camera = look_at((0, 0, -1), (0, 0, 0), width=3, height=2, name="a")
    view = View(camera, ViewImage(np.zeros((2, 3, 3), np.uint8)))
    assert (view.name, view.image.shape, view.alpha, view.mask) == ("a", (2, 3, 3), None, None)
    with pytest.raises(ValueError, match="view 'a': its image has shape"):
        _ = View(camera, ViewImage(np.zeros((3, 2, 3), np.uint8))).image


# ---- Memory


def test_images_are_read_when_asked_for_and_kept_within_the_limit(tmp_path, monkeypatch):
    from meshsplats.datasets import photo_file as photographs

    reads = []
    original = photographs.load_image
    monkeypatch.setattr(
        photographs, "load_image", lambda path, **_: reads.append(path.name) or original(path)
    )
    folder = simple_colmap(tmp_path, 4)
    dataset = load_dataset(folder, test_every=0, cache_bytes=3 * 12 * 8 * 3)  # three of the four
    assert reads == []
    assert dataset.memory == 4 * 12 * 8 * 3
    for _ in range(3):
        for i, view in enumerate(dataset.train):
            assert view.image[0, 0, 0] == np.float32(10 * i / 255)
    assert sorted(reads) == ["p00.png", "p01.png", "p02.png", *["p03.png"] * 3]
    assert all(view.load().color.dtype == np.uint8 for view in dataset.train)


@pytest.mark.parametrize(
    ("orientation", "edge"), [(1, "top"), (2, "top"), (3, "bottom"), (4, "bottom"), (6, "left"), (8, "right")]
)
def test_up_is_the_edge_that_exif_says(tmp_path, orientation, edge):
    """Pixels and cameras stay as they are stored."""
    folder = simple_colmap(tmp_path, 2)
    exif = Image.Exif()
    exif[0x112] = orientation
    for path in sorted((folder / "images").iterdir()):
        Image.open(path).save(path, exif=exif)
    view = load_dataset(folder, test_every=0).train[0]
    right, down = view.camera.world_to_camera[:2, :3]
    up = {"top": -down, "bottom": down, "left": -right, "right": right}[edge]
    assert np.allclose(view.upright.up, up)
    assert (view.camera.width, view.camera.height) == (12, 8)
    # A point on the axis through the upright image's middle of the upper edge is on that edge as stored.
    upright = view.upright
    point = upright.center + np.linalg.inv(upright.world_to_camera[:3, :3]) @ [
        (upright.width / 2 - upright.cx) / upright.fx,
        -upright.cy / upright.fy,
        1,
    ]
    (x, y), _ = (part[0] for part in view.camera.project(point[None]))
    assert (x, y) == pytest.approx({"top": (6, 0), "bottom": (6, 8), "left": (0, 4), "right": (12, 4)}[edge])


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pixels_of_tiff_are_those_stored(tmp_path, orientation):
    """Pillow turns them by their orientation; cameras mean them as they are in the file, as of JPEG."""
    folder = simple_colmap(tmp_path, 2)
    pixels = np.random.default_rng(0).integers(0, 256, (8, 12, 3)).astype(np.uint8)
    for path in sorted((folder / "images").iterdir()):
        exif = Image.Exif()
        exif[0x112] = orientation
        Image.fromarray(pixels).save(path.with_suffix(".tif"), exif=exif)
        Image.fromarray(pixels).save(path.with_suffix(".jpg"), exif=exif)
        path.unlink()
        assert read_shot(path.with_suffix(".tif")).size == (12, 8)
        turn = read_header(path.with_suffix(".jpg")).turn
        path.with_suffix(".jpg").unlink()
    with pytest.warns(DataWarning, match="other names"):
        view = load_dataset(folder, test_every=0).train[0]
    assert np.array_equal(view.load().color, pixels)
    assert view.turn == turn


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 1), (8, 3)])
def test_upright_masks_lie_on_photographs_stored_on_their_side(tmp_path, orientation, turns):
    """Programs that make masks read photographs as they were held, and leave no EXIF data."""
    folder = simple_colmap(tmp_path, 1)
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.open(folder / "images/p00.png").save(folder / "images/p00.png", exif=exif)
    mask = np.zeros((8, 12), np.uint8)
    mask[:3, :5] = 255  # as the photograph is stored
    save(folder / "masks/p00.png", np.rot90(mask, -turns) if turns != 2 else mask)
    said = pytest.warns(DataWarning, match="taken upside down, or .*, and are used as these are stored")
    with said if turns == 2 else nullcontext():
        view = load_dataset(folder, test_every=0).train[0]
    assert np.array_equal(view.mask, mask > 0)
    if turns % 2:
        save(folder / "masks/p00.png", mask)  # as the photograph
        assert np.array_equal(load_dataset(folder, test_every=0).train[0].mask, mask > 0)


@pytest.mark.parametrize("orientation", [1, 6])
def test_masks_of_turned_square_photographs_are_named(tmp_path, orientation):
    folder = simple_colmap(tmp_path, 1, size=(8, 8))
    exif = Image.Exif()
    exif[0x112] = orientation
    Image.open(folder / "images/p00.png").save(folder / "images/p00.png", exif=exif)
    save(folder / "masks/p00.png", np.full((8, 8), 255, np.uint8))
    said = pytest.warns(DataWarning, match="1 masks are of .* turned square ones, and are used as these")
    with said if orientation == 6 else nullcontext():
        load_dataset(folder, test_every=0)


def test_a_photograph_taken_upright_is_shown_so(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    exif = Image.Exif()
    exif[0x112] = 6
    Image.open(folder / "images/p00.png").save(folder / "images/p00.png", exif=exif)
    opening = load_dataset(folder, test_every=2).opening
    assert (opening.width, opening.height) == (8, 12)


def test_broken_exif_is_no_matter(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    for path in sorted((folder / "images").iterdir()):
        Image.open(path).save(path, exif=b"Exif\0\0MM\0*\xff\xff\xff\xff\0\1")
    assert [view.turn for view in load_dataset(folder).views] == [0, 0]


def test_photographs_that_cannot_be_read_need_not_be_where_smaller_copies_are(tmp_path):
    """Too large, or broken: such a one only does not tell which way it was held."""
    folder = simple_colmap(tmp_path, 2)
    for path in sorted((folder / "images").iterdir()):
        save(folder / "images_2" / path.name, np.full((4, 6, 3), 255, np.uint8))
        path.write_bytes(b"none")
    views = load_dataset(folder, downscale=2, test_every=0).train
    assert [(view.turn, view.image.shape) for view in views] == [(0, (4, 6, 3))] * 2


def test_masks_of_a_subject_cut_it_out(tmp_path):
    folder = simple_colmap(tmp_path, 3)
    rng = np.random.default_rng(0)
    opaque, translucent = (
        rng.integers(0, 256, (8, 12, 3), np.uint8),
        rng.integers(0, 256, (8, 12, 4), np.uint8),
    )
    save(folder / "images/p00.png", opaque)
    save(folder / "images/p01.png", translucent)
    mask = np.zeros((8, 12), np.uint8)
    mask[:, :5] = 255
    for name in ("p00", "p01"):
        save(folder / f"masks/{name}.png", mask)
    with pytest.warns(ms.DataWarning, match="1 images have no mask"):
        data = load_dataset(folder, masks="subject", test_every=0)
    cut, mixed, whole = sorted(data.train, key=lambda view: view.name)
    inside = (mask > 0).astype(np.float32)
    assert (cut.mask, mixed.mask, whole.mask, whole.alpha) == (None, None, None, None)
    assert np.array_equal(cut.alpha, inside)
    np.testing.assert_allclose(cut.load().over((0, 0, 0)), inside[..., None] * opaque / 255, atol=1e-3)
    np.testing.assert_allclose(mixed.alpha, inside * translucent[..., 3] / 255, atol=1e-3)
    for view in data.train:
        assert view.load().nbytes == view.source.nbytes
    with pytest.warns(ms.DataWarning, match="1 images have no mask"):
        half = load_dataset(folder, masks="subject", test_every=0, downscale=2)
    half_cut = min(half.train, key=lambda view: view.name)
    np.testing.assert_allclose(half_cut.alpha, [[1, 1, 0.5, 0, 0, 0]] * 4)
    color = (inside[..., None] * opaque / 255).reshape(4, 2, 6, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(half_cut.load().over((0, 0, 0)), color, atol=1e-3)


def test_held_out_views_in_which_nothing_counts_are_not_scored(tmp_path):
    folder = simple_colmap(tmp_path, 9)
    for i in range(9):
        save(folder / f"masks/p{i:02d}.png", np.full((8, 12), 0 if i in (5, 8) else 255, np.uint8))
    dataset = load_dataset(folder)
    with pytest.warns(DataWarning, match=r"1 of 2 held-out photographs are not scored.*: p08\.png"):
        left = dataset.scorable()
    assert [view.name for view in left.test] == ["p00.png"]
    assert left.train == dataset.train
    assert left.scorable() is left


def test_where_masks_are_clear_they_do_not_count(tmp_path):
    """White ones with a hole, as programs that cut out write them."""
    folder = simple_colmap(tmp_path, 2)
    mask = np.full((8, 12, 4), 255, np.uint8)
    mask[:3, :5, 3] = 0
    for name in ("p00", "p01"):
        save(folder / f"masks/{name}.png", mask)
    assert np.array_equal(load_dataset(folder).views[0].mask, mask[..., 3] > 0)


def test_a_subject_needs_masks(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    with pytest.raises(ms.FileFormatError, match="no masks, so none of a subject"):
        load_dataset(folder, masks="subject")
    with pytest.raises(ValueError, match="masks must be 'count' or 'subject', got 'alpha'"):
        load_dataset(folder, masks="alpha")


def test_memory_is_known_before_and_right(tmp_path):
    folder = simple_colmap(tmp_path, 3)
    save(folder / "images/p01.png", np.zeros((8, 12, 4), np.uint8))
    save(folder / "masks/p02.png.png", np.zeros((8, 12), np.uint8))
    with pytest.warns(ms.DataWarning, match="2 images have no mask"):
        dataset = load_dataset(folder)
    assert [view.source.nbytes for view in sorted(dataset.views, key=lambda v: v.name)] == [288, 768, 384]
    for view in dataset.views:
        assert view.load().nbytes == view.source.nbytes


# ---- Options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"downscale": 0}, "downscale must be a whole number from 1 to 64, got 0"),
        ({"downscale": 1.5}, "downscale must be a whole number"),
        ({"test_every": -1}, "test_every must be"),
        ({"test_every": 1}, "leaves nothing to train with"),
        ({"background": (1, 1)}, "background must be three numbers"),
        ({"background": (0, 0, 2)}, "background must be three numbers"),
        ({"cache_bytes": -1}, "cache_bytes must be >= 0"),
    ],
)
def test_options_out_of_range(tmp_path, options, message):
    with pytest.raises(ValueError, match=message):
        load_dataset(simple_colmap(tmp_path), **options)


def test_the_background_can_be_changed(tmp_path):
    folder = simple_colmap(tmp_path, 1)
    save(folder / "images/p00.png", np.zeros((8, 12, 4), np.uint8))
    dataset = load_dataset(folder, test_every=0)
    assert (dataset.train[0].image == 1).all()
    assert (dataset.over((0, 0.5, 0)).train[0].image == (0, 0.5, 0)).all()
    assert (dataset.train[0].image == 1).all()


# ---- ViewImage files


def test_grey_palette_and_sixteen_bits(tmp_path):
    folder = simple_colmap(tmp_path, 4)
    values = np.arange(160, 256, dtype=np.uint8).reshape(8, 12)
    Image.fromarray(values).save(folder / "images/p00.png")
    Image.fromarray(values.astype(np.uint16) * 257).save(folder / "images/p01.png")
    paletted = Image.fromarray(np.stack([values] * 3, axis=2)).quantize(256)
    paletted.save(folder / "images/p02.png")
    Image.fromarray(np.stack([values, values // 2], axis=2)).save(folder / "images/p03.png")
    views = load_dataset(folder, test_every=0).train
    for i in range(3):
        np.testing.assert_allclose(views[i].image[..., 1] * 255, values, atol=1e-3, err_msg=views[i].name)
    assert views[2].alpha is None
    np.testing.assert_allclose(views[3].alpha * 255, values // 2, atol=0.07)


def png_claiming(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 99))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not an image of a known format"),
        (b"no image", "not an image of a known format"),
        (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 8\n", "not an image of a known format"),
        (png_claiming(9_000, 8_000), "9000 x 8000 pixels; up to 67,108,864 pixels"),
        (png_claiming(60_000, 40_000), "not an image of a known format|up to 67,108,864 pixels"),
        (png_claiming(60_000, 2), "60000 x 2 pixels; up to .* and 32768 a side"),
    ],
)
def test_what_is_no_image_is_refused_by_its_header(tmp_path, content, message):
    folder = simple_colmap(tmp_path, 2)
    (folder / "images/p01.png").write_bytes(content)
    with pytest.raises(FileFormatError, match=message) as caught:
        load_dataset(folder)
    assert "p01.png" in str(caught.value)


def test_a_truncated_image_is_refused_when_it_is_read(tmp_path):
    folder = simple_colmap(tmp_path, 1, size=(120, 80))
    path = folder / "images/p00.png"
    save(path, np.random.default_rng(0).integers(0, 255, (80, 120, 3)).astype(np.uint8))
    path.write_bytes(path.read_bytes()[:5000])
    view = load_dataset(folder, test_every=0).train[0]
    with pytest.raises(FileFormatError, match=r"p00\.png: a broken image"):
        _ = view.image


def test_links_out_of_the_folder_are_refused(tmp_path):
    folder = simple_colmap(tmp_path / "set", 2)
    save(tmp_path / "outside.png", np.zeros((8, 12, 3), np.uint8))
    (folder / "images/p01.png").unlink()
    make_link(folder / "images/p01.png", tmp_path / "outside.png")
    with pytest.raises(FileFormatError, match="a link that leads out"):
        load_dataset(folder)
    (folder / "images/p01.png").unlink()
    make_link(folder / "images/p01.png", folder / "images/p00.png")
    assert len(load_dataset(folder).views) == 2
    make_link(tmp_path / "link", folder)  # the data set itself may be behind a link
    assert len(load_dataset(tmp_path / "link").views) == 2


# ---- Splats as a data set


@pytest.fixture(scope="module")
def cloud() -> GaussianCloud:
    return make_scene(2000)


@pytest.mark.parametrize("look", ["area", "splats"])
def test_splat_views_are_the_images_of_their_look(cloud, look):
    cameras = ms.orbit(cloud, 2, width=40, height=30)
    views = splat_views(cloud, cameras, look=look, sh_degree=1, background=(0, 0.5, 1))
    for view, camera in zip(views, cameras, strict=True):
        want = draw_splats(cloud, camera, look, sh_degree=1, background=(0, 0.5, 1))
        np.testing.assert_allclose(view.image, want.color, atol=1e-3)
        np.testing.assert_allclose(view.alpha, want.alpha, atol=1e-3)
        want = draw_splats(cloud, camera, look, sh_degree=1, background=(1, 0, 0))
        np.testing.assert_allclose(view.load().over((1, 0, 0)), want.color, atol=1e-3)
        assert view.load() is view.load()  # drawn once
        assert view.load().nbytes == 8 * 40 * 30
        points = view.source.points()
        want = draw_splats(cloud, camera, look, sh_degree=1, background=(1, 0, 0), samples=1)
        np.testing.assert_allclose(points.over((1, 0, 0)), want.color, atol=1e-3)
        assert view.source.nbytes == {"area": 2, "splats": 1}[look] * view.load().nbytes


def test_training_views_take_fewer_samples_than_those_held_out(cloud):
    data = splat_dataset(cloud, train=1, test=1, width=24, zooms=(1,))
    for views, samples in ((data.train, TRAINING_SAMPLES), (data.test, None)):
        (expected,) = splat_views(cloud, [views[0].camera], samples=samples)
        np.testing.assert_array_equal(views[0].image, expected.image)
    (exact,) = splat_views(cloud, [data.train[0].camera])
    assert (exact.image != data.train[0].image).any()


def test_means_over_areas_come_from_points(cloud):
    """As many points as a finer image has pixels: their means are the images of the coarser one."""
    (camera,) = ms.orbit(cloud, 1, width=40, height=30)
    (fine,) = splat_views(cloud, [camera.scaled(2)])
    (coarse,) = splat_views(cloud, [camera], samples=2)
    # The filter of 0.3 / 16 px^2 is that of either image: only it differs.
    points = fine.source.points().over().reshape(30, 2, 40, 2, 3).mean(axis=(1, 3))
    assert ms.psnr(points, coarse.image) > 35


def test_windows_are_parts_of_larger_images(cloud):
    whole = splat_dataset(cloud, train=8, test=0, width=40, look="splats", zooms=(1,))
    windows = splat_dataset(cloud, train=8, test=0, width=40, look="splats")
    places = set()
    for number, (a, b) in enumerate(zip(whole.train, windows.train, strict=True)):
        zoom = (1, 2, 4)[number % 3]
        if zoom == 1:
            np.testing.assert_array_equal(a.image, b.image)
            continue
        left, top = round(a.camera.cx * zoom - b.camera.cx), round(a.camera.cy * zoom - b.camera.cy)
        assert 0 <= left <= 40 * (zoom - 1)
        assert 0 <= top <= 40 * (zoom - 1)
        places.add((left, top))
        large = ms.render_splats(cloud, a.camera.scaled(zoom)).color
        # Splats are projected by their local affine approximation, which an image's border limits.
        part = np.abs(large[top : top + 40, left : left + 40] - b.image)
        assert np.median(part) < 1e-3
        assert part.mean() < 0.01
    assert len(places) == 5
    assert all(view.camera.width == view.camera.height == 40 for view in windows.train)
    for zooms in ((), (0,), (1.5,)):
        with pytest.raises(ValueError, match="zooms must be whole numbers"):
            splat_dataset(cloud, zooms=zooms)
    for name, value in {"samples": 99, "sh_degree": 7, "threads": 0}.items():
        with pytest.raises(ValueError, match=f"{name} must be"):
            splat_dataset(cloud, **{name: value})
        with pytest.raises(ValueError, match=f"{name} must be"):
            splat_views(cloud, [], **{name: value})


def test_windows_show_the_subject():
    """Most windows that were spread over the images of a pole would show background only."""
    pole = np.random.default_rng(2).uniform(-1, 1, (500, 3)) * [0.03, 0.03, 1]
    faint = np.full((500, 3), [3.0, 0, 0])  # shows nothing, and gets no windows of its own
    cloud = cloud_at(np.concatenate([faint, pole]))
    cloud.opacities[:500] = 0
    views = {"train": 60, "test": 0, "width": 40, "look": "splats", "zooms": (4,)}
    windows = splat_dataset(cloud, **views, up=(0, 0, 1), placement="object").train
    assert min(view.camera.sees(pole).mean() for view in windows) > 0.02
    assert len({view.camera.cy for view in windows}) > 30
    nothing = cloud_at(pole)
    nothing.opacities[:] = 0
    assert len(splat_dataset(nothing, train=4, test=0, width=40, look="splats").train) == 4
    for cameras in (None, ms.orbit(cloud, 4)):
        with pytest.raises(ValueError, match="the scene is empty"):
            splat_dataset(cloud_at(pole[:0]), cameras=cameras)


def angles_of(cameras, cloud) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation in degrees of cameras around the middle of their optical axes, y down."""
    center = scene_bounds(cloud).center
    away = np.array([c.center for c in cameras]) - center
    return np.degrees(np.arctan2(away[:, 0], away[:, 2])), np.degrees(
        np.arcsin(-away[:, 1] / np.linalg.norm(away, axis=1))
    )


def test_object_cameras_surround_it_and_see_it(cloud):
    dataset = splat_dataset(cloud, train=40, test=6, width=32)
    assert (len(dataset.train), len(dataset.test)) == (40, 6)
    for part in (dataset.train, dataset.test):
        azimuth, elevation = angles_of([view.camera for view in part], cloud)
        assert np.histogram(azimuth, 3, (-180, 180))[0].min() >= 1
        assert elevation.min() < 15
        assert elevation.max() > 40
        for view in part:
            assert 0.04 < view.alpha.mean() < 0.95
    held = {view.name for view in dataset.test}
    assert held.isdisjoint(view.name for view in dataset.train)
    again = splat_dataset(cloud, train=40, test=6, width=32)
    assert all(
        np.array_equal(a.camera.world_to_camera, b.camera.world_to_camera)
        for a, b in zip(dataset.views, again.views, strict=True)
    )


def test_distances_lie_between_the_given_multiples(cloud):
    fit, near, far = (
        np.array([c.near for c in outside_cameras(cloud, 30, distance=d)])
        for d in ((1, 1), (0.5, 0.5), (0.5, 2))
    )
    np.testing.assert_allclose(fit, fit[0])
    np.testing.assert_allclose(near, fit / 2)
    ratio = far / fit
    assert (ratio >= 0.5).all()
    assert (ratio <= 2).all()
    assert ratio.min() < 0.6
    assert ratio.max() > 1.8
    # Near and far ones on every side: distance does not go with the angle.
    azimuth, elevation = angles_of(outside_cameras(cloud, 200, distance=(0.5, 2)), cloud)
    ratio = np.array([c.near for c in outside_cameras(cloud, 200, distance=(0.5, 2))])
    for angle in (elevation, np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth))):
        assert abs(np.corrcoef(ratio, angle)[0, 1]) < 0.2


def test_the_fitting_distance_is_that_of_a_sphere_with_nine_tenths_of_the_opacity():
    rng = np.random.default_rng(0)
    shell = rng.normal(size=(3000, 3))
    shell *= (2 / np.linalg.norm(shell, axis=1))[:, None]
    ball = cloud_at(np.concatenate([shell, shell[:150] * 1.5]))
    center = scene_bounds(ball).center
    np.testing.assert_allclose(center, 0, atol=0.2)
    for fov in (50.0, 90.0):
        for camera in outside_cameras(ball, 5, distance=(1, 1), fov=fov, width=40, height=20):
            away = np.linalg.norm(camera.center - center)
            assert away == pytest.approx(2 / np.sin(np.radians(fov / 2)), rel=0.05)
    # Surroundings with most of the opacity do not push the cameras away.
    far = rng.normal(size=(2000, 3)) * 60
    within = cloud_at(np.concatenate([shell, far]))
    cameras = outside_cameras(within, 5, distance=(1, 1))
    assert max(np.linalg.norm(camera.center) for camera in cameras) < 4 * 2.5 / np.sin(np.radians(25))


def test_long_subjects_are_whole_in_images():
    """A body with most of the splats and a neck: cameras look half-way between, at others at their middle."""
    rng = np.random.default_rng(0)
    body, neck = rng.uniform(-0.5, 0.5, (6000, 3)), rng.uniform(-0.1, 0.1, (3000, 3))
    neck[:, 1] = rng.uniform(-3, -0.5, len(neck))
    guitar, ball = cloud_at(np.concatenate([body, neck])), cloud_at(rng.normal(size=(2000, 3)))
    bounds = scene_bounds(guitar)
    assert bounds.center[1] > -0.4
    target = target_of(bounds, front_axes(np.array([0.0, -1, 0])))
    assert target[1] == pytest.approx(-1.25, abs=0.25)
    cameras = outside_cameras(guitar, 20)
    for camera in cameras:
        gaze, away = camera.world_to_camera[2, :3], target - camera.center
        assert gaze @ away == pytest.approx(np.linalg.norm(away))
    round_one = scene_bounds(ball)
    np.testing.assert_array_equal(target_of(round_one, np.eye(3)), round_one.center)


def test_surroundings_are_noticed_and_keep_cameras_above_the_ground(monkeypatch):
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(2000, 3)) * 0.3
    far = rng.normal(size=(100, 3)) * 0.5 + [0, 0, 20]
    alone, within = cloud_at(ball), cloud_at(np.concatenate([ball, far]))
    assert not has_surroundings(alone)
    assert has_surroundings(within)
    monkeypatch.setattr("meshsplats.cameras.placing.MOST", 500)  # as some of the splats tell
    assert not has_surroundings(alone)
    assert has_surroundings(within)
    below = angles_of([v.camera for v in splat_dataset(alone, width=8).train], alone)[1].min()
    above = angles_of([v.camera for v in splat_dataset(within, width=8).train], within)[1].min()
    assert 0 <= below < 1.5
    assert 3 <= above < 5


def test_inside_cameras_stand_in_free_space_and_look_all_round():
    """A closed room of 8 x 3 x 6 with a block in the middle: from inside every image is full of wall."""
    rng = np.random.default_rng(0)
    half = np.array([4.0, 1.5, 3.0])
    walls = rng.uniform(-1, 1, (30_000, 3)) * half
    axis = rng.integers(0, 3, 30_000)
    walls[np.arange(30_000), axis] = (half * np.sign(rng.normal(size=(30_000, 3))))[np.arange(30_000), axis]
    block = rng.uniform(-1, 1, (8000, 3)) * [1.2, 1.5, 1.2]
    room = cloud_at(np.concatenate([walls, block]), 0.08)
    cameras = inside_cameras(room, 36, width=24, height=24)
    centers = np.unique(np.array([c.center for c in cameras]).round(6), axis=0)
    assert (np.abs(centers) < half - 0.3).all()
    assert (np.abs(centers[:, [0, 2]]).max(axis=1) > 1.25).all()  # not in the block
    assert len(centers) >= 4
    assert np.ptp(centers[:, 0]) > 2  # they are spread over the room
    forward = np.array([c.world_to_camera[2, :3] for c in cameras])
    assert np.linalg.norm(forward.mean(axis=0)) < 0.2
    dataset = splat_dataset(room, placement="inside", train=12, test=3, width=24)
    assert dataset.opening is dataset.test[0].camera
    assert np.mean([view.alpha.mean() for view in dataset.views]) > 0.95


@pytest.mark.parametrize("known", [False, True])
def test_the_first_views_held_out_are_the_same_for_any_number_of_others(cloud, known):
    """What was trained on can be measured later without knowing on how many views it was."""
    cameras = ms.orbit(cloud, 60, width=64, height=48) if known else None
    held = [
        {v.name for v in splat_dataset(cloud, cameras=cameras, train=train, test=8, width=32).test}
        for train in (3, 20, 500)
    ]
    assert len(held[0]) == 8
    assert held[0] == held[1] == held[2]
    trained = {v.name for v in splat_dataset(cloud, cameras=cameras, train=500, test=8, width=32).train}
    assert trained.isdisjoint(held[0])
    assert len(trained) == (52 if known else 500)
    if not known:  # nor are they trained on where fewer are held out
        few = splat_dataset(cloud, train=20, test=1, width=32)
        assert held[0].isdisjoint(v.name for v in few.train)


def test_no_free_space_is_an_error():
    ball = np.random.default_rng(0).normal(size=(500, 3)) * 0.1
    with pytest.raises(ValueError, match="no free place was found inside the scene"):
        splat_dataset(cloud_at(ball, 5.0), placement="inside")


def test_known_cameras_are_used_as_they_are(cloud):
    cameras = ms.orbit(cloud, 30, width=64, height=48)
    dataset = splat_dataset(cloud, cameras=cameras, train=10, test=2, width=32)
    assert (len(dataset.train), len(dataset.test)) == (10, 2)
    given = {camera.name: camera for camera in cameras}
    for view in dataset.views:
        np.testing.assert_array_equal(view.camera.world_to_camera, given[view.name].world_to_camera)
        assert (view.camera.width, view.camera.height) == (32, 24)
    few = splat_dataset(cloud, cameras=cameras[:3], train=10, test=2, width=32)
    assert (len(few.train), len(few.test)) == (2, 1)  # at most every eighth, but one


@pytest.mark.parametrize(("given", "held"), [(1, 0), (2, 1), (8, 1), (9, 2), (40, 5), (100, 8)])
def test_of_few_cameras_most_are_trained_on_and_none_is_held_out_too(cloud, given, held):
    dataset = splat_dataset(cloud, cameras=ms.orbit(cloud, given, width=16), train=200, test=8)
    assert (len(dataset.train), len(dataset.test)) == (given - held, held)
    assert not {view.name for view in dataset.train} & {view.name for view in dataset.test}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"placement": "outside"}, "placement must be"),
        ({"train": 0}, "at least 1 training view"),
        ({"width": 0}, "width and height"),
        ({"distance": (2, 1)}, "distance must be"),
        ({"cameras": []}, "cameras is empty"),
    ],
)
def test_splat_data_sets_check_their_options(cloud, options, message):
    with pytest.raises(ValueError, match=message):
        splat_dataset(cloud, **options)


# ---- Commands


def test_commands_take_the_cameras_of_a_data_set(cloud, tmp_path, capsys):
    folder = simple_colmap(tmp_path / "set", 9)
    poses = [(f"p{i:02d}.png", (1, 0, 0, 0), (0.1 * i, 0, 8), 1) for i in range(9)]
    write_colmap(folder, [(1, "PINHOLE", 12, 8, (10.0, 11.0, 6.5, 3.5))], poses)
    ms.save_gaussians(cloud, tmp_path / "s.ply")
    out = tmp_path / "out"
    assert (
        main(["render", str(tmp_path / "s.ply"), "-o", str(out), "--as-splats", "--data", str(folder)]) == 0
    )
    used = ms.load_cameras(out / "cameras.json")
    assert [c.name for c in used] == ["p00.png", "p08.png"]
    assert not list(out.glob("turntable*"))
    mesh = str(tmp_path / "m.npz")
    assert main(["convert", str(tmp_path / "s.ply"), "-o", mesh, "--data", str(folder), "--no-preview"]) == 0
    cameras = [view.camera for view in load_dataset(folder).train]
    # But for the file's rounding of quaternions and scales.
    np.testing.assert_allclose(
        ms.load_mesh(mesh).vertices, ms.convert(cloud, cameras=cameras).vertices, atol=1e-5
    )
    both = ["--data", str(folder), "--cameras", str(out / "cameras.json")]
    assert main(["convert", str(tmp_path / "s.ply"), "-o", mesh, "--force", *both]) == 2
    assert main(["render", mesh, "-o", str(out), "--force", *both]) == 2
    assert main(["render", mesh, "-o", str(out), "--force", "--data", str(tmp_path)]) == 1
    assert "set/ in it looks like one" in capsys.readouterr().err


# ---- Real photographs


@pytest.mark.slow
@pytest.mark.parametrize(
    ("photos", "splats", "downscale", "background", "train", "test", "least"),
    [
        ("lego", "lego_60k_sh0", 2, (1, 1, 1), 100, 40, 27.0),
        ("snowmiku", "miku_58k_sh0", 4, (0, 0, 0), 84, 13, 27.0),
    ],
)
def test_trained_splats_look_like_the_photographs(photos, splats, downscale, background, train, test, least):
    """A pose, a focal length or a pixel that is off would cost several dB."""
    dataset = load_dataset(shared_data(f"photos/{photos}"), downscale=downscale, background=background)
    assert (len(dataset.train), len(dataset.test)) == (train, test)
    cloud = ms.load_gaussians(shared_data(f"splats/trained/{splats}.ply"))
    views = dataset.test[3::4]

    def median(**shift: float) -> float:
        scores = []
        for view in views:
            # Drawn larger and made smaller, as the photographs are: the splats' filter is a pixel of those.
            camera = view.camera.scaled(2)
            camera = replace(camera, **{key: getattr(camera, key) + value for key, value in shift.items()})
            drawn = ms.render_splats(cloud, camera, background=background).color
            scores.append(ms.psnr(smaller(drawn), view.image))
        return float(np.median(scores))

    score = median()
    assert score > least
    for shift in ({"cx": 2}, {"cx": -2}, {"cy": 2}, {"cy": -2}):
        assert median(**shift) < score - 0.3, shift


def smaller(image: np.ndarray) -> np.ndarray:
    h, w = image.shape[0] // 2, image.shape[1] // 2
    return np.clip(image, 0, 1).reshape(h, 2, w, 2, 3).mean(axis=(1, 3))


def test_results_of_the_loader_can_be_saved_as_cameras(tmp_path):
    dataset = load_dataset(simple_colmap(tmp_path, 2))
    ms.save_cameras([view.camera for view in dataset.views], tmp_path / "c.json")
    assert [c["name"] for c in json.loads((tmp_path / "c.json").read_text())] == ["p01.png", "p00.png"]


def shares(before: int, after: int) -> np.ndarray:
    """(after, before) by how much of each of ``after`` equal spans each of ``before`` makes up."""
    edges, cells = np.linspace(0, before, after + 1), np.arange(before)
    overlap = np.minimum(edges[1:, None], cells + 1) - np.maximum(edges[:-1, None], cells)
    return np.maximum(overlap, 0) * after / before


@pytest.mark.parametrize(("before", "after"), [(1921, 960), (400, 133), (100, 50), (64, 63)])
def test_reduced_photographs_show_things_where_they_are(before, after):
    """A ramp: the mean over a pixel's area is the value at its middle, whether or not the factor is whole."""
    ramp = np.tile(np.arange(before, dtype=np.float32), (6, 1))
    middles = (np.arange(after) + 0.5) * before / after - 0.5
    np.testing.assert_allclose(_resized(ramp, (after, 6)), np.tile(middles, (6, 1)), atol=0.01)
    np.testing.assert_allclose(_resized(ramp.T, (6, after)), np.tile(middles, (6, 1)).T, atol=0.01)
    bytes_ = np.random.default_rng(0).integers(0, 256, (40, before, 3), dtype=np.uint8)
    small = _resized(bytes_, (after, 17))
    truth = np.einsum("rh,hwc,kw->rkc", shares(40, 17), bytes_.astype(float), shares(before, after))
    assert small.dtype == np.uint8
    assert np.abs(small - truth).max() <= 0.51
