"""COLMAP folders: poses and lenses of binary and text models, splits, sizes; what can be broken in them."""

from __future__ import annotations

import struct
import tracemalloc
import warnings

import numpy as np
import pytest
from _datasets import colmap_bytes, pinhole_rays, rotation, save, simple_colmap, sky, write_colmap

from meshsplats import load_dataset
from meshsplats.errors import DataWarning, FileFormatError


def by_name(dataset) -> dict:
    return {view.name: view for view in dataset.views}


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_poses_intrinsics_and_images(tmp_path, text):
    views = by_name(load_dataset(simple_colmap(tmp_path, 4, text=text)))
    assert len(views) == 4
    for i in range(4):
        view = views[f"p{i:02d}.png"]
        camera = view.camera
        np.testing.assert_allclose(camera.world_to_camera[:3, :3], rotation(i)[1], atol=1e-12)
        np.testing.assert_array_equal(camera.world_to_camera[:3, 3], (i, 0.5, -1))
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 11, 6.5, 3.5)
        assert (camera.width, camera.height) == (12, 8)
        np.testing.assert_allclose(view.image, np.full((8, 12, 3), 10 * i / 255, np.float32))
        assert view.alpha is None
        assert view.mask is None


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", "sparse/2", "."])
def test_places_of_the_model(tmp_path, place):
    assert len(load_dataset(simple_colmap(tmp_path, place=place)).views) == 3


def test_every_eighth_by_name_is_held_out(tmp_path):
    folder = simple_colmap(tmp_path, 18)
    dataset = load_dataset(folder)
    assert [view.name for view in dataset.test] == ["p00.png", "p08.png", "p16.png"]
    assert [view.name for view in dataset.train][:8] == [f"p{i:02d}.png" for i in (1, 2, 3, 4, 5, 6, 7, 9)]
    assert len(dataset.train) == 15
    assert [view.name for view in load_dataset(folder, test_every=9).test] == ["p00.png", "p09.png"]
    assert load_dataset(folder, test_every=0).test == ()


def test_a_list_of_test_images_is_followed(tmp_path):
    folder = simple_colmap(tmp_path, 5)
    (folder / "sparse/0/test.txt").write_text("p03.png\n\np01\n")
    dataset = load_dataset(folder)
    assert [view.name for view in dataset.test] == ["p01.png", "p03.png"]
    assert [view.name for view in dataset.train] == ["p00.png", "p02.png", "p04.png"]


@pytest.mark.parametrize("listed", ["p03.small", "p03.small.png", "p03.small.JPG"])
def test_names_in_a_list_of_test_images_may_have_dots(tmp_path, listed):
    folder = simple_colmap(tmp_path, 5, text=True)
    (folder / "images/p03.png").rename(folder / "images/p03.small.png")
    images = folder / "sparse/0/images.txt"
    images.write_text(images.read_text().replace("p03.png", "p03.small.png"))
    (folder / "sparse/0/test.txt").write_text(f"{listed}\n")
    assert [view.name for view in load_dataset(folder).test] == ["p03.small.png"]


def test_a_list_of_test_images_that_does_not_match_is_named_or_refused(tmp_path):
    folder = simple_colmap(tmp_path, 5)
    listed = folder / "sparse/0/test.txt"
    for text in ("images/p03.png\n", "p01.png p03.png\n", "IMG_3025.JPG\n"):
        listed.write_text(text)
        refused(folder, r"none of its images is in test\.txt, which has '.*their names are such as 'p00'")
    listed.write_text("p03.png\nIMG_9999.JPG\n")
    with pytest.warns(DataWarning, match=r"1 of 2 names in test\.txt are of no image.*\('IMG_9999'\)"):
        assert [view.name for view in load_dataset(folder).test] == ["p03.png"]
    listed.write_text("\n")
    with pytest.warns(DataWarning, match=r"test\.txt: lists no image, so no view is held out"):
        assert load_dataset(folder).test == ()
    listed.write_text("p01.png\np03.png\n")
    (folder / "images/p03.png").unlink()  # of which there is a warning of its own
    with pytest.warns(DataWarning, match="1 images are missing") as warned:
        assert [view.name for view in load_dataset(folder).test] == ["p01.png"]
    assert len(warned) == 1


