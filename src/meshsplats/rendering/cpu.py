"""The engine of the processor: the compiled core."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from meshsplats._core import library, structures
from meshsplats.rendering.backward import TAPE_BYTES, TapedRendering, TapeOptions
from meshsplats.rendering.core_arguments import Pointers, camera_struct, checked_options, mesh_struct
from meshsplats.rendering.engine import Drawn, ImageOptions, Need
from meshsplats.rendering.shading import shaded
from meshsplats.scene.camera import Camera
from meshsplats.scene.mesh import SplatMesh, Triangles


@dataclass(frozen=True)
class CpuEngine:
    """Draws with at most ``threads``; None: all processors. It can do everything, and keeps nothing."""

    threads: int | None = None

    def check(self, needs: Collection[Need] = (), mesh: SplatMesh | None = None) -> None:
        """Nothing is missing."""

    def render(self, mesh: SplatMesh, camera: Camera, options: ImageOptions) -> Drawn:
        keep = Pointers()
        wanted = checked_options(keep, camera, options.background, options.samples, self.threads)
        wanted.max_layers, wanted.min_transmittance = options.max_layers, options.min_transmittance
        if options.cutoff is not None:
            wanted.cutoff = options.cutoff
        triangles = shaded(mesh.triangles, camera, threads=self.threads)._replace(
            values=options.values, filter_px2=options.filter_px2, order=options.order
        )
        h, w = camera.height, camera.width
        width = 0 if options.values is None else options.values.shape[1]
        drawn = Drawn(
            np.empty((h, w, 3), np.float32),
            np.empty((h, w), np.float32),
            np.empty((h, w), np.float32) if options.depth else None,
            np.empty((h, w, 3), np.float32) if options.normals else None,
            np.empty((h, w, width), np.float32) if width else None,
            np.empty((h, w), np.float32) if options.median_depth else None,
            0,
        )
        image = structures.ImageStruct(*map(keep, drawn[:6]), 0)
        library.call("ms_render_mesh", mesh_struct(keep, triangles), camera_struct(camera), wanted, image)
        return drawn._replace(fragments=int(image.fragments))

    def tape(
        self,
        triangles: Triangles,
        camera: Camera,
        options: TapeOptions | None = None,
        *,
        tape_bytes: int | None = TAPE_BYTES,
    ) -> TapedRendering:
        return TapedRendering(triangles, camera, options, threads=self.threads, tape_bytes=tape_bytes)

    def session(self, mesh: SplatMesh) -> CpuSession:
        return CpuSession(self)


@dataclass(frozen=True)
class CpuSession:
    """A run on the processor, whose steps are all its own."""

    engine: CpuEngine

    def tape(self, triangles: Triangles, camera: Camera, options: TapeOptions) -> TapedRendering:
        return self.engine.tape(triangles, camera, options)

    def fused_steps(self, camera: Camera, needs: Collection[Need]) -> None:
        return None

    def release(self) -> None:
        """Nothing depends on the arrays."""

    def arrays(self) -> dict[str, np.ndarray]:
        return {}

    def resume(self, arrays: dict[str, np.ndarray]) -> None:
        """Nothing is kept."""
