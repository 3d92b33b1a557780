"""A data set that is there is found: layouts and names as other programs write them, whole and in parts."""

from __future__ import annotations

import builtins
import json
import unicodedata
import warnings
from pathlib import Path

import numpy as np
import pytest
from _datasets import rotation, save, simple_colmap, write_colmap, write_json
from _local import make_link, shared_data
from PIL import Image

import meshsplats as ms
from meshsplats.cli import main
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.image_files import ImageIndex
from meshsplats.datasets.layouts import find_layout, unread_cameras
from meshsplats.datasets.points import load_points
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError
from meshsplats.images.reading import load_image
from meshsplats.training.reconstruction import bare_photographs, ensure_cameras

SIZE = (12, 8)
CAMERA = (1, "PINHOLE", *SIZE, (10.0, 11.0, 6.5, 3.5))


def pictures(folder: Path, names: list[str]) -> Path:
    """Image i has the grey value 10 i."""
    for i, name in enumerate(names):
        save(folder / name, np.full((SIZE[1], SIZE[0], 3), 10 * i, np.uint8))
    return folder


def text_model(folder: Path, names: list[str], *, points: str = "1.5 2.5 -1\n", head: str = "") -> Path:
    """As text, image i at x = -i, each line followed by ``points``, which may be nothing at all."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"{head}1 PINHOLE 12 8 10 11 6.5 3.5\n", "utf-8", newline="")
    lines = [f"{i + 1} 1 0 0 0 {i} 0.0 4e-001 1 {name}\n{points}" for i, name in enumerate(names)]
    (folder / "images.txt").write_text(head + "".join(lines), "utf-8", newline="")
    return folder


def need_case(folder: Path) -> None:
    """Skips where names in letters of another case name the same file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "Probe").touch()
    if (folder / "probe").exists():
        pytest.skip("the file system does not tell letters of another case apart")
    (folder / "Probe").unlink()


