"""Cameras of bare photographs: which folders have none, what is written, clear words where it fails."""

from __future__ import annotations

import builtins
import os
import sqlite3
import subprocess
import sys
import warnings
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _balls import cameras_around
from _datasets import save, simple_colmap
from _local import make_link
from PIL import Image, TiffImagePlugin

from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.points import load_points
from meshsplats.errors import DataWarning, FileFormatError, MissingDependencyError, OptionsError
from meshsplats.images.reading import Shot, load_image, read_shot
from meshsplats.scene.camera import Camera
from meshsplats.training import poses, reconstruction
from meshsplats.training.feature_masks import FeatureMasks
from meshsplats.training.photographs import PhotographOptions
from meshsplats.training.pycolmap_input import for_pycolmap
from meshsplats.training.reconstruction import bare_photographs, ensure_cameras, find_cameras


def photographs(folder, count):
    for i in range(count):
        save(folder / f"p{i}.png", np.random.default_rng(i).integers(0, 256, (40, 60, 3)).astype(np.uint8))
    return folder


def test_bare_photographs_lie_in_the_folder_or_in_images(tmp_path):
    folder = photographs(tmp_path / "a", 3)
    (folder / "notes.txt").write_text("x")
    assert [path.name for path in bare_photographs(folder)] == ["p0.png", "p1.png", "p2.png"]
    photographs(tmp_path / "b" / "images", 2)
    assert len(bare_photographs(tmp_path / "b")) == 2
    assert bare_photographs(simple_colmap(tmp_path / "c")) == []
    assert bare_photographs(tmp_path / "none") == []


def test_too_few_photographs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="2 photographs without cameras; at least 3"):
        find_cameras(photographs(tmp_path, 2))


@pytest.mark.parametrize("allowed", [("symlink", "link"), ("link",), ()])
def test_photographs_with_blanks_in_their_names_are_linked_or_copied(tmp_path, monkeypatch, allowed):
    """And copied where it does not: they may be many gigabytes."""

    def refuse(*_):
        raise OSError(1314, "A required privilege is not held by the client")

    photograph, work = tmp_path / "IMG (1).jpg", tmp_path / "work"
    Image.new("RGB", (8, 6)).save(photograph)
    work.mkdir()
    for name in {"symlink", "link"} - set(allowed):
        monkeypatch.setattr(os, name, refuse)
    (file,) = for_pycolmap({photograph: read_shot(photograph)}, work, 1)
    assert " " not in file.name
    assert file.read_bytes() == photograph.read_bytes()
    assert file.samefile(photograph) == bool(allowed)
    assert file.is_symlink() == ("symlink" in allowed)


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "pycolmap":
            raise ModuleNotFoundError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"meshsplats\[photos\]"):
        find_cameras(photographs(tmp_path, 3))


def test_a_found_camera_is_written_with_its_place_and_lens():
    world_to_camera = np.array([[1.0, 0, 0, 1], [0, 0, -1, 2], [0, 1, 0, 3]])
    image = SimpleNamespace(
        name="a", camera_id=7, has_pose=True, cam_from_world=SimpleNamespace(matrix=lambda: world_to_camera)
    )
    camera = SimpleNamespace(params=[50.0, 31.0, 19.0, -0.1], width=60, height=40)
    model = SimpleNamespace(images={1: image}, cameras={7: camera})
    (frame,) = reconstruction._transforms(model, "images/", {"a": "b.png"})["frames"]
    pose = np.array(frame.pop("transform_matrix"))
    np.testing.assert_allclose(pose[:3, 3], -world_to_camera[:, :3].T @ [1, 2, 3])
    np.testing.assert_allclose(pose[:3, :3].T, world_to_camera[:, :3] * [[1], [-1], [-1]])
    lens = {"fl_x": 50, "fl_y": 50, "cx": 31, "cy": 19, "k1": -0.1}
    assert frame == {"file_path": "images/b.png", **lens, "w": 60, "h": 40}


@pytest.mark.parametrize(
    ("limit", "value"),
    [("DOUBLED_BELOW", 60), ("DOUBLED_UP_TO", 4)],  # their longest side; fewer than there are
)
def test_large_and_many_photographs_are_not_doubled(scene, monkeypatch, limit, value):
    monkeypatch.setattr(reconstruction, limit, value)
    folder, colmap, _ = scene()
    colmap.octave = 0
    with pytest.warns(DataWarning, match="1 of 5 photographs"):
        find_cameras(folder)
    assert (folder / "transforms.json").is_file()


