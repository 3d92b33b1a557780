"""NeRF-synthetic and nerfstudio folders."""

from __future__ import annotations

import json
import math
import warnings

import numpy as np
import pytest
from _datasets import pinhole_rays, rotation, save, sky, write_json
from _local import linux_names

from meshsplats import load_dataset
from meshsplats.datasets.points import load_points
from meshsplats.errors import DataWarning, FileFormatError

EYE = np.eye(4).tolist()


def camera_to_world(i: int) -> np.ndarray:
    """An OpenGL pose: its columns are right, up, back, position."""
    result = np.eye(4)
    result[:3, :3] = rotation(i)[1]
    result[:3, 3] = (i, -1, 2)
    return result


def frame(file: str, i: int = 0, **more) -> dict:
    return {"file_path": file, "transform_matrix": camera_to_world(i).tolist()} | more


def nerf(folder, train: int = 3, test: int = 2, angle: float = 0.8):
    for part, count in (("train", train), ("test", test)):
        frames = [frame(f"./{part}/r_{i}", i, rotation=0.03) for i in range(count)]
        write_json(folder / f"transforms_{part}.json", {"camera_angle_x": angle, "frames": frames})
        for i in range(count):
            save(folder / f"{part}/r_{i}.png", np.full((8, 12, 4), (200, 100, 0, 51 * i), np.uint8))
    return folder


def studio(folder, count: int = 3, frames: list | None = None, **change):
    common = {"camera_model": "OPENCV", "w": 12, "h": 8, "fl_x": 10.0, "fl_y": 11.0, "cx": 6.5, "cy": 3.5}
    names = [f"images/f{i}.png" for i in range(count)]
    given = frames if frames is not None else [frame(name, i) for i, name in enumerate(names)]
    content = common | {"frames": given} | change
    for name in names:
        save(folder / name, np.full((8, 12, 3), 77, np.uint8))
    write_json(folder / "transforms.json", {k: v for k, v in content.items() if v is not None})
    return folder


def refused(path, message: str, **options) -> None:
    with pytest.raises(FileFormatError, match=message):
        load_dataset(path, **options)


# ---- NeRF-synthetic


def test_own_split_focal_length_and_names(tmp_path):
    dataset = load_dataset(nerf(tmp_path, train=12))
    assert [view.name for view in dataset.train] == [f"train/r_{i}" for i in range(12)]  # 2 before 10
    assert [view.name for view in dataset.test] == ["test/r_0", "test/r_1"]
    camera = dataset.train[0].camera
    assert camera.fx == camera.fy == pytest.approx(6 / math.tan(0.4))
    assert (camera.cx, camera.cy, camera.width, camera.height) == (6, 4, 12, 8)


def test_opengl_poses_become_opencv_ones(tmp_path):
    view = load_dataset(nerf(tmp_path)).train[2]
    pose = camera_to_world(2)
    np.testing.assert_allclose(view.camera.center, (2, -1, 2), atol=1e-12)
    right, down, forward = view.camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(right, pose[:3, 0], atol=1e-12)
    np.testing.assert_allclose(down, -pose[:3, 1], atol=1e-12)
    np.testing.assert_allclose(forward, -pose[:3, 2], atol=1e-12)


def test_alpha_goes_over_any_background(tmp_path):
    views = load_dataset(nerf(tmp_path, train=6), background=(0, 1, 0.5)).train
    alpha = 51 * 2 / 255
    np.testing.assert_allclose(views[2].alpha, np.full((8, 12), alpha, np.float32), atol=3e-4)
    straight = np.array([200, 100, 0]) / 255
    for got, background in [(views[2].image, (0, 1, 0.5)), (views[2].load().over((1, 1, 1)), (1, 1, 1))]:
        want = alpha * straight + (1 - alpha) * np.array(background)
        np.testing.assert_allclose(got, np.broadcast_to(want, (8, 12, 3)), atol=5e-4)
    pattern = np.random.default_rng(0).uniform(size=(8, 12, 3))
    np.testing.assert_allclose(views[0].load().over(pattern), pattern, atol=1e-6)  # wholly clear
    np.testing.assert_allclose(views[5].load().over(pattern)[0, 0], straight, atol=5e-4)  # wholly opaque
    assert views[0].mask is None