def whole(path: Path, count: int) -> None:
    """All images are found without a word, each with its own pose."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        views = load_dataset(path, test_every=0).train
    greys = [round(255 * float(view.image[0, 0, 0])) for view in views]
    assert sorted(greys) == [10 * i for i in range(count)]
    for view, grey in zip(views, greys, strict=True):
        assert view.camera.center[0] == -grey / 10


# ---- Where the parts lie


@pytest.mark.parametrize(
    ("model", "images"),
    [
        (".", "."),  # RealityCapture and RealityScan, flat
        (".", "images"),
        ("colmap", "images"),  # Metashape, into a folder
        ("sparse", "Images"),
        ("sparse/0", "IMAGES"),
        ("sparse/0", "."),
        ("sparse/0", "input"),
        ("distorted/sparse/0", "input"),  # before INRIA's convert.py has finished
        ("dense/0/sparse", "dense/0/images"),  # COLMAP's automatic reconstruction
        ("dense/sparse", "dense/images"),  # its undistortion
        ("sparse/0", "sparse/0"),
        ("model", "images"),
        ("Sparse/0", "images"),
        ("colmap_text", "."),
        ("0", "images"),
        ("images", "images"),
    ],
)
def test_models_and_images_in_their_usual_places(tmp_path, model, images):
    names = [f"im{i}.png" for i in range(4)]
    text_model(tmp_path / model, names)
    pictures(tmp_path / images, names)
    whole(tmp_path, 4)
    layout = find_layout(tmp_path)
    assert layout is not None
    assert layout.source == tmp_path / model
    assert bare_photographs(tmp_path) == []
    if model not in ("colmap", "distorted/sparse/0", "model", "Sparse/0", "colmap_text", "0"):
        whole(tmp_path / model, 4)


def test_a_model_without_its_images_does_not_hide_the_undistorted_one(tmp_path):
    """COLMAP's automatic reconstruction: sparse/0 is of the photographs as they were taken, elsewhere."""
    text_model(tmp_path / "sparse/0", [f"im{i}.png" for i in range(4)])
    (tmp_path / "images").mkdir()
    pictures(tmp_path / "dense/0/images", [f"im{i}.png" for i in range(4)])
    text_model(tmp_path / "dense/0/sparse", [f"im{i}.png" for i in range(4)])
    (tmp_path / "dense/0/sparse/points3D.txt").write_text("\ufeff# x\n1 1 2 3 4 5 6 0.5 1 0 2 0\n", "utf-8")
    whole(tmp_path, 4)
    points = load_points(tmp_path)
    assert points is not None
    np.testing.assert_array_equal(points.positions, [[1, 2, 3]])
    # Nor a transforms.json whose images are there.
    other = tmp_path / "other"
    text_model(other / "sparse/0", ["elsewhere.png"])
    pictures(other / "images", ["a.png"])
    frame = {"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}
    write_json(other / "transforms.json", {"fl_x": 10, "frames": [frame]})
    assert [view.name for view in load_dataset(other, test_every=0).train] == ["images/a.png"]


def test_several_models_in_folders_of_other_names_are_named_and_not_replaced(tmp_path):
    names = [f"im{i}.png" for i in range(4)]
    pictures(tmp_path / "images", names)
    for place in ("first", "second/0"):
        text_model(tmp_path / place, names)
    message = "first/ and second/0/ hold cameras of COLMAP for its images: move all but one elsewhere"
    with pytest.raises(FileFormatError, match=message):
        load_dataset(tmp_path)
    with pytest.raises(FileFormatError, match=f"{message}; .*estimate_cameras"):
        ensure_cameras(tmp_path)


def test_a_model_of_other_images_is_named_and_not_replaced(tmp_path):
    pictures(tmp_path / "images", ["a.png", "b.png"])
    text_model(tmp_path / "model", ["elsewhere.png"])
    with pytest.raises(FileFormatError, match="model/ in it looks like one"):
        ensure_cameras(tmp_path)


def test_data_sets_in_a_folder_are_not_read_as_one(tmp_path):
    pictures(text_model(tmp_path / "one", ["a.png"]), ["a.png"])
    with pytest.raises(FileFormatError, match="one/ in it looks like one"):
        load_dataset(tmp_path)


def test_the_larger_dense_model_is_taken(tmp_path):
    for k, count in enumerate((2, 5)):
        pictures(tmp_path / f"dense/{k}/images", [f"im{i}.png" for i in range(count)])
        text_model(tmp_path / f"dense/{k}/sparse", [f"im{i}.png" for i in range(count)])
    with pytest.warns(DataWarning, match=r"dense.1.sparse: this model is taken.*dense.0.sparse \(2\)"):
        assert len(load_dataset(tmp_path).views) == 5


def test_a_file_of_the_model_names_it(tmp_path):
    text_model(pictures(tmp_path, ["a.png"]), ["a.png"])
    whole(tmp_path / "images.txt", 1)
    binary = simple_colmap(tmp_path / "binary", 2)
    assert len(load_dataset(binary / "sparse/0/cameras.bin").views) == 2


# ---- What text files look like


@pytest.mark.parametrize("points", ["1.5 2.5 -1\n", "\n", "", "1 2 -1 " * 40 + "\n", "\n\n", "# no points\n"])
@pytest.mark.parametrize(
    "names",
    [
        [f"{i} (1).jpg" for i in range(6)],
        [f"A-DJI_2024 ({i}).JPG" for i in range(6)],
        [f"cam{i % 2}/IMG {i}.png" for i in range(6)],
        [f"cam{i % 2}\\IMG{i}.png" for i in range(6)],
        [f"Größe {i} 写真.png" for i in range(6)],
        [f"{i}" for i in range(6)],  # numbers alone
        [f"0.{i}.png" for i in range(6)],
        [f"#{i}.png" for i in range(6)],
    ],
    ids=["brackets", "blanks", "folders", "backslashes", "unicode", "numbers", "decimals", "signs"],
)
def test_names_of_any_shape_with_and_without_points(tmp_path, names, points):
    stored = [name.replace("\\", "/") for name in names]
    for i, name in enumerate(stored):
        place = tmp_path / "images" / name
        place.parent.mkdir(parents=True, exist_ok=True)
        file = place if place.suffix.lower() in (".jpg", ".png") else place.with_name(f"{name}.png")
        Image.new("RGB", SIZE, (10 * i,) * 3).save(file, format="PNG")
    text_model(tmp_path / "sparse/0", names, points=points)
    whole(tmp_path, 6)


def test_marks_comments_and_line_ends_of_other_systems(tmp_path):
    pictures(tmp_path / "images", [f"im{i}.png" for i in range(4)])
    model = text_model(tmp_path / "sparse/0", [f"im{i}.png" for i in range(4)], head="\ufeff# list\n\n  \n")
    for name in ("cameras.txt", "images.txt"):
        content = (model / name).read_bytes()
        (model / name).write_bytes(content.replace(b"\n", b"\r\n"))
    (model / "test.txt").write_text("\ufeffim1.png\r\n", "utf-8", newline="")
    assert [view.name for view in load_dataset(tmp_path).test] == ["im1.png"]
    (model / "test.txt").unlink()
    whole(tmp_path, 4)


def test_points_are_not_taken_for_images(tmp_path):
    """Lines of points of any length, of which the longest are cut when they are read."""
    pictures(tmp_path / "images", [f"im{i}.png" for i in range(3)])
    model = text_model(tmp_path / "sparse/0", [f"im{i}.png" for i in range(3)])
    lines = (model / "images.txt").read_text().splitlines()
    lines[1] = "123 " + "1 2 -1 " * 30_000  # cut after a minus
    lines[3] = " ".join(["1 0 0 0 0 0 0 4 1"] * 4)
    (model / "images.txt").write_text("\n".join(lines))
    whole(tmp_path, 3)


# ---- Other suffixes and letters


@pytest.mark.parametrize(
    ("named", "stored"),
    [
        ("IMG_{}.jpeg", "IMG_{}.png"),
        ("IMG_{}.JPG", "IMG_{}.jpg"),
        ("IMG_{}.jpg", "img_{}.JPEG"),
        ("IMG_{}.exr", "IMG_{}.png"),
        ("Cam/IMG_{}.jpg", "cam/IMG_{}.jpg"),
        ("cam/IMG_{}.png", "IMG_{}.png"),  # INRIA's code takes the last part only
        ("C:\\photos\\IMG_{}.png", "IMG_{}.png"),
        (unicodedata.normalize("NFD", "größe_{}.png"), unicodedata.normalize("NFC", "größe_{}.png")),
    ],
)
def test_the_only_file_that_can_be_meant_is_taken(tmp_path, named, stored):
    need_case(tmp_path)
    for i in range(4):
        place = tmp_path / "images" / stored.format(i)
        place.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", SIZE, (10 * i,) * 3).save(place, format="PNG")
    text_model(tmp_path / "sparse/0", [named.format(i) for i in range(4)])
    with pytest.warns(DataWarning, match="4 images were found under other names than the file gives"):
        views = load_dataset(tmp_path, test_every=0).train
    for i, view in enumerate(views):
        assert round(255 * float(view.image[0, 0, 0])) == 10 * i
        assert view.camera.center[0] == -i


def test_transforms_with_paths_of_another_place(tmp_path):
    """Absolute ones, of another machine, and those relative to where the file was made."""
    folder = pictures(tmp_path / "fox/images", ["a.png", "b.png", "c.png", "d.png"]).parent
    names = ["/home/me/fox/images/a.png", "..\\fox\\images\\b.png", "C:/fox/images/c.png"]
    frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
    write_json(folder / "transforms.json", {"fl_x": 10, "frames": frames})
    with pytest.warns(DataWarning, match=r"3 images have paths of another machine.*images/a\.png"):
        views = load_dataset(folder, test_every=0).train
    greys = {view.name: round(255 * float(view.image[0, 0, 0])) for view in views}
    assert greys == {names[0]: 0, names[1]: 10, names[2]: 20}
    write_json(
        folder / "transforms.json", {"fl_x": 10, "frames": [frames[0] | {"file_path": "fox/images/d.png"}]}
    )
    with pytest.warns(DataWarning, match=r"other names .*fox/images/d\.png: images/d\.png"):
        (view,) = load_dataset(folder, test_every=0).train
    assert round(255 * float(view.image[0, 0, 0])) == 30


def test_half_of_them_renamed_is_a_whole_data_set(tmp_path):
    need_case(tmp_path)
    pictures(tmp_path / "images", ["a.png", "b.PNG"])
    text_model(tmp_path / "sparse/0", ["a.PNG", "b.PNG"])
    with pytest.warns(DataWarning, match=r"1 images were found under .*\(images/a\.PNG: images/a\.png\)"):
        assert len(load_dataset(tmp_path).views) == 2


def test_transforms_take_the_only_file_too(tmp_path):
    pictures(tmp_path / "images", ["a.png"])
    frames = [{"file_path": "images/a.JPG", "transform_matrix": np.eye(4).tolist()}]
    write_json(tmp_path / "transforms.json", {"camera_angle_x": 1.0, "frames": frames})
    with pytest.warns(DataWarning, match="other names"):
        view = load_dataset(tmp_path, test_every=0).train[0]
    assert (view.camera.width, view.camera.height) == SIZE


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["a.png", "a.tif"], r"images/a\.png and images/a\.tif may both be meant: keep one"),
        (["a.exr"], r"images/a\.exr is there, but \.exr images are not read here"),
        (["b.png"], r"images/b\.png is there, which another image of the file may mean, too"),
        (["../photos/a.jpeg"], r"photos/ has an image of that name: name that folder 'images'"),
        (["._a.jpg", ".DS_Store"], r"missing \(images/a\.jpg\); missing skip"),
    ],
)
def test_what_may_be_meant_is_named(tmp_path, files, message):
    for file in files:
        path = tmp_path / "images" / file
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix in (".png", ".tif", ".jpeg") and not path.name.startswith("."):
            Image.new("RGB", SIZE).save(path)
        else:
            path.write_bytes(b"\0\1")
    save(tmp_path / "images/z.png", np.zeros((8, 12, 3), np.uint8))
    name = "b" if files == ["b.png"] else "a"
    text_model(tmp_path / "sparse/0", [f"{name}.jpg", *([f"{name}.jpeg"] if name == "b" else []), "z.png"])
    with pytest.raises(FileFormatError, match=message):
        load_dataset(tmp_path)


