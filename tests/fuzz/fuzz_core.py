"""Arrays made up at random for every entry point of the compiled core, which runs under sanitizers.

    make fuzz-core
    python tests/fuzz/fuzz_core.py [--calls render ...] [--count 1000] [--seed 0] [--start 0]

The arrays keep what callers have checked: shapes, indices in range, finite numbers. Values are otherwise as
bad as they get: coincident and collinear points, 1e-38 and 1e38, opacities of exactly 0 and 1. A call may
raise a ValueError or a MemoryError. A report of a sanitizer ends the process; the last line names the call,
which --calls, --seed and --start repeat.
"""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from meshsplats import Camera, GaussianCloud, SplatMesh, draw_splats, render, render_splats, simplify
from meshsplats._core import stereo
from meshsplats._core.cells import VertexGrid, nearest_vertices, sums_around
from meshsplats._core.kernels import AdamStep, adam_rows, compare_images, listed_triangles, round_fans
from meshsplats._core.neighbours import nearest
from meshsplats._core.resampling import resample
from meshsplats._core.structures import CameraStruct
from meshsplats._core.surfaces import (
    Grid,
    Samples,
    coordinate_gradients,
    fuse_depth,
    relax_texels,
    texel_sums,
    texture_samples,
)
from meshsplats.rendering.backward import ExpectedError, OpacityRamp, TapedRendering, TapeOptions
from meshsplats.rendering.core_arguments import camera_struct
from meshsplats.rendering.edges import edge_gradients
from meshsplats.rendering.ordering import drawing_order
from meshsplats.rendering.viewers import viewer_images

THREADS = 2
SPECIAL = np.array([0, -0.0, 1, -1, 0.5, 1e-38, -1e-45, 1e-7, 1e7, 1e19, -1e19, 1e38, -3e38])
SHARES = np.array([0, 1, 0.5, 1 / 255, 1 - 2**-24, 1e-30])


