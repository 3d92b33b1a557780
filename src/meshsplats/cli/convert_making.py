"""What ``convert`` makes of one input: a mesh, splats, or either in blocks."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from meshsplats._files.atomic import together
from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside
from meshsplats.cameras.framing import unit_up
from meshsplats.cli.arguments import spelled
from meshsplats.cli.common import alpha_record, draw_preview, parse_up, say_origin, written
from meshsplats.cli.convert_options import ConvertCommand
from meshsplats.cli.images import views_of_a_place
from meshsplats.cli.messages import UsageError
from meshsplats.cli.records import write_configuration
from meshsplats.conversion import convert, simplify
from meshsplats.conversion.selection import choose_splats
from meshsplats.errors import FileFormatError
from meshsplats.formats.meshes import load_mesh
from meshsplats.formats.outputs import scaled, splat_options
from meshsplats.formats.scenes import save_scene
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending
from meshsplats.gaussians import GaussianCloud
from meshsplats.jobs import Job
from meshsplats.mesh import SplatMesh

if TYPE_CHECKING:
    from meshsplats.formats.streaming import SplatStream


class Making:
    """Makes the outputs of jobs with the options of a command. ``cameras`` are in the world; None: those of
    each input, if it has some."""

    def __init__(self, asked: ConvertCommand) -> None:
        self.asked = asked

    def made(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``."""
        kind = identify(job.source)
        if kind == "cameras" or (kind == "mesh" and self.asked.as_splats):
            raise FileFormatError(f"{job.source}: not splats; convert needs splats or a mesh")
        if self.asked.stream and kind == "mesh":
            raise FileFormatError(f"{job.source}: a mesh; --stream is for splats")
        if self.asked.stream:
            return self._stream_splats(job) if self.asked.as_splats else self._stream_mesh(job, cameras)
        if self.asked.as_splats:
            return self._save_splats(job, cameras)
        return self._save_again(job, cameras) if kind == "mesh" else self._save_mesh(job, cameras)

    @contextmanager
    def _recorded(self, job: Job) -> Iterator[None]:
        """The files that are written within the block appear together with their configurations: a mesh
        without one cannot be told from a stranger's. The preview, which takes longer, comes later."""
        with together():
            for path, config in zip(job.outputs, job.configs, strict=False):
                write_configuration(config, "convert", self.asked.alone(job, path))
            yield

    def _save_mesh(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats of ``job`` as a mesh."""
        if self.asked.alpha == "hybrid":
            raise UsageError(
                f"{job.shown} holds splats: --alpha hybrid is for a mesh with solid triangles, as finetune"
                " --opacity cutoff --soft-share makes"
            )
        start = time.perf_counter()
        cloud = self.asked.reading.load(job.source, up=self.asked.up)
        cameras = seen_from(cameras, job.source, cloud.origin)
        read = time.perf_counter()
        up = None if self.asked.up is None else parse_up(self.asked.up)
        mesh = convert(cloud, self.asked.conversion, preset=self.asked.preset, cameras=cameras, up=up)
        mesh = self.asked.files.prepared(mesh, cameras)
        times = {"read": read - start, "convert": time.perf_counter() - read}
        return {
            "splats": len(cloud),
            "converted": mesh.splat_count or 0,
            "merged": self.asked.merges(),
            **self._finish(mesh, job, cameras, times, self._opening(cloud, cameras, job, up)),
            "fidelity": self._fidelity(cloud, mesh, cameras),
        }

    def _opening(
        self, cloud: GaussianCloud, cameras: Sequence[Camera], job: Job, up: np.ndarray | None
    ) -> Camera | None:
        """The camera of the preview of a place, from which the splats look right; None: one in front."""
        found = views_of_a_place(cloud, job.source, 1, up=up, given=cameras or None) if job.preview else None
        return found[0] if found else None

    def _stream_mesh(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats of ``job`` as a mesh, in blocks."""
        from meshsplats.conversion.streaming import convert_blocks
        from meshsplats.formats.meshes import save_mesh_blocks

        start = time.perf_counter()
        source = self._opened(job)
        cameras = seen_from(cameras, job.source, source.origin)
        up = None if self.asked.up is None else parse_up(self.asked.up)
        blocks = convert_blocks(
            source, self.asked.conversion, preset=self.asked.preset, cameras=cameras, up=up
        )
        kept = self.asked.origin == "keep"
        parts = (part if kept else replace(part, origin=np.zeros(3)) for part in blocks)
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

    def _stream_splats(self, job: Job) -> dict[str, Any]:
        """The splats of ``job`` as a .ply, in blocks."""
        from meshsplats.conversion.driver import worth_drawing
        from meshsplats.formats.gaussians import save_gaussian_blocks

        start = time.perf_counter()
        source = self._opened(job)
        options, count, degree, kernels = self.asked.conversion, 0, 0, set()
        for block in source:
            count += len(worth_drawing(block, options))
            degree = max(degree, block.sh_degree)
            kernels.add(block.kernel)
        if not count:
            raise ValueError(f"{job.source}: none of the {source.count:,} splats is left")
        kernel = kernels.pop() if len(kernels) == 1 else "3dgs"
        up = source.up if self.asked.up is None else unit_up(parse_up(self.asked.up))
        origin = source.origin if self.asked.origin == "keep" else np.zeros(3)
        kept = (replace(block.take(worth_drawing(block, options)), origin=origin) for block in source)
        with self._recorded(job):
            save_gaussian_blocks(kept, job.outputs[0], count, degree=degree, kernel=kernel, up=up)
        seconds = round(time.perf_counter() - start, 4)
        return {"read": source.count, "written": count, "seconds": seconds}

    def _opened(self, job: Job) -> SplatStream:
        """The splats of ``job`` in blocks, relative to the origin that is asked for."""
        given = None if isinstance(self.asked.origin, str) else self.asked.origin
        source = self.asked.reading.stream(job.source, given, up=self.asked.up)
        say_origin(source.origin, self.asked.origin, splats=self.asked.as_splats)
        return source

    def _fidelity(
        self, cloud: GaussianCloud, mesh: SplatMesh, cameras: Sequence[Camera]
    ) -> dict[str, Any] | None:
        """Scores of the mesh against its splats."""
        if self.asked.fidelity is None:
            return None
        from meshsplats.evaluation.comparison import fidelity

        if self.asked.conversion.crop is not None:
            cloud = choose_splats(cloud, crop=self.asked.conversion.crop)
        return fidelity(cloud, mesh, cameras, self.asked.fidelity, self.asked.look_of_result)

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
        start = time.perf_counter()
        choice = self.asked.files.choice(mesh, job.outputs, cameras)
        order = self.asked.files.order(mesh, job.outputs, cameras)
        chosen = time.perf_counter()
        placed = written(scaled(mesh, self.asked.scale), self.asked.origin)
        with self._recorded(job):
            self.asked.files.save(placed, job.outputs, choice, order)
        comparing = "choose alpha" if order is None else "solve order"
        times |= {comparing: chosen - start, "save": time.perf_counter() - chosen}
        if job.preview:
            draw_preview(mesh, job.preview, opening)
        return {
            "triangles": len(mesh.faces),
            "vertices": len(mesh.vertices),
            "alpha": alpha_record(choice),
            "seconds": {name: round(value, 4) for name, value in times.items()},
        }

    def _save_again(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The mesh of ``job`` in another format."""
        views = () if self.asked.alpha == "ordered" else ("cameras", "data")
        idle = [name for name in (*views, "fidelity") if getattr(self.asked, name) is not None]
        idle += ["preset"] if self.asked.preset != "default" else []
        idle += [name for name, value in asdict(self.asked.conversion).items() if value is not None]
        if idle:
            flags = ", ".join(spelled(type(self.asked), name) for name in idle)
            raise UsageError(f"{job.shown} is a mesh: {flags} would have no effect, as they are for splats")
        self.asked.reading.refuse_for(job.source)
        start = time.perf_counter()
        mesh = load_mesh(job.source)
        if self.asked.up is not None:
            mesh = replace(mesh, up=unit_up(parse_up(self.asked.up)))
        mesh = self.asked.files.prepared(mesh)
        times = {"read": time.perf_counter() - start}
        seen = [camera.relative_to(mesh.origin) for camera in cameras or ()]
        return {**self._finish(mesh, job, seen, times), "fidelity": None}

    def _save_splats(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats themselves."""
        from meshsplats.formats.gaussians import save_gaussians

        start = time.perf_counter()
        cloud = self.asked.reading.load(job.source, up=self.asked.up)
        if self.asked.up is not None:
            cloud = replace(cloud, up=unit_up(parse_up(self.asked.up)))
        options = self.asked.conversion
        merging, count = options.budget != "drop", options.max_splats
        kept = choose_splats(
            cloud,
            crop=options.crop,
            min_opacity=options.min_opacity,
            max_splats=None if merging else count,
        )
        if merging and count is not None:
            seen = seen_from(cameras, job.source, kept.origin)
            kept = simplify(kept, count, cameras=seen or None)
        result = written(scaled(kept, self.asked.scale), self.asked.origin)
        with self._recorded(job):
            kinds = [written_ending(path.name) for path in job.outputs]
            taken = splat_options(kinds, spz_version=self.asked.spz_version, linear=self.asked.linear)
            for path, own in zip(job.outputs, taken, strict=True):
                if self.asked.with_mesh is None and self.asked.collider is None:
                    save_gaussians(result, path, **own)
                else:
                    mesh, collider = self._part(self.asked.with_mesh), self._part(self.asked.collider)
                    save_scene(path, splats=result, mesh=mesh, collider=collider)
        seconds = time.perf_counter() - start
        if job.preview:
            draw_preview(kept, job.preview)
        return {"read": len(cloud), "written": len(kept), "seconds": round(seconds, 4)}

    def _part(self, path: Path | None) -> SplatMesh | None:
        """A mesh to write beside the splats, as they are."""
        if path is None:
            return None
        mesh = load_mesh(path)
        if self.asked.up is not None:
            mesh = replace(mesh, up=unit_up(parse_up(self.asked.up)))
        return written(scaled(mesh, self.asked.scale), self.asked.origin)


def seen_from(cameras: list[Camera] | None, source: Path, origin: np.ndarray) -> list[Camera]:
    """``cameras``, which are in the world, relative to ``origin``; None: those of the model folder
    ``source``, if it is one."""
    if cameras is None:
        return cameras_beside(source, origin) or []
    return [camera.relative_to(origin) for camera in cameras]