def test_names_stay_inside_the_folder(tmp_path):
    """Neither parts that lead up nor links are followed where a name is looked for with another suffix."""
    save(tmp_path / "secret.png", np.zeros((8, 12, 3), np.uint8))
    inner = tmp_path / "set"
    pictures(inner / "images", ["a.png"])
    assert ImageIndex(inner).alike("../secret.jpg") == []
    assert ImageIndex(inner).alike(str(tmp_path / "secret.jpg")) == []
    text_model(inner / "sparse/0", ["../../secret.jpg", "a.png"])
    with pytest.raises(FileFormatError, match="only files inside"):
        load_dataset(inner)
    make_link(inner / "images/secret.png", tmp_path / "secret.png")
    text_model(inner / "sparse/0", ["secret.jpg", "a.png"])
    with pytest.raises(FileFormatError, match="a link that leads out"):
        load_dataset(inner)


# ---- Half a data set


def test_many_missing_images_are_an_error_for_every_command(tmp_path, capsys):
    folder = simple_colmap(tmp_path / "half", 6)
    for i in (1, 2, 4):
        (folder / f"images/p0{i}.png").unlink()
    scene = tmp_path / "mesh.npz"
    corners = np.array([[1.0, 0, 5], [0, 1, 5], [0, 0, 6]])
    ms.save_mesh(ms.SplatMesh(corners, np.array([[0, 1, 2]], np.int32), np.ones((3, 4))), scene)
    command = ["render", str(scene), "-o", str(tmp_path / "out"), "--data", str(folder)]
    assert main(command) == 1
    assert "3 of 6 images are missing" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main([*command, "--missing", "skip"]) == 0
    assert "3 images are missing; their views are left out" in capsys.readouterr().err
    assert main(["render", str(scene), "-o", str(tmp_path / "out2"), "--missing", "skip"]) == 2
    assert main(["info", str(folder), "--json"]) == 0
    shown = capsys.readouterr()
    assert json.loads(shown.out)["images"] == 3
    assert shown.err.count("3 images are missing") == 1
    with pytest.raises(ValueError, match="missing must be 'few', 'error' or 'skip', got 'no'"):
        load_dataset(folder, missing="no")  # type: ignore[arg-type]


