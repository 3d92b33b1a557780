"""render and render_splats: exact images of meshes and splats from the compiled core."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from meshsplats._common.arrays import check_faces
from meshsplats._common.choices import Device
from meshsplats._common.kinds import each, need, need_numbers
from meshsplats._core import library, structures
from meshsplats.rendering.core_arguments import Pointers, camera_struct, checked_options
from meshsplats.rendering.devices import engine
from meshsplats.rendering.engine import ImageOptions, check_device
from meshsplats.scene.camera import Camera
from meshsplats.scene.gaussians import DILATION, LOW_PASS_PX2, GaussianCloud
from meshsplats.scene.mesh import MIN_TRANSMITTANCE, SplatMesh, checked_cutoff, checked_filter
from meshsplats.scene.order import Order, checked_order


@dataclass(frozen=True, eq=False)
class Rendering:
    """An image with alpha, and further outputs. Rows run from top to bottom."""

    color: np.ndarray
    """(h, w, 3) float32 RGB over the background, in the colour space of the mesh or splats (display RGB)."""
    alpha: np.ndarray
    """(h, w) float32 in [0, 1]: 1 minus the transmittance that is left for the background."""
    depth: np.ndarray | None = None
    """(h, w) float32 accumulated depth: camera z summed with the blending weights of colour, as render mode D
    of gsplat; ``mean_depth`` is the expected depth, ED."""
    normals: np.ndarray | None = None
    """(h, w, 3) float32 world-frame unit normals that face the camera, summed with the same weights."""
    attributes: Mapping[str, np.ndarray] = field(default_factory=dict)
    """The requested vertex attributes, (h, w) or (h, w, c) float32, summed with the same weights."""
    fragments: int = 0
    """Count of blended fragments: triangles, or splats, at samples."""
    median_depth: np.ndarray | None = None
    """(h, w) float32 camera depth z of the first fragment behind which the transmittance is 0.5 or less, mean
    over the samples that have one; infinite in pixels where fewer than half of them do."""

    def __repr__(self) -> str:
        height, width = self.alpha.shape
        more = [name for name in ("depth", "median_depth", "normals") if getattr(self, name) is not None]
        named = [f"attribute {name!r}" for name in self.attributes]
        size = f"{width} x {height}"
        return f"Rendering({', '.join([size, f'{self.fragments:,} fragments', *more, *named])})"

    def mean_depth(self, *, min_alpha: float = 0.0, empty: float = np.inf) -> np.ndarray:
        """(h, w) float32 expected depth: mean camera z of the fragments, weighted as their colours are.

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
    median_depth: bool = False,
    normals: bool = False,
    attributes: Sequence[str] = (),
    filter_px2: float | None = None,
    cutoff: float | None = None,
    order: Order | None = None,
    threads: int | None = None,
    device: Device = "cpu",
) -> Rendering:
    """The image of a mesh of translucent triangles.

    With the ``order`` 'fragment' it is exact at every sample: all triangles that cover the sample are sorted
    by their depth there (equal depths by face index) and blended front to back, ``C = sum_k T_k a_k c_k +
    T_end * background`` with ``T_k = prod_{j<k} (1 - a_j)``; colour and opacity are interpolated with
    perspective-correct weights. A sample on an edge shared by two triangles belongs to exactly one (top-left
    rule). Triangles are visible from both sides and are clipped at the near plane.

    With the order 'splat', whole splats are blended by the depth of their centres, as 3D Gaussian Splatting
    does. A centre is the mean of the corners of the splat's triangles. At equal depth the splat with the
    higher index is in front, and within a splat the later triangle: as with the painter's algorithm, back to
    front, triangles in list order. Depth groups have no effect. This is faster.

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
    the last call stays on the GPU, until its arrays change.

    Args:
        mesh: the triangles.
        camera: viewpoint, lens and size of the image.
        background: RGB, (3,) or (h, w, 3), in the space of the mesh's colours.
        samples: side of the supersampling grid in each pixel, 1 to 16; 2 means 2 x 2 samples, averaged.
        max_layers: blend at most this many of the nearest triangles at each sample, as depth peeling does
            with that many passes.
        min_transmittance: early termination of samples with less transmittance than this; 0: none.
        depth, median_depth, normals, attributes: further outputs; ``attributes`` names some of
            ``mesh.attributes``. Median depths are the CPU's alone. They are those of one of two surfaces
            where the mean lies between them.
        filter_px2: overrides ``mesh.filter_px2``; 0 draws the triangles as they are.
        cutoff: least opacity that is drawn, as opaque; 0 to 1. None: blended with the opacity.
        order: 'fragment' or 'splat', overrides ``mesh.order``. With a cutoff always 'fragment'.
        threads: at most this many, of the CPU; all processors by default. The result does not depend on it.
        device: 'cpu' or 'gpu'.

    Raises:
        ValueError: an option out of its range, an attribute that the mesh does not have, a filter for a mesh
            without ``face_splat`` or whose splats share vertices, or faces that were changed in place and
            number vertices that there are not.
        MemoryError: the scene does not fit.
        MissingDependencyError: no GPU, or no library for it.
        DeviceError: the GPU failed, or did not finish; this process was forked from one that uses it.
    """
    need(SplatMesh, mesh=mesh, instead={"GaussianCloud": "render_splats draws splats, convert makes a mesh"})
    need(Camera, camera=camera)
    check_device(device)
    check_faces(mesh.faces, len(mesh.vertices))
    camera = camera.with_near_plane(mesh.vertices)
    checked_options(Pointers(), camera, background, samples, threads)
    if max_layers is not None and not (
        isinstance(max_layers, (int, np.integer)) and 1 <= max_layers <= np.iinfo(np.int32).max
    ):
        raise ValueError(f"max_layers must be a whole number from 1 to 2^31 - 1, got {max_layers!r}")
    if not 0 <= min_transmittance < 1:
        raise ValueError(f"min_transmittance must lie in [0, 1), got {min_transmittance}")
    if cutoff is not None:
        cutoff = checked_cutoff(cutoff)
    order = resolved_order(mesh, order, cutoff)
    px2 = mesh.filter_px2 if filter_px2 is None else checked_filter(filter_px2, mesh.face_splat)
    values, widths = None, {}
    attributes = list(each(str, "attributes", attributes))
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
        values = values if values.shape[1] else None

    def named(sums: np.ndarray | None) -> dict[str, np.ndarray]:
        """The attributes by name, of (h, w, c) ``sums`` over all of them."""
        parts = {}
        none = np.zeros((camera.height, camera.width, 0), np.float32)  # attributes without columns alone
        start = 0
        for name, width in widths.items():
            part = none if sums is None else sums[:, :, start : start + width]
            parts[name] = part[:, :, 0] if mesh.attributes[name].ndim == 1 else part
            start += width
        return parts

    options = ImageOptions(
        background,
        int(samples),
        max_layers=int(max_layers or 0),
        min_transmittance=min_transmittance,
        filter_px2=px2,
        order=order,
        cutoff=cutoff,
        depth=depth,
        median_depth=median_depth,
        normals=normals,
        values=values,
    )
    drawn = engine(device, threads).render(mesh, camera, options)
    return Rendering(
        drawn.color,
        drawn.alpha,
        drawn.depth,
        drawn.normals,
        named(drawn.values),
        drawn.fragments,
        drawn.median_depth,
    )