def test_intrinsics_follow_the_images_real_size(tmp_path):
    """The model was made of images twice as large, the folder of smaller ones a pixel short."""
    folder = simple_colmap(tmp_path, 2)
    for i in range(2):
        save(folder / f"images/p{i:02d}.png", np.zeros((4, 6, 3), np.uint8))
        save(folder / f"images_4/p{i:02d}.JPG", np.zeros((2, 3, 3), np.uint8))
    camera = load_dataset(folder).views[0].camera
    assert (camera.width, camera.height) == (6, 4)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (5, 5.5, 3.25, 1.75)
    camera = load_dataset(folder, downscale=4).views[0].camera  # from images_4, under another suffix
    assert (camera.width, camera.height) == (3, 2)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (2.5, 2.75, 1.625, 0.875)


def test_rounded_sides_scale_each_axis_by_itself(tmp_path):
    folder = simple_colmap(tmp_path, 1, size=(25, 17))
    camera = load_dataset(folder, downscale=2, test_every=0).train[0].camera
    assert (camera.width, camera.height) == (12, 8)
    assert (camera.fx, camera.fy) == pytest.approx((10 * 12 / 25, 11 * 8 / 17))
    assert (camera.cx, camera.cy) == pytest.approx((6.5 * 12 / 25, 3.5 * 8 / 17))


def test_lens_is_undistorted_with_its_borders_masked(tmp_path):
    lens = (90.0, 90.0, 79.0, 62.0, 0.0, 0.0, 0.0, 0.0)
    y, x = np.mgrid[0:120, 0:160] + 0.5
    r = np.maximum(np.hypot(x - 79, y - 62), 1e-9)
    theta = r / 90
    rays = np.stack([(x - 79) / r * np.sin(theta), (y - 62) / r * np.sin(theta), np.cos(theta)], axis=-1)
    quaternion, matrix = rotation(3)
    save(tmp_path / "images/a b.png", sky(rays @ matrix))  # rays @ R = R.T @ ray: camera to world
    write_colmap(
        tmp_path, [(7, "OPENCV_FISHEYE", 160, 120, lens)], [("a b.png", quaternion * 2, (0, 0, 0), 7)]
    )
    view = load_dataset(tmp_path, test_every=0).train[0]
    camera = view.camera
    assert (camera.fx, camera.cx, camera.cy, camera.width, camera.height) == (90, 79, 62, 160, 120)
    want = sky(pinhole_rays(160, 120, 90, 90, 79, 62) @ camera.world_to_camera[:3, :3])
    assert view.mask is not None
    assert view.mask.mean() > 0.95
    assert np.abs(view.image - want)[view.mask].max() < 0.006  # 8 bits and bilinear values


def test_borders_that_no_photograph_covers_are_black_and_masked(tmp_path):
    """A pincushion lens: the pinhole's corners lie outside of the photograph."""
    save(tmp_path / "images/p.png", np.full((60, 80, 3), 200, np.uint8))
    write_colmap(
        tmp_path, [(1, "SIMPLE_RADIAL", 80, 60, (60, 40, 30, 0.4))], [("p.png", (1, 0, 0, 0), (0, 0, 0), 1)]
    )
    view = load_dataset(tmp_path, test_every=0).train[0]
    mask, image = view.mask, view.image
    assert not mask[0, 0]
    assert mask[30, 40]
    assert 0.5 < mask.mean() < 0.95
    assert (image[~mask] == 0).all()
    np.testing.assert_allclose(image[mask], 200 / 255, atol=1e-6)