def test_smaller_images_mix_colours_by_their_opacity(tmp_path):
    nerf(tmp_path)
    pixels = np.zeros((8, 12, 4), np.uint8)
    pixels[:, ::2] = (200, 0, 0, 255)
    pixels[:, 1::2] = (0, 255, 0, 0)  # green, but clear
    save(tmp_path / "train/r_0.png", pixels)
    view = load_dataset(tmp_path, downscale=2).train[0]
    assert (view.camera.width, view.camera.height) == (6, 4)
    np.testing.assert_allclose(view.alpha, 0.5, atol=1e-3)
    np.testing.assert_allclose(view.load().over((0, 0, 0))[0, 0], (100 / 255, 0, 0), atol=1e-3)


def test_validation_views_stand_in_for_missing_test_views(tmp_path):
    nerf(tmp_path)
    (tmp_path / "transforms_test.json").rename(tmp_path / "transforms_val.json")
    assert len(load_dataset(tmp_path).test) == 2
    (tmp_path / "transforms_val.json").unlink()
    with pytest.warns(DataWarning, match="there are no test views"):
        assert load_dataset(tmp_path).test == ()


def test_test_views_are_held_out_where_there_are_validation_views_too(tmp_path):
    """As in every NeRF-synthetic scene: published scores are of the test views."""
    nerf(tmp_path)
    write_json(tmp_path / "transforms_val.json", {"camera_angle_x": 0.8, "frames": [frame("./val/r_0")]})
    save(tmp_path / "val/r_0.png", np.zeros((8, 12, 4), np.uint8))
    assert [view.name for view in load_dataset(tmp_path).test] == ["test/r_0", "test/r_1"]


def test_images_to_train_with_are_not_held_out(tmp_path):
    """As where transforms_train.json was copied for programs that want a file of test views."""
    nerf(tmp_path, train=2, test=1)
    own = json.loads((tmp_path / "transforms_test.json").read_text())
    train = json.loads((tmp_path / "transforms_train.json").read_text())
    write_json(tmp_path / "transforms_test.json", own | {"frames": own["frames"] + train["frames"]})
    with pytest.warns(DataWarning, match=r"2 images listed both .* not held out \(train/r_0, train/r_1\)"):
        dataset = load_dataset(tmp_path)
    assert [view.name for view in dataset.train] == ["train/r_0", "train/r_1"]
    assert [view.name for view in dataset.test] == ["test/r_0"]


def test_a_named_file_decides_the_layout(tmp_path):
    studio(nerf(tmp_path))
    assert len(load_dataset(tmp_path).train) == 3
    assert load_dataset(tmp_path / "transforms_train.json").train[0].name == "train/r_0"
    assert load_dataset(tmp_path / "transforms.json").test[0].name == "images/f0.png"


# ---- nerfstudio


def test_common_intrinsics_and_the_every_eighth_split(tmp_path):
    dataset = load_dataset(studio(tmp_path, 9))
    assert [view.name for view in dataset.test] == ["images/f0.png", "images/f8.png"]
    camera = dataset.train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10, 11, 6.5, 3.5)
    np.testing.assert_allclose(dataset.train[0].image, 77 / 255, atol=1e-6)


def test_frames_have_intrinsics_of_their_own(tmp_path):
    frames = [
        frame("images/f0.png", fl_x=5, cx=1),
        frame("images/f1.png", w=24, h=16, k1=0.1),
        frame("images/f2.png", transform_matrix=EYE[:3]),
    ]
    views = load_dataset(studio(tmp_path, frames=frames), test_every=0).train
    assert (views[0].camera.fx, views[0].camera.fy, views[0].camera.cx) == (5, 11, 1)
    assert (views[1].camera.fx, views[1].camera.cy) == (5, 1.75)  # meant for images twice as large
    assert views[0].mask is None
    assert views[1].mask is not None
    np.testing.assert_array_equal(views[2].camera.world_to_camera, np.diag([1.0, -1, -1, 1]))