def test_photographs_that_do_not_match_are_refused(tmp_path):
    pytest.importorskip("pycolmap")
    folder = photographs(tmp_path / "noise", 3)
    with pytest.raises(ValueError, match=r"of 3 photographs match each other, at least 3 must"):
        find_cameras(folder)
    assert sorted(os.listdir(folder)) == ["p0.png", "p1.png", "p2.png"]


class Colmap:
    """What ``find_cameras`` uses of pycolmap: it finds the ``cameras`` of images by their names, if they have
    one. Poses are methods or properties, as in different versions."""

    class CameraMode:
        SINGLE, PER_IMAGE = "single", "per image"

    class Device:
        cpu = "cpu"

    ImageReaderOptions = SimpleNamespace

    def __init__(self, cameras: dict[str, Camera], methods: bool) -> None:
        self.logging = SimpleNamespace()
        self.octave = -1  # for small images
        self.matches: dict[tuple[int, int], int] = {}  # by places in the reversed list of names
        self.ratio = "ba_global_images_ratio" if methods else "ba_global_frames_ratio"
        self.cameras, self.methods, self.calls = cameras, methods, []
        self.apart: list[str] = []  # names of photographs that have poses of their own
        self.lenses: list[tuple[str, list[str]]] = []

    def IncrementalPipelineOptions(self):
        return SimpleNamespace(**{self.ratio: 1.1})

    def set_random_seed(self, seed):
        self.calls.append("seed")

    def extract_features(
        self, database, folder, names, *, camera_mode, device, sift_options, reader_options=None
    ):
        self.masks = {}
        if reader_options is not None:
            files = Path(reader_options.mask_path).iterdir()
            self.masks = {path.name: np.asarray(Image.open(path)) for path in files}
        assert sift_options == {"max_image_size": 1600, "max_num_features": 3000, "first_octave": self.octave}
        self.lenses.append((camera_mode, names))
        self.names, self.folder = sorted(name for _, names in self.lenses for name in names), Path(folder)
        with closing(sqlite3.connect(database)) as connection:
            connection.execute(
                "create table if not exists two_view_geometries (pair_id integer, rows integer)"
            )
            for (one, other), matches in self.matches.items():
                values = (one * (2**31 - 1) + other, matches)
                connection.execute("insert into two_view_geometries values (?, ?)", values)
            connection.commit()

    def match_exhaustive(self, database, *, device):
        self.calls.append("match")

    def incremental_mapping(self, database, folder, work, options):
        assert Path(folder) == self.folder
        ratios = [options.ba_global_points_ratio, getattr(options, self.ratio)]
        assert (ratios, options.ba_global_max_refinements) == ([1.4, 1.4], 2)
        images, lenses = {}, {}
        for i, name in enumerate(reversed(self.names)):
            camera = self.cameras.get(name)
            shown = camera or next(iter(self.cameras.values()))
            pose = SimpleNamespace(matrix=lambda shown=shown: shown.world_to_camera[:3])
            params = [shown.fx, shown.cx, shown.cy, 0.0]
            lenses[i] = SimpleNamespace(params=params, width=shown.width, height=shown.height)
            images[i] = SimpleNamespace(
                name=name,
                has_pose=camera is not None,
                camera_id=i,
                cam_from_world=(lambda pose=pose: pose) if self.methods else pose,
            )
        points = {
            7 * i: SimpleNamespace(
                xyz=[i, 2.5, -1],
                color=np.array([10 * i, 20, 30], np.uint8),
                track=SimpleNamespace(
                    elements=[SimpleNamespace(image_id=i), SimpleNamespace(image_id=i + 1)]
                ),
            )
            for i in range(4)
        }
        count = len(self.cameras)
        best = SimpleNamespace(images=images, cameras=lenses, points3D=points, num_reg_images=lambda: count)
        other = {i: SimpleNamespace(name=name, has_pose=True) for i, name in enumerate(self.apart)}
        return {0: SimpleNamespace(num_reg_images=lambda: 2, images=other), 1: best}


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A folder of five photographs, and a stand-in for pycolmap that places four of them."""

    def made(under="", methods=True):
        folder = photographs(tmp_path / "scene" / under, 5) if under else photographs(tmp_path / "scene", 5)
        cameras = {}
        for i, camera in enumerate(cameras_around(4)):
            cameras[f"p{i}.png"] = Camera(camera.world_to_camera, 70, 70, 29, 21, 60, 40)
        colmap = Colmap(cameras, methods)
        monkeypatch.setitem(sys.modules, "pycolmap", colmap)
        return tmp_path / "scene", colmap, folder

    return made


@pytest.mark.parametrize(("under", "methods"), [("", True), ("images", False)])
def test_cameras_are_found_and_written_beside_the_photographs(scene, under, methods):
    """The data set that is read from them has the cameras and the points that were found."""
    folder, colmap, place = scene(under, methods)
    save(place / "previews" / "p0.png", np.zeros((40, 60), np.uint8))
    lines = []
    with pytest.warns(
        DataWarning,
        match=r"1 of 5 photographs could not be registered with the others and are left out: p4\.png",
    ):
        find_cameras(folder, lines.append)
    assert colmap.names == [f"p{i}.png" for i in range(5)]
    assert colmap.lenses == [("single", colmap.names)]
    assert "4 photographs and 4 points" in lines[-1]
    dataset = load_dataset(folder, test_every=0)
    assert len(dataset.train) == 4
    for view, (name, camera) in zip(dataset.train, sorted(colmap.cameras.items()), strict=True):
        assert view.name.endswith(name)
        assert view.camera.world_to_camera == pytest.approx(camera.world_to_camera)
        found = [getattr(view.camera, key) for key in ("fx", "fy", "cx", "cy", "width", "height")]
        assert found == pytest.approx([70, 70, 29, 21, 60, 40])
        assert view.load().color.shape == (40, 60, 3)
    points = load_points(folder)
    assert points.positions.tolist() == [[i, 2.5, -1] for i in range(4)]
    assert points.colors.tolist() == [[10 * i, 20, 30] for i in range(4)]


def test_cameras_that_matches_contradict_are_doubted(scene):
    folder, colmap, _ = scene()
    colmap.matches = {(1, 2): 100, (2, 3): 2000}  # p3 and p2, p2 and p1, which have one common point each
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    messages = [str(warning.message) for warning in warned]
    assert len(messages) == 2
    assert (
        "some cameras may be wrong: they contradict 2 pairs of photographs that match, most of all those of"
        " p2.png" in messages[1]
    )
    colmap.matches = {(1, 2): 14}  # too few to tell
    for name in ("transforms.json", "sparse_points.ply"):
        (folder / name).unlink()
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    assert len(warned) == 1


def test_points_that_are_there_are_not_overwritten(scene):
    folder, colmap, _ = scene()
    (folder / "sparse_points.ply").write_text("ours")
    with pytest.raises(FileExistsError, match="move it away"):
        find_cameras(folder)
    assert not colmap.calls  # before the work
    assert (folder / "sparse_points.ply").read_text() == "ours"


def test_cameras_and_points_are_written_both_or_not_at_all(scene, monkeypatch):
    folder, _, _ = scene()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(reconstruction, "write_text", full)
    with pytest.warns(DataWarning), pytest.raises(OSError, match="No space"):
        find_cameras(folder)
    assert sorted(os.listdir(folder)) == [f"p{i}.png" for i in range(5)]


def write_jpeg(path, side, focal=None, focal_of_film=None, more=None):
    """A JPEG ``side`` x 40 pixels large, with focal lengths in its EXIF data."""
    exif = Image.Exif()
    exif[0x0110] = "Phone"
    values = {0x920A: focal, 0xA405: focal_of_film}
    exif[0x8769] = {tag: value for tag, value in (values | (more or {})).items() if value is not None}
    Image.new("RGB", (side, 40)).save(path, exif=exif)


def test_photographs_of_one_size_and_focal_length_share_a_lens(scene):
    """One photograph of another size, or a second lens of one, does not take it from the others."""
    folder, colmap, _ = scene()
    save(folder / "p4.png", np.zeros((60, 40, 3), np.uint8))
    write_jpeg(folder / "q0.jpg", 60, 4.2, 26)
    write_jpeg(folder / "q1.jpg", 60, 4.2, 52)
    write_jpeg(folder / "q2.jpg", 60, 4.2)
    write_jpeg(folder / "q3.jpg", 60, 4.2003, 26, {0xA404: 1.004})  # as some cameras focus
    write_jpeg(folder / "q4.jpg", 60, 2.2, 26)  # the wide lens, cut to the same field
    for name, zoom in (("r0", 1.0), ("r1", 2.0), ("r2", 2.0), ("r3", 0.0)):
        write_jpeg(folder / f"{name}.jpg", 60, 5.4, 23, {0xA404: zoom})
    write_jpeg(folder / "r4.jpg", 60, 5.4, 23, {0xA434: "ultra-wide"})
    with pytest.warns(DataWarning):
        find_cameras(folder)
    assert colmap.lenses == [
        ("single", ["p0.png", "p1.png", "p2.png", "p3.png"]),
        ("single", ["q0.jpg", "q3.jpg"]),
        ("single", ["r0.jpg", "r3.jpg"]),
        ("single", ["r1.jpg", "r2.jpg"]),
        ("per image", ["p4.png", "q1.jpg", "q2.jpg", "q4.jpg", "r4.jpg"]),
    ]


def test_exif_data_that_are_none_do_not_matter(tmp_path):
    Image.new("RGB", (60, 40)).save(tmp_path / "a.jpg", exif=b"Exif\0\0" + bytes(range(200)))
    exif = Image.Exif()
    exif[0x8769] = {0x920A: TiffImagePlugin.IFDRational(1, 0)}
    Image.new("RGB", (60, 40)).save(tmp_path / "b.jpg", exif=exif)
    for name in ("a.jpg", "b.jpg"):
        assert read_shot(tmp_path / name) == Shot((60, 40), "JPEG")


def test_formats_that_the_library_does_not_read_are_copied(scene):
    """By what a file holds, whatever it is called; the others are not written anew."""
    folder, colmap, _ = scene()
    pixels = np.linspace(0, 255, 40 * 60 * 3).reshape(40, 60, 3).astype(np.uint8)
    exif = Image.Exif()
    exif[0x8769] = {0xA405: 26}
    Image.fromarray(pixels).save(folder / "p1.webp", lossless=True, exif=exif)
    Image.fromarray(pixels).save(folder / "p2.jpg", "WEBP", lossless=True)
    for name in ("p1.png", "p2.png"):
        (folder / name).unlink()
    held = {}
    real = colmap.match_exhaustive

    def match(database, **options):
        held.update({path.name: (path.is_symlink(), load_image(path)) for path in colmap.folder.iterdir()})
        held["lens"] = read_shot(colmap.folder / "000001.jpg").lens
        real(database, **options)

    colmap.match_exhaustive = match
    names = ["000000.png", "000001.jpg", "000002.jpg", "000003.png"]
    colmap.cameras = dict(zip(names, colmap.cameras.values(), strict=True))
    said: list[str] = []
    with pytest.warns(DataWarning, match=r"p4\.png"):
        find_cameras(folder, said.append)
    assert "finding the cameras of 5 photographs: copies of 2, as JPEG" in said
    assert "26" in held.pop("lens")  # where the search for the focal length begins
    assert sorted(held) == [*names, "000004.png"]
    for name in ("000001.jpg", "000002.jpg"):
        assert not held[name][0]
        assert np.abs(held[name][1].astype(int) - pixels).max() < 12
    assert load_dataset(folder, test_every=0).train[1].name.endswith("p1.webp")


def test_images_of_kinds_that_are_not_read_are_named(scene):
    """But for raw photographs beside what was developed of them."""
    folder, _, _ = scene()
    for name in ("p0.dng", "p7.dng", "p8.jxl", "p9.JFIF", ".p6.jxl"):
        (folder / name).write_bytes(b"x")
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    assert str(warned[0].message).endswith(
        "3 images are of kinds that are not read, and are left out: p7.dng, p8.jxl, p9.JFIF"
    )


def test_links_out_of_the_folder_are_refused_before_the_search(scene, tmp_path):
    folder, colmap, _ = scene()
    (folder / "p2.png").rename(tmp_path / "other.png")
    make_link(folder / "p2.png", tmp_path / "other.png")
    with pytest.raises(FileFormatError, match=r"'p2\.png' is a link that leads out"):
        find_cameras(folder)
    assert not colmap.lenses


def panoramas(folder, count):
    Image.new("RGB", (80, 40)).save(folder / "r.jpg")
    flat = (folder / "r.jpg").read_bytes()
    said = b'<x:xmpmeta><rdf:li GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    segment = b"http://ns.adobe.com/xap/1.0/\0" + said
    segment = b"\xff\xe1" + (len(segment) + 2).to_bytes(2, "big") + segment
    for i in range(count):
        (folder / f"q{i}.jpg").write_bytes(flat[:2] + segment + flat[2:])


def test_panoramas_are_refused_before_the_search(scene):
    folder, colmap, _ = scene()
    panoramas(folder, 7)
    with pytest.raises(
        ValueError, match=r"7 of 13 photographs are panoramas, .*: q0\.jpg, q1\.jpg.*; convert them"
    ):
        find_cameras(folder)
    assert not colmap.lenses


def test_panoramas_among_flat_photographs_are_left_out(scene):
    folder, colmap, _ = scene()
    panoramas(folder, 2)
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    assert "2 of 8 photographs are panoramas" in str(warned[0].message)
    assert str(warned[0].message).endswith("not found here: q0.jpg, q1.jpg; they are left out")
    assert colmap.names == ["p0.png", "p1.png", "p2.png", "p3.png", "p4.png", "r.jpg"]


def masked(folder, dark: slice, turn: int = 0) -> np.ndarray:
    """Masks of the photographs, dark in some of their rows."""
    mask = np.full((40, 60), 255, np.uint8)
    mask[dark] = 0
    for i in range(4):
        save(folder / f"masks/p{i}.png", np.rot90(mask, turn))
    return mask


@pytest.mark.parametrize("turn", [0, -1])
def test_features_of_what_passed_by_do_not_count(scene, turn):
    folder, colmap, _ = scene()
    mask = masked(folder, slice(0, 15), turn)
    if turn:  # as the photographs were held
        exif = Image.Exif()
        exif[0x112] = 6
        for i in range(4):
            Image.open(folder / f"p{i}.png").save(folder / f"p{i}.png", exif=exif)
    with pytest.warns(DataWarning):
        find_cameras(folder)
    assert sorted(colmap.masks) == [f"p{i}.png.png" for i in range(5)]
    assert colmap.masks.pop("p4.png.png").all()  # that has none
    assert all(np.array_equal(found, mask) for found in colmap.masks.values())


@pytest.mark.parametrize("still", [True, False])
def test_the_surroundings_of_a_subject_count_unless_they_stand_still(scene, monkeypatch, still):
    folder, colmap, _ = scene()
    mask = masked(folder, slice(0, 30))
    monkeypatch.setattr(FeatureMasks, "surroundings_stand_still", lambda self, database, images: still)
    said: list[str] = []
    with pytest.warns(DataWarning):
        find_cameras(folder, said.append)
    assert any("stands still, so features there do not count" in line for line in said) == still
    assert len(colmap.lenses) == 1 + still
    assert len(colmap.masks) == 5 * still
    assert not still or colmap.masks.pop("p4.png.png").all()
    assert all(np.array_equal(found, mask) for found in colmap.masks.values())


@pytest.mark.parametrize(
    ("moving", "still", "answer"), [(0, 120, True), (50, 120, True), (130, 120, False), (0, 90, False)]
)
def test_surroundings_that_stand_still_are_told_by_their_matches(tmp_path, moving, still, answer):
    """Those of the subject, which turns, are inside of the masks."""
    photographs(tmp_path, 2)
    masked(tmp_path, slice(0, 30))
    names, rng = ["p0.png", "p1.png"], np.random.default_rng(0)
    count = moving + still
    first = rng.uniform(0, 1, (count + 200, 2)) * (58, 25)
    first[count:, 1] += 31  # the subject
    second = first + rng.uniform(-0.1, 0.1, first.shape)
    second[:moving, 0] = (first[:moving, 0] + 20) % 58
    second[count:, 0] = (first[count:, 0] + 10) % 58
    with closing(sqlite3.connect(tmp_path / "database.db")) as connection:
        connection.execute("create table images (image_id integer, name text)")
        connection.execute("create table keypoints (image_id integer, rows, cols, data blob)")
        connection.execute("create table two_view_geometries (pair_id integer, rows, data blob)")
        for image, points in ((1, first), (2, second)):
            table = np.column_stack([points, np.ones((len(points), 4))]).astype(np.float32)
            connection.execute("insert into images values (?, ?)", (image, names[image - 1]))
            connection.execute(
                "insert into keypoints values (?, ?, 6, ?)", (image, len(table), table.tobytes())
            )
        matches = np.repeat(np.arange(len(first), dtype=np.uint32)[:, None], 2, axis=1)
        values = (1 * (2**31 - 1) + 2, len(matches), matches.tobytes())
        connection.execute("insert into two_view_geometries values (?, ?, ?)", values)
        connection.commit()
    masks = FeatureMasks(tmp_path, names, [(60, 40)] * 2)
    assert masks.are_of_a_subject()
    images = [tmp_path / name for name in names]
    assert masks.surroundings_stand_still(tmp_path / "database.db", images) == answer


def test_the_library_heeds_masks(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    folder, names = photographs(tmp_path / "scene", 4), [f"p{i}.png" for i in range(4)]
    masked(folder, slice(0, 20))
    (folder / "masks/p3.png").unlink()
    images = [folder / name for name in names]
    FeatureMasks(folder, names, [(60, 40)] * 4).write(tmp_path / "masks", images)
    heights = []
    for masks in (None, tmp_path / "masks"):
        database = tmp_path / f"{masks is None}.db"
        reconstruction._extract(pycolmap, database, images, [read_shot(path) for path in images], masks, 1)
        with closing(sqlite3.connect(database)) as connection:
            query = "select name, rows, cols, data from keypoints join images using (image_id)"
            tables = connection.execute(query).fetchall()
        points = {
            name: np.frombuffer(data, np.float32).reshape(rows, cols) for name, rows, cols, data in tables
        }
        whole = points.pop("p3.png")[:, 1]
        assert (whole < 20).any()  # it has no mask
        heights.append(np.concatenate(list(points.values()))[:, 1])
    everywhere, inside = heights
    assert (everywhere < 20).any()
    assert len(inside) > 10
    assert (inside >= 20).all()


def test_masks_that_do_not_fit_are_refused_before_the_search(scene):
    folder, colmap, _ = scene()
    save(folder / "masks/p1.png", np.zeros((60, 40), np.uint8))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DataWarning)
        with pytest.raises(FileFormatError, match=r"p1\.png: 40 x 60 pixels do not fit"):
            find_cameras(folder)
    assert not colmap.lenses


def test_broken_photographs_are_left_out_before_the_search(scene):
    folder, colmap, _ = scene()
    whole = np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8)
    Image.fromarray(whole).save(folder / "q.jpg", quality=95)
    (folder / "q.jpg").write_bytes((folder / "q.jpg").read_bytes()[:2000])
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    assert "1 of 6 photographs cannot be read and are left out: q.jpg (" in str(warned[0].message)
    assert "truncated" in str(warned[0].message)
    assert colmap.names == [f"p{i}.png" for i in range(5)]


def test_photographs_that_are_all_broken_are_refused(scene):
    folder, colmap, _ = scene()
    for i in range(3):
        (folder / f"p{i}.png").write_bytes(b"none")
    with pytest.raises(ValueError, match=r"2 photographs can be read, at least 3 must be; .*p0\.png: not an"):
        find_cameras(folder)
    assert not colmap.lenses


def test_photographs_that_match_each_other_only_are_named_as_such(scene):
    folder, colmap, _ = scene()
    for name in ("q0.png", "q1.png", "q2.png"):
        save(folder / name, np.zeros((40, 60, 3), np.uint8))
    colmap.apart = ["q1.png", "q0.png", "q2.png", "p0.png"]
    with pytest.warns(DataWarning) as warned:
        find_cameras(folder)
    messages = [str(warning.message).partition(": ")[2] for warning in warned]
    assert messages == [
        "1 of 8 photographs could not be registered with the others and are left out: p4.png",
        "3 of 8 photographs match each other, but nothing joins them to the rest: left out: q0.png, q1.png,"
        " q2.png",
    ]


def test_the_library_takes_no_more_threads_than_are_given(scene, monkeypatch):
    folder, colmap, _ = scene()
    seen = []
    options = {"max_image_size": 1600, "num_threads": 1, "max_num_features": 3000, "first_octave": -1}
    extract, mapping = colmap.extract_features, colmap.incremental_mapping

    def extracting(*args, sift_options, **more):
        seen.append(dict(sift_options))
        del sift_options["num_threads"]
        extract(*args, sift_options=sift_options, **more)

    def matching(database, *, device, sift_options):
        seen.append(sift_options)

    def finding(database, folder, work, options):
        seen.append(options.num_threads)
        return mapping(database, folder, work, options)

    monkeypatch.setattr(colmap, "extract_features", extracting)
    monkeypatch.setattr(colmap, "match_exhaustive", matching)
    monkeypatch.setattr(colmap, "incremental_mapping", finding)
    with pytest.warns(DataWarning):
        find_cameras(folder, threads=1)
    assert seen == [options, {"num_threads": 1}, 1]


def test_options_of_threads_are_those_of_the_library():
    pycolmap = pytest.importorskip("pycolmap")
    assert poses._incremental_options(pycolmap, 3).num_threads == 3
    if hasattr(pycolmap, "FeatureMatchingOptions"):
        assert reconstruction._feature_options(pycolmap, 9, 9, 3)["extraction_options"].num_threads == 3
        assert reconstruction._matching_options(pycolmap, 3)["matching_options"].num_threads == 3
    if hasattr(pycolmap, "global_mapping"):
        assert poses._global_options(pycolmap, 3)["options"].num_threads == 3


@pytest.mark.skipif(sys.platform == "win32", reason="signals are others there")
def test_a_signal_is_answered_as_before_the_library_was_loaded():
    """pycolmap answers SIGTERM with a stack trace. And Pillow, loaded after it, ends the process."""
    pytest.importorskip("pycolmap")
    code = """if 1:
        import io, os, signal
        from meshsplats.training.reconstruction import _imported
        signal.signal(signal.SIGTERM, lambda number, frame: print("tidied", flush=True))
        _imported()
        from PIL import Image
        Image.effect_noise((800, 600), 99).convert("RGB").save(io.BytesIO(), "PNG")
        os.kill(os.getpid(), signal.SIGTERM)
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (0, "tidied\n", "")