def test_a_test_split_that_is_not_there(tmp_path):
    for part in ("train", "test"):
        frames = [{"file_path": f"./{part}/r_0", "transform_matrix": np.eye(4).tolist()}]
        write_json(tmp_path / f"transforms_{part}.json", {"camera_angle_x": 0.8, "frames": frames})
    save(tmp_path / "train/r_0.png", np.zeros((8, 12, 4), np.uint8))
    with pytest.raises(
        FileFormatError, match=r"transforms_test\.json: none of its .*missing skip goes on without"
    ):
        load_dataset(tmp_path)
    with pytest.warns(DataWarning, match="1 images are missing"):
        dataset = load_dataset(tmp_path, missing="skip")
    assert (len(dataset.train), len(dataset.test)) == (1, 0)


# ---- Numbers of transforms.json


def test_nulls_and_numbers_as_text(tmp_path):
    pictures(tmp_path, ["a.png"])
    frame = {
        "file_path": "a.png",
        "transform_matrix": np.eye(4).tolist(),
        "k1": None,
        "fl_y": None,
        "w": None,
    }
    common = {"fl_x": "10.5", "fl_y": 11, "w": 12, "h": "8", "k1": None, "k2": None, "p1": "0", "cx": None}
    common |= {"train_filenames": None, "ply_file_path": None, "camera_model": None, "k3": "0.0"}
    write_json(tmp_path / "transforms.json", common | {"frames": [frame]})
    camera = load_dataset(tmp_path, test_every=0).train[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (10.5, 11, 6, 4)
    write_json(tmp_path / "transforms.json", common | {"fl_x": "wide", "frames": [frame]})
    with pytest.raises(FileFormatError, match="'fl_x' must be a finite number, got 'wide'"):
        load_dataset(tmp_path)


# ---- LLFF


def llff(folder: Path, count: int = 9, *, near: float = 2.0, images: str = "images") -> np.ndarray:
    """Poses as LLFF has them; returns the OpenGL ones, which NeRF's code makes of them."""
    pictures(folder / images, [f"IMG_{i}.png" for i in range(count)])
    opengl = np.zeros((count, 3, 4))
    for i in range(count):
        opengl[i, :, :3] = rotation(i)[1]
        opengl[i, :, 3] = (i, -1, 2)
    down, right, back = -opengl[..., 1], opengl[..., 0], opengl[..., 2]
    size = np.broadcast_to(np.array([16.0, 24.0, 30.0]), (count, 3))  # twice as large as the images
    matrices = np.stack([down, right, back, opengl[..., 3], size], axis=-1)
    bounds = np.tile([near, 20.0], (count, 1))
    np.save(folder / "poses_bounds.npy", np.hstack([matrices.reshape(count, 15), bounds]))
    return opengl


@pytest.mark.parametrize("images", ["images", "."])
def test_poses_bounds(tmp_path, images):
    opengl = llff(tmp_path, images=images)
    assert bare_photographs(tmp_path) == []
    dataset = load_dataset(tmp_path)
    assert [view.name for view in dataset.test] == ["IMG_0.png", "IMG_8.png"]
    assert load_points(tmp_path) is None
    for view in dataset.views:
        pose = opengl[int(view.name[4])]
        np.testing.assert_allclose(view.camera.center, pose[:, 3], atol=1e-12)
        right, down, forward = view.camera.world_to_camera[:3, :3]
        np.testing.assert_allclose([right, -down, -forward], pose[:, :3].T, atol=1e-12)
        assert (view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy) == (15, 15, 6, 4)
        assert view.camera.near == 1.0  # half the depth of the nearest content
    assert len(load_dataset(tmp_path / "poses_bounds.npy").views) == 9
    # Column by column, as some programs write it.
    np.save(tmp_path / "poses_bounds.npy", np.asfortranarray(np.load(tmp_path / "poses_bounds.npy")))
    again = {view.name: view.camera for view in load_dataset(tmp_path).views}
    np.testing.assert_array_equal(again[view.name].world_to_camera, view.camera.world_to_camera)
    # A file that says nothing of depths.
    llff(tmp_path, near=0.0, images=images)
    assert {view.camera.near for view in load_dataset(tmp_path).views} != {1.0}


def test_poses_bounds_as_nerfs_code_reads_them(tmp_path):
    """The published conversion, from [down, right, back] to [right, up, back], applied to a row."""
    llff(tmp_path)
    rows = np.load(tmp_path / "poses_bounds.npy")[:, :15].reshape(-1, 3, 5).transpose(1, 2, 0)
    turned = np.concatenate([rows[:, 1:2, :], -rows[:, 0:1, :], rows[:, 2:, :]], axis=1)
    for i, view in enumerate(sorted(load_dataset(tmp_path).views, key=lambda view: view.name)):
        ahead = turned[:, 3, i] - 3 * turned[:, 2, i] + 0.5 * turned[:, 1, i]  # before the camera, above
        (pixel,), (depth,) = view.camera.project(ahead[None])
        assert depth == pytest.approx(3)
        np.testing.assert_allclose(pixel, (6, 4 - 15 * 0.5 / 3), atol=1e-9)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (np.zeros((9, 15)), r"rows of 17 numbers.*shape is \(9, 15\)"),
        (np.zeros((9, 17)), "row 0: an image of 0 x 0 pixels"),
        (np.full((9, 17), np.nan), "not finite"),
        (np.full((9, 17), 3.0), "row 0: its axes down, right and back are not those of a camera"),
        (np.zeros((8, 17)), r"has the cameras of 8 images.*images/ holds 9"),
        (np.array([[None] * 17] * 9), "pickled Python objects, which can run code; refused"),
        (b"\x93NUMPY", r"not in \.npy format 1 or 2"),
    ],
)
def test_broken_poses_bounds_are_refused(tmp_path, rows, message):
    llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    path.write_bytes(rows) if isinstance(rows, bytes) else np.save(path, rows)
    with pytest.raises(FileFormatError, match=message):
        load_dataset(tmp_path)


