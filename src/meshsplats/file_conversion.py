"""What is made of one input: a mesh, splats, or either in blocks."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from meshsplats._files.atomic import together
from meshsplats._options import Advanced, changed, check_options
from meshsplats._words import optional_up
from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside
from meshsplats.cameras.framing import unit_up
from meshsplats.conversion import ConversionOptions, convert, simplify
from meshsplats.conversion.driver import worth_drawing
from meshsplats.conversion.options import Preset
from meshsplats.conversion.selection import choose_splats
from meshsplats.conversion.streaming import convert_blocks, refuse_whole
from meshsplats.datasets.scene_files import SceneReading
from meshsplats.datasets.scene_views import MissingOfData, cameras_named, check_photographs
from meshsplats.errors import FileFormatError, OptionsError, OptionValueError
from meshsplats.evaluation.comparison import fidelity
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.formats.gaussians import save_gaussian_blocks, save_gaussians
from meshsplats.formats.meshes import load_mesh, save_mesh_blocks
from meshsplats.formats.outputs import (
    WantedOrigin,
    check_origin,
    check_outputs,
    check_splat_endings,
    scaled,
    splat_options,
)
from meshsplats.formats.scenes import SUFFIXES, save_scene
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending
from meshsplats.formats.streaming import SplatStream
from meshsplats.gaussians import GaussianCloud
from meshsplats.jobs import Job, sources
from meshsplats.mesh import SplatMesh
from meshsplats.rendering.looks import Look

_SELECTION = ("crop", "min_opacity", "max_splats", "budget")
"""Options of the conversion that select splats: they have an effect on splats, too."""
_OF_SPLATS = (
    *("cameras", "data", "up", "scale", "files", "as_splats", "spz_version", "linear", "with_mesh"),
    *("collider", "stream", "origin", "no_preview", "no_sidecar", "conversion"),
)
"""Options of a product that have one."""


@dataclass(frozen=True)
class Product:
    """What is made of each input."""

    preset: Preset = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    cameras: Path | None = None
    """Cameras that the mesh will be seen from: a JSON list, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input if it is a model folder, else none."""
    data: Path | None = None
    """Data set of photographs, in place of ``cameras``: the cameras of its training views."""
    missing: MissingOfData = "few"
    up: str | None = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, of the
    file, else -y."""
    scale: float | None = None
    """Factor for all lengths of the result, of meshes and splats: metres in an output unit, say."""
    files: MeshFileOptions = field(default_factory=MeshFileOptions)
    as_splats: bool = False
    """Write splats, not a mesh, as .ply, .glb or .usdc, too: all of them, or those that ``crop``,
    ``max_splats`` and min_opacity leave."""
    spz_version: Annotated[Literal[3, 4] | None, Advanced] = None
    """.spz: version. 4 is read by newer programs only. Default: 3."""
    linear: Annotated[bool | None, Advanced] = None
    """Splats as .usdc, .usda, .usdz: linear colours, for renderers that take all colours so."""
    with_mesh: Path | None = None
    """Splats as .glb or USD: a mesh to put into the file, too, such as one converted of them."""
    collider: Path | None = None
    """Splats as .glb or USD: a mesh that physics engines collide with and nobody draws, in the file."""
    fidelity: int | None = None
    """Compare the mesh with its splats in N views, of the cameras or around it, and print PSNR and SSIM."""
    stream: bool = False
    """Convert in blocks, so that memory does not grow with the file: into a .ply mesh, or with ``as_splats``
    into a .ply of splats, without a preview. The result is the same."""
    origin: WantedOrigin = "keep"  # as of outputs.placed
    no_preview: bool = False
    """Write no preview."""
    no_sidecar: bool = False
    """Write neither preview nor configuration."""
    conversion: ConversionOptions = field(default_factory=ConversionOptions)

    @property
    def merges(self) -> bool:
        """Whether splats are merged to keep a limit."""
        limits = (self.conversion.max_splats, self.conversion.max_triangles)
        return self.conversion.budget != "drop" and any(limit is not None for limit in limits)

    @property
    def look(self) -> Look:
        """The look that the conversion is for."""
        return "splats" if self.conversion.footprint == "filter" else self.conversion.look or "area"

    @property
    def direction(self) -> np.ndarray | None:
        """(3,) ``up``; None where it is not given."""
        return optional_up(self.up)

    def seen_by(self) -> list[Camera] | None:
        """The cameras of the options, in the world; None: each input may have its own."""
        return cameras_named(self.cameras, self.data, self.missing)

    def resolved(self, inputs: Sequence[Path]) -> ConversionOptions:
        """The options of the conversion that the preset leads to, checked."""
        beside = any((path / "cameras.json").is_file() for path in inputs if path.is_dir())
        has_cameras = bool(self.cameras or self.data) or beside
        return self.conversion.resolved(self.preset, has_cameras=has_cameras)

    def taken_by(self, path: Path) -> Product:
        """Those options that have an effect on the file ``path``; the others as by default."""
        return replace(self, files=self.files.taken_by(path))

    def check(self, kinds: Sequence[str], inputs: Sequence[Path], output: Path) -> None:
        """Checks options before the work. ``kinds``: suffixes of the results, without a dot, which are
        ``output`` or in it.

        Raises:
            OptionsError: options contradict each other or have no effect.
            ValueError: one is out of range.
            OverwritingError: ``output`` is a mesh that goes into it.
        """
        if self.fidelity is not None and self.fidelity < 1:
            raise OptionValueError(f"``fidelity`` must be a number of views, at least 1, got {self.fidelity}")
        if self.scale is not None and not 0 < self.scale < float("inf"):
            raise OptionValueError(f"``scale`` must be a number above 0, got {self.scale}")
        check_options(self)
        check_origin(self.origin)
        optional_up(self.up)
        if self.stream:
            self._check_stream(kinds, inputs)
        if self.as_splats:
            self._check_splats(kinds, output)
            return
        if self.with_mesh is not None or self.collider is not None:
            raise OptionsError("``with_mesh`` and ``collider`` go beside splats: ``as_splats``")
        if self.spz_version is not None or self.linear is not None:
            raise OptionsError("``spz_version`` and linear are for splats: ``as_splats``")
        self.files.check(kinds)
        check_photographs(self.data, self.missing, self.cameras)
        self.resolved(sources(inputs))

    def _check_splats(self, kinds: Sequence[str], output: Path) -> None:
        check_splat_endings(*kinds)
        splat_options(kinds, spz_version=self.spz_version, linear=self.linear)
        if meshes := [path for path in (self.with_mesh, self.collider) if path is not None]:
            if not all(f".{kind}" in SUFFIXES for kind in kinds) or self.linear is not None:
                raise OptionsError(
                    "``with_mesh`` and ``collider`` are for .glb and USD, with display colours"
                )
            check_outputs([output], True, inputs=meshes)
        idle = [name for name in (*changed(self), *changed(self.files)) if name not in _OF_SPLATS]
        if self.conversion.budget == "drop" or self.conversion.max_splats is None:
            idle += [name for name in ("cameras", "data") if getattr(self, name) is not None]
        explicit = asdict(self.conversion).items()
        idle += [name for name, value in explicit if value is not None and name not in _SELECTION]
        if idle:
            names = ", ".join(f"``{name}``" for name in idle)
            raise OptionsError(f"{names}: for a mesh, no effect with ``as_splats``")
        self.conversion.resolved("paper", has_cameras=False)

    def check_kind(self, job: Job, reading: SceneReading) -> None:
        """OptionsError for options that have no effect on the input of ``job``, which is to be a mesh."""
        kind = identify(job.source)
        if kind == "splats" and self.files.alpha == "hybrid":
            raise OptionsError(
                f"{job.shown} holds splats: ``alpha`` hybrid is for a mesh with solid triangles, as finetune"
                " --opacity cutoff --soft-share makes"
            )
        if kind != "mesh":
            return
        views = () if self.files.alpha == "ordered" else ("cameras", "data")
        idle = [name for name in (*views, "fidelity") if getattr(self, name) is not None]
        idle += ["preset"] if self.preset != "default" else []
        idle += [name for name, value in asdict(self.conversion).items() if value is not None]
        if idle:
            names = ", ".join(f"``{name}``" for name in idle)
            raise OptionsError(f"{job.shown} is a mesh: {names} would have no effect, as they are for splats")
        reading.refuse_for(job.source)

    def _check_stream(self, kinds: Sequence[str], inputs: Sequence[Path]) -> None:
        """OptionsError or ValueError for what needs the whole scene in memory."""
        if tuple(kinds) != ("ply",):
            raise OptionsError(
                "``stream`` writes .ply; for other programs, 'meshsplats tiles' makes .glb tiles"
            )
        if self.fidelity is not None or self.files.alpha not in ("auto", "blend") or self.scale is not None:
            raise OptionsError(
                "``fidelity``, ``alpha`` and ``scale`` need all in memory: leave out ``stream``"
            )
        refuse_whole(self.resolved(sources(inputs)))