def test_photographs_that_are_added_later_are_named_and_found_on_demand(scene):
    folder, colmap, _ = scene()
    with pytest.warns(DataWarning, match="left out"):
        ensure_cameras(folder)
    asked = len(colmap.calls)
    assert ensure_cameras(folder) is None  # the one without a place is not new
    save(folder / "q.png", np.full((40, 60, 3), 9, np.uint8))
    save(folder / "mesh.npz.preview.png", np.full((40, 60, 3), 9, np.uint8))
    (folder / "mesh.npz").write_bytes(b"")
    with pytest.warns(DataWarning, match=r"1 photographs were added .*: q\.png; estimate_cameras finds"):
        assert ensure_cameras(folder) is None
    assert len(colmap.calls) == asked
    colmap.lenses.clear()
    with pytest.warns(DataWarning, match="2 of 6 photographs could not be registered"):
        assert ensure_cameras(folder, replacing=True) is None
    assert colmap.names == [*(f"p{i}.png" for i in range(5)), "q.png"]
    assert ensure_cameras(folder) is None


def test_cameras_of_others_are_never_replaced(scene):
    folder, colmap, _ = scene()
    content = '{"frames": [{"file_path": "p0.png"}]}'
    (folder / "transforms.json").write_text(content)
    options = PhotographOptions(estimate_cameras=True)
    with pytest.raises(
        OptionsError, match=r"transforms\.json has cameras that were not found here; move it away"
    ):
        options.with_cameras(folder, print)
    assert not colmap.calls
    assert (folder / "transforms.json").read_text() == content