def test_a_panorama_gives_six_views_that_stay_together(tmp_path):
    for i in range(2):
        save(tmp_path / f"images/{i}.png", np.full((32, 64, 3), 100 + i, np.uint8))
    write_colmap(
        tmp_path,
        [(1, "EQUIRECTANGULAR", 64, 32, (64, 32))],
        [(f"{i}.png", rotation(i)[0], (0, i, 0), 1) for i in range(2)],
    )
    dataset = load_dataset(tmp_path, test_every=2)
    sides = ("front", "right", "back", "left", "up", "down")
    assert [view.name for view in dataset.test] == [f"0.png/{side}" for side in sides]
    assert [view.name for view in dataset.train] == [f"1.png/{side}" for side in sides]
    assert {view.camera.width for view in dataset.views} == {16}
    np.testing.assert_allclose(dataset.train[2].camera.center, -rotation(1)[1].T @ (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(dataset.train[4].image, 101 / 255, atol=1e-6)
    forward = [view.camera.world_to_camera[2, :3] @ rotation(1)[1].T for view in dataset.train]
    along = [(0, 0, 1), (1, 0, 0), (0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, 1, 0)]
    np.testing.assert_allclose(forward, along, atol=1e-12)


# ---- Against COLMAP itself


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_models_written_by_colmap(tmp_path, text):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_frames_per_rig, options.num_points3D = 2, 4, 30
    options.camera_model_id = pycolmap.CameraModelId.OPENCV
    options.camera_params = [900, 910, 510, 380, -0.05, 0.01, 0.001, -0.002]
    model = pycolmap.synthesize_dataset(options)
    (tmp_path / "sparse/0").mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(tmp_path / "sparse/0"))
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        save(tmp_path / "images" / image.name, np.zeros((camera.height // 8, camera.width // 8, 3), np.uint8))
    views = by_name(load_dataset(tmp_path))
    assert len(views) == len(model.images) == 8
    points = np.array([p.xyz for p in model.points3D.values()])
    for image in model.images.values():
        view = views[image.name]
        camera = model.cameras[image.camera_id]
        rigid = image.cam_from_world()
        np.testing.assert_allclose(view.camera.world_to_camera[:3], rigid.matrix(), atol=1e-12)
        # The lens, through the image's size: an eighth of the model's.
        seen = points @ view.camera.world_to_camera[:3, :3].T + view.camera.world_to_camera[:3, 3]
        want = camera.img_from_cam(seen) * [
            view.camera.width / camera.width,
            view.camera.height / camera.height,
        ]
        np.testing.assert_allclose(view.source.lens.pixels(seen), want, atol=1e-6)


# ---- Broken folders


def refused(folder, message: str, **options) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_dataset(folder, **options)


GOOD = ([(1, "PINHOLE", 4, 4, (1.0, 1, 2, 2))], [("a.png", (1, 0, 0, 0), (0, 0, 0), 1)])


def broken(tmp_path, cameras: bytes | None = None, images: bytes | None = None):
    save(tmp_path / "images/a.png", np.zeros((4, 4, 3), np.uint8))
    write_colmap(tmp_path, *GOOD)
    if cameras is not None:
        (tmp_path / "sparse/0/cameras.bin").write_bytes(cameras)
    if images is not None:
        (tmp_path / "sparse/0/images.bin").write_bytes(images)
    return tmp_path


def test_the_good_folder_of_these_tests_is_good(tmp_path):
    assert len(load_dataset(broken(tmp_path)).views) == 1


def test_every_truncation_is_refused(tmp_path):
    cameras, images = colmap_bytes(*GOOD)
    for cut in range(len(cameras)):
        refused(broken(tmp_path, cameras=cameras[:cut]), r"cameras\.bin: ")
    broken(tmp_path, cameras=cameras)
    for cut in range(len(images)):
        refused(broken(tmp_path, images=images[:cut]), r"images\.bin: ")


def test_absurd_counts_take_no_memory(tmp_path):
    cameras, images = colmap_bytes(*GOOD)
    tracemalloc.start()
    for count in (2, 10**6, 2**63, 2**64 - 1):
        refused(broken(tmp_path, cameras=struct.pack("<Q", count) + cameras[8:]), "only 56 bytes follow")
        broken(tmp_path, cameras=cameras)
        refused(broken(tmp_path, images=struct.pack("<Q", count) + images[8:]), "only .* bytes follow")
        broken(tmp_path, images=images)
        refused(broken(tmp_path, images=images[:-8] + struct.pack("<Q", count)), "ends within the points")
        broken(tmp_path, images=images)
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def camera(**change) -> bytes:
    values = {"model": 1, "width": 4, "height": 4, "parameters": (1.0, 1, 2, 2)} | change
    head = struct.pack("<QiiQQ", 1, 1, values["model"], values["width"], values["height"])
    return head + struct.pack(f"<{len(values['parameters'])}d", *values["parameters"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": 99}, "camera 0 has model number 99; known are 0 to 17"),
        ({"model": -1}, "model number -1"),
        ({"width": 0}, "an image of 0 x 4 pixels"),
        ({"height": 2**40}, "an image of 4 x 1099511627776 pixels"),
        ({"parameters": (float("nan"), 1, 2, 2)}, "must be finite"),
        ({"parameters": (1, -1, 2, 2)}, "focal lengths must be positive"),
    ],
)
def test_impossible_cameras_are_refused(tmp_path, change, message):
    refused(broken(tmp_path, cameras=camera(**change)), message)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (("a.png", (0, 0, 0, 0), (0, 0, 0), 1), "no rotation and translation"),
        (("a.png", (1, 0, 0, 0), (0, float("inf"), 0), 1), "no rotation and translation"),
        (("a.png", (1, 0, 0, 0), (0, 0, 0), 5), "refers to camera 5"),
        (("x" * 1001, (1, 0, 0, 0), (0, 0, 0), 1), "does not end within 1000 bytes"),
        (("../secret.png", (1, 0, 0, 0), (0, 0, 0), 1), "only files inside"),
        (("/etc/passwd", (1, 0, 0, 0), (0, 0, 0), 1), "none of its images is there"),
        (("a/../../../b.png", (1, 0, 0, 0), (0, 0, 0), 1), "only files inside"),
        (("..\\b.png", (1, 0, 0, 0), (0, 0, 0), 1), "only files inside"),
    ],
)
def test_impossible_images_are_refused(tmp_path, image, message):
    refused(broken(tmp_path, images=colmap_bytes([], [image])[1]), message)


def test_names_that_are_not_text_and_names_twice_are_refused(tmp_path):
    _, images = colmap_bytes(*GOOD)
    refused(broken(tmp_path, images=images.replace(b"a.png", b"\xff.png")), "not UTF-8 text")
    twice = colmap_bytes([], GOOD[1] * 2)[1]
    refused(broken(tmp_path, images=twice), "two images have the name 'a.png'")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("cameras", "1 PINHOLE 4\n", "line 1: a camera is"),
        ("cameras", "1 PINHOLE 4 4 1 1 2\n", "PINHOLE has 4 parameters, got 3"),
        ("cameras", "1 GLASS 4 4 1 1 2 2\n", "unknown camera model 'GLASS'"),
        ("cameras", "1 PINHOLE 4 x 1 1 2 2\n", "expected a whole number, got b'x'"),
        ("cameras", "# only a comment\n", "refers to camera 1, which the model does not have"),
        ("images", "1 1 0 0 0 0 0 0 1\n\n", "line 1: an image is"),
        ("images", "# x\n1 1 0 0 0 0 0 y 1 a.png\n\n", "line 2: expected numbers"),
        ("images", "\n", "names no images"),
    ],
)
def test_broken_text_is_refused(tmp_path, name, text, message):
    save(tmp_path / "images/a.png", np.zeros((4, 4, 3), np.uint8))
    write_colmap(tmp_path, *GOOD, text=True)
    (tmp_path / f"sparse/0/{name}.txt").write_text(text)
    refused(tmp_path, message)