# ---- Files that are not the user's


def test_hidden_files_are_passed_over(tmp_path):
    llff(tmp_path)
    for name in ("._IMG_3.png", ".DS_Store", "Thumbs.db", "desktop.ini"):
        (tmp_path / "images" / name).write_bytes(b"\0\5\x16\7")
    assert len(load_dataset(tmp_path).views) == 9
    pictures(tmp_path / "bare", ["a.png", "b.png"])
    (tmp_path / "bare/._a.png").write_bytes(b"\0")
    assert [path.name for path in bare_photographs(tmp_path / "bare")] == ["a.png", "b.png"]


# ---- Cameras of others: never estimated without a word

FOREIGN = {
    "cameras.xml": ('<?xml version="1.0"?>\n<document version="2.0.0">\n  <chunk label="1">', "Metashape"),
    "blocks.xml": ("<BlocksExchange version='2.1'>", "ContextCapture"),
    "im0.xmp": ('<rdf:Description xcr:Version="3" xcr:PosePrior="initial">', "RealityCapture"),
    "reg.csv": ("#name,x,y,alt,heading,pitch,roll\n", "RealityCapture"),
    "bundle.out": ("# Bundle file v0.3\n", "Bundler"),
    "scene.nvm": ("NVM_V3\n", "VisualSFM"),
    "sfm_data.json": ('{"sfm_data_version": "0.3"}', "OpenMVG"),
    "cameras.sfm": ('{"version": []}', "Meshroom"),
    "reconstruction.json": ("[{}]", "OpenSfM"),
    "keyframes/cameras/1.json": ("{}", "Polycam"),
    "EXR_RGBD/metadata.json": ("{}", "Record3D"),
    "cams/00000000_cam.txt": ("extrinsic\n", "MVSNet"),
    "cameras_sphere.npz": ("PK\3\4", "NeuS"),
    "cameras.json": ('[{"id": 0}]', "3DGS trainer"),
    "transforms_undistorted.json": ('{"frames": []}', "give that file itself"),
    "images.bin": ("", "half of COLMAP's model"),
    "sparse/0/images.bin": ("", "sparse/ holds no cameras and images"),
    "scan/transforms.json": ("{}", "scan/ in it looks like one"),
    "scan.psx": ("", "a project of Metashape"),
    "opensfm/reconstruction.json": ("[{}]", "OpenDroneMap"),
    "odm_report/stats.json": ("{}", "OpenDroneMap"),
    "params/x_calibrated_camera_parameters.txt": ("fileName imageWidth", "Pix4D"),
    "x.p4d": ("", "a project of Pix4D"),
    "odometry.csv": ("timestamp, frame, x, y, z, qx, qy, qz, qw\n", "Stray Scanner"),
    "groundtruth.txt": ("# ground truth\n# timestamp tx ty tz qx qy qz qw\n", "TUM RGB-D"),
    "metadata.json": ('{"w": 720, "K": [1], "poses": [[]]}', "Record3D"),
    "pose/0.txt": ("1 0 0 0\n", "NSVF or ScanNet"),
}