def test_a_resumed_run_keeps_the_cameras_that_it_began_with(scene):
    folder, colmap, _ = scene()
    options = PhotographOptions(estimate_cameras=True)
    with pytest.warns(DataWarning):
        options.with_cameras(folder, print)
    asked = len(colmap.calls)
    options.with_cameras(folder, print, resumed=True)
    assert len(colmap.calls) == asked


def test_previews_of_results_are_no_photographs(tmp_path):
    folder = photographs(tmp_path, 3)
    for name in ("mesh.npz.preview.png", "p7.preview.png"):
        save(folder / name, np.zeros((40, 60, 3), np.uint8))
    (folder / "mesh.npz").write_bytes(b"")
    names = [path.name for path in bare_photographs(folder)]
    assert names == ["p0.png", "p1.png", "p2.png", "p7.preview.png"]


class WithPairs(Colmap):
    """A later version, which matches the pairs of a file, and writes the features to its database."""

    ImportedPairingOptions = SimpleNamespace

    def extract_features(self, database, folder, names, **options):
        super().extract_features(database, folder, names, **options)
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("create table images (image_id integer, name text)")
            connection.execute("create table descriptors (image_id integer, rows, cols, data blob)")
            for i, name in enumerate(names):
                rows = np.full((2 if i else 0, 128), 10 * i + 1, np.uint8)
                connection.execute("insert into images values (?, ?)", (7 * i, name))
                values = (7 * i, *rows.shape, rows.tobytes() or None)  # the first has no features
                connection.execute("insert into descriptors values (?, ?, ?, ?)", values)
            connection.commit()

    def match_image_pairs(self, database, *, pairing_options, device):
        lines = Path(pairing_options.match_list_path).read_text().splitlines()
        self.pairs = [line.split(" ") for line in lines]


