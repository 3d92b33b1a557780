"""Colours and opacities for linear light from those trained for display blending.

Splats are trained so that blended display values are right. Blended in linear light, as every lit scene is,
the same layers are too bright: of two colours, linear light shows the brighter one more. Here each splat gets
a factor on its linear colour and an exponent on its transparency, fitted so that blending in linear light
shows the image that display blending does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from meshsplats._common.arrays import subsample
from meshsplats.blender.options import CAREFUL
from meshsplats.conversion.normals import views_around
from meshsplats.finetuning.adam import RowAdam
from meshsplats.rendering import Rendering, render
from meshsplats.rendering.backward import TapeOptions
from meshsplats.rendering.cpu import CpuEngine
from meshsplats.scene.camera import Camera
from meshsplats.scene.colors import encoding_slope, linear_to_srgb, srgb_to_linear
from meshsplats.scene.mesh import SplatMesh

_SIDE = 200
"""Side in pixels of the images around the scene."""
_CAMERA_SIDE = 480
"""Longer side in samples, at most, of the images of given cameras: those of up to half of it have 2 x 2
samples a pixel, larger ones one."""
_RATE = 0.3
_FINAL = 0.1
"""Learning rate of the logarithms of factor and exponent, and what remains of it at the end."""
_LIMIT = 2.0
"""Greatest logarithm, up or down."""
_BACKGROUNDS = ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.5, 0.5, 0.5))
_DARKEST = 0.002
"""Linear light below which errors count no more than there: display values are steep near black."""


def linear_colors(
    mesh: SplatMesh,
    cameras: Sequence[Camera] = (),
    *,
    steps: int = CAREFUL.steps,
    views: int = CAREFUL.fit_views,
    threads: int | None = None,
) -> np.ndarray:
    """(v, 4) float32 RGBA of ``mesh`` for blending in linear light.

    Minimises the squared difference of display values over images from around the scene and from ``cameras``,
    before white, black and grey. All vertices of a splat share a factor and an exponent; without
    ``face_splat`` each vertex has its own. A mesh with ``blending='linear'`` keeps its colours. ``views``
    are around the scene; each of the ``steps`` sees one image.
    """
    if mesh.blending == "linear":
        return mesh.colors
    plain = np.column_stack([srgb_to_linear(mesh.colors[:, :3]), mesh.colors[:, 3]]).astype(np.float32)
    if steps == 0 or not len(mesh.faces):
        return plain
    owner = np.arange(len(plain)) if mesh.face_splat is None else np.maximum(mesh.splats.of_vertex, 0)
    count = int(owner.max()) + 1
    values = np.zeros((count, 4), np.float32)
    adam = RowAdam(values, lr=_RATE, betas=(0.5, 0.9), bounds=(-_LIMIT, _LIMIT), eps=1e-12, threads=threads)
    clear = np.log1p(-np.minimum(plain[:, 3], np.float32(0.9999)))
    unmoved = np.zeros_like(mesh.vertices)
    around, near = _views(mesh, cameras, views)
    seen_from, given = around + near, {id(camera) for camera in near}
    rng = np.random.default_rng(0)
    order: list[int] = []
    targets: dict[int, Rendering] = {}
    for step in range(steps):
        if not order:
            order = rng.permutation(len(seen_from)).tolist()
        camera = seen_from[order.pop()]
        background = _BACKGROUNDS[step % 3]
        colors, exponent = _with(plain, clear, values, owner)
        samples = 2 if id(camera) in given and 2 * max(camera.width, camera.height) <= _CAMERA_SIDE else 1
        seen = targets.get(id(camera))
        if seen is None:
            seen = render(mesh, camera, background=(0, 0, 0), samples=samples, threads=threads)
            targets[id(camera)] = seen
        target = seen.color + (1 - seen.alpha)[:, :, None] * np.array(background, np.float32)
        options = TapeOptions(srgb_to_linear(np.array(background, np.float32)), samples)
        drawn = CpuEngine(threads).tape(mesh.triangles._replace(colors=colors), camera, options)
        error = (linear_to_srgb(drawn.color) - target) * encoding_slope(
            np.maximum(drawn.color, np.float32(_DARKEST))
        )
        grad = np.zeros_like(colors)
        drawn.backward(np.ascontiguousarray(error, np.float32), None, None, vertices=unmoved, colors=grad)
        unmoved[:] = 0
        grad[:, :3] *= colors[:, :3]
        grad[:, 3] *= -(1 - colors[:, 3]) * clear * exponent
        sums = np.stack([np.bincount(owner, grad[:, k], count) for k in range(4)], axis=1).astype(np.float32)
        adam.lr = _RATE * _FINAL ** (step / steps)
        adam.step(sums, sums.any(axis=1))
    return _with(plain, clear, values, owner)[0]


def _with(
    plain: np.ndarray, clear: np.ndarray, values: np.ndarray, owner: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(v, 4) colours with the factors and exponents whose logarithms are ``values`` (n, 4), and the (v,)
    exponents; ``clear`` (v,) is the logarithm of the transparency."""
    factors = np.exp(values)[owner]
    colors = factors * plain
    colors[:, 3] = -np.expm1(factors[:, 3] * clear)
    colors[plain[:, 3] >= 1, 3] = 1
    return np.clip(colors, 0, 1, out=colors), factors[:, 3]


def _views(mesh: SplatMesh, cameras: Sequence[Camera], count: int) -> tuple[list[Camera], list[Camera]]:
    """``count`` cameras around ``mesh``, and as many of the given ones, some of them repeated."""
    given = [camera.within(_CAMERA_SIDE) for camera in subsample(cameras or (), count)]
    return views_around(mesh, count, _SIDE), given * (max(1, count // len(given)) if given else 0)
