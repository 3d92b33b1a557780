"""Cameras of bare photographs: which folders have none, what is written, clear words where it fails."""

from __future__ import annotations

import builtins
import os
import sqlite3
import sys
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from _balls import cameras_around
from _datasets import save, simple_colmap

from meshsplats.camera import Camera
from meshsplats.datasets.folder import load_dataset
from meshsplats.datasets.points import load_points
from meshsplats.errors import DataWarning, MissingDependencyError
from meshsplats.training import reconstruction
from meshsplats.training.reconstruction import bare_photographs, find_cameras


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


def test_a_missing_library_is_named(tmp_path, monkeypatch):
    real = builtins.__import__

    def without(name, *rest, **more):
        if name == "pycolmap":
            raise ImportError(name)
        return real(name, *rest, **more)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingDependencyError, match=r"meshsplats\[photos\]"):
        find_cameras(photographs(tmp_path, 3))


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

    def __init__(self, cameras: dict[str, Camera], methods: bool) -> None:
        self.logging = SimpleNamespace()
        self.octave = -1  # for small images
        self.matches: dict[tuple[int, int], int] = {}  # by places in the reversed list of names
        self.ratio = "ba_global_images_ratio" if methods else "ba_global_frames_ratio"
        self.cameras, self.methods, self.calls = cameras, methods, []

    def IncrementalPipelineOptions(self):
        return SimpleNamespace(**{self.ratio: 1.1})

    def set_random_seed(self, seed):
        self.calls.append("seed")

    def extract_features(self, database, folder, names, *, camera_mode, device, sift_options):
        assert sift_options == {"max_image_size": 1600, "max_num_features": 3000, "first_octave": self.octave}
        self.names, self.mode, self.folder = names, camera_mode, Path(folder)
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("create table two_view_geometries (pair_id integer, rows integer)")
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
        return {0: SimpleNamespace(num_reg_images=lambda: 2), 1: best}


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
    with pytest.warns(DataWarning, match=r"1 of 5 photographs match no others and are left out: p4\.png"):
        find_cameras(folder, lines.append)
    assert colmap.names == [f"p{i}.png" for i in range(5)]
    assert colmap.mode == "single"
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
        "some cameras may be wrong: 2 pairs of photographs that match contradict them, most of p2.png"
        in messages[1]
    )
    colmap.matches = {(1, 2): 99}  # too few to tell
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


def test_photographs_of_several_sizes_have_cameras_of_their_own(scene):
    folder, colmap, _ = scene()
    save(folder / "p4.png", np.zeros((60, 40, 3), np.uint8))
    with pytest.warns(DataWarning):
        find_cameras(folder)
    assert colmap.mode == "per image"


class WithPairs(Colmap):
    """A later version, which matches the pairs of a file, and writes the features to its database."""

    ImportedPairingOptions = SimpleNamespace

    def extract_features(self, database, folder, names, **options):
        super().extract_features(database, folder, names, **options)
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("create table images (image_id integer, name text)")
            connection.execute("create table descriptors (image_id integer, rows, cols, data blob)")
            for i, name in enumerate(names):
                rows = np.full((2, 128), 10 * i + 1, np.uint8)
                connection.execute("insert into images values (?, ?)", (7 * i, name))
                if i:  # the first has no features
                    values = (7 * i, *rows.shape, rows.tobytes())
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