def test_the_files_own_split(tmp_path):
    names = [f"images/f{i}.png" for i in range(5)]
    split = {
        "train_filenames": [*names[:2], "./" + names[2]],
        "val_filenames": names[3:4],
        "test_filenames": names[4:],
    }
    dataset = load_dataset(studio(tmp_path, 5, **split))
    assert [view.name for view in dataset.train] == names[:3]
    assert [view.name for view in dataset.test] == names[4:]
    dataset = load_dataset(studio(tmp_path, 5, **split | {"test_filenames": []}))
    assert [view.name for view in dataset.test] == names[3:4]
    refused(
        studio(tmp_path, 5, **split | {"train_filenames": ["other.png"]}),
        "none of its images is in 'train_",
    )
    refused(studio(tmp_path, 5, test_filenames="all"), "'test_filenames' must be a list")


def test_a_list_that_the_file_lacks_has_the_rest(tmp_path):
    names = [f"images/f{i}.png" for i in range(5)]
    for lists, test in [
        ({"test_filenames": names[3:]}, names[3:]),
        ({"val_filenames": names[2:3]}, names[2:3]),
        ({"train_filenames": names[1:]}, names[:1]),
        ({"train_filenames": names}, names[:1]),  # which leave nothing: every 8th
    ]:
        dataset = load_dataset(studio(tmp_path, 5, **lists))
        assert [view.name for view in dataset.test] == test
        assert [view.name for view in dataset.train] == [name for name in names if name not in test]


def test_lists_of_the_file_that_do_not_match_are_named_or_refused(tmp_path):
    names = [f"images/f{i}.png" for i in range(5)]
    lists = {"train_filenames": names[:3], "test_filenames": ["f3.png", "f4.png"]}
    refused(studio(tmp_path, 5, **lists), "none of its images is in 'test_filenames', which has 'f3.png'")
    lists["test_filenames"] = ["f3.png", *names[2:]]
    with (
        pytest.warns(DataWarning, match="1 of 4 names in 'test_filenames' are of no image"),
        pytest.warns(DataWarning, match=r"1 image listed both .* not held out \(images/f2\.png\)"),
    ):
        dataset = load_dataset(studio(tmp_path, 5, **lists))
    assert [view.name for view in dataset.train] == names[:3]
    assert [view.name for view in dataset.test] == names[3:]


def test_brown_distortion_is_taken_out(tmp_path):
    """Rays of the photograph by Newton's method on the formula, which the reader never inverts."""
    k1, k2, p1, p2, k3 = -0.12, 0.03, 0.004, -0.003, 0.01
    x, y = np.meshgrid((np.arange(160) + 0.5 - 79) / 120, (np.arange(120) + 0.5 - 62) / 125)
    u, v = x.copy(), y.copy()
    for _ in range(50):
        s = u * u + v * v
        radial = 1 + k1 * s + k2 * s * s + k3 * s**3
        u = (x - 2 * p1 * u * v - p2 * (s + 2 * u * u)) / radial
        v = (y - 2 * p2 * u * v - p1 * (s + 2 * v * v)) / radial
    folder = tmp_path
    save(folder / "images/p.png", sky(np.stack([u, v, np.ones_like(u)], axis=-1)))
    lens = {"w": 160, "h": 120, "fl_x": 120, "fl_y": 125, "cx": 79, "cy": 62}
    lens |= {"k1": k1, "k2": k2, "p1": p1, "p2": p2, "k3": k3}
    opengl = np.diag([1.0, -1, -1, 1]).tolist()
    studio(folder, 0, frames=[{"file_path": "images/p.png", "transform_matrix": opengl}], **lens)
    view = load_dataset(folder, test_every=0).train[0]
    error = np.abs(view.image - sky(pinhole_rays(160, 120, 120, 125, 79, 62)))
    assert view.mask.mean() > 0.9
    assert error[view.mask].max() < 0.006


