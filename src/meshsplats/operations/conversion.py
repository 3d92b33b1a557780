"""What is made of one input: a mesh, splats, or either in blocks."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from meshsplats._common.choices import Look
from meshsplats._common.words import plural
from meshsplats._files.atomic import in_words, together
from meshsplats.cameras.framing import unit_up
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.gaps import with_usual_look
from meshsplats.conversion.merging_views import convert_within_limits, simplify_for_views
from meshsplats.conversion.selection import choose_splats
from meshsplats.conversion.streaming import convert_blocks
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.evaluation.comparison import fidelity
from meshsplats.evaluation.viewers import SIDE, VIEWS
from meshsplats.formats.base_meshes import load_vertex_colored
from meshsplats.formats.gaussians import save_gaussian_blocks, save_gaussians
from meshsplats.formats.gltf.reader import listed_order
from meshsplats.formats.mesh_formats import written_mesh_suffixes
from meshsplats.formats.meshes import save_mesh_blocks
from meshsplats.formats.outputs import scaled, splat_options
from meshsplats.formats.scenes import save_scene
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import listed, written_ending
from meshsplats.formats.streaming import SplatStream
from meshsplats.operations.batches import Job
from meshsplats.operations.product import Product
from meshsplats.rendering.ordering import VIEWS as ORDER_VIEWS
from meshsplats.scene.camera import Camera
from meshsplats.scene.draw_order import DrawOrder
from meshsplats.scene.gaussians import GaussianCloud
from meshsplats.scene.mesh import SplatMesh
from meshsplats.viewpoints.beside import cameras_beside, that_see
from meshsplats.viewpoints.showing import default_views

LARGE_BYTES = 1_000_000_000
_FACE_BYTES, _VERTEX_BYTES = 12, 24
"""Of a .glb that is not compressed, about."""


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
    """The camera of the preview of splats from a file, and given cameras; None: ``opening_camera``."""
    tell_of: Callable[[str, int], object] = lambda work, count: None
    """Is told of work on so many splats as it begins."""


@dataclass(frozen=True)
class Converter:
    """Makes the outputs of jobs. Cameras that ``made`` gets are in the world; None: those of each input, if
    it has some."""

    product: Product
    callbacks: ConversionCallbacks
    threads: int | None = None
    """At most this many; None: all processors. The callbacks have theirs."""

    def made(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``. Returns counts, scores and seconds, for JSON."""
        kind, product = identify(job.source), self.product
        if kind == "cameras":
            raise FileFormatError(f"{job.source}: cameras, not splats; convert needs splats or a mesh")
        if kind == "mesh" and product.as_splats:
            raise FileFormatError(_no_splats(job))
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
        seen = seen_from(cameras, job.source, cloud.origin, cloud)
        read = time.perf_counter()
        options = product.conversion
        if product.preset == "default" and not seen and not product.merges:
            options = with_usual_look(cloud, options, threads=self.threads, named=True)
        self.callbacks.tell_of("merging and converting" if product.merges else "converting", len(cloud))
        mesh = convert_within_limits(
            cloud,
            options,
            preset=product.preset,
            cameras=seen,
            up=product.direction,
            source=job.source,
            threads=self.threads,
        )
        mesh = product.files.prepared(mesh, seen, self.threads)
        times = {"read": read - start, "convert": time.perf_counter() - read}
        measured = seen or self._views_of_place(cloud, job)
        opening = self.callbacks.opening(cloud, job.source, seen) if job.preview else None
        return {
            "splats": len(cloud),
            "converted": mesh.splat_count or 0,
            "merged": product.merges,
            "look": (look := product.look if options.look is None else options.look),
            **self._finish(mesh, job, seen, times, opening, measured),
            "fidelity": self._fidelity(cloud, mesh, seen, look),
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
            whole = source.count if product.conversion.crop is None else None
            vertices, triangles, converted = save_mesh_blocks(parts, job.outputs[0], splats=whole)
        return {
            "splats": source.count,
            "converted": converted,
            "merged": False,
            "look": product.look,
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
        self, cloud: GaussianCloud, mesh: SplatMesh, cameras: Sequence[Camera], look: Look
    ) -> dict[str, Any] | None:
        """Scores of the mesh against its splats with this ``look``."""
        if self.product.fidelity is None:
            return None
        if self.product.conversion.crop is not None:
            cloud = choose_splats(cloud, crop=self.product.conversion.crop)
        counted = self.product.fidelity
        return fidelity(cloud, mesh, cameras, counted, look, threads=self.threads)

    def _views_of_place(self, cloud: GaussianCloud, job: Job) -> list[Camera]:
        """Views by which the alpha mode is chosen, or for which the order is solved, where no cameras are
        given: those that are found in a place, which from outside shows the backs of its walls. None for an
        object. With or without a preview, which has the first of them: it must not change the mesh."""
        files = self.product.files
        if not (files.measures(job.outputs) or files.orders(job.outputs)):
            return []
        if self.product.conversion.crop is not None:
            cloud = choose_splats(cloud, crop=self.product.conversion.crop)
        up, side = self.product.direction, (SIDE, SIDE)
        count = ORDER_VIEWS if files.orders(job.outputs) else VIEWS
        found = default_views(cloud, job.source, count, side=side, up=up, threads=self.threads)
        return [] if found is None else found[0]

    def _finish(
        self,
        mesh: SplatMesh,
        job: Job,
        cameras: Sequence[Camera],
        times: dict[str, float],
        opening: Camera | None = None,
        measured: Sequence[Camera] | None = None,
        order: DrawOrder | None = None,
    ) -> dict[str, Any]:
        """Writes ``mesh``, which is prepared, and its preview. Its part of the result; ``times``: of what was
        done before, in seconds; ``measured``: views that the alpha mode or the order is chosen by, by default
        the ``cameras``; ``order``: one that the mesh has already."""
        start, files, threads = time.perf_counter(), self.product.files, self.threads
        views = cameras if measured is None else measured
        choice = None
        if files.compression == "none":
            _warn_of_size(mesh, job.outputs)
        if order is None:
            choice = files.choice(mesh, job.outputs, views, threads)
            order = files.order(mesh, job.outputs, views, threads)
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
        """A mesh in another format, as a .glb in the order of blending that its file has."""
        start = time.perf_counter()
        files = self.product.files
        mesh = files.prepared(self._upright(load_vertex_colored(job.source)))
        order, is_glb = None, job.source.suffix.lower() in (".glb", ".gltf")
        if is_glb and files.measures(job.outputs) and not files.lit and files.compression == "none":
            order = listed_order(job.source, mesh)
        times = {"read": time.perf_counter() - start}
        seen = [camera.relative_to(mesh.origin) for camera in cameras or ()]
        return {**self._finish(mesh, job, seen, times, order=order), "fidelity": None}

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
        seen = seen_from(cameras, job.source, kept.origin, kept)
        if merging and count is not None:
            kept = simplify_for_views(kept, count, seen, up=product.direction, threads=self.threads)
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


def _no_splats(job: Job) -> str:
    """Why the mesh that is the source of ``job`` does not become splats, and what it can become."""
    meshes = listed(written_mesh_suffixes())
    endings = [f".{written_ending(path.name)}" for path in job.outputs]
    if splats := [ending for ending in endings if ending not in written_mesh_suffixes()]:
        why = f"convert writes {listed(tuple(splats), 'and')} of splats only; as a mesh it can be {meshes}"
        if ".usdz" in splats:
            why += "; in Python, save_scene(path, mesh=mesh) writes a mesh as .usdz"
    else:
        why = f"no splats are made of it; without ``as_splats`` it can become {meshes}"
    return f"{job.source}: a mesh, not splats: {why}"


def seen_from(
    cameras: Sequence[Camera] | None, source: Path, origin: np.ndarray, cloud: GaussianCloud | None = None
) -> list[Camera]:
    """``cameras``, which are in the world, relative to ``origin``; None: those ``cameras_beside`` the
    ``source``, if there are any, that see some of ``cloud``, if it is given."""
    if cameras is None:
        beside = cameras_beside(source, origin)
        return (beside if cloud is None else that_see(beside, cloud)) or []
    return [camera.relative_to(origin) for camera in cameras]


def counts_in_words(result: dict[str, Any]) -> str:
    """Sizes before and after, and the scores, of the ``result`` of a conversion to a mesh."""
    vertices = plural(result["vertices"], "vertex", "vertices")
    sizes = f"{plural(result['triangles'], 'triangle')}, {vertices}"
    if "splats" in result:
        share = result["converted"] / result["splats"]
        kept = f", merged into {result['converted']:,} ({share:.1%})"
        if result["converted"] == result["splats"]:
            kept = ""
        elif not result["merged"]:
            kept = f", {result['converted']:,} of them converted ({share:.1%})"
        sizes = f"{plural(result['splats'], 'splat')}{kept} -> {sizes}"
    fidelity = result["fidelity"]
    if fidelity is None:
        return sizes
    psnr = "equal" if fidelity["psnr"] is None else f"{fidelity['psnr']:.2f} dB"
    views = plural(fidelity["views"], "view")
    scores = f"{psnr}, SSIM {fidelity['ssim']:.4f} against the splats"
    return f"{sizes}; {scores}, {views}, look {fidelity['look']}"


def times_in_words(seconds: dict[str, float]) -> str:
    """What took how long."""
    words = {"read": "read", "convert": "converted", "save": "saved", "choose alpha": "chose alpha"}
    words["solve order"] = "solved the order"
    return ", ".join(f"{words[name]} {value:.2f} s" for name, value in seconds.items() if value)


def _warn_of_size(mesh: SplatMesh, outputs: Sequence[Path]) -> None:
    """Warns of a .glb that viewers in browsers will not take: they hold it in memory, more than once."""
    size = _FACE_BYTES * len(mesh.faces) + _VERTEX_BYTES * len(mesh.vertices)
    if size > LARGE_BYTES and any(path.suffix.lower() == ".glb" for path in outputs):
        warnings.warn(
            f"{plural(len(mesh.faces), 'triangle')}: the .glb will have about {in_words(size)}, too large for"
            " viewers in browsers and for most engines. ``max_triangles`` 2000000 merges splats first,"
            " 'meshsplats tiles' keeps them all",
            DataWarning,
            stacklevel=2,
        )