@pytest.fixture
def many(scene, monkeypatch):
    """The same scene, where five photographs are many."""

    def made(names=None):
        folder, colmap, _ = scene()
        for i, name in enumerate(names or ()):
            (folder / f"p{i}.png").rename(folder / name)
        cameras = dict(colmap.cameras)
        later = WithPairs(cameras, True)
        monkeypatch.setitem(sys.modules, "pycolmap", later)
        monkeypatch.setattr(reconstruction, "ALL_UP_TO", 4)
        seen = []

        def pairs(descriptors):
            seen.extend(descriptors)
            return np.array([[0, 1], [2, 4]])

        monkeypatch.setattr(reconstruction, "alike_pairs", pairs)
        return folder, later, seen

    return made


def test_of_many_photographs_those_that_look_alike_are_matched(many):
    folder, colmap, seen = many()
    lines = []
    with pytest.warns(DataWarning):
        find_cameras(folder, lines.append)
    assert colmap.pairs == [["p0.png", "p1.png"], ["p2.png", "p4.png"]]
    assert [rows.shape for rows in seen] == [(0, 128), *[(2, 128)] * 4]
    assert [int(rows[0, 0]) for rows in seen[1:]] == [11, 21, 31, 41]
    assert "match" not in colmap.calls
    assert any(line.endswith("2 pairs of photographs that look alike") for line in lines)