def test_fisheye_by_model_and_by_flag(tmp_path):
    by_model = load_dataset(studio(tmp_path / "a", camera_model="OPENCV_FISHEYE", k1=0.1))
    by_name = load_dataset(studio(tmp_path / "c", camera_model="opencv_fisheye", k1=0.1))
    assert by_name.views[0].source.lens == by_model.views[0].source.lens
    by_flag = load_dataset(studio(tmp_path / "b", camera_model=None, is_fisheye=True, k1=0.1))
    assert by_model.views[0].source.lens == by_flag.views[0].source.lens
    assert by_model.views[0].source.lens.model == "OPENCV_FISHEYE"


def test_angles_stand_for_focal_lengths(tmp_path):
    folder = studio(tmp_path, fl_x=None, fl_y=None, camera_angle_x=1.0)
    camera = load_dataset(folder).views[0].camera
    assert camera.fx == camera.fy == pytest.approx(6 / math.tan(0.5))
    camera = load_dataset(studio(tmp_path, fl_y=None)).views[0].camera
    assert (camera.fx, camera.fy) == (10, 10)


def test_smaller_copies_of_nested_folders(tmp_path):
    studio(tmp_path, 0, frames=[frame("images/left/f0.png")])
    save(tmp_path / "images/left/f0.png", np.zeros((8, 12, 3), np.uint8))
    save(tmp_path / "images_2/left/f0.png", np.full((4, 6, 3), 255, np.uint8))
    view = load_dataset(tmp_path, downscale=2, test_every=0).train[0]
    assert view.image.min() == 1
    assert view.camera.fx == 5


@pytest.mark.parametrize("listed", [True, False])
def test_photographs_of_a_neighbour_are_no_smaller_copies(tmp_path, listed):
    """walk_2/ beside walk/ is another session, whether it is one of the data set or not."""
    frames = [frame(f"images/{name}/0.png") for name in ("walk", *(["walk_2"] if listed else []))]
    studio(tmp_path, 0, frames=frames)
    save(tmp_path / "images/walk/0.png", np.full((8, 12, 3), 250, np.uint8))
    save(tmp_path / "images/walk_2/0.png", np.full((4, 6, 3) if listed else (8, 12, 3), 20, np.uint8))
    views = load_dataset(tmp_path, downscale=2, test_every=0).train
    assert round(255 * float(views[0].image.mean())) == 250
    assert views[0].camera.width == 6


def test_frames_that_are_listed_twice_are_taken_once(tmp_path):
    names = [f"images/f{i}.png" for i in range(4)]
    frames = [frame(name, i) for i, name in enumerate([*names, *(f"./{name}" for name in names[:2])])]
    folder = studio(tmp_path, 4, frames)
    with pytest.warns(DataWarning, match=r"2 images listed more than once, and taken once .*f0\.png"):
        data = load_dataset(folder, test_every=2)
    assert [view.name for view in data.views] == [names[1], names[3], names[0], names[2]]
    assert np.allclose(data.test[0].camera.center, camera_to_world(0)[:3, 3])


def test_masks_and_points_of_another_place_are_found(tmp_path):
    frames = [frame("images/f0.png", mask_path="/home/me/scan/m/x.png")]
    save(tmp_path / "m/x.png", np.eye(8, 12).astype(np.uint8) * 255)
    folder = studio(tmp_path, 1, frames, ply_file_path="/home/me/scan/points.ply")
    with pytest.warns(DataWarning, match=r"1 masks have paths of another machine.*m/x\.png\)"):
        (view,) = load_dataset(folder, test_every=0).train
    assert view.mask.sum() == 8
    with pytest.warns(DataWarning, match=r"its points, '/home/me/scan/points\.ply', are not in the folder"):
        assert load_points(folder) is None
    header = "ply\nformat ascii 1.0\nelement vertex 1\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz")
    (folder / "points.ply").write_text(header + "end_header\n1 2 3\n")
    assert load_points(folder).positions.tolist() == [[1, 2, 3]]


