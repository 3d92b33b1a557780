"""The converted demo scene is the same mesh with every version of Python and NumPy, and inside Blender."""

from __future__ import annotations

import numpy as np
import pytest

from meshsplats.conversion import convert
from meshsplats.conversion.fans import CHUNK
from meshsplats.demo_scene import make_scene

COUNT, PART = 20_000, 8_192

# For each preset, of the triangles of the first, second and third PART of splats, axis by axis: mean of their
# corners, standard deviation of the corners from the centre of the splat, sum of the triangles' areas as seen
# along the axis. Not a digest: the last bits depend on the processor.
PINNED = {
    "default": [
        [
            [0.063993516, -0.396393811, -0.093802531],
            [0.014396977, 0.015276707, 0.014396006],
            [11.907229299, 9.214537790, 11.908398912],
        ],
        [
            [-0.114475306, -0.850371908, 0.096796255],
            [0.031818696, 0.016811269, 0.030929391],
            [9.772092893, 29.004793351, 9.963895771],
        ],
        [
            [0.000121529, 0.000996179, -0.000166796],
            [0.027924687, 0.000000003, 0.027924689],
            [0.000001983, 23.532839821, 0.000001983],
        ],
    ],
    "paper": [
        [
            [0.063993516, -0.396393811, -0.093802531],
            [0.015596598, 0.016548317, 0.015595546],
            [13.971618116, 10.810854732, 13.972988379],
        ],
        [
            [-0.114475306, -0.850371908, 0.096796255],
            [0.030570597, 0.015364595, 0.029806736],
            [8.456952172, 30.829958924, 8.674442101],
        ],
        [
            [0.000121529, 0.000996179, -0.000166796],
            [0.031071950, 0.000000004, 0.031071951],
            [0.000002457, 29.138675042, 0.000002457],
        ],
    ],
}


@pytest.fixture(scope="module")
def cloud():
    return make_scene(COUNT)


@pytest.mark.parametrize("preset", PINNED)
def test_vertices_of_the_converted_scene_are_pinned(cloud, preset):
    assert COUNT > 2 * CHUNK, "full chunks and a part of one"
    mesh = convert(cloud, preset=preset)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    from_center = corners - cloud.means[mesh.face_splat, None]
    areas = np.abs(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])) / 2
    found = []
    for first in range(0, COUNT, PART):
        own = (mesh.face_splat >= first) & (mesh.face_splat < first + PART)
        spread = np.sqrt(np.square(from_center[own]).mean(axis=(0, 1)))
        found.append([corners[own].mean(axis=(0, 1)), spread, areas[own].sum(axis=0)])
    np.testing.assert_allclose(found, PINNED[preset], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("preset", PINNED)
def test_each_splat_is_the_same_whatever_comes_with_it(cloud, preset):
    """A few at a time make the same fans as all at once."""
    # Pixels are guessed from the whole cloud: without them, a splat knows of no other.
    options = dict(preset=preset, footprint="none", min_opacity=0)
    whole = convert(cloud, **options)
    for k in range(0, COUNT, 1_111):
        part = convert(cloud.take(np.arange(k, min(k + 5, COUNT))), **options)
        own = (whole.face_splat >= k) & (whole.face_splat < k + 5)
        np.testing.assert_allclose(
            whole.vertices[whole.faces[own]], part.vertices[part.faces], rtol=1e-5, atol=1e-6
        )