@pytest.mark.parametrize("name", list(FOREIGN))
def test_cameras_that_are_not_read_are_named_and_not_replaced(tmp_path, name):
    content, message = FOREIGN[name]
    folder = pictures(tmp_path / "set", [f"im{i}.png" for i in range(3)])
    assert unread_cameras(folder) == ""
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    with pytest.raises(FileFormatError, match=message):
        load_dataset(folder)
    with pytest.raises(FileFormatError, match=f"{message}.*estimate_cameras"):
        ensure_cameras(folder)


@pytest.mark.parametrize(
    "content", ['{"colors": {"k": 4}}', '{"colors": {"K": 4}}', '{"poses": ["standing"]}']
)
def test_metadata_of_any_program_are_no_cameras(tmp_path, content):
    folder = pictures(tmp_path / "set", [f"im{i}.png" for i in range(3)])
    (folder / "metadata.json").write_text(content)
    assert unread_cameras(folder) == ""


def test_train_does_not_estimate_cameras_where_some_lie(tmp_path, capsys, monkeypatch):
    calls = []
    monkeypatch.setattr(
        "meshsplats.training.reconstruction.find_cameras", lambda *given: calls.append(given) or 1 / 0
    )
    folder = pictures(tmp_path / "set/images", [f"im{i}.png" for i in range(3)]).parent
    (folder / "im0.XMP").write_text(FOREIGN["im0.xmp"][0])
    command = ["train", str(folder), "-o", str(tmp_path / "mesh.npz")]
    assert main(command) == 1
    assert "im0.XMP is there, cameras of RealityCapture" in capsys.readouterr().err
    assert not calls
    with pytest.raises(ZeroDivisionError):
        main([*command, "--estimate-cameras"])
    assert len(calls) == 1
    read = simple_colmap(tmp_path / "read", 3)
    assert main(["train", str(read), "-o", str(tmp_path / "mesh.npz"), "--estimate-cameras"]) == 2
    assert "--estimate-cameras has no effect: " in capsys.readouterr().err
    # The photographs alone of a data set that has cameras.
    inner = simple_colmap(tmp_path / "good", 3) / "images"
    assert main(["train", str(inner), "-o", str(tmp_path / "mesh.npz")]) == 1
    assert "give the folder above it" in capsys.readouterr().err
    assert len(calls) == 1


