"""What is made of one input: a mesh, splats, or either in blocks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._files.atomic import together
from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside
from meshsplats.cameras.framing import unit_up
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.merging_views import convert_within_limits, simplify_for_views
from meshsplats.conversion.selection import choose_splats
from meshsplats.conversion.streaming import convert_blocks
from meshsplats.errors import FileFormatError
from meshsplats.evaluation.comparison import fidelity
from meshsplats.formats.base_meshes import load_vertex_colored
from meshsplats.formats.gaussians import save_gaussian_blocks, save_gaussians
from meshsplats.formats.meshes import save_mesh_blocks
from meshsplats.formats.outputs import (
    scaled,
    splat_options,
)
from meshsplats.formats.scenes import save_scene
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending
from meshsplats.formats.streaming import SplatStream
from meshsplats.gaussians import GaussianCloud
from meshsplats.jobs import Job
from meshsplats.mesh import SplatMesh
from meshsplats.product import Product


@dataclass(frozen=True)
class ConversionCallbacks:
    """What a program does for the converter of its files."""

    load: Callable[[Path], GaussianCloud]
    stream: Callable[[Path], SplatStream]
    """Splats in blocks, relative to the origin that the result shall have."""
    place: Callable[[Any], Any]
    """Makes of a scene the one that is written."""
    record: Callable[[Job], None]
    """Writes what is noted beside the outputs, with which it appears."""
    preview: Callable[..., None]
    """Draws a scene to a file, from a camera or None."""
    opening: Callable[[GaussianCloud, Path, Sequence[Camera] | None], Camera | None]
    """The camera of the preview of splats from a file, and given cameras; None: one in front."""


@dataclass(frozen=True)
class Converter:
    """Makes the outputs of jobs. Cameras that ``made`` gets are in the world; None: those of each input, if
    it has some."""

    product: Product
    callbacks: ConversionCallbacks

    def made(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``. Returns counts, scores and seconds, for JSON."""
        kind, product = identify(job.source), self.product
        if kind == "cameras" or (kind == "mesh" and product.as_splats):
            raise FileFormatError(f"{job.source}: not splats; convert needs splats or a mesh")
        if product.stream and kind == "mesh":
            raise FileFormatError(f"{job.source}: a mesh; ``stream`` is for splats")
        if product.stream:
            return self._splats_in_blocks(job) if product.as_splats else self._mesh_in_blocks(job, cameras)
        if product.as_splats:
            return self._splats(job, cameras)
        return self._mesh_again(job, cameras) if kind == "mesh" else self._mesh(job, cameras)

    @contextmanager
    def _recorded(self, job: Job) -> Iterator[None]:
        """The files that are written within the block appear together with their records: a mesh without one
        cannot be told from a stranger's. The preview, which takes longer, comes later."""
        with together():
            self.callbacks.record(job)
            yield

    def _mesh(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        product, start = self.product, time.perf_counter()
        cloud = self.callbacks.load(job.source)
        seen = seen_from(cameras, job.source, cloud.origin)
        read = time.perf_counter()
        mesh = convert_within_limits(
            cloud,
            product.conversion,
            preset=product.preset,
            cameras=seen,
            up=product.direction,
            source=job.source,
        )
        mesh = product.files.prepared(mesh, seen)
        times = {"read": read - start, "convert": time.perf_counter() - read}
        opening = self.callbacks.opening(cloud, job.source, seen) if job.preview else None
        return {
            "splats": len(cloud),
            "converted": mesh.splat_count or 0,
            "merged": product.merges,
            **self._finish(mesh, job, seen, times, opening),
            "fidelity": self._fidelity(cloud, mesh, seen),
        }

    def _mesh_in_blocks(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        product, start = self.product, time.perf_counter()
        source = self.callbacks.stream(job.source)
        seen = seen_from(cameras, job.source, source.origin)
        blocks = convert_blocks(
            source, product.conversion, preset=product.preset, cameras=seen, up=product.direction
        )
        parts = (part if product.origin == "keep" else replace(part, origin=np.zeros(3)) for part in blocks)
        with self._recorded(job):
            vertices, triangles, converted = save_mesh_blocks(parts, job.outputs[0])
        return {
            "splats": source.count,
            "converted": converted,
            "merged": False,
            "triangles": triangles,
            "vertices": vertices,
            "seconds": {"convert": round(time.perf_counter() - start, 4)},
            "fidelity": None,
        }

    def _splats_in_blocks(self, job: Job) -> dict[str, Any]:
        start = time.perf_counter()
        source = self.callbacks.stream(job.source)
        options, count, degree, kernels = self.product.conversion, 0, 0, set()
        for block in source:
            count += len(worth_drawing(block, options))
            degree = max(degree, block.sh_degree)
            kernels.add(block.kernel)
        if not count:
            raise ValueError(f"{job.source}: none of the {source.count:,} splats is left")
        kernel = kernels.pop() if len(kernels) == 1 else "3dgs"
        up = source.up if self.product.direction is None else unit_up(self.product.direction)
        origin = source.origin if self.product.origin == "keep" else np.zeros(3)
        kept = (replace(block.take(worth_drawing(block, options)), origin=origin) for block in source)
        with self._recorded(job):
            save_gaussian_blocks(kept, job.outputs[0], count, degree=degree, kernel=kernel, up=up)
        seconds = round(time.perf_counter() - start, 4)
        return {"read": source.count, "written": count, "seconds": seconds}

    def _fidelity(
        self, cloud: GaussianCloud, mesh: SplatMesh, cameras: Sequence[Camera]
    ) -> dict[str, Any] | None:
        """Scores of the mesh against its splats."""
        if self.product.fidelity is None:
            return None
        if self.product.conversion.crop is not None:
            cloud = choose_splats(cloud, crop=self.product.conversion.crop)
        return fidelity(cloud, mesh, cameras, self.product.fidelity, self.product.look)

    def _finish(
        self,
        mesh: SplatMesh,
        job: Job,
        cameras: Sequence[Camera],
        times: dict[str, float],
        opening: Camera | None = None,
    ) -> dict[str, Any]:
        """Writes ``mesh``, which is prepared, and its preview. Its part of the result; ``times``: of what was
        done before, in seconds."""
        start, files = time.perf_counter(), self.product.files
        choice = files.choice(mesh, job.outputs, cameras)
        order = files.order(mesh, job.outputs, cameras)
        chosen = time.perf_counter()
        placed = self.callbacks.place(scaled(mesh, self.product.scale))
        with self._recorded(job):
            files.save(placed, job.outputs, choice, order)
        comparing = "choose alpha" if order is None else "solve order"
        times |= {comparing: chosen - start, "save": time.perf_counter() - chosen}
        if job.preview:
            self.callbacks.preview(mesh, job.preview, opening)
        return {
            "triangles": len(mesh.faces),
            "vertices": len(mesh.vertices),
            "alpha": None if choice is None else asdict(choice),
            "seconds": {name: round(value, 4) for name, value in times.items()},
        }

    def _mesh_again(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        """A mesh in another format."""
        start = time.perf_counter()
        mesh = self.product.files.prepared(self._upright(load_vertex_colored(job.source)))
        times = {"read": time.perf_counter() - start}
        seen = [camera.relative_to(mesh.origin) for camera in cameras or ()]
        return {**self._finish(mesh, job, seen, times), "fidelity": None}

    def _splats(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        start, product = time.perf_counter(), self.product
        cloud = self._upright(self.callbacks.load(job.source))
        options = product.conversion
        merging, count = options.budget != "drop", options.max_splats
        kept = choose_splats(
            cloud,
            crop=options.crop,
            min_opacity=options.min_opacity,
            max_splats=None if merging else count,
        )
        seen = seen_from(cameras, job.source, kept.origin)
        if merging and count is not None:
            kept = simplify_for_views(kept, count, seen, up=product.direction)
        result = self.callbacks.place(scaled(kept, product.scale))
        with self._recorded(job):
            kinds = [written_ending(path.name) for path in job.outputs]
            taken = splat_options(kinds, spz_version=product.spz_version, linear=product.linear)
            for path, own in zip(job.outputs, taken, strict=True):
                if product.with_mesh is None and product.collider is None:
                    save_gaussians(result, path, **own)
                else:
                    mesh, collider = self._part(product.with_mesh), self._part(product.collider)
                    save_scene(path, splats=result, mesh=mesh, collider=collider)
        seconds = time.perf_counter() - start
        if job.preview:
            self.callbacks.preview(kept, job.preview, self.callbacks.opening(cloud, job.source, seen))
        return {"read": len(cloud), "written": len(kept), "seconds": round(seconds, 4)}

    def _part(self, path: Path | None) -> SplatMesh | None:
        """A mesh to write beside the splats, as they are."""
        if path is None:
            return None
        part: SplatMesh = self.callbacks.place(
            scaled(self._upright(load_vertex_colored(path)), self.product.scale)
        )
        return part

    def _upright(self, scene: Any) -> Any:
        return scene if self.product.direction is None else replace(scene, up=unit_up(self.product.direction))


def seen_from(cameras: Sequence[Camera] | None, source: Path, origin: np.ndarray) -> list[Camera]:
    """``cameras``, which are in the world, relative to ``origin``; None: those of the model folder
    ``source``, if it is one."""
    if cameras is None:
        return cameras_beside(source, origin) or []
    return [camera.relative_to(origin) for camera in cameras]
