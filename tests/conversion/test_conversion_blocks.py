"""Conversion in blocks: the same mesh as the conversion of the whole, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats import GaussianCloud, convert, convert_blocks, orbit
from meshsplats.conversion import streaming
from meshsplats.demo_scene import make_scene

FIELDS = ("means", "quaternions", "scales", "opacities", "sh")


@pytest.fixture
def small_blocks(monkeypatch):
    """Blocks of the least size that keeps the chunks of a conversion."""
    monkeypatch.setattr(streaming, "BLOCK", 1 << 14)


def in_blocks(cloud, size=5000):
    return [cloud.take(np.arange(i, min(i + size, len(cloud)))) for i in range(0, len(cloud), size)]


def with_strays(n, strays):
    """The still life of ``n`` splats, the last ``strays`` of them far away, some faint and some flat."""
    scene = make_scene(n)
    fields = {name: getattr(scene, name).copy() for name in FIELDS}
    rng = np.random.default_rng(1)
    fields["means"][-strays:] = rng.normal(size=(strays, 3)) * 300
    fields["opacities"][::7] = 0.002
    fields["scales"][3::1000, 1:] = 0  # without area
    order = rng.permutation(n)
    return GaussianCloud(**{name: values[order] for name, values in fields.items()})


def assert_same(parts, mesh):
    starts = np.cumsum([0, *(len(part.vertices) for part in parts)])
    for name in ("vertices", "colors", "face_splat"):
        np.testing.assert_array_equal(np.concatenate([getattr(p, name) for p in parts]), getattr(mesh, name))
    faces = [part.faces + start for part, start in zip(parts, starts[:-1], strict=True)]
    np.testing.assert_array_equal(np.concatenate(faces), mesh.faces)
    for part in parts:
        np.testing.assert_array_equal(part.up, mesh.up)
        assert part.filter_px2 == mesh.filter_px2


@pytest.mark.slow(keep=3)
@pytest.mark.parametrize("strays", [60, 61])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"look": "splats", "mode": "flat", "sides": 6},
        {"footprint": "none"},
        {"footprint": "filter"},
        {"footprint": "distance", "viewing_distance": 3.0},
        {"preset": "paper", "up": (0, 0, 1)},
        {"crop": (-0.5, -2, -2, 2, 2, 2), "min_opacity": 0.1},
    ],
    ids=lambda options: " ".join(map(str, options)) or "default",
)
def test_blocks_are_the_mesh_of_the_whole(small_blocks, options, strays):
    cloud = with_strays(40_000, strays)
    parts = list(convert_blocks(in_blocks(cloud), **options))
    assert len(parts) >= 2
    assert_same(parts, convert(cloud, **options))


def test_cameras_and_their_colors(small_blocks):
    cloud = with_strays(40_000, 100)
    cameras = orbit(cloud, 5, distance=0.3)  # close: many splats are in no image
    for colors in ("base", "mean", "view"):
        parts = list(convert_blocks(in_blocks(cloud, 3000), cameras=cameras, colors=colors))
        assert_same(parts, convert(cloud, cameras=cameras, colors=colors))


def test_the_median_pixel_is_exact(small_blocks):
    """Of an even and an odd number of sizes, against NumPy's."""
    for n in (999, 1000):
        sizes = np.random.default_rng(n).lognormal(size=n).astype(np.float32)
        sizes[:100] = 0

        class Views:
            def seen(self, means, sizes=sizes):
                return sizes[means[:, 0].astype(int)]

        cloud = GaussianCloud(
            np.arange(n)[:, None] * [1, 0, 0],
            np.tile([1, 0, 0, 0], (n, 1)),
            np.ones((n, 3)),
            np.ones(n),
            np.zeros((n, 1, 3)),
        )
        chosen = streaming.ConversionOptions().resolved("default", has_cameras=False)
        found = streaming._median_seen(in_blocks(cloud, 77), chosen, Views())
        assert found == np.median(sizes[100:])


def test_what_needs_the_whole_is_refused():
    cloud = make_scene(300)
    for options, message in [
        ({"max_splats": 100}, "limits on splats"),
        ({"max_triangles": 100}, "limits on splats"),
        ({"detail": "cameras", "cameras": orbit(cloud, 2)}, "detail='cameras'"),
    ]:
        with pytest.raises(ValueError, match=message):
            next(convert_blocks([cloud], **options))
    with pytest.raises(ValueError, match="none of the 300 splats is left"):
        next(convert_blocks([cloud], crop=(50, 50, 50, 60, 60, 60)))
    with pytest.raises(TypeError, match="max_splat"):
        next(convert_blocks([cloud], max_splat=3))
