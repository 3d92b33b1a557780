"""What draws meshes: images, images with a backward pass, and steps of an optimisation.

An engine draws on one device and owns what it keeps there. ``cpu.py`` is the compiled core, ``gpu.py``
WebGPU; ``devices.engine`` gives that of a device. Nothing above them asks which one it has.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol, get_args

import numpy as np

from meshsplats._common.choices import Device
from meshsplats.rendering.backward import TAPE_BYTES, ExpectedError, TapeOptions
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import MIN_TRANSMITTANCE, SplatMesh, Triangles
from meshsplats.scene.order import Order
from meshsplats.webgpu.training import Parameters, Rates, Sums

Need = Literal[
    "cutoff",
    "base mesh",
    "exposure",
    "linear light",
    "frozen",
    "depth groups",
    "loss",
    "file order",
    "dropout",
]
"""What a run may ask of steps beyond positions and colours that follow the default loss: gradients for a
cutoff; positions on a base mesh; exposures of images; blending in linear light; opacities that decay; fans
that are rounded between steps; frozen vertices; triangles that share a depth; a custom loss; view-dependent
colours; the order of a file; splats that a step leaves out."""


def check_device(device: str) -> None:
    """ValueError for a device that does not exist."""
    if device not in get_args(Device):
        raise ValueError(f"device must be {' or '.join(map(repr, get_args(Device)))}, got {device!r}")


@dataclass(frozen=True, eq=False)
class ImageOptions:
    """Options of an image, checked; as in ``render``."""

    background: Sequence[float] | np.ndarray = (1, 1, 1)
    samples: int = 1
    max_layers: int = 0
    """0: all."""
    min_transmittance: float = MIN_TRANSMITTANCE
    filter_px2: float = 0.0
    order: Order = "fragment"
    cutoff: float | None = None
    depth: bool = False
    median_depth: bool = False
    normals: bool = False
    values: np.ndarray | None = None
    """(v, k) float32 further values of the vertices to blend."""


class Drawn(NamedTuple):
    """An image, float32."""

    color: np.ndarray
    """(h, w, 3) RGB over the background."""
    alpha: np.ndarray
    """(h, w)."""
    depth: np.ndarray | None
    """(h, w)."""
    normals: np.ndarray | None
    """(h, w, 3)."""
    values: np.ndarray | None
    """(h, w, k)."""
    median_depth: np.ndarray | None
    """(h, w)."""
    fragments: int


class Taped(Protocol):
    """An image with a backward pass; see ``backward.TapedRendering``."""

    color: np.ndarray
    """(h, w, 3) float32 RGB over the background."""
    alpha: np.ndarray
    """(h, w) float32."""
    attributes: np.ndarray
    """(h, w, k) float32: the further values of the triangles."""
    fragments: int

    @property
    def vertex_count(self) -> int: ...

    def backward(
        self,
        color: np.ndarray,
        alpha: np.ndarray | None,
        attributes: np.ndarray | None,
        *,
        vertices: np.ndarray,
        colors: np.ndarray,
        vertex_attributes: np.ndarray | None = None,
        harmonics: np.ndarray | None = None,
        expected: ExpectedError | None = None,
    ) -> None:
        """Adds vertex gradients to the arrays given; see ``backward.TapedRendering.backward``."""


class FusedSteps(Protocol):
    """Steps whose loss and optimiser run where the images are drawn."""

    def step(
        self,
        now: Parameters,
        camera: Camera,
        options: TapeOptions,
        target: np.ndarray,
        mask: np.ndarray | None,
        rates: Rates,
    ) -> Sums:
        """Draws the mesh, compares it with a target, and takes a step of Adam.

        Args:
            now: the arrays of the run; read by the first step after they have changed.
            camera, options: of the image.
            target: (h, w, 3) float32 RGB.
            mask: (h, w) bool, True where pixels count; None: all do.
            rates: of the loss and of Adam.

        Returns:
            The sums. If they or the gradients are not finite, nothing has changed.
        """

    def round_fans(self, corners: int, share: float) -> None:
        """``kernels.round_fans`` on the vertices as the last step left them, all of them in fans of so many
        ``corners``."""

    def fetch(self, into: Parameters) -> None:
        """Brings the arrays of the run up to the steps that were taken."""


class Session(Protocol):
    """The images and steps of one run."""

    def tape(self, triangles: Triangles, camera: Camera, options: TapeOptions) -> Taped:
        """``Engine.tape``, in windows that a resumed run has, too."""

    def fused_steps(self, camera: Camera, needs: Collection[Need]) -> FusedSteps | None:
        """What takes steps with images of this camera for a run that ``needs`` these; None: the run does it,
        with images and gradients from here."""

    def release(self) -> None:
        """To be called before the run changes its arrays, into which fused steps were fetched."""

    def arrays(self) -> dict[str, np.ndarray]:
        """What a checkpoint keeps."""

    def resume(self, arrays: dict[str, np.ndarray]) -> None:
        """Goes on from the arrays of a checkpoint. ValueError if they are broken."""


class Engine(Protocol):
    """What draws on one device."""

    def check(self, needs: Collection[Need] = (), mesh: SplatMesh | None = None) -> None:
        """Checks that the device is there, and can do what a run ``needs``, with ``mesh``.

        Raises:
            ValueError: it cannot do it; with a filter, two splats of ``mesh`` share a vertex.
            MissingDependencyError: there is no such device, or no library for it.
            DeviceError: the device refuses; a splat or a vertex of ``mesh`` has too many triangles.
            MemoryError: ``mesh`` does not fit.
        """

    def render(self, mesh: SplatMesh, camera: Camera, options: ImageOptions) -> Drawn:
        """The image of ``render``, from a camera with a near plane."""

    def tape(
        self,
        triangles: Triangles,
        camera: Camera,
        options: TapeOptions | None = None,
        *,
        tape_bytes: int | None = TAPE_BYTES,
    ) -> Taped:
        """The image of a mesh, with a backward pass; arguments are those of ``backward.TapedRendering``."""

    def session(self, mesh: SplatMesh) -> Session:
        """The session of a run with these triangles."""


def scatter_to_vertices(image: Taped, values: np.ndarray) -> np.ndarray:
    """(v, k) float32: for each vertex the sum of ``values`` (h, w, k) over the pixels, with the weights by
    which the vertex is blended into them.

    For an ``image`` with k further values, whose own size does not matter: a weight is the derivative of a
    pixel's value with respect to the vertex's.
    """
    count, width = image.vertex_count, image.attributes.shape[2]
    sums = np.zeros((count, width), np.float32)
    image.backward(
        np.zeros_like(image.color),
        None,
        np.ascontiguousarray(values, np.float32),
        vertices=np.zeros((count, 3), np.float32),
        colors=np.zeros((count, 4), np.float32),
        vertex_attributes=sums,
    )
    return sums


def visible_pixels(engine: Engine, triangles: Triangles, camera: Camera) -> np.ndarray:
    """(v,) float32 visible pixels of each vertex: sums of its blending weights over the image."""
    blank = np.zeros((len(triangles.vertices), 1), np.float32)
    image = engine.tape(triangles._replace(values=blank), camera)
    return scatter_to_vertices(image, np.ones_like(image.attributes))[:, 0]
