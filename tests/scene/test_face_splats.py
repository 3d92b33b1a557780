"""Which triangles and vertices belong to which splat."""

import numpy as np

from meshsplats.scene.face_splats import FaceSplats
from meshsplats.scene.mesh import SplatMesh

FACES = np.array([(0, 1, 2), (0, 2, 3), (5, 6, 7), (8, 9, 10), (8, 10, 11)], np.int32)
SPLATS = FaceSplats(FACES, np.array([3, 3, 4, 9, 9], np.int32), 13)


def test_splats_are_runs_of_triangles_counted_without_gaps():
    assert len(SPLATS) == 3
    assert SPLATS.starts.tolist() == [0, 2, 3]
    assert SPLATS.ends.tolist() == [2, 3, 5]
    assert SPLATS.counts.tolist() == [2, 1, 2]
    assert SPLATS.numbers.tolist() == [3, 4, 9]
    assert SPLATS.of_face.tolist() == [0, 0, 1, 2, 2]
    assert SPLATS.of_vertex.tolist() == [0, 0, 0, 0, -1, 1, 1, 1, 2, 2, 2, 2, -1]
    assert SPLATS.sums(np.array([1.0, 2, 4, 8, 16])).tolist() == [3, 4, 24]
    assert SPLATS.sums(np.arange(10).reshape(5, 2)).tolist() == [[2, 4], [4, 5], [14, 16]]


def test_a_vertex_of_two_splats_is_noticed():
    assert not SPLATS.share_vertices
    shared = FACES.copy()
    shared[2, 0] = 3
    splats = FaceSplats(shared, SPLATS.face_splat, 13)
    assert splats.share_vertices
    assert splats.of_vertex[3] == 1  # the last one
    assert np.flatnonzero(splats.shared).tolist() == [3]
    assert not SPLATS.shared.any()


def test_a_part_of_the_splats():
    part = SPLATS.part(slice(1, 3))
    assert part.starts.tolist() == [0, 1]
    assert part.numbers.tolist() == [4, 9]
    np.testing.assert_array_equal(part.faces, FACES[2:])
    assert len(SPLATS.part(slice(2, 100))) == 1
    assert len(SPLATS.part(slice(3, 9))) == 0
    assert FaceSplats(FACES, None, 13).part(slice(1, 4)).numbers.tolist() == [0, 1, 2]


def test_without_splats_each_triangle_counts_as_one():
    splats = FaceSplats(FACES, None, 13)
    assert splats.starts.tolist() == splats.of_face.tolist() == splats.numbers.tolist() == [0, 1, 2, 3, 4]
    assert splats.share_vertices


def test_no_triangles_are_no_splats():
    for face_splat in (None, np.zeros(0, np.int32)):
        splats = FaceSplats(np.zeros((0, 3), np.int32), face_splat, 2)
        assert len(splats) == 0
        assert splats.ends.tolist() == splats.counts.tolist() == splats.of_face.tolist() == []
        assert splats.of_vertex.tolist() == [-1, -1]
        assert splats.sums(np.zeros((0, 3))).shape == (0, 3)


def test_a_mesh_has_them():
    mesh = SplatMesh(np.zeros((13, 3)), FACES, np.zeros((13, 4)), face_splat=SPLATS.face_splat)
    assert mesh.splat_count == len(mesh.splats) == 3
    kept = mesh.take(mesh.splats.of_face != 1)
    assert kept.splats.numbers.tolist() == [3, 9]


def test_splats_whose_vertices_follow_each_other_need_no_search(monkeypatch):
    mixed = FACES.copy()
    mixed[1, 2], mixed[2, 0] = 5, 3
    assert not FaceSplats(mixed, SPLATS.face_splat, 13).share_vertices
    monkeypatch.delattr(FaceSplats, "of_vertex")
    assert not SPLATS.share_vertices