def test_masks_of_zeros_and_ones(tmp_path):
    mask = np.zeros((8, 12), np.uint8)
    mask[:, :5] = 1
    folder = studio(tmp_path, 1, [frame("images/f0.png", mask_path="m.png")])
    save(tmp_path / "m.png", mask)
    assert np.array_equal(load_dataset(folder, test_every=0).train[0].mask, mask > 0)
    save(tmp_path / "m.png", 0 * mask)
    assert not load_dataset(folder, test_every=0).train[0].mask.any()


@pytest.mark.parametrize(
    ("name", "file", "read"),
    [
        ("Masks", "f1.png", True),
        ("mask", "f1.png", False),
        ("images_masks", "f1.png.png", False),
        ("mask", "other.png", None),
    ],
)
def test_folders_that_look_like_masks_are_read_or_named(tmp_path, name, file, read):
    folder = studio(tmp_path)
    save(tmp_path / name / file, np.zeros((8, 12), np.uint8))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        views = load_dataset(folder, test_every=0).train
    text = "".join(str(warning.message) for warning in caught)
    assert [view.mask is not None for view in views] == [False, read is True, False]
    assert (f"{name}/ looks like masks" in text) == (read is False)


def test_masks_by_name_and_by_folder(tmp_path):
    mask = np.zeros((8, 12), np.uint8)
    mask[:, :5] = 255
    frames = [frame("images/f0.png", mask_path="m/x.png"), frame("images/f1.png", mask_path="")]
    frames.append(frame("images/f2.png", mask_path=None))
    save(tmp_path / "m/x.png", mask)
    save(tmp_path / "masks/f1.png.png", 255 - mask)
    folder = studio(tmp_path, frames=frames)
    with pytest.warns(DataWarning, match=r"1 images have no mask, so all .* count \(masks/f2\.png\)"):
        views = load_dataset(folder, test_every=0).train
    np.testing.assert_array_equal(views[0].mask, mask > 0)
    np.testing.assert_array_equal(views[1].mask, mask == 0)
    assert views[2].mask is None
    # A smaller pixel counts if all of it does.
    save(tmp_path / "masks/f2.png", mask)
    small = load_dataset(folder, downscale=2, test_every=0).train[0].mask
    np.testing.assert_array_equal(small, np.tile(np.arange(6) < 2, (4, 1)))
    save(tmp_path / "m/x.png", mask.T)
    refused(folder, "8 x 12 pixels do not fit its camera")


