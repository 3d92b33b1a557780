"""take, joined, transformed: splats that are chosen, joined or moved are drawn as they should be."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from meshsplats import Camera, DataWarning, GaussianCloud, render_splats

FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


def cloud(n: int = 40, degree: int = 3, seed: int = 0, kernel: str = "3dgs", **more) -> GaussianCloud:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    scales = np.exp(rng.normal(-1.5, 0.4, (n, 3)))
    if kernel == "2dgs":
        scales[:, 2] = 0
    sh = rng.normal(0, 0.5, (n, (degree + 1) ** 2, 3))
    means = rng.normal((0, 0, 6), 1.0, (n, 3))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    return GaussianCloud(means, q, scales, rng.uniform(0.2, 0.9, n), sh, kernel, **more)


def view(near: float = 0.1) -> Camera:
    return Camera(np.eye(4), 70, 70, 24, 20, 48, 40, near)


def similarity(seed: int, scale: float, *, mirrored: bool = False) -> np.ndarray:
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.linalg.det(q) * (-1 if mirrored else 1)
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = scale * q, rng.normal(size=3)
    return matrix


def moved_along(camera: Camera, matrix: np.ndarray) -> Camera:
    """The camera that sees the world after a similarity ``matrix`` as ``camera`` saw it before."""
    scale = np.cbrt(np.linalg.det(matrix[:3, :3]))
    there = camera.world_to_camera @ np.linalg.inv(matrix)
    there[:3] *= scale
    return replace(camera, world_to_camera=there, near=camera.near * scale)


def assert_bits(one: GaussianCloud, two: GaussianCloud) -> None:
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), err_msg=name)


@pytest.mark.parametrize("kernel", ["3dgs", "antialiased", "2dgs"])
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("scale", [1.0, 7.5])
def test_a_cloud_that_moves_with_its_camera_looks_the_same(kernel, degree, scale):
    before = cloud(degree=degree, kernel=kernel, seed=degree)
    matrix = similarity(degree, scale)
    after = before.transformed(matrix)
    one = render_splats(before, view()).color
    two = render_splats(after, moved_along(view(), matrix)).color
    assert np.ptp(one) > 0.3
    np.testing.assert_allclose(one, two, atol=2e-3)
    assert np.abs(one - two).mean() < 2e-5
    if degree:  # without turned harmonics, it does not
        plain = render_splats(replace(after, sh=before.sh), moved_along(view(), matrix)).color
        assert np.abs(one - plain).mean() > 1e-3


def test_transforms_follow_each_other_and_are_undone():
    before = cloud(up=(0, -1, 0))
    first, second = similarity(1, 2.0), similarity(2, 0.3)
    two, one = before.transformed(first).transformed(second), before.transformed(second @ first)
    for name in ("means", "scales", "sh", "up"):
        np.testing.assert_allclose(getattr(two, name), getattr(one, name), atol=1e-5)
    np.testing.assert_allclose(two.rotations, one.rotations, atol=1e-5)
    back = before.transformed(first).transformed(np.linalg.inv(first))
    for name in FIELDS:
        if name != "quaternions":
            np.testing.assert_allclose(getattr(back, name), getattr(before, name), atol=1e-5)
    assert_bits(before.transformed(np.eye(4)), before)


def test_the_origin_is_a_point_of_the_world():
    far = cloud(origin=(4e6, 0, 0))
    turn = np.diag([0.0, 0, 1, 1])
    turn[0, 1], turn[1, 0] = -1, 1
    moved = far.transformed(turn)
    np.testing.assert_array_equal(moved.origin, [0, 4e6, 0])
    other = far.transformed(turn, origin=np.array([1.0, 4e6, 0]))
    np.testing.assert_allclose(other.means, moved.means - [1, 0, 0], atol=1e-6)


def test_a_far_move_goes_to_the_origin():
    near, far, matrix = cloud(), np.array([5e5, 4.5e6, 100]), np.eye(4)
    matrix[:3, 3] = far
    moved = near.transformed(matrix)
    assert_bits(moved, near)
    np.testing.assert_array_equal(moved.origin, far)
    assert_bits(moved.transformed(np.linalg.inv(matrix), origin=[0, 0, 0]), near)
    matrix[:3, 3] = [300, 0, 0]
    assert near.transformed(matrix).origin.tolist() == [0, 0, 0]
    matrix[:3, 3] = far
    with pytest.warns(DataWarning, match="means near 500000 4500000 .* \\(origin\\), they keep it"):
        coarse = near.transformed(matrix, origin=[0, 0, 0])
    coarse.transformed(similarity(0, 2.0))  # what is lost already is not lost again
    with pytest.warns(DataWarning, match="means near 500000 4500000"):
        GaussianCloud.joined([replace(near, origin=-far), near])


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(2), r"shape \(4, 4\), \(3, 4\) or \(3, 3\), got \(2, 2\)"),
        (np.diag([1.0, 1, 1, 2]), "last row of the transform must be 0 0 0 1"),
        (np.diag([1.0, 1, np.nan]), "not finite"),
        (np.diag([1.0, 1, 0]), "flattens space"),
    ],
)
def test_what_is_no_transform(matrix, message):
    with pytest.raises(ValueError, match=message):
        cloud().transformed(matrix)


def test_take_of_all_has_the_same_bits():
    whole = cloud()
    for chosen in (slice(None), np.ones(40, bool), np.arange(40)):
        assert_bits(whole.take(chosen), whole)
    order = np.array([5, 3, 3, -1])
    np.testing.assert_array_equal(whole.take(order).means, whole.means[order])
    with pytest.raises(ValueError, match=r"a mask of splats must have shape \(40,\), got \(39,\)"):
        whole.take(np.ones(39, bool))
    with pytest.raises(ValueError, match="indices of 40 splats, got 0 to 40"):
        whole.take(np.array([0, 40]))


def test_a_cloud_that_is_divided_and_joined_is_the_same():
    whole = cloud(up=(0, -1, 0), origin=(1, 2, 3))
    back = GaussianCloud.joined([whole.take(slice(0, 13)), whole.take(slice(13, None))])
    assert_bits(back, whole)
    np.testing.assert_array_equal(back.up, whole.up)
    np.testing.assert_array_equal(back.origin, whole.origin)
    with pytest.raises(ValueError, match="at least one cloud"):
        GaussianCloud.joined([])


def test_kernels_that_differ_are_told_of():
    fine = cloud(kernel="antialiased")
    with pytest.warns(
        DataWarning, match="kernels '3dgs' and 'antialiased' are joined: all are drawn as '3dgs'"
    ):
        assert GaussianCloud.joined([fine, cloud()]).kernel == "3dgs"
    assert GaussianCloud.joined([fine, fine]).kernel == "antialiased"


def test_a_cloud_behind_another_is_drawn_behind_it():
    """Joined, both are drawn as one over the other: no splat of the first is behind one of the second."""
    front = cloud(12, degree=1, seed=1)
    behind = replace(cloud(30, seed=2), means=cloud(30, seed=2).means + np.float32([0, 0, 9]))
    behind = replace(behind, origin=np.array([0, 0, 5.0]), means=behind.means - np.float32([0, 0, 5]))
    both = GaussianCloud.joined([behind, front])
    assert both.origin.tolist() == [0, 0, 5]
    together = render_splats(both.relative_to((0, 0, 0)), view()).color
    back = render_splats(behind.relative_to((0, 0, 0)), view()).color
    over = render_splats(front, view(), background=back).color
    np.testing.assert_allclose(together, over, atol=1e-5)
    assert np.abs(over - back).max() > 0.1