def test_names_with_blanks_are_no_trouble_in_a_list_of_pairs(many):
    names = [f"photo ({i}).png" for i in range(5)]
    folder, colmap, _ = many(names)
    colmap.cameras = {f"{i:06d}.png": camera for i, camera in enumerate(colmap.cameras.values())}
    with pytest.warns(DataWarning, match=r"photo \(4\)\.png"):
        find_cameras(folder)
    assert colmap.pairs == [["000000.png", "000001.png"], ["000002.png", "000004.png"]]
    assert [view.name for view in load_dataset(folder, test_every=0).train] == names[:4]


def test_an_older_library_matches_all_pairs(scene, monkeypatch):
    folder, colmap, _ = scene()
    monkeypatch.setattr(reconstruction, "ALL_UP_TO", 4)
    with pytest.warns(DataWarning):
        find_cameras(folder)
    assert "match" in colmap.calls


def test_only_the_photographs_are_read(tmp_path):
    """By the library itself: none of the folders below, which hold masks and previews."""
    pycolmap = pytest.importorskip("pycolmap")
    folder = photographs(tmp_path / "scene", 3)
    photographs(folder / "masks", 3)
    seen = []
    real = pycolmap.match_exhaustive

    def match(database, **more):
        with sqlite3.connect(database) as connection:
            seen.extend(row[0] for row in connection.execute("select name from images"))
        return real(database, **more)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pycolmap, "match_exhaustive", match)
        with pytest.raises(ValueError, match="of 3 photographs"):
            find_cameras(folder)
    assert sorted(seen) == ["p0.png", "p1.png", "p2.png"]
