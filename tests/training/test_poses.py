"""Poses that matches contradict: told by hand-made models, and found once more by another method."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshsplats.training.poses import MANY, Poses, find_poses, judge, strong_pairs


def model_of(common: dict[tuple[int, ...], int], placed: set[int]) -> SimpleNamespace:
    """A model whose images 1 to 6, of which ``placed`` have poses, see so many ``common`` points."""
    points = {}
    for images, count in common.items():
        for _ in range(count):
            elements = [SimpleNamespace(image_id=image) for image in images]
            points[len(points) + 1] = SimpleNamespace(track=SimpleNamespace(elements=elements))
    images = {i: SimpleNamespace(name=f"{i}.jpg", has_pose=i in placed) for i in range(1, 7)}
    return SimpleNamespace(images=images, points3D=points, num_reg_images=lambda: len(placed))


def test_pairs_agree_that_see_the_same_points():
    model = model_of({(1, 2): 60, (1, 2, 3): 30, (2, 4): 9, (5, 6): 300}, {1, 2, 3, 4, 5})
    pairs = {(1, 2): 120, (2, 3): 300, (2, 4): 100, (5, 6): 300, (1, 5): 150, (3, 2): 301}
    # 1 and 2 have 90 in common, 2 and 3 30, 2 and 4 nine; 6 has no pose; 1 and 5 have none.
    found = judge(model, pairs)
    assert found.agreeing == 2
    assert found.contradicting == ((2, 4), (1, 5), (3, 2))
    assert found.suspects()[0] == "2.jpg"
    assert sorted(found.suspects()) == ["1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"]


@pytest.mark.parametrize(
    ("agreeing", "contradicting", "doubtful"), [(99, 1, False), (98, 2, True), (0, 0, False)]
)
def test_one_pair_in_a_hundred_may_contradict(agreeing, contradicting, doubtful):
    assert Poses(None, agreeing, ((1, 2),) * contradicting).doubtful == doubtful


def database_of(path: Path, matches: dict[tuple[int, int], int]) -> Path:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("create table two_view_geometries (pair_id integer, rows integer)")
        rows = [(one * (2**31 - 1) + other, count) for (one, other), count in matches.items()]
        connection.executemany("insert into two_view_geometries values (?, ?)", rows)
        connection.commit()
    return path


def test_strong_pairs_are_those_of_the_library(tmp_path):
    """Read from a database that pycolmap itself has written."""
    pycolmap = pytest.importorskip("pycolmap")
    if not hasattr(pycolmap.Database, "open"):
        pytest.skip("this version of pycolmap opens databases in another way")
    path = tmp_path / "database.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 100.0, 64, 48)
        database.write_camera(camera, use_camera_id=True)
        for i in range(1, 4):
            database.write_image(pycolmap.Image(name=f"{i}.jpg", camera_id=1, image_id=i), use_image_id=True)
        for pair, count in (((1, 2), 100), ((1, 3), 99), ((2, 3), 250)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((count, 2), np.uint32)
            database.write_two_view_geometry(*pair, geometry)
    assert strong_pairs(path) == {(1, 2): 100, (2, 3): 250}


class Library:
    """What ``find_poses`` uses of pycolmap."""

    def __init__(self, first, second) -> None:
        self.calls: list[str] = []
        self.first, self.second = first, second

    def IncrementalPipelineOptions(self):
        return SimpleNamespace(ba_global_frames_ratio=1.1)

    def incremental_mapping(self, database, images, work, options):
        assert options.ba_global_frames_ratio == 1.4
        self.calls.append("one after the other")
        return dict(enumerate(self.first))

    def global_mapping(self, database, images, work):
        assert Path(work).is_dir()
        self.calls.append("together")
        return dict(enumerate(self.second))


GOOD = model_of({(1, 2, 3, 4): 200}, {1, 2, 3, 4})
SMALL = model_of({(1, 2): 200}, {1, 2})
SPLIT = model_of({(1, 2): 200, (3, 4): 200}, {1, 2, 3, 4})
PAIRS = {(1, 2): 250, (2, 3): 250, (3, 4): 250}


@pytest.mark.parametrize(
    ("first", "second", "chosen", "calls"),
    [
        ([SMALL, GOOD], [], GOOD, 1),
        ([SPLIT], [GOOD], GOOD, 2),
        ([SPLIT], [SMALL], SPLIT, 2),  # consistent, but of two photographs
        ([SPLIT], [], SPLIT, 2),
    ],
)
def test_poses_that_matches_contradict_are_found_once_more(tmp_path, first, second, chosen, calls):
    library, lines = Library(first, second), []
    found = find_poses(library, database_of(tmp_path / "a.db", PAIRS), tmp_path, tmp_path, 4, lines.append)
    assert found.model is chosen
    assert library.calls == ["one after the other", "together"][:calls]
    assert any("1 of 3 pairs contradict the poses" in line for line in lines) == (calls == 2)
    assert found.doubtful == (chosen is SPLIT)


@pytest.mark.parametrize(
    ("together", "alone", "chosen", "calls"),
    [
        ([GOOD], [SPLIT], GOOD, 1),
        ([SPLIT], [GOOD], GOOD, 2),
        ([SPLIT], [SMALL], SPLIT, 2),
        ([], [SMALL], SMALL, 2),
        ([], [], None, 2),
    ],
)
def test_many_are_first_found_all_together(tmp_path, together, alone, chosen, calls):
    library, lines = Library(alone, together), []
    database = database_of(tmp_path / "a.db", PAIRS)
    found = find_poses(library, database, tmp_path, tmp_path, MANY, lines.append)
    assert (found and found.model) is chosen
    assert library.calls == ["together", "one after the other"][:calls]
    assert any("one after the other" in line for line in lines) == (calls == 2)


def test_an_older_library_finds_poses_once(tmp_path):
    library = SimpleNamespace(
        IncrementalPipelineOptions=SimpleNamespace, incremental_mapping=lambda *_, options: {0: SPLIT}
    )
    database = database_of(tmp_path / "a.db", PAIRS)
    assert find_poses(library, database, tmp_path, tmp_path, MANY).doubtful
    library.incremental_mapping = lambda *_, options: {}
    assert find_poses(library, database, tmp_path, tmp_path, MANY) is None