def resolved_order(mesh: SplatMesh, order: Order | None, cutoff: float | None) -> Order:
    """The order in which ``render`` blends: ``order``, else the mesh's; a depth buffer has that of fragments.

    Raises ValueError for 'splat' with a mesh without splats, or asked for with a ``cutoff``.
    """
    if order == "splat" and cutoff is not None:
        raise ValueError(
            "order='splat' blends splats, and a cutoff leaves opaque triangles for a depth buffer: leave out"
            " one of the two"
        )
    if cutoff is not None:
        return "fragment"
    return mesh.order if order is None else checked_order(order, mesh.face_splat)


def render_splats(
    cloud: GaussianCloud,
    camera: Camera,
    *,
    background: Sequence[float] | np.ndarray = (1, 1, 1),
    samples: int = 1,
    sh_degree: int | None = None,
    dilation: float = DILATION,
    threads: int | None = None,
) -> Rendering:
    """The image of the splats themselves, as 3D Gaussian Splatting draws them.

    Splats are projected by their local affine approximation (EWA), widened by ``dilation``, and blended
    whole in the order of their centres' depth. As in 3DGS, the approximation of a splat whose centre is
    outside the image by more than 0.15 of its side is that at this distance, so that a ``Camera.window`` of
    an image may show such splats otherwise than the whole image does. Alpha below 1/255 is skipped and is
    limited to 0.99; a sample terminates before the splat that would leave a transmittance below 1e-4. Every
    sample where a splat's alpha reaches 1/255 is drawn, however far from its centre. The cloud's kernel
    decides the details: '3dgs' as above; 'antialiased' with the opacity lowered by as much as the widening
    adds; '2dgs' flat splats intersected by the ray (no widening; a low-pass filter of variance 5/3
    ``dilation``, so 1/2 px^2).

    Args:
        cloud: the splats.
        camera: viewpoint, lens and size of the image; splats whose centres are nearer than its near plane
            are left out.
        background: RGB, (3,) or (h, w, 3).
        samples: side of the grid of samples in each pixel, 1 to 16; the widening stays that of whole pixels.
        sh_degree: use spherical harmonics up to this degree, 0 to 3; all that are stored by default. Colours
            are clamped to 0 and above, as in 3DGS; those of degree 0 alone are ``cloud.colors``, clamped to
            [0, 1].
        dilation: variance added to the projected covariance, square pixels (gsplat: ``eps2d``). Models that
            were trained with another value need theirs.
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
    need_numbers(dilation=dilation)
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
        dilation=LOW_PASS_PX2["2dgs"] * (dilation / DILATION) if cloud.kernel == "2dgs" else dilation,
    )
    h, w = camera.height, camera.width
    color, alpha = np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32)
    image = structures.ImageStruct(keep(color), keep(alpha))
    library.call("ms_render_splats", splats, camera_struct(camera), options, image)
    return Rendering(color, alpha, fragments=int(image.fragments))