def test_few_missing_images_are_left_out(tmp_path):
    folder = studio(tmp_path, 4)
    (tmp_path / "images/f2.png").unlink()
    with pytest.warns(DataWarning, match=r"1 images are missing.*\(images/f2\.png\)"):
        assert len(load_dataset(folder).views) == 3
    with pytest.raises(FileFormatError, match=r"1 of 4 images are missing \(images/f2\.png\)"):
        load_dataset(folder, missing="error")
    (tmp_path / "images/f1.png").unlink()  # half of them
    refused(
        folder, r"2 of 4 images are missing \(images/f1\.png, images/f2\.png\); missing skip leaves them out"
    )
    with pytest.warns(DataWarning, match="2 images are missing"):
        assert len(load_dataset(folder, missing="skip").views) == 2
    # The same where their size would have been asked of them.
    folder = studio(tmp_path, 3, [*map(frame, ("images/f0.png", "no.png"))], w=None)
    with pytest.warns(DataWarning, match="1 images are missing"):
        assert len(load_dataset(folder, missing="skip").views) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"file_path": None}, "needs a 'file_path'"),
        ({"file_path": "../x.png"}, "only files inside"),
        ({"file_path": "/etc/hostname"}, "only files inside"),
        ({"file_path": "images/../../x.png"}, "only files inside"),
        ({"file_path": "C:\\x.png"}, "only files inside"),
        ({"file_path": "\\\\host\\x.png"}, "only files inside"),
        ({"file_path": "x\0.png"}, "no file can be called 'x.x00.png': 1 to 1000 characters"),
        ({"file_path": "x" * 1001}, "no file can be called 'xx"),
        pytest.param({"file_path": "x" * 300 + ".png"}, "no file can be called 'xx", marks=linux_names),
        pytest.param({"file_path": "\ud800.png"}, "no file can be called '.ud800.png'", marks=linux_names),
        ({"file_path": "."}, "no file can be called '.'"),
        ({"mask_path": "../m.png"}, "only files inside"),
        ({"mask_path": 3}, "'mask_path' must be a file name"),
        ({"transform_matrix": None}, "'transform_matrix' must be a 4 x 4 matrix"),
        ({"transform_matrix": [[1, 2], [3]]}, "'transform_matrix' must be a 4 x 4 matrix"),
        ({"transform_matrix": np.diag([2.0, 2, 2, 1]).tolist()}, "no rotation and translation"),
        ({"transform_matrix": np.diag([1.0, 1, -1, 1]).tolist()}, "no rotation and translation"),
        ({"transform_matrix": [*EYE[:3], [0, 0, 1, 1]]}, "last row"),
        ({"transform_matrix": [[10**400, 0, 0, 0], *EYE[1:]]}, "must be a 4 x 4 matrix"),
        ({"fl_x": "wide"}, "'fl_x' must be a finite number, got 'wide'"),
        ({"fl_x": float("nan")}, "'fl_x' must be a finite number"),
        ({"fl_x": -3}, "focal lengths must be positive"),
        ({"fl_x": True}, "'fl_x' must be a finite number"),
        ({"w": 40_000}, "whole numbers from 1 to 32768"),
        ({"h": 7.5}, "whole numbers from 1 to 32768"),
        ({"camera_model": "ORTHOPHOTO"}, "camera_model 'ORTHOPHOTO' is not known here"),
        ({"camera_model": ["OPENCV"]}, "is not known here"),
        ({"k4": 0.1}, "programs differ"),
        ({"camera_model": "OPENCV_FISHEYE", "p1": 0.1}, "no tangential terms"),
    ],
)
def test_impossible_frames_are_refused(tmp_path, change, message):
    folder = studio(tmp_path, 1, frames=[frame("images/f0.png") | change])
    refused(folder, message)


def test_a_frame_without_any_focal_length_is_refused(tmp_path):
    refused(studio(tmp_path, fl_x=None, fl_y=None), "needs a focal length 'fl_x'")
    refused(studio(tmp_path, fl_x=None, fl_y=None, camera_angle_x=4), "must lie between 0 and pi")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not a JSON file"),
        ("[]", "must be a JSON object"),
        ("{}", "needs a list 'frames'"),
        ('{"frames": []}', "at least one frame"),
        ('{"frames": [3]}', "frame 0: must be a JSON object"),
        ("[" * 100_000, "not a JSON file"),
    ],
)
def test_broken_files_are_refused(tmp_path, text, message):
    (tmp_path / "transforms.json").write_text(text)
    refused(tmp_path, message)


def test_small_errors_of_rotations_are_taken_out(tmp_path):
    """Files of float32 or a few digits: the camera is exactly rigid, and turned by less than the error."""
    pose = camera_to_world(1)
    pose[:3, :3] += np.random.default_rng(0).uniform(-1e-3, 1e-3, (3, 3))
    studio(tmp_path, 1, frames=[frame("images/f0.png") | {"transform_matrix": pose.tolist()}])
    camera = load_dataset(tmp_path, test_every=0).train[0].camera
    axes = camera.world_to_camera[:3, :3]
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(axes.T * [1, -1, -1], camera_to_world(1)[:3, :3], atol=2e-3)
    np.testing.assert_allclose(camera.center, (1, -1, 2), atol=1e-9)


def test_json_as_nerfstudio_writes_it_is_read_whole(tmp_path):
    """Fields that are of no use here do not disturb."""
    more = {"applied_transform": EYE[:3], "ply_file_path": "sparse_pc.ply", "orientation_override": "none"}
    folder = studio(tmp_path, **more)
    content = json.loads((folder / "transforms.json").read_text())
    content["frames"][0]["colmap_im_id"] = 4
    write_json(folder / "transforms.json", content)
    assert len(load_dataset(folder).views) == 3