def test_an_endless_line_of_points_is_skipped_without_memory(tmp_path):
    folder = simple_colmap(tmp_path, 2, text=True)
    path = folder / "sparse/0/images.txt"
    lines = path.read_text().splitlines()
    rows = [i for i, line in enumerate(lines) if line.endswith(".png")]
    lines[rows[0] + 1] = "1.5 2.5 -1 " * 1_000_000
    path.write_text("\n".join(lines) + "\n")
    tracemalloc.start()
    assert len(load_dataset(folder).views) == 2
    assert tracemalloc.get_traced_memory()[1] < 4 << 20
    tracemalloc.stop()


def test_held_out_views_are_those_that_are_there(tmp_path):
    folder = simple_colmap(tmp_path, 5)
    (folder / "images/p01.png").unlink()
    (folder / "images/p03.png").unlink()
    with pytest.raises(FileFormatError, match=r"2 of 5 .* \(images/p01\.png, images/p03\.png\)$"):
        load_dataset(folder, missing="error")
    with pytest.warns(DataWarning, match=r"2 images are missing.*images/p01\.png, images/p03\.png"):
        dataset = load_dataset(folder, test_every=2)
    assert len(dataset.views) == 3


@pytest.mark.parametrize("lost", [3, 4])
def test_a_missing_photograph_leaves_the_others_on_their_side(tmp_path, lost):
    folder = simple_colmap(tmp_path, 12)
    whole = load_dataset(folder, test_every=4)
    (folder / f"images/p{lost:02d}.png").unlink()
    with pytest.warns(DataWarning, match="1 images are missing"):
        dataset = load_dataset(folder, test_every=4)
    for before, after in (whole.train, dataset.train), (whole.test, dataset.test):
        kept = [view.name for view in before if view.name != f"p{lost:02d}.png"]
        assert [view.name for view in after] == kept