class Maker:
    """Values of one call."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.wild = rng.random() < 0.3
        """Whether extreme values occur."""

    def chance(self, share: float) -> bool:
        return bool(self.rng.random() < share)

    def count(self, most: int) -> int:
        return int(self.rng.integers(0, most + 1))

    def one_of(self, *values: object) -> object:
        return values[int(self.rng.integers(len(values)))]

    def values(self, *shape: int) -> np.ndarray:
        """float32 of many sizes."""
        found = self.rng.normal(size=shape)
        if self.wild:
            some = self.rng.random(shape) < 0.2
            found = np.where(some, self.rng.choice(SPECIAL, shape), found)
        return found.astype(np.float32)

    def shares(self, *shape: int) -> np.ndarray:
        """float32 from 0 to 1."""
        some = self.rng.random(shape) < (0.5 if self.wild else 0.1)
        return np.where(some, self.rng.choice(SHARES, shape), self.rng.random(shape)).astype(np.float32)

    def points(self, n: int) -> np.ndarray:
        """(n, 3) float32 around (0, 0, 2): a cloud, a grid on which many coincide, a line, a plane."""
        scale = 10.0 ** self.rng.integers(-3, 4) if self.chance(0.2) else 1.0
        points = self.values(n, 3).astype(np.float64)
        kind = self.count(3)
        if kind == 1:
            points = np.rint(points * 2) / 2
        elif kind == 2:
            points = points[:, :1] * self.values(3)
        elif kind == 3:
            points[:, self.count(2)] = 0
        with np.errstate(over="ignore"):
            return (scale * (points + np.array([0, 0, 2]))).clip(-3e38, 3e38).astype(np.float32)

    def camera(self) -> Camera:
        width, height = (1 + self.count(40) for _ in range(2))
        matrix = np.eye(4)
        if self.chance(0.5):
            rotation = np.linalg.qr(self.rng.normal(size=(3, 3)))[0]
            matrix[:3, :3] = rotation * np.linalg.det(rotation)
            matrix[:3, 3] = [0, 0, 2] @ (np.eye(3) - matrix[:3, :3].T)
        focal = 30.0 * 10.0 ** self.rng.uniform(-2, 2, 2) if self.wild else (30.0, 27.0)
        middle = self.rng.uniform(-10, 50, 2) if self.chance(0.2) else (width / 2, height / 2)
        near = self.one_of(None, 0.5, 0.01, 1e-9, 5.0)
        return Camera(matrix, *focal, *middle, width, height, near)

    def mesh(self, most: int = 60) -> SplatMesh:
        faces, splats = self.count(most), 1 + self.count(8)
        size = 1 + self.count(max(1, most // splats))
        vertices = splats * size
        extras: dict[str, object] = {}
        index = self.rng.integers(0, vertices, (faces, 3))
        if self.chance(0.6):
            splat = np.sort(self.rng.integers(0, splats, faces))
            extras = {"face_splat": splat.astype(np.int32), "order": self.one_of("fragment", "splat")}
            if self.chance(0.6):  # the filter and harmonics want vertices that belong to one splat
                extras["filter_px2"] = self.one_of(0.0, 0.3, 1e-6, 100.0)
                if self.chance(0.5):
                    coefficients = (3, 8, 15)[self.count(2)]
                    extras["harmonics"] = self.values(len(np.unique(splat)), coefficients, 3)
                index = splat[:, None] * size + self.rng.integers(0, size, (faces, 3))
        if self.chance(0.3):
            extras["depth_group"] = self.rng.integers(-1, 1 + self.count(4), faces).astype(np.int32)
        if self.chance(0.3):
            extras["normals"] = self.values(vertices, 3)
        if self.chance(0.3):
            extras["attributes"] = {"a": self.values(vertices, 1 + self.count(5))}
        return SplatMesh(self.points(vertices), index.astype(np.int32), self.shares(vertices, 4), **extras)

    def cloud(self, most: int = 80) -> GaussianCloud:
        n, degree = 1 + self.count(most), self.count(3)
        turns = self.rng.normal(size=(n, 4))
        scales = np.abs(self.values(n, 3)) * float(10.0 ** self.rng.integers(-4, 1))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return GaussianCloud(
                self.points(n),
                turns / np.linalg.norm(turns, axis=1, keepdims=True),
                scales.clip(1e-12, 1e12),
                self.shares(n),
                self.values(n, (degree + 1) ** 2, 3).clip(-100, 100),
                kernel=self.one_of("3dgs", "antialiased", "2dgs"),
            )

    def background(self, camera: Camera) -> np.ndarray:
        return self.shares(*((camera.height, camera.width) if self.chance(0.3) else ()), 3)


def near_struct(camera: Camera) -> CameraStruct:
    return camera_struct(replace(camera, near=camera.near or 0.01))


def call_render(make: Maker) -> None:
    mesh, camera = make.mesh(), make.camera()
    cut = mesh.order == "fragment" and mesh.filter_px2 == 0 and make.chance(0.3)
    render(
        mesh,
        camera,
        background=make.background(camera),
        samples=1 + make.count(3),
        max_layers=make.one_of(None, None, 1, 3),
        min_transmittance=float(make.one_of(0.0, 1e-4, 0.5)),
        depth=make.chance(0.3),
        normals=make.chance(0.3),
        attributes=tuple(mesh.attributes) if make.chance(0.7) else (),
        cutoff=float(make.shares()) if cut else None,
        threads=THREADS,
    )


def call_backward(make: Maker) -> None:
    mesh, camera = make.mesh(), make.camera()
    h, w = camera.height, camera.width
    ramp = None
    if mesh.order == "fragment" and make.chance(0.4):
        leak, width = make.one_of(0.0, 0.1), make.one_of(0.0, 1.0, 30.0)
        ramp = OpacityRamp(float(make.shares()), float(make.shares()), 10.0 ** make.count(6), width, leak)
    options = TapeOptions(make.background(camera), samples=1 + make.count(2), ramp=ramp)
    if make.chance(0.1):
        TapedRendering(mesh.triangles, camera, options, threads=THREADS, tape_bytes=None)
    tape = make.one_of(0, 1000, 1 << 24)
    taped = TapedRendering(mesh.triangles, camera, options, threads=THREADS, tape_bytes=tape)
    v, k = len(mesh.vertices), taped.attributes.shape[2]
    expected = ExpectedError(make.shares(h, w, 3), make.shares(h, w)) if make.chance(0.3) else None
    taped.backward(
        make.values(h, w, 3),
        make.values(h, w) if make.chance(0.5) else None,
        make.values(h, w, k) if k and make.chance(0.5) else None,
        vertices=np.zeros((v, 3), np.float32),
        colors=np.zeros((v, 4), np.float32),
        vertex_attributes=np.zeros((v, k), np.float32),
        harmonics=None if mesh.harmonics is None else np.zeros_like(mesh.harmonics),
        expected=expected,
    )


def call_splats(make: Maker) -> None:
    cloud, camera = make.cloud(), make.camera()
    if make.chance(0.5):
        draw_splats(cloud, camera, background=make.background(camera), threads=THREADS)
    else:
        render_splats(
            cloud, camera, samples=1 + make.count(2), dilation=make.one_of(0.0, 0.3, 50.0), threads=THREADS
        )


def call_compare(make: Maker) -> None:
    b, h, w, c = make.count(2), 1 + make.count(30), 1 + make.count(30), 1 + make.count(4)
    images = [make.values(b, h, w, c).clip(-1e6, 1e6) for _ in range(2)]
    mask = make.rng.random((b, h, w)) < 0.5 if make.chance(0.5) else None
    rates = {"l1_weight": make.count(1), "ssim_weight": make.count(1)}
    compare_images(*images, mask, **rates, gradient=make.chance(0.7), threads=THREADS)


def call_adam(make: Maker) -> None:
    n, k = make.count(50), 1 + make.count(6)
    arrays = [make.values(n, k) for _ in range(4)]
    arrays[2] = np.abs(arrays[2])
    rows = make.one_of(
        None,
        make.rng.random(n) < 0.5,
        np.flatnonzero(make.rng.random(n) < 0.5).astype(np.int32),
        make.rng.integers(-2, n + 2, make.count(n)).astype(np.int32),
    )
    scale = make.shares(n) if make.chance(0.5) else None
    step = AdamStep(float(make.shares()), (0.9, 0.999), 1e-8, scale, make.one_of((-np.inf, np.inf), (0, 1)))
    adam_rows(arrays[0], (arrays[1], arrays[2]), arrays[3], rows, step, THREADS)


def call_fans(make: Maker) -> None:
    round_fans(make.values(make.count(30), 4 + make.count(9), 3), float(make.shares()), THREADS)


def call_edges(make: Maker) -> None:
    mesh, camera = replace(make.mesh(), filter_px2=0.0, order="fragment"), make.camera()
    gradient = make.values(camera.height, camera.width, 3)
    edge_gradients(mesh, camera, float(make.shares()), gradient, threads=THREADS)


def call_nearest(make: Maker) -> None:
    count = 1 + make.count(10)
    nearest(make.points(count + 1 + make.count(200)), count, THREADS)


def call_merge(make: Maker) -> None:
    cloud = make.cloud(150)
    simplify(cloud, 1 + make.count(len(cloud)), low_pass=make.one_of(None, 0.0, 0.01), threads=THREADS)


def call_viewer(make: Maker) -> None:
    cutoffs = [make.one_of(None, 0.0, 0.5, 1.0) for _ in range(1 + make.count(2))]
    viewer_images(make.mesh(), make.camera(), cutoffs, multisample=make.chance(0.5), threads=THREADS)


def call_order(make: Maker) -> None:
    mesh, cameras = make.mesh(), [make.camera() for _ in range(1 + make.count(2))]
    order = drawing_order(mesh, cameras, nodes=1 + make.count(3), threads=THREADS)
    triangles = (mesh.vertices, mesh.faces, mesh.face_splat if make.chance(0.7) else None)
    listed_triangles(triangles, (order.copies, order.starts), near_struct(cameras[0]), THREADS)


def call_cells(make: Maker) -> None:
    n, size = 1 + make.count(30), [1 + make.count(5) for _ in range(3)]
    normals = make.rng.normal(size=(n, 3))
    ids = make.rng.integers(-1, n, size).astype(np.int32)
    grid = VertexGrid(ids, make.points(1)[0].astype(float), 0.5, make.points(n), normals)
    places, reach = make.points(make.count(30)), make.count(3)
    nearest_vertices(
        places, make.rng.normal(size=(len(places), 3)), grid, reach=reach, facing_away=4.0, threads=THREADS
    )
    points, middles = make.points(make.count(40)).astype(float), make.points(n).astype(float)
    cells = make.rng.integers(0, n, len(points)).astype(np.int32)
    beside = make.rng.integers(-1, n, (n, 1 + make.count(27))).astype(np.int32)
    sums_around(points, cells, beside, middles, make.rng.random((n, 3)), deviation=0.3, threads=THREADS)


def call_resample(make: Maker) -> None:
    image = make.shares(1 + make.count(12), 1 + make.count(12), 1 + make.count(3))
    points = (20 * make.values(make.count(60), 2)).astype(np.float32)
    points[make.rng.random(points.shape) < 0.1] = make.one_of(np.nan, np.inf, -np.inf)
    image = (255 * image).astype(np.uint8) if make.chance(0.5) else image
    resample(image, points, wraps=make.chance(0.5), threads=THREADS)


def call_texture(make: Maker) -> None:
    height, width, side = 1 + make.count(8), 1 + make.count(8), 1 + make.count(2)
    shape = (height * side, width * side)
    uv = make.values(*shape, 2)
    uv[make.rng.random(uv.shape) < 0.05] = make.one_of(np.nan, np.inf, -np.inf)
    samples = Samples(uv, make.rng.random(shape) < 0.7, side)
    texels, values = make.shares(1 + make.count(8), 1 + make.count(8), 3), make.values(height, width, 4)
    texture_samples(samples, texels, make.shares(3), threads=THREADS)
    coordinate_gradients(samples, texels, values, threads=THREADS)
    sums = texel_sums(samples, texels, values, threads=THREADS)
    relax_texels(samples, texels, values, sums, share=0.5, doubt=0.25, threads=THREADS)


def call_depth(make: Maker) -> None:
    """Depth images fused on a grid."""
    camera, size = make.camera(), tuple(1 + make.count(9) for _ in range(3))
    total, weight = np.zeros((2, *size), np.float32)
    depth = np.abs(make.values(camera.height, camera.width))
    depth[make.rng.random(depth.shape) < 0.3] = np.inf
    radius = float(make.one_of(0.0, 1.0))
    grid = Grid(
        make.points(1)[0].astype(float), 10.0 ** make.rng.uniform(-2, 1), size, (0.0, 0.0, 2.0), radius
    )
    how = {"truncation": float(make.one_of(0.01, 1.0)), "behind": float(make.shares())}
    fuse_depth(total, weight, depth, near_struct(camera), grid, **how, threads=THREADS)


def call_stereo(make: Maker) -> None:
    """Photographs, and what their depths say of each other."""
    structs = [near_struct(make.camera()) for _ in range(1 + make.count(3))]
    n, chosen = len(structs), np.flatnonzero(make.rng.random(len(structs)) < 0.7).astype(np.int32)
    photos, matched = stereo.Layout(structs), stereo.Layout([structs[i] for i in chosen])
    color = make.rng.integers(0, 256, (photos.pixels, 3)).astype(np.uint8)
    least = make.rng.uniform(0.01, 1, (len(chosen), 1))
    range_ = np.concatenate([least, least + make.rng.uniform(0, 2)], axis=1).astype(np.float32)
    sources = make.rng.integers(-1, n, (len(chosen), 1 + make.count(3))).astype(np.int32)
    pairs = stereo.Pairs(chosen, sources, range_)
    how = {"planes": 2 + make.count(10), "rounds": make.count(2) - 1}
    planes = stereo.match_photos(photos, color, matched, pairs, **how, threads=THREADS)
    own = np.concatenate(
        [np.zeros((0, 3), np.uint8), *(photos.image(color, i).reshape(-1, 3) for i in chosen)]
    )
    known = (make.rng.random(matched.pixels) < float(make.one_of(0.0, 0.3, 1.0))) & (planes.inverse > 0)
    inverse = stereo.fill_depths(matched, own, planes, known, per_pixel=1.0, threads=THREADS)
    neighbors = make.rng.integers(-1, max(1, len(chosen)), (len(chosen), 1 + make.count(3))).astype(np.int32)
    tolerances = (0.02, 0.05)
    stereo.count_consistent(matched, planes.inverse, inverse, neighbors, tolerances, THREADS)
    stereo.count_views(matched, inverse, make.points(make.count(40)).astype(float), tolerances, THREADS)


def call_points(make: Maker) -> None:
    """Points of photographs that become patches."""
    n = make.count(80)
    normals = make.rng.normal(size=(n, 3))
    normals *= (make.rng.random((n, 1)) < 0.8) / np.linalg.norm(normals, axis=1, keepdims=True)
    colors = make.rng.integers(0, 256, (n, 3)).astype(np.uint8)
    surface = stereo.SurfaceArrays(
        make.points(n),
        normals.astype(np.float32),
        make.shares(n) + np.float32(1e-6),
        colors,
        colors[:, 0] % 2,
    )
    stereo.fuse_points(surface, make.count(n), float(make.one_of(1.0, 30.0)), THREADS)


CALLS: dict[str, Callable[[Maker], None]] = {
    name.removeprefix("call_"): call for name, call in list(globals().items()) if name.startswith("call_")
}


def outcomes(name: str, seed: int, numbers: Iterable[int], *, say: bool = False) -> Counter[str]:
    """What came of the calls with these ``numbers``. ``say``: names each before it is made."""
    found: Counter[str] = Counter()
    for i in numbers:
        if say:
            print(f"--calls {name} --seed {seed} --start {i} --count 1", end="\r", flush=True)
        try:
            CALLS[name](Maker(np.random.default_rng([seed, i, sum(name.encode())])))
            found["done"] += 1
        except (ValueError, MemoryError) as error:
            found[type(error).__name__] += 1
    return found


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--calls", nargs="*", choices=CALLS, default=list(CALLS))
    parser.add_argument("--count", type=int, default=1000, help="of each call")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--start", type=int, default=0, help="number of the first call")
    asked = parser.parse_args()
    if "MESHSPLATS_LIBRARY" not in os.environ:
        print("not under sanitizers: make fuzz-core runs it so", flush=True)
    warnings.simplefilter("ignore")
    for name in asked.calls:
        found = outcomes(name, asked.seed, range(asked.start, asked.start + asked.count), say=True)
        listed = ", ".join(f"{count} {what}" for what, count in sorted(found.items()))
        print(f"{name}: {listed}".ljust(60), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
