"""What convert leaves out on request, and what it refuses."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from _splats import few_splats

from meshsplats.conversion import PRESETS, ConversionOptions, convert
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import LEAST_OPACITY, GaussianCloud

CAMERA = Camera(np.eye(4), 100, 100, 32, 32, 64, 64)


def row_of(opacities, scales=None, positions=None) -> GaussianCloud:
    """Splats at x = 0, 1, 2 ... 10 units in front of ``CAMERA``."""
    n = len(opacities)
    means = np.zeros((n, 3))
    means[:, 0] = np.arange(n) if positions is None else positions
    means[:, 2] = 10
    sizes = np.full(n, 0.1) if scales is None else np.asarray(scales)
    return GaussianCloud(
        means, [[1, 0, 0, 0]] * n, np.tile(sizes[:, None], 3), opacities, np.zeros((n, 1, 3))
    )


def kept(mesh) -> list[int]:
    return np.unique(mesh.face_splat).tolist()


class TestSelection:
    def test_faint_splats_are_left_out(self):
        cloud = row_of([0.5, 0.0039, 0.004, 0.0])
        assert kept(convert(cloud)) == [0, 2]
        assert kept(convert(cloud, min_opacity=0.1)) == [0]
        assert kept(convert(cloud, min_opacity=0, shrink_faint=False)) == [0, 1, 2, 3]
        assert kept(convert(cloud, preset="paper", min_opacity=0.004)) == [0, 2]

    def test_splats_without_area_are_left_out(self):
        cloud = replace(row_of([0.5] * 3), scales=[[0.1, 0, 0], [0, 0.1, 0.1], [0, 0, 0]])
        assert kept(convert(cloud, footprint="none")) == [1]
        assert kept(convert(cloud, cameras=[CAMERA])) == [0, 1, 2]  # the filter gives them some

    def test_faint_splats_are_smaller(self):
        """2/255: half of what integrates to 2 pi is below 1/255; half the area is a factor of sqrt(1/2)."""
        cloud = row_of([2 / 255])
        options = dict(footprint="none", mode="flat")
        size = [np.ptp(convert(cloud, **options, shrink_faint=s).vertices[:, 1]) for s in (True, False)]
        assert size[0] / size[1] == pytest.approx(0.5**0.5, rel=1e-5)

    def test_crop(self):
        cloud = row_of([0.5] * 6)
        assert kept(convert(cloud, crop=(1, -1, 9, 3, 1, 11))) == [1, 2, 3]
        assert kept(convert(cloud, crop=(2, 0, 10, 2, 0, 10))) == [2]
        mesh = convert(cloud, crop=(1, -1, 9, 3, 1, 11))
        assert mesh.vertices[:, 0].min() > 0
        assert len(mesh.faces) == 24

    def test_empty_crop_says_where_the_splats_are(self):
        with pytest.raises(ValueError, match=r"none of the 3 splats.* \(0, 0, 10\) to \(2, 0, 10\)"):
            convert(row_of([0.5] * 3), crop=(5, 5, 5, 6, 6, 6))

    def test_max_splats_by_opacity_times_area(self):
        # opacity x scale^2: 0.9, 0.4 x 4 = 1.6, 0.1 x 9 = 0.9 (tie: the first), 0.5, 1.0
        cloud = row_of([0.9, 0.4, 0.1, 0.5, 1.0], [1, 2, 3, 1, 1])
        options = dict(footprint="none", shrink_faint=False, budget="drop")
        assert kept(convert(cloud, **options, max_splats=1)) == [1]
        assert kept(convert(cloud, **options, max_splats=2)) == [1, 4]
        assert kept(convert(cloud, **options, max_splats=3)) in ([0, 1, 4], [1, 2, 4])
        assert kept(convert(cloud, **options, max_splats=99)) == [0, 1, 2, 3, 4]

    def test_ties_keep_the_first(self):
        assert kept(convert(row_of([0.5] * 9), max_splats=4, footprint="none", budget="drop")) == [0, 1, 2, 3]

    def test_visible_area_is_that_on_the_image(self):
        cloud = row_of([0.5, 0.5], [0.1, 0.11], positions=[0, 0])
        cloud = replace(cloud, means=[[0, 0, 5], [0, 0, 10]])
        assert kept(convert(cloud, cameras=[CAMERA], max_splats=1, budget="drop")) == [0]
        assert kept(convert(cloud, footprint="none", max_splats=1, budget="drop")) == [1]

    def test_splats_that_no_camera_sees_count_as_at_the_median_distance(self):
        # Seen at 5, 10 and 20, and one behind the camera as if at 10: 4, 1.1, 1/4 and 1 times its area.
        cloud = row_of([0.5, 0.55, 0.5, 0.5])
        cloud = replace(cloud, means=[[0, 0, 5], [0, 0, 10], [0, 0, 20], [0, 0, -50]])
        options = dict(cameras=[CAMERA], footprint_px2=0, budget="drop")
        assert kept(convert(cloud, **options, max_splats=2)) == [0, 1]
        assert kept(convert(cloud, **options, max_splats=3)) == [0, 1, 3]

    def test_max_triangles(self):
        cloud = row_of([0.2, 0.8, 0.6, 0.4])
        options = dict(budget="drop", sides=4)
        assert kept(convert(cloud, max_triangles=31, **options)) == [1, 2, 3]
        assert kept(convert(cloud, max_triangles=32, **options)) == [0, 1, 2, 3]
        assert len(convert(cloud, max_triangles=16, **options).faces) == 16
        assert kept(convert(cloud, max_triangles=16, max_splats=1, **options)) == [1]
        with pytest.raises(ValueError, match="max_triangles must be at least 8, one splat's, got 7"):
            convert(cloud, max_triangles=7, **options)

    def test_limits_keep_rows_of_the_cloud(self):
        mesh = convert(row_of([0.001, 0.5, 0.9, 0.8]), max_splats=2, footprint="none", budget="drop")
        np.testing.assert_array_equal(mesh.face_splat, np.repeat([2, 3], 8))
        assert mesh.vertices[mesh.faces[0, 0]].tolist() == [2, 0, 10]

    def test_nothing_left(self):
        with pytest.raises(ValueError, match="no splats"):
            convert(row_of([0.5]).take(np.zeros(1, bool)))
        with pytest.raises(ValueError, match=r"greatest opacity is 0\.3, below min_opacity 0\.5"):
            convert(row_of([0.3, 0.2]), min_opacity=0.5)
        with pytest.raises(ValueError, match="none of the 2 splats has a visible area"):
            convert(replace(row_of([0.5, 0.6]), scales=np.zeros((2, 3))), footprint="none")

    def test_single_splat(self):
        assert len(convert(row_of([0.5])).faces) == 8


REFUSED = [
    (dict(preset="papre"), "preset must be one of default, paper, got 'papre'"),
    (dict(mode="2d"), "mode must be one of"),
    (dict(footprint="camera"), "footprint must be one of"),
    (dict(colors="rgb"), "colors must be one of"),
    (dict(sides=2), "sides must be a whole number from 3 to 64, got 2"),
    (dict(sides=65), "sides"),
    (dict(sides=4.5), "sides"),
    (dict(sides=True), "sides"),
    (dict(sides="8"), "sides"),
    (dict(mode="3d", sides=6), "multiple of 4"),
    (dict(sides=5), "even"),
    (dict(rim_radius=0), "rim_radius"),
    (dict(rim_radius=11), "rim_radius"),
    (dict(rim_radius=float("nan")), "rim_radius"),
    (dict(rim_opacity=-0.1), "rim_opacity"),
    (dict(rim_opacity=1.1), "rim_opacity must be a number from 0 to 1, got 1.1"),
    (dict(center_opacity=0), "center_opacity"),
    (dict(rings=0), "rings"),
    (dict(rings=5), "rings"),
    (dict(compensation=1.5), "compensation"),
    (dict(shrink_faint="no"), "shrink_faint must be True or False, got 'no'"),
    (dict(flat_below=-1), "flat_below"),
    (
        dict(mode="flat", flat_below=0.2),
        "without mode 'crossed' or detail 'cameras', got mode 'flat' and detail 'even'",
    ),
    (dict(footprint="cameras"), "needs cameras"),
    (dict(footprint="distance"), "needs viewing_distance"),
    (dict(viewing_distance=0), "viewing_distance"),
    (
        dict(viewing_distance=3, footprint="framing"),
        "viewing_distance has no effect without footprint 'distance'",
    ),
    (dict(focal=100), "focal has no effect without footprint 'distance'"),
    (
        dict(preset="paper", viewing_distance=3),
        "viewing_distance has no effect without footprint 'distance', got footprint 'none'",
    ),
    (dict(footprint="none", footprint_px2=0.3), "footprint_px2"),
    (dict(footprint_px2=-1), "footprint_px2"),
    (dict(colors="mean"), "colors='mean' needs cameras"),
    (dict(detail="cameras"), "detail='cameras' needs cameras"),
    (dict(detail="finest"), "detail must be one of even, cameras"),
    (dict(detail="cameras", mode="3d", cameras=[CAMERA]), "mode '3d'"),
    (dict(detail="cameras", rings=2, cameras=[CAMERA]), "rings 2"),
    (dict(min_opacity=2), "min_opacity"),
    (dict(crop=(0, 0, 0, 1, 1)), "crop"),
    (dict(crop=(0, 0, 0, -1, 1, 1)), "each minimum <= its maximum"),
    (dict(crop=(0, 0, 0, float("nan"), 1, 1)), "crop"),
    (dict(max_splats=0), "max_splats"),
    (dict(max_triangles=-8), "max_triangles"),
    (dict(up=(0, 0, 0)), "up"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED, ids=lambda x: str(x)[:40])
def test_refused(options, message):
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        convert(row_of([0.5, 0.6]), **options)


def test_misspelt_option():
    with pytest.raises(TypeError, match="no option 'rimradius'; did you mean 'rim_radius'"):
        convert(row_of([0.5]), rimradius=2)
    with pytest.raises(TypeError, match="options: mode, rim_radius, sides"):
        convert(row_of([0.5]), zzz=2)


def test_every_option_does_something():
    """On a varied cloud, each option changes the mesh."""
    rng = np.random.default_rng(0)
    cloud = GaussianCloud(
        rng.normal((0, 0, 8), size=(60, 3)),
        [[1, 0, 0, 0]] * 60,
        np.exp(rng.normal(size=(60, 3)) - 3),
        rng.uniform(0.004, 1, 60),
        rng.normal(size=(60, 9, 3)),
    )
    other = dict(
        mode="3d",
        rim_radius=2.0,
        sides=6,
        rim_opacity=0.3,
        center_opacity=0.7,
        rings=2,
        detail="cameras",
        flat_below=0.6,
        compensation=0.3,
        look="splats",
        footprint="none",
        footprint_px2=2.0,
        viewing_distance=3.0,
        focal=50.0,
        min_opacity=0.3,
        shrink_faint=False,
        crop=(-1, -1, 7, 1, 1, 9),
        max_splats=9,
        max_triangles=99,
        budget="drop",
        colors="mean",
        color_degree=1,
    )
    assert set(other) == {f.name for f in fields(ConversionOptions)}
    for name, value in other.items():
        base = dict(cameras=[CAMERA])
        if name == "focal":
            base["viewing_distance"] = 3.0
        if name == "budget":
            base["max_splats"] = 9
        a, b = convert(cloud, **base), convert(cloud, **base, **{name: value})
        same = (
            a.vertices.shape == b.vertices.shape
            and (a.vertices == b.vertices).all()
            and (a.colors == b.colors).all()
            and a.sh_degree == b.sh_degree
        )
        assert not same, name


LIMITS = {"crop", "max_triangles", "max_splats", "color_degree", "footprint_px2", "viewing_distance"}
CALIBRATED = {"sides", "rim_radius", "center_opacity", "footprint"}


def test_presets_state_every_choice():
    """But for limits, which are the user's, and what the mode and the cameras decide."""
    for name, preset in PRESETS.items():
        resolved = ConversionOptions().resolved(name, has_cameras=False)
        values = {field.name: getattr(preset, field.name) for field in fields(ConversionOptions)}
        decided = CALIBRATED if name == "default" else set()
        assert {field for field, value in values.items() if value is None} == LIMITS | decided
        for field, value in values.items():
            assert value is None or getattr(resolved, field) == value, field


def test_what_3dgs_never_draws_is_left_out_by_default():
    assert PRESETS["default"].min_opacity == LEAST_OPACITY


def test_up():
    upright = replace(CAMERA, world_to_camera=[[1, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    cloud = replace(row_of([0.5]), means=[[0, 10, 0]])
    np.testing.assert_allclose(convert(cloud, cameras=[upright]).up, [0, 0, 1], atol=1e-6)
    np.testing.assert_allclose(convert(cloud, cameras=[upright], up=(2, 0, 0)).up, [1, 0, 0])
    np.testing.assert_allclose(convert(cloud).up, [0, -1, 0])


def test_whole_numbers_may_be_floats():
    cloud = few_splats()
    limited = convert(cloud, max_triangles=1e2)
    np.testing.assert_array_equal(limited.vertices, convert(cloud, max_triangles=100).vertices)
    assert len(convert(cloud, max_splats=5.0, sides=6.0).faces) <= 5 * 12