def test_no_images_at_all_says_where_they_were_expected(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    (folder / "images").rename(folder / "images_2")
    refused(folder, r"none of its images is there.*images.p00\.png.*give a downscale of 2")
    assert len(load_dataset(folder, downscale=2).views) == 2


def test_images_that_a_smaller_folder_lacks_are_made_smaller(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    save(folder / "images_2/p00.png", np.full((4, 6, 3), 255, np.uint8))
    views = load_dataset(folder, downscale=2, test_every=0).train
    assert [view.load().color.shape for view in views] == [(4, 6, 3)] * 2
    assert [bool((view.load().color == 255).all()) for view in views] == [True, False]


def test_images_that_were_thrown_away_do_not_come_back_from_a_smaller_folder(tmp_path):
    folder = simple_colmap(tmp_path, 5)
    for i in range(5):
        save(folder / f"images_2/p{i:02d}.png", np.zeros((4, 6, 3), np.uint8))
    (folder / "images/p01.png").unlink()
    for downscale in (1, 2):
        with pytest.warns(DataWarning, match=r"1 images are missing; their .*\(images/p01\.png\)"):
            assert len(load_dataset(folder, downscale=downscale).views) == 4


def test_images_of_another_shape_are_refused(tmp_path):
    folder = simple_colmap(tmp_path, 2)
    save(folder / "images/p01.png", np.zeros((8, 16, 3), np.uint8))
    refused(folder, "16 x 8 pixels do not fit its camera, which took 12 x 8")
    save(folder / "images/p01.png", np.zeros((12, 8, 3), np.uint8))
    refused(folder, "8 x 12 pixels do not fit.*It is rotated")


def test_a_model_beside_its_images_is_no_numbered_one(tmp_path):
    """Nor does an empty sparse/ hide it, nor is a test.txt beside the images a list of them."""
    folder = simple_colmap(tmp_path / "0", 3, place=".")
    simple_colmap(tmp_path / "1", 9, place=".")
    (folder / "sparse").mkdir()
    (folder / "test.txt").write_text("what I tested\n")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = load_dataset(folder)
    assert (len(dataset.train), len(dataset.test)) == (2, 1)


def test_of_several_models_the_one_with_the_most_images_is_taken(tmp_path):
    folder = simple_colmap(tmp_path, 5, place="sparse/3")
    few = [(f"p{i:02d}.png", (1, 0, 0, 0), (0, 0, 0), 1) for i in range(2)]
    write_colmap(folder, [(1, "PINHOLE", 12, 8, (1.0, 1, 2, 2))], few, place="sparse/0")
    with pytest.warns(DataWarning, match=r"sparse.3: this model is taken.*sparse.0 \(2\)"):
        assert len(load_dataset(folder).views) == 5
    assert len(load_dataset(folder / "sparse/0").views) == 2  # by name
    # One whose images are elsewhere does not count, and the first needs no word.
    many = [(f"{i}.png", (1, 0, 0, 0), (0, 0, 0), 1) for i in range(9)]
    write_colmap(folder, GOOD[0], many, place="sparse/2")
    (folder / "sparse/3").rename(folder / "elsewhere")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_dataset(folder).views) == 2


def photograph(path):
    save(path, np.zeros((4, 6, 3), np.uint8))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda f: None, "it holds nothing"),
        (lambda f: (f / "sparse").mkdir(), "sparse/ holds no cameras"),
        (lambda f: (f / "database.db").touch(), "without a sparse model"),
        (lambda f: (f / "point_cloud").mkdir(), "a trained model"),
        (lambda f: (f / "cameras.bin").touch(), r"cameras\.bin is there, half of COLMAP's model"),
        (lambda f: simple_colmap(f / "inner"), "inner/ in it looks like one"),
        (lambda f: (f / "notes.md").touch(), r"it holds notes\.md"),
        (lambda f: (f / "clip.MP4").touch(), r"clip\.MP4 in it is a video: 'meshsplats train"),
        (lambda f: (f / "clip.mts").touch(), r"clip\.mts in it is a video: 'meshsplats train"),
        (lambda f: (f / "a.dng").touch(), r"a\.dng in it is a raw photograph, .*: develop it to JPEG"),
        (lambda f: (f / "a.jxl").touch(), r"a\.jxl in it is an image .*: convert it to JPEG"),
        (lambda f: photograph(f / "a.jpg"), "of photographs without, 'meshsplats train' finds the cameras"),
        (lambda f: photograph(f / "DCIM/100APPLE/a.jpg"), "there are photographs in DCIM/100APPLE/: give"),
        (lambda f: (f / "scan.las").touch(), r"scan\.las in it is a point cloud"),
    ],
)
def test_other_folders_are_refused_with_a_hint(tmp_path, make, message):
    make(tmp_path)
    refused(tmp_path, message)


def test_nothing_there_is_an_os_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such data set"):
        load_dataset(tmp_path / "missing")
    (tmp_path / "x.ply").touch()
    refused(tmp_path / "x.ply", "a data set is a folder")
