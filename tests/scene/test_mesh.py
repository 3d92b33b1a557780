"""What the constructors of the data classes check, and what they leave alone."""

from __future__ import annotations

import warnings
from dataclasses import FrozenInstanceError

import numpy as np
import pytest
from _splats import few_splats

from meshsplats import (
    BaseMesh,
    DataWarning,
    GaussianCloud,
    SplatMesh,
    orbit,
    plain_colors_of,
    render,
    save_mesh,
)
from meshsplats._common.arrays import checked_array

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
COLORS = np.full((3, 4), 0.5, np.float32)
FACES = np.array([[0, 1, 2]], np.int32)


def triangle(**changed) -> SplatMesh:
    return SplatMesh(**{"vertices": CORNERS, "faces": FACES, "colors": COLORS, **changed})


def test_everything_is_named_in_a_line():
    from meshsplats.cameras.trajectories import orbit
    from meshsplats.datasets.splat_targets import splat_views
    from meshsplats.datasets.views import Dataset, ViewImage
    from meshsplats.demo_scene import make_scene
    from meshsplats.scene.base_mesh import BaseMesh

    cloud = make_scene(1234)
    assert repr(cloud) == "GaussianCloud(1,234 splats of degree 3, kernel '3dgs')"
    assert repr(triangle()) == "SplatMesh(3 vertices, 1 triangles, blending 'display')"
    full = triangle(face_splat=[0], normals=COLORS[:, :3], attributes={"heat": COLORS[:, 0]})
    assert repr(full) == (
        "SplatMesh(3 vertices, 1 triangles, 1 splats, blending 'display', attribute 'heat', normals)"
    )
    views = splat_views(cloud, orbit(cloud, 3, width=64, height=48))
    assert repr(views[0]) == f"View({views[0].name!r}, 64 x 48)"
    data = Dataset(views[:2], views[2:], "still life")
    assert repr(data) == "Dataset('still life', 2 views to train with, 1 held out, 64 x 48)"
    assert repr(Dataset(())) == "Dataset(0 views to train with, 0 held out)"
    assert repr(ViewImage(np.zeros((4, 6, 3), np.uint8), None, np.ones((4, 6), bool))) == (
        "ViewImage(6 x 4 uint8, mask)"
    )
    drawn = render(full, orbit(full, 1, width=6, height=4)[0], depth=True, attributes=["heat"])
    assert repr(drawn) == f"Rendering(6 x 4, {drawn.fragments} fragments, depth, attribute 'heat')"
    assert repr(BaseMesh(CORNERS, FACES, COLORS)) == "BaseMesh(3 vertices, 1 faces, colours)"


def test_good_arrays_are_not_copied():
    mesh = triangle()
    assert mesh.vertices is CORNERS
    assert mesh.faces is FACES
    assert mesh.colors is COLORS


def test_float64_positions_that_lose_their_detail_are_told_of():
    far = CORNERS * 0.1 + np.array([5e5, 4.5e6, 100])
    splats = {name: getattr(few_splats(), name)[:3] for name in ("quaternions", "scales", "opacities", "sh")}
    for make in (
        lambda points: triangle(vertices=points),
        lambda points: BaseMesh(points, FACES),
        lambda points: GaussianCloud(points, **splats),
    ):
        for given in (far, far.tolist()):
            with pytest.warns(
                DataWarning, match="steps of 0.5 across an extent of 0.09.* \\(origin\\)"
            ) as told:
                make(given)
            assert told[0].filename == __file__
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            for fine in (far.astype(np.float32), far.astype(np.float32).astype(float), far - far.min(axis=0)):
                make(fine)


def test_values_that_float32_cannot_hold_are_named_without_a_warning_of_numpy():
    with pytest.raises(ValueError, match="vertices must be finite, row 2 is not"):
        triangle(vertices=CORNERS * np.array([1, 1e300, 1]))
    with pytest.raises(ValueError, match=r"colors must lie in \[0, 16\], got 0 to 200; divide bytes by 255"):
        triangle(colors=(COLORS * 400).astype(np.uint8) * np.array([1, 1, 1, 0], np.uint8))
    with pytest.raises(ValueError, match="up must not be the zero vector"):
        BaseMesh(CORNERS, FACES, up=(0, 0, 0))


