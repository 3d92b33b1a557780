"""Poses that matches contradict: told by hand-made models, and found once more by another method."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from meshsplats.training.poses import MANY, Poses, find_poses, judge, verified_pairs


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
    assert found.agreeing == ((1, 2), (2, 3))
    assert found.contradicting == ((2, 4), (1, 5), (3, 2))
    # 4 and 5 agree with nothing; half of the pairs of 1, 2 and 3 contradict.
    assert sorted(found.suspects()[:2]) == ["4.jpg", "5.jpg"]
    assert sorted(found.suspects()) == ["1.jpg", "2.jpg", "3.jpg", "4.jpg", "5.jpg"]


@pytest.mark.parametrize(
    ("agreeing", "contradicting", "doubtful"),
    [(317, 23, False), (293, 24, False), (302, 38, True), (0, 0, False)],
)
def test_as_many_pairs_may_contradict_as_in_right_solutions(agreeing, contradicting, doubtful):
    """Of 40 photographs of a room: 0.068 and 0.076 where all are right, 0.11 where two are wrong."""
    apart = tuple((2 * i, 2 * i + 1) for i in range(contradicting))
    agree = tuple(pair for pair in apart for _ in range(2))[:agreeing]  # so that none is outvoted
    agree += ((1000, 1001),) * (agreeing - len(agree))
    assert Poses(None, agree, apart).doubtful == doubtful


def test_a_photograph_that_most_of_its_pairs_contradict_is_left_out():
    """One in twenty; the rest stays, and is not doubted any more."""
    chain = tuple((i, i + 1) for i in range(1, 20))
    poses = Poses(placed_in(range(1, 21)), (*chain * 2, (20, 5)), ((20, 1), (20, 2), (20, 3), (20, 4)))
    assert poses.doubtful
    found = poses.without_outvoted()
    assert found.outvoted == ("20.jpg",)
    assert found.agreeing == chain[:-1] * 2
    assert found.contradicting == ()
    assert not found.doubtful
    assert [number for number, image in found.model.images.items() if not image.has_pose] == [20]


def test_where_many_are_outvoted_none_is_left_out():
    """Either half could be the wrong one: all stay, and are doubted."""
    poses = Poses(placed_in(range(1, 5)), ((1, 2), (3, 4)), ((1, 3), (1, 4), (2, 3), (2, 4)))
    assert poses.without_outvoted() is poses
    assert poses.doubtful
    assert all(image.has_pose for image in poses.model.images.values())


def test_of_a_pair_that_contradicts_only_each_other_none_is_left_out():
    """Either may be right; two pairs against a photograph are a vote."""
    poses = Poses(placed_in(range(1, 21)), (), ((19, 20),))
    assert poses.without_outvoted() is poses
    assert poses.doubtful
    more = Poses(placed_in(range(1, 21)), (), ((19, 20), (18, 20)))
    assert more.without_outvoted().outvoted == ("20.jpg",)


def placed_in(numbers) -> SimpleNamespace:
    """A model in which the images ``numbers`` have poses, each with a frame of its own."""
    images = {
        i: SimpleNamespace(name=f"{i}.jpg", has_pose=True, frame_id=100 + i, image_id=i) for i in numbers
    }

    def deregister_frame(frame):
        images[frame - 100].has_pose = False

    return SimpleNamespace(
        images=images,
        deregister_frame=deregister_frame,
        num_reg_images=lambda: sum(image.has_pose for image in images.values()),
    )


def database_of(path: Path, matches: dict[tuple[int, int], int]) -> Path:
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("create table two_view_geometries (pair_id integer, rows integer)")
        rows = [(one * (2**31 - 1) + other, count) for (one, other), count in matches.items()]
        connection.executemany("insert into two_view_geometries values (?, ?)", rows)
        connection.commit()
    return path


def test_verified_pairs_are_those_of_the_library(tmp_path):
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
        for pair, count in (((1, 2), 15), ((1, 3), 14), ((2, 3), 250)):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.zeros((count, 2), np.uint32)
            database.write_two_view_geometry(*pair, geometry)
    assert verified_pairs(path) == {(1, 2): 15, (2, 3): 250}


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


ROOM = [(i, j) for i in range(1, 6) for j in range(i + 1, 7)]
"""Six photographs that all match each other: 6 lies elsewhere in a solution that sees no points with it."""


def test_weak_pairs_tell_which_solution_is_right(tmp_path):
    """One strong pair speaks for the wrong one, four weak ones against it: in 40 photographs of a room, 81 of
    86 strong pairs agreed with two in wrong places and 80 with the right places, but 302 and 317 of 340."""
    right = model_of({(1, 2, 3, 4, 5): 200, (2, 3, 4, 5, 6): 30}, {1, 2, 3, 4, 5, 6})
    wrong = model_of({(1, 2, 3, 4, 5): 200, (1, 6): 30}, {1, 2, 3, 4, 5, 6})
    pairs = dict.fromkeys(ROOM, 250) | {(i, 6): 40 for i in range(2, 6)} | {(1, 6): 120}
    database = database_of(tmp_path / "a.db", pairs)
    for first, second in ((wrong, right), (right, wrong)):
        work = tmp_path / ("a" if first is wrong else "b")
        work.mkdir()
        assert find_poses(Library([first], [second]), database, work, work, 6).model is right


def test_of_solutions_with_which_as_many_pairs_agree_fewer_contradictions_count(tmp_path):
    """A lost photograph has no pairs that contradict it; else, more photographs count."""
    lost = model_of({(1, 2): 200, (3, 4): 200}, {1, 2, 3, 4})
    more = model_of({(1, 2): 200, (3, 4): 200}, {1, 2, 3, 4, 5})
    worse = model_of({(1, 2): 200, (3, 4): 200}, {1, 2, 3, 4, 6})
    database = database_of(tmp_path / "a.db", {**PAIRS, (4, 6): 20})
    for k, (first, second, chosen) in enumerate(
        ((lost, worse, lost), (worse, lost, lost), (lost, more, more), (more, lost, more))
    ):
        work = tmp_path / str(k)
        work.mkdir()
        assert find_poses(Library([first], [second]), database, work, work, 4).model is chosen


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
    assert any("incremental" in line for line in lines) == (calls == 2)


def test_an_older_library_finds_poses_once(tmp_path):
    library = SimpleNamespace(
        IncrementalPipelineOptions=SimpleNamespace, incremental_mapping=lambda *_, options: {0: SPLIT}
    )
    database = database_of(tmp_path / "a.db", PAIRS)
    assert find_poses(library, database, tmp_path, tmp_path, MANY).doubtful
    library.incremental_mapping = lambda *_, options: {}
    assert find_poses(library, database, tmp_path, tmp_path, MANY) is None
