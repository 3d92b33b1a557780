"""The compiled core as a whole: all builds, any number of threads, hostile scenes, wrong options, memory."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from _rendering import EXTRAS, assert_same_bits, camera, layers, outputs, soup, splats

from meshsplats import SplatMesh
from meshsplats._core import library
from meshsplats.rendering import render, render_splats

KERNELS = ("3dgs", "antialiased", "2dgs")


def scenes():
    """Images that go through every path: short and long lists, ties, groups, crossing triangles, extras."""
    many = soup(1, 500, spread=(2, 2, 2))
    groups = np.random.default_rng(0).integers(-1, 50, 500)
    view = camera(70, 50, near=0.3)
    yield lambda **options: render(many, view, **options)
    yield lambda **options: render(many, view, samples=3, **EXTRAS, **options)
    yield lambda **options: render(
        replace(many, depth_group=groups), view, samples=2, max_layers=9, **options
    )
    yield lambda **options: render(layers([2.0] * 300, 0.01), view, **options)
    yield lambda **options: render(layers(np.linspace(1, 2, 700), 0.003), view, **options)
    # More than one thread's share of vertices, groups and splats.
    rng = np.random.default_rng(1)
    centers = rng.normal(size=(24_000, 1, 3)) + np.array([0, 0, 4])
    dust = SplatMesh(
        (centers + rng.normal(size=(24_000, 3, 3)) * 0.15).reshape(-1, 3),
        np.arange(72_000).reshape(-1, 3),
        rng.random((72_000, 4)),
    )
    yield lambda **options: render(dust, view, **options)
    for kernel in KERNELS:
        cloud = splats(2, 10_000, kernel=kernel, sizes=(0.01, 0.1))
        yield lambda cloud=cloud, **options: render_splats(cloud, view, samples=2, **options)


def digest() -> str:
    import hashlib

    total = hashlib.sha256()
    for scene in scenes():
        image = scene()
        for value in outputs(image).values():
            total.update(value.tobytes())
        total.update(str(image.fragments).encode())
    return total.hexdigest()


def in_another_process(code: str, **environment: str) -> str:
    result = subprocess.run(
        [sys.executable, "-c", f"import sys; sys.path[:] = {sys.path!r}\n{code}"],
        env={**os.environ, **environment},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    return result.stdout.strip()


@pytest.mark.slow(keep=2)
@pytest.mark.parametrize("number", range(9))
def test_threads_do_not_change_a_bit(number):
    scene = list(scenes())[number]
    one = scene(threads=1)
    assert one.fragments > 5_000
    for threads in (2, 7, 100):
        assert_same_bits(one, scene(threads=threads))


@pytest.mark.slow
def test_variants_do_not_change_a_bit():
    variants = library.available_variants()
    if len(variants) < 2:
        pytest.skip(f"one variant of the core runs here: {variants}")
    code = "import test_rendering_variants as t; from meshsplats._core import library\n"
    code += "print(library.load_core().ms_variant().decode(), t.digest())"
    expected = digest()
    for variant in variants:
        assert in_another_process(code, MESHSPLATS_VARIANT=variant) == f"{variant} {expected}"


@pytest.mark.skipif("MESHSPLATS_DIGEST" not in os.environ, reason="no digest of another machine is given")
@pytest.mark.parametrize("variant", library.available_variants())
def test_images_are_the_same_as_elsewhere(variant, monkeypatch):
    """MESHSPLATS_DIGEST is what ``digest`` gives on another platform."""
    monkeypatch.setattr(library, "load_core", partial(library.load_core, variant))
    assert digest() == os.environ["MESHSPLATS_DIGEST"]


def test_an_unknown_variant_is_refused():
    with pytest.raises(ValueError, match="has no variant 'v9'"):
        library.load_core("v9")


# Hostile scenes: finite images, no crash

VIEWS = {
    "common": camera(),
    "near tiny": camera(near=1e-30),
    "near smaller than float32": camera(near=1e-310),
    "near far": camera(near=1e30),
    "long focal lengths": camera(fx=1e30, fy=1e30),
    "absurd focal lengths": camera(fx=1e300, fy=1e300),
    "short focal lengths": camera(fx=1e-30, fy=1e-30),
    "far off the middle": camera(cx=1e9, cy=-1e300),
    "one row": camera(300, 1),
}


def scaled(values: np.ndarray, factor) -> np.ndarray:
    return np.clip(values.astype(np.float64) * factor, -3e38, 3e38)


def assert_image(image) -> None:
    for name, value in outputs(image).items():
        assert np.isfinite(value).all(), name
    assert image.alpha.min() >= 0
    assert image.alpha.max() <= 1


@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
def test_hostile_meshes(view):
    mesh = soup(3)
    rng = np.random.default_rng(4)
    groups = rng.integers(-1, 9, 60)
    for size in (1e-42, 1e-30, 1e-6, 1, 1e6, 1e18, 1e30, 3e38):
        vertices = scaled(mesh.vertices, size)
        assert_image(render(replace(mesh, vertices=vertices, depth_group=groups), view, **EXTRAS))
        mixed = scaled(mesh.vertices, 10 ** rng.uniform(-40, 38, (60, 1)))
        hostile = replace(mesh, vertices=mixed, normals=np.zeros((60, 3)), face_splat=np.sort(groups + 1))
        assert_image(render(hostile, view, samples=3, max_layers=3, **EXTRAS))


def test_degenerate_faces():
    mesh = soup(3)
    truth = render(mesh, camera(), **EXTRAS)
    nothing = np.vstack([mesh.faces[:, [0, 0, 1]], mesh.faces[:, [2, 1, 1]], mesh.faces[:, [0, 0, 0]]])
    assert_same_bits(truth, render(replace(mesh, faces=np.vstack([mesh.faces, nothing])), camera(), **EXTRAS))
    assert render(replace(mesh, faces=nothing), camera(), **EXTRAS).fragments == 0
    line = replace(mesh, vertices=np.outer(np.arange(60), [1, 2, 4]))
    assert render(line, camera(), **EXTRAS).fragments == 0
    big = replace(mesh, attributes={"heat": np.full(60, 3e38), "flow": np.full((60, 2), -3e38)})
    assert_image(render(big, camera(), **EXTRAS))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("view", VIEWS.values(), ids=VIEWS.keys())
def test_hostile_splats(view, kernel):
    cloud = splats(3, 60, kernel=kernel)
    rng = np.random.default_rng(4)
    for size in (1e-42, 1e-6, 1e6, 1e18, 1e30, 3e38):
        for scale in (size, 1e-40, 1e30):
            hostile = replace(
                cloud,
                means=scaled(cloud.means, size),
                scales=scaled(cloud.scales, scale),
            )
            for dilation in (0, 0.3, 1e30, 1e300):
                assert_image(render_splats(hostile, view, dilation=dilation))
        mixed = replace(
            cloud,
            means=scaled(cloud.means, 10 ** rng.uniform(-40, 38, (60, 1))),
            scales=scaled(cloud.scales, 10 ** rng.uniform(-40, 38, (60, 3))),
        )
        assert_image(render_splats(mixed, view, dilation=0))


# Wrong options


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples must be"),
        ({"samples": 17}, "samples must be"),
        ({"samples": 1.5}, "samples must be"),
        ({"samples": float("nan")}, "samples must be"),
        ({"threads": 0}, "threads must be"),
        ({"threads": 2.0}, "threads must be"),
        ({"max_layers": 0}, "max_layers must be"),
        ({"max_layers": 2.5}, "max_layers must be"),
        ({"max_layers": float("nan")}, "max_layers must be"),
        ({"max_layers": 2**40}, "max_layers must be"),
        ({"min_transmittance": -0.1}, "min_transmittance must"),
        ({"min_transmittance": 1}, "min_transmittance must"),
        ({"min_transmittance": float("nan")}, "min_transmittance must"),
        ({"background": (1, 1)}, "background must have shape"),
        ({"background": np.ones((37, 29, 3))}, "background must have shape"),
        ({"background": (0, float("inf"), 0)}, "background must be finite"),
        ({"background": np.full((29, 37, 3), np.nan)}, "background must be finite"),
        ({"background": (255, 255, 255)}, "got values up to 255; divide bytes by 255"),
        ({"background": np.full((29, 37, 3), 200, np.uint8)}, "got values up to 200; divide bytes by 255"),
        ({"attributes": ("cold",)}, "no attribute 'cold'; it has: heat, flow"),
    ],
)
def test_wrong_options_of_meshes(options, message):
    with pytest.raises(ValueError, match=message):
        render(soup(1), camera(), **options)


def test_backgrounds_may_be_brighter_than_white():
    drawn = render(soup(1).take(slice(0, 3)), camera(), background=(2, 1.5, 1))
    empty = drawn.alpha == 0
    assert empty.any()
    assert (drawn.color[empty] == np.array([2, 1.5, 1], np.float32)).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"samples": 0}, "samples must be"),
        ({"threads": -1}, "threads must be"),
        ({"sh_degree": 4}, "sh_degree must be"),
        ({"sh_degree": -1}, "sh_degree must be"),
        ({"sh_degree": 1.5}, "sh_degree must be"),
        ({"dilation": -0.1}, "dilation must be"),
        ({"dilation": float("nan")}, "dilation must be"),
        ({"dilation": float("inf")}, "dilation must be"),
        ({"background": 1.0}, "background must have shape"),
        ({"background": (0, 0, 128)}, "got values up to 128; divide bytes by 255"),
    ],
)
def test_wrong_options_of_splats(options, message):
    with pytest.raises(ValueError, match=message):
        render_splats(splats(1), camera(), **options)


def test_numbers_of_numpy_are_numbers():
    mesh, cloud, view = soup(1), splats(1), camera()
    plain = render(mesh, view, samples=2, max_layers=3, threads=2)
    other = render(mesh, view, samples=np.int64(2), max_layers=np.int32(3), threads=np.uint8(2))
    assert_same_bits(plain, other)
    assert_same_bits(
        render_splats(cloud, view, sh_degree=2), render_splats(cloud, view, sh_degree=np.int64(2))
    )


# Memory

PEAK = """
import resource, numpy as np
from meshsplats import Camera, SplatMesh
from meshsplats.rendering import render
rng = np.random.default_rng(0)
n, side = {n}, {side}
z = {depths}
corners = np.array([(-100, -100, 1), (300, -100, 1), (-100, 300, 1)])
colors = np.full((3 * n, 4), {alpha})
mesh = SplatMesh((z[:, :, None] * corners).reshape(-1, 3), np.arange(3 * n).reshape(-1, 3), colors)
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
image = render(mesh, Camera(np.eye(4), side, side, side / 2, side / 2, side, side, 0.05), threads=2)
after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
print((after - before) / 1024, image.alpha.min())
"""


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="measures memory as Linux does")
@pytest.mark.parametrize(
    ("scene", "most"),
    [
        # Large triangles over the whole image: the lists of 256 tiles would be 600 MiB.
        (
            {
                "n": 200_000,
                "side": 256,
                "alpha": 0.5,
                "depths": "np.repeat(rng.uniform(1, 20, (n, 1)), 3, 1)",
            },
            150,
        ),
        # All begin at one depth near the camera: nothing can be blended before the last triangle has come.
        (
            {
                "n": 30_000,
                "side": 32,
                "alpha": 0.5,
                "depths": "np.c_[np.full(n, 0.1), rng.uniform(1, 20, (n, 2))]",
            },
            60,
        ),
    ],
    ids=["large triangles", "all from the near plane"],
)
def test_memory_stays_bounded(scene, most):
    grown, alpha = map(float, in_another_process(PEAK.format(**scene)).split())
    assert alpha > 0.999
    assert grown < most