def test_assigning_a_field_says_how_to_change_it():
    cloud, mesh = few_splats(), triangle(colors=COLORS.copy())
    with pytest.raises(
        FrozenInstanceError, match=r"'sh' of a GaussianCloud.*replace\(it, sh=...\) makes another.$"
    ):
        cloud.sh = cloud.sh + 1
    with pytest.raises(
        FrozenInstanceError, match=r"replace.*The operation has changed the array in place already"
    ):
        mesh.colors *= 0.5
    with pytest.raises(FrozenInstanceError, match="'more' of a SplatMesh"):
        mesh.more = 1


@pytest.mark.parametrize("number", [-5, 3, 10**7])
def test_faces_that_are_changed_in_place_do_not_crash(number, tmp_path):
    mesh = triangle(faces=FACES.copy(), face_splat=[0], harmonics=np.ones((1, 3, 3)))
    cameras = orbit(mesh, 1, width=8, height=8)
    mesh.faces[0, 1] = number
    for use in (
        lambda: render(mesh, cameras[0]),
        lambda: plain_colors_of(mesh, cameras),
        *(lambda end=end: save_mesh(mesh, tmp_path / f"mesh.{end}") for end in ("npz", "glb", "ply")),
    ):
        with pytest.raises(ValueError, match="faces must be vertex indices from 0 to 2, got"):
            use()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "value", [[1, 2], np.array([1, 2], np.int64), np.array([1, 2], np.uint8), np.array([[1, 2]]).T[:, 0]]
)
def test_whole_numbers_of_any_type_become_int32(value):
    got = checked_array("numbers", value, np.int32, (None,))
    assert got.dtype == np.int32
    assert got.flags.c_contiguous
    assert got.tolist() == [1, 2]


@pytest.mark.parametrize("number", [1 << 31, -(1 << 31) - 1])
def test_whole_numbers_that_do_not_fit(number):
    with pytest.raises(ValueError, match=rf"must fit int32, got values from .*{number}"):
        checked_array("numbers", [7, number], np.int32, (None,))


def test_large_values_are_finite_though_their_sum_is_not():
    values = np.full((2, 3), 3e38, np.float32)
    assert checked_array("values", values, np.float32, (None, 3)) is values


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_the_row_that_is_not_finite_is_named(bad):
    values = np.zeros((4, 3), np.float32)
    values[2, 1] = bad
    with pytest.raises(ValueError, match=r"values must be finite, row 2 is not \(1 such rows\)"):
        checked_array("values", values, np.float32, (None, 3))


def test_infinities_that_cancel_are_found():
    with pytest.raises(ValueError, match="row 0"):
        checked_array("values", np.array([np.inf, -np.inf], np.float32), np.float32, (None,))


@pytest.mark.parametrize("number", [-1, 3, -(1 << 31), (1 << 31) - 1])
def test_faces_number_vertices(number):
    with pytest.raises(ValueError, match=r"faces must be vertex indices from 0 to 2, got "):
        triangle(faces=np.array([[0, 1, number]]))


def test_face_splat_ascends():
    faces = np.repeat(FACES, 3, axis=0)
    assert triangle(faces=faces, face_splat=np.array([2, 2, 5])).splat_count == 2
    for wrong in ([0, 2, 1], [-1, 0, 0]):
        with pytest.raises(ValueError, match="ascending indices >= 0"):
            triangle(faces=faces, face_splat=np.array(wrong))


def test_up_is_normalised_once():
    assert triangle(up=(0, 0, 2)).up.tolist() == [0, 0, 1]
    rng = np.random.default_rng(0)
    for direction in rng.normal(size=(200, 3)):
        up = triangle(up=direction).up
        assert abs(np.linalg.norm(up.astype(np.float64)) - 1) < 2e-7
        assert triangle(up=up).up.tolist() == up.tolist()  # not by another bit
    with pytest.raises(ValueError, match="zero vector"):
        triangle(up=(0, 0, 0))


def test_quaternions_are_not_normalised_but_checked():
    cloud = {"means": CORNERS, "scales": np.ones((3, 3)), "opacities": np.ones(3), "sh": np.zeros((3, 1, 3))}
    unit = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    assert GaussianCloud(quaternions=unit, **cloud).quaternions is unit
    with pytest.raises(ValueError, match="row 1 has length 2"):
        GaussianCloud(quaternions=unit * np.array([[1], [2], [1]]), **cloud)


@pytest.mark.parametrize("length", [1e30, 1e-30])
def test_an_up_direction_of_any_length_is_normalised(length):
    mesh = SplatMesh(np.eye(3), [[0, 1, 2]], np.ones((3, 4)), up=(0, 0, length))
    np.testing.assert_array_equal(mesh.up, [0, 0, 1])
