"""render and render_splats: exact images of meshes and splats from the compiled core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_double
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from meshsplats._core import library, structures
from meshsplats._kinds import need
from meshsplats.camera import MAX_SIDE, Camera
from meshsplats.gaussians import GaussianCloud
from meshsplats.mesh import MIN_TRANSMITTANCE, SplatMesh, Triangles, checked_cutoff, checked_filter

MAX_SAMPLES = 16
"""Largest side of the grid of samples in each pixel."""

Device = Literal["cpu", "gpu"]
"""Where meshes are rendered: by the compiled core, or on a GPU by WebGPU."""


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image with alpha, and further outputs. Rows run from top to bottom."""

    color: np.ndarray
    """(h, w, 3) float32 RGB over the background, in the colour space of the mesh or splats (display RGB)."""
    alpha: np.ndarray
    """(h, w) float32 in [0, 1]: 1 minus the transmittance that is left for the background."""
    depth: np.ndarray | None = None
    """(h, w) float32 camera depth z, summed with the blending weights of colour; see ``mean_depth``."""
    normals: np.ndarray | None = None
    """(h, w, 3) float32 world-frame unit normals that face the camera, summed with the same weights."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """The requested vertex attributes, (h, w) or (h, w, c) float32, summed with the same weights."""
    fragments: int = 0
    """Count of blended fragments: triangles, or splats, at samples."""

    def mean_depth(self, *, min_alpha: float = 0.0, empty: float = np.inf) -> np.ndarray:
        """(h, w) float32 mean depth z of the fragments in each pixel, weighted as their colours are.

        Args:
            min_alpha: pixels whose alpha is not above this are empty.
            empty: depth of empty pixels.

        Raises ValueError for a rendering without depth.
        """
        if self.depth is None:
            raise ValueError("the rendering has no depth: render with depth=True")
        covered = self.alpha > min_alpha
        return np.where(covered, self.depth / np.where(covered, self.alpha, 1), np.float32(empty))


def render(
    mesh: SplatMesh,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    max_layers: int | None = None,
    min_transmittance: float = MIN_TRANSMITTANCE,
    depth: bool = False,
    normals: bool = False,
    attributes: Sequence[str] = (),
    filter_px2: float | None = None,
    cutoff: float | None = None,
    threads: int | None = None,
    device: Device = "cpu",
) -> Rendering:
    """The image of a mesh of translucent triangles, exact at every sample.

    All triangles that cover a sample are sorted by their depth there (equal depths by face index) and
    blended front to back, ``C = sum_k T_k a_k c_k + T_end * background`` with ``T_k = prod_{j<k} (1 -
    a_j)``; colour and opacity are interpolated with perspective-correct weights. A sample on an edge shared
    by two triangles belongs to exactly one (top-left rule). Triangles are visible from both sides and are
    clipped at the near plane.

    A mesh with a low-pass filter of s = ``filter_px2`` is drawn with the fan of each splat widened in screen
    space, as 3D Gaussian Splatting widens splats by 0.3 px^2 at any size of the image. With c and M the mean
    and the covariance of a splat's opacity in the image, projected vertices p move to ``c + A (p - c)``, ``A
    = (M + s I)^(1/2) M^(-1/2)``; depths, colours and opacities stay. No direction counts as narrower than a
    variance of s / 10,000: a splat seen exactly edge on has no triangle to widen. Splats that reach nearer
    than the near plane stay as they are. The variance is in square pixels for any ``samples``.

    With a ``cutoff`` c, fragments are opaque where the interpolated opacity is at least c, and are not drawn
    elsewhere: each sample has the colour of the nearest opaque fragment, or of the background. This is the
    image of a depth buffer with an alpha test, or with triangles that were cut at the level set of c.

    ``device="gpu"`` draws the same image on the best GPU of the machine (extra ``gpu``): a few samples
    differ, where two triangles are within rounding of one depth. It never falls back to the CPU. The mesh of
    the last call stays on the GPU.

    Args:
        mesh: the triangles.
        camera: viewpoint, lens and size of the image.
        background: RGB, (3,) or (h, w, 3), in the space of the mesh's colours.
        samples: side of the grid of samples in each pixel, 1 to 16; 2 means 2 x 2 samples, averaged.
        max_layers: blend at most this many of the nearest triangles at each sample, as depth peeling does
            with that many passes.
        min_transmittance: early termination of samples with less transmittance than this; 0: none.
        depth, normals, attributes: further outputs; ``attributes`` names some of ``mesh.attributes``.
        filter_px2: overrides ``mesh.filter_px2``; 0 draws the triangles as they are.
        cutoff: least opacity that is drawn, as opaque; 0 to 1. None: blended with the opacity.
        threads: at most this many, of the CPU; all processors by default. The result does not depend on it.
        device: 'cpu' or 'gpu'.

    Raises:
        ValueError: an option out of its range, an attribute that the mesh does not have, or a filter for a
            mesh without ``face_splat`` or whose splats share vertices.
        MemoryError: the scene does not fit.
        MissingDependencyError: no GPU, or no library for it.
        DeviceError: the GPU failed, or did not finish.
    """
    need(SplatMesh, mesh=mesh, instead={"GaussianCloud": "render_splats draws splats, convert makes a mesh"})
    need(Camera, camera=camera)
    check_device(device)
    camera = camera.with_near_plane(mesh.vertices)
    keep = Pointers()
    options = checked_options(keep, camera, background, samples, threads)
    if max_layers is not None and not (
        isinstance(max_layers, (int, np.integer)) and 1 <= max_layers <= np.iinfo(np.int32).max
    ):
        raise ValueError(f"max_layers must be a whole number from 1 to 2^31 - 1, got {max_layers!r}")
    if not 0 <= min_transmittance < 1:
        raise ValueError(f"min_transmittance must lie in [0, 1), got {min_transmittance}")
    options.max_layers = int(max_layers or 0)
    if cutoff is not None:
        options.cutoff = checked_cutoff(cutoff)
    options.min_transmittance = min_transmittance

    px2 = mesh.filter_px2 if filter_px2 is None else checked_filter(filter_px2, mesh.face_splat)
    values, widths = None, {}
    if attributes:
        for name in attributes:
            if name not in mesh.attributes:
                raise ValueError(
                    f"the mesh has no attribute {name!r}; it has: {', '.join(mesh.attributes) or 'none'}"
                )
        chosen = {name: mesh.attributes[name] for name in attributes}
        columns = {name: value if value.ndim == 2 else value[:, None] for name, value in chosen.items()}
        widths = {name: column.shape[1] for name, column in columns.items()}
        values = np.ascontiguousarray(np.concatenate(list(columns.values()), axis=1))

    def named(sums: np.ndarray | None) -> dict[str, np.ndarray]:
        """The attributes by name, of (h, w, c) ``sums`` over all of them."""
        parts = {}
        start = 0
        for name, width in widths.items():
            assert sums is not None
            part = sums[:, :, start : start + width]
            parts[name] = part[:, :, 0] if mesh.attributes[name].ndim == 1 else part
            start += width
        return parts

    if device == "gpu":
        from meshsplats.webgpu.frames import DrawSettings
        from meshsplats.webgpu.renderer import draw

        settings = DrawSettings(
            samples=options.samples,
            max_layers=options.max_layers,
            min_transmittance=options.min_transmittance,
            cutoff=options.cutoff,
            filter_px2=px2,
        )
        drawn = draw(mesh, camera, settings, depth=depth, normals=normals, values=values)
        backdrop = np.asarray(background, np.float32)
        return Rendering(
            drawn.color + drawn.transmittance[:, :, None] * backdrop,
            1 - drawn.transmittance,
            drawn.depth,
            drawn.normals,
            named(drawn.values),
            drawn.work.fragments,
        )
    struct = mesh_struct(keep, mesh.triangles._replace(values=values, filter_px2=px2))
    h, w = camera.height, camera.width
    color, alpha = np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32)
    depths = np.empty((h, w), np.float32) if depth else None
    directions = np.empty((h, w, 3), np.float32) if normals else None
    sums = np.empty((h, w, sum(widths.values())), np.float32) if widths else None
    image = structures.ImageStruct(keep(color), keep(alpha), keep(depths), keep(directions), keep(sums), 0)
    library.call("ms_render_mesh", struct, camera_struct(camera), options, image)
    return Rendering(color, alpha, depths, directions, named(sums), int(image.fragments))


def check_device(device: str) -> None:
    """ValueError for a device that does not exist."""
    if device not in get_args(Device):
        raise ValueError(f"device must be {' or '.join(map(repr, get_args(Device)))}, got {device!r}")


def render_splats(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    sh_degree: int | None = None,
    dilation: float = 0.3,
    threads: int | None = None,
) -> Rendering:
    """The image of the splats themselves, as 3D Gaussian Splatting draws them.

    Splats are projected by their local affine approximation (EWA), widened by ``dilation``, and blended
    whole in the order of their centres' depth. Alpha below 1/255 is skipped and is limited to 0.99; a sample
    terminates before the splat that would leave a transmittance below 1e-4. Every sample where a splat's
    alpha reaches 1/255 is drawn, however far from its centre. The cloud's kernel decides the details: '3dgs'
    as above; 'antialiased' with the opacity lowered by as much as the widening adds; '2dgs' flat splats
    intersected by the ray (no widening; a low-pass filter of variance 5/3 ``dilation``, so 1/2 px^2).

    Args:
        cloud: the splats.
        camera: viewpoint, lens and size of the image; splats whose centres are nearer than its near plane
            are left out.
        background: RGB, (3,) or (h, w, 3).
        samples: side of the grid of samples in each pixel, 1 to 16; the widening stays that of whole pixels.
        sh_degree: use spherical harmonics up to this degree, 0 to 3; all that are stored by default. Colours
            are clamped to 0 and above, as in 3DGS; those of degree 0 alone are ``cloud.colors``, clamped to
            [0, 1].
        dilation: variance added to the projected covariance, square pixels. Models that were trained with
            another one need theirs.
        threads: at most this many; all processors by default. The result does not depend on it.

    Raises:
        ValueError: an option out of its range.
        MemoryError: the scene does not fit.
    """
    need(GaussianCloud, cloud=cloud, instead={"SplatMesh": "render draws meshes"})
    need(Camera, camera=camera)
    camera = camera.with_near_plane(cloud.means)
    keep = Pointers()
    options = checked_options(keep, camera, background, samples, threads)
    if sh_degree is not None and sh_degree not in (0, 1, 2, 3):
        raise ValueError(f"sh_degree must be 0, 1, 2 or 3, got {sh_degree}")
    if not (np.isfinite(dilation) and dilation >= 0):
        raise ValueError(f"dilation must be a variance in square pixels, >= 0, got {dilation}")
    degree = cloud.sh_degree if sh_degree is None else min(int(sh_degree), cloud.sh_degree)
    splats = structures.SplatsStruct(
        count=len(cloud),
        means=keep(cloud.means),
        quaternions=keep(cloud.quaternions),
        scales=keep(cloud.scales),
        opacities=keep(cloud.opacities),
        sh=keep(cloud.sh),
        sh_stored=cloud.sh.shape[1],
        sh_used=(degree + 1) ** 2,
        kernel=("3dgs", "antialiased", "2dgs").index(cloud.kernel),
        dilation=0.5 * (dilation / 0.3) if cloud.kernel == "2dgs" else dilation,
    )
    h, w = camera.height, camera.width
    color, alpha = np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32)
    image = structures.ImageStruct(keep(color), keep(alpha), None, None, None, 0)
    library.call("ms_render_splats", splats, camera_struct(camera), options, image)
    return Rendering(color, alpha, fragments=int(image.fragments))


class Pointers:
    """Gives the core pointers to arrays, and keeps the arrays alive as long as itself."""

    def __init__(self) -> None:
        self._arrays: list[np.ndarray] = []

    def __call__(self, array: np.ndarray | None) -> int | None:
        if array is not None:
            self._arrays.append(array)
        return library.pointer(array)


def mesh_struct(keep: Pointers, triangles: Triangles) -> structures.MeshStruct:
    """The core's structure of ``triangles``, whose arrays ``keep`` holds.

    Raises ValueError for a filter that is out of range or has no splats.
    """
    values = triangles.values
    width = 0 if values is None else values.shape[1]
    return structures.MeshStruct(
        vertex_count=len(triangles.vertices),
        face_count=len(triangles.faces),
        vertices=keep(triangles.vertices),
        colors=keep(triangles.colors),
        faces=keep(triangles.faces),
        face_splat=keep(triangles.face_splat),
        depth_group=keep(compact_groups(triangles.depth_group)),
        normals=keep(triangles.normals),
        attributes=keep(values if width else None),
        attribute_count=width,
        filter_px2=checked_filter(triangles.filter_px2, triangles.face_splat),
    )


def camera_struct(camera: Camera) -> structures.CameraStruct:
    """``camera``, which has a near plane, for the core."""
    assert camera.near is not None
    rows = (c_double * 12)(*camera.world_to_camera[:3].ravel())
    return structures.CameraStruct(
        rows, camera.fx, camera.fy, camera.cx, camera.cy, camera.near, camera.width, camera.height
    )


def checked_options(
    keep: Pointers,
    camera: Camera,
    background: Sequence[float] | np.ndarray,
    samples: int,
    threads: int | None,
) -> structures.OptionsStruct:
    if not (isinstance(samples, (int, np.integer)) and 1 <= samples <= MAX_SAMPLES):
        raise ValueError(f"samples must be the side of the sample grid, 1 to {MAX_SAMPLES}, got {samples!r}")
    if threads is not None and not (isinstance(threads, (int, np.integer)) and threads >= 1):
        raise ValueError(f"threads must be at least 1, got {threads!r}")
    backdrop = np.ascontiguousarray(background, np.float32)
    if backdrop.shape not in ((3,), (camera.height, camera.width, 3)):
        raise ValueError(
            f"background must have shape (3,) or ({camera.height}, {camera.width}, 3), got {backdrop.shape}"
        )
    if not np.isfinite(backdrop).all():
        raise ValueError("background must be finite")
    assert max(camera.width, camera.height) <= MAX_SIDE
    return structures.OptionsStruct(
        samples=int(samples),
        max_layers=0,
        threads=min(int(threads) if threads else library.processors(), 256),
        min_transmittance=0,
        background=keep(backdrop),
        background_per_pixel=backdrop.ndim == 3,
        cutoff=-1,
    )


def compact_groups(depth_group: np.ndarray | None) -> np.ndarray | None:
    """The same groups, indexed without gaps, so that tables over them are no larger than the mesh."""
    if depth_group is None or not len(depth_group) or depth_group.max() < len(depth_group):
        return depth_group
    values, indices = np.unique(depth_group, return_inverse=True)
    shift = int(values[0] == -1)
    return np.ascontiguousarray(indices.reshape(-1) - shift, np.int32)