# ---- Rigs and frames of COLMAP 3.12 and later


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_rigs_of_several_sensors(tmp_path, text):
    pycolmap = pytest.importorskip("pycolmap")
    options = pycolmap.SyntheticDatasetOptions()
    if not hasattr(options, "num_cameras_per_rig"):
        pytest.skip("pycolmap without rigs")
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 3, 2
    options.num_points3D = 20
    model = pycolmap.synthesize_dataset(options)
    place = tmp_path / "sparse/0"
    place.mkdir(parents=True)
    (model.write_text if text else model.write_binary)(str(place))
    assert (place / ("rigs.txt" if text else "rigs.bin")).is_file()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        save(tmp_path / "images" / image.name, np.zeros((camera.height // 8, camera.width // 8, 3), np.uint8))
    views = {view.name: view for view in load_dataset(tmp_path).views}
    assert len(views) == len(model.images) == 12
    for image in model.images.values():
        got = views[image.name].camera.world_to_camera[:3]
        np.testing.assert_allclose(got, image.cam_from_world().matrix(), atol=1e-12)


# ---- HEIF


def test_heif_photographs(tmp_path):
    pillow_heif = pytest.importorskip("pillow_heif")
    pillow_heif.register_heif_opener()
    (tmp_path / "images").mkdir()
    for i in range(3):
        image = Image.new("RGB", (64, 48), (10 * i, 100, 200))
        image.save(tmp_path / f"images/IMG_{i}.HEIC", format="HEIF", quality=95)
    write_colmap(
        tmp_path,
        [(1, "PINHOLE", 64, 48, (60.0, 60, 32, 24))],
        [(f"IMG_{i}.HEIC", (1, 0, 0, 0), (0, 0, 4), 1) for i in range(3)],
    )
    views = load_dataset(tmp_path, test_every=0).train
    for i, view in enumerate(views):
        assert np.abs(view.image[24, 32] * 255 - (10 * i, 100, 200)).max() < 4
    (tmp_path / "sparse/0/images.bin").unlink()
    (tmp_path / "sparse/0/cameras.bin").unlink()
    (tmp_path / "sparse/0").rmdir()
    (tmp_path / "sparse").rmdir()
    assert len(bare_photographs(tmp_path)) == 3


def test_heif_without_its_library_names_it(tmp_path, monkeypatch):
    (tmp_path / "a.heic").write_bytes(b"\0\0\0\x1cftypheic\0\0\0\0mif1heic" + bytes(100))
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "pillow_heif":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"meshsplats\[heic\]"):
        load_image(tmp_path / "a.heic")


# ---- Real photographs


@pytest.mark.parametrize(
    ("name", "counts"),
    [
        ("bonsai", (255, 37)),
        ("dtu65", (42, 7)),
        ("lego", (100, 40)),
        ("saharov", (28, 4)),
        ("snowmiku", (84, 13)),
        ("temple", (41, 6)),
    ],
)
def test_real_photographs_are_found_whole(name, counts):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        dataset = load_dataset(shared_data(f"photos/{name}"))
    assert (len(dataset.train), len(dataset.test)) == counts