@dataclass(frozen=True)
class Callbacks:
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
    callbacks: Callbacks

    def made(self, job: Job, cameras: Sequence[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``. Returns counts, scores and seconds, for JSON."""
        kind, product = identify(job.source), self.product
        if kind == "cameras" or (kind == "mesh" and product.as_splats):
            raise FileFormatError(f"{job.source}: not splats; convert needs splats or a mesh")
        if product.stream and kind == "mesh":
            raise FileFormatError(f"{job.source}: a mesh; --stream is for splats")
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
        mesh = convert(cloud, product.conversion, preset=product.preset, cameras=seen, up=product.direction)
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
        mesh = self.product.files.prepared(self._upright(load_mesh(job.source)))
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
        if merging and count is not None:
            seen = seen_from(cameras, job.source, kept.origin)
            kept = simplify(kept, count, cameras=seen or None)
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
            self.callbacks.preview(kept, job.preview)
        return {"read": len(cloud), "written": len(kept), "seconds": round(seconds, 4)}

    def _part(self, path: Path | None) -> SplatMesh | None:
        """A mesh to write beside the splats, as they are."""
        if path is None:
            return None
        part: SplatMesh = self.callbacks.place(scaled(self._upright(load_mesh(path)), self.product.scale))
        return part

    def _upright(self, scene: Any) -> Any:
        return scene if self.product.direction is None else replace(scene, up=unit_up(self.product.direction))


def seen_from(cameras: Sequence[Camera] | None, source: Path, origin: np.ndarray) -> list[Camera]:
    """``cameras``, which are in the world, relative to ``origin``; None: those of the model folder
    ``source``, if it is one."""
    if cameras is None:
        return cameras_beside(source, origin) or []
    return [camera.relative_to(origin) for camera in cameras]
