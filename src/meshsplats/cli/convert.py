"""``meshsplats convert``: splats to a mesh."""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, fields, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from meshsplats._files.atomic import together
from meshsplats.camera import Camera
from meshsplats.cameras.files import cameras_beside, load_cameras
from meshsplats.cameras.framing import unit_up
from meshsplats.cli.arguments import Command, as_cli_options, of_presets, spelled
from meshsplats.cli.common import (
    Count,
    File,
    Folder,
    Missing,
    Number,
    Origin,
    Output,
    SplatOptions,
    Text,
    alpha_in_words,
    alpha_record,
    check_data,
    check_mesh_suffix,
    check_splat_endings,
    draw_preview,
    parse_up,
    plural,
    say_origin,
    size_of,
    track,
    warnings_kept,
    written,
)
from meshsplats.cli.images import views_of_a_place
from meshsplats.cli.messages import (
    FAILED,
    NO_SPACE,
    OK,
    UsageError,
    command_line,
    error_record,
    exit_code,
    one_line,
    say,
    shown_path,
)
from meshsplats.cli.records import changes_since, write_configuration
from meshsplats.conversion import ConversionOptions, convert, simplify
from meshsplats.conversion.options import PRESETS
from meshsplats.conversion.selection import choose_splats
from meshsplats.datasets.folder import load_dataset
from meshsplats.errors import DataWarning, FileFormatError
from meshsplats.evaluation.mesh_files import GLB_ALPHA, MeshFileOptions
from meshsplats.formats.meshes import MESH_SUFFIXES, load_mesh
from meshsplats.formats.outputs import (
    CONFIGURATION,
    Ending,
    beside,
    check_outputs,
    means_splats,
    scaled,
    splat_options,
)
from meshsplats.formats.scenes import SUFFIXES as SCENE_SUFFIXES
from meshsplats.formats.scenes import save_scene
from meshsplats.formats.sniff import identify
from meshsplats.formats.splat_formats import written_ending
from meshsplats.gaussians import GaussianCloud
from meshsplats.jobs import Job, is_batch, jobs, sources, without_results
from meshsplats.mesh import SplatMesh, checked_cutoff
from meshsplats.rendering.ordering import NODES, check_nodes

_SELECTION = ("crop", "min_opacity", "max_splats", "budget")
"""Options of the conversion that select splats: they have an effect with --as-splats."""
_FOR_SPLATS = (
    *("input", "output", "cameras", "data", "formats", "as_splats", "stream", "no_preview", "no_sidecar"),
    *("conversion", "reading", "origin", "json", "force", "skip_existing", "spz_version", "linear"),
    *("up", "scale", "with_mesh", "collider"),
)
"""Options of the command that have one."""
_IDLE = ("fidelity", "no_preview", "no_sidecar", "stream")
"""Options that do not change the mesh."""
ENGINE_GAIN = "7 to 10 dB in minutes, on three scenes"
"""What meshes for a depth buffer gain in three.js with MSAA: docs/viewers.md."""
ORDER_GAIN = "7 to 10 dB in three.js and Babylon.js in half a minute; not for ray tracers and CesiumJS"
"""What a solved order gains there: benchmarks/results/viewers_ordered.md."""


if TYPE_CHECKING:
    from meshsplats.formats.streaming import SplatStream

    ConvertOptions = ConversionOptions
else:
    ConvertOptions = as_cli_options(
        ConversionOptions,
        "In parentheses: the values of the presets.",
        metavars={"crop": "X0 Y0 Z0 X1 Y1 Z1"},
        defaults=of_presets(PRESETS),
    )


@dataclass(frozen=True)
class Convert(Command):
    """Converts splats to a mesh of translucent, vertex-coloured triangles; several files or folders, into a
    folder. Converts meshes to other formats, and splats, too: with --as-splats, or a name such as scene.spz.

    Writes a preview and the configuration beside the result.
    """

    COMMON = (
        *("input", "output", "formats", "preset", "look", "cameras", "data", "up", "lit"),
        *("alpha", "as_splats", "max_splats", "max_triangles", "crop", "json", "force"),
    )
    EXCLUSIVE = (("cameras", "data"),)
    CONFIGURABLE = True

    input: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT...", help_behavior_hint="")]
    ]
    """Splat file, the folder of a trained model, or a mesh; several of them; a folder of them; - for standard
    input."""
    output: Output
    """The mesh: .glb for engines, viewers and Blender; .npz or .ply, which keep everything; .usdc, .obj. Or
    splats: .spz, .sog, .splat, .compressed.ply, .usdz. Or a folder, for files named like the inputs."""
    formats: Annotated[tuple[Ending, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """With a folder: formats to write. Default: glb."""
    preset: Literal["default", "paper"] = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    cameras: File = None
    """Cameras that the mesh will be seen from: a JSON list, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input if it is a model folder, else none."""
    data: Folder = None
    """Data set of photographs, in place of --cameras: the cameras of its training views."""
    missing: Missing = "error"
    up: Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, of the
    file, else -y."""
    scale: Number = None
    """Factor for all lengths of the result, of meshes and splats: metres in an output unit, say."""
    lit: bool = False
    """.glb, .usd: a material that takes light and shadow, not one that shows the colours as they are."""
    smooth: bool = False
    """With --lit: normals of the surface that the splats form, in place of the triangles' own, which look
    mottled under light."""
    color_type: tyro.conf.Fixed[Literal["uint16", "float32"]] = "uint16"
    """.glb: storage of colours."""
    alpha: Literal["auto", "blend", "mask", "opaque", "hybrid", "ordered"] = "auto"
    """auto: for .glb, blend or mask, whichever is nearer to the sorted image in viewers that do not sort, by
    a few images of both; else blend. blend: the viewer blends true opacities; mask (.glb): it draws as solid
    what has at least ``cutoff``; opaque: solid triangles, cut there; hybrid (.glb), for a mesh of finetune
    with soft_share: solid and blended triangles apart; ordered (.glb), for web viewers and engines alone:
    every triangle twice, for either side, in an order of blending that suits views from all around."""
    nodes: tyro.conf.Fixed[int | Literal["auto"] | None] = None
    """--alpha ordered: parts that viewers sort, each a draw call; auto: few, if they do. Default: 8."""
    quick: tyro.conf.Fixed[bool] = False
    """--alpha ordered: an order by a formula, in a second, and several dB worse."""
    cutoff: tyro.conf.Fixed[float | None] = None
    """--alpha opaque, mask: least opacity that is drawn, 0 to 1. Default: 0.2."""
    compression: Literal["none", "meshopt"] = "none"
    """.glb: meshopt: a quarter to a third of the size, for viewers that can unpack it."""
    as_splats: bool = False
    """Write splats, not a mesh, as .ply, .glb or .usdc, too: all of them, or those that --crop, --max-splats
    and min_opacity leave."""
    spz_version: tyro.conf.Fixed[Literal[3, 4] | None] = None
    """.spz: version. 4 is read by newer programs only. Default: 3."""
    linear: tyro.conf.Fixed[bool | None] = None
    """Splats as .usdc, .usda, .usdz: linear colours, for renderers that take all colours so."""
    with_mesh: File = None
    """Splats as .glb or USD: a mesh to put into the file, too, such as one converted of them."""
    collider: File = None
    """Splats as .glb or USD: a mesh that physics engines collide with and nobody draws, in the file."""
    fidelity: Count = None
    """Compare the mesh with its splats in N views, of the cameras or around it, and print PSNR and SSIM."""
    stream: bool = False
    """Convert in blocks, so that memory does not grow with the file: into a .ply mesh, or with --as-splats
    into a .ply of splats, without a preview. The result is the same."""
    origin: Origin = "keep"
    no_preview: bool = False
    """Write no preview."""
    no_sidecar: bool = False
    """Write neither preview nor configuration."""
    conversion: ConvertOptions = field(default_factory=ConvertOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    json: bool = False
    """Print the results as JSON, a line for each input, errors too."""
    force: bool = False
    """Overwrite existing outputs."""
    skip_existing: bool = False
    """Keep the meshes that are there, and make those that are missing. Says which of them are older than
    their input or were made with other options."""

    def execute(self) -> int:
        if not self.input:
            raise UsageError("give a splat file, a mesh or a folder to convert")
        ending = written_ending(self.output.name)
        if not self.as_splats and means_splats(self.formats or [ending]):
            return replace(self, as_splats=True).execute()
        batch = is_batch(self.input)
        folder = batch or bool(self.formats) or self.output.is_dir()
        formats = self._formats(folder)
        self._check(formats or [ending])
        found = sources(self.input)
        preview = not (self.no_preview or self.stream)
        if formats:
            found = without_results(found, self.input, self.output, formats)
        todo = jobs(
            found, self.output, formats, preview=preview, sidecars=not self.no_sidecar, shown=shown_path
        )
        cameras = self._cameras()
        if not folder:
            self._print_result(self._convert(todo[0], cameras), todo[0], cameras)
            return OK
        new = not self.output.exists()
        if new:
            self.output.mkdir()
        try:
            return self._convert_all(todo, cameras)
        finally:
            if new:
                with suppress(OSError):
                    self.output.rmdir()  # where nothing was written

    def _formats(self, folder: bool) -> Sequence[str]:
        """Suffixes to write in a folder; none for a single file."""
        if not folder:
            if not self.as_splats:
                _check_file(self.output)
            return ()
        _check_folder(self.output)
        return self.formats or (("ply",) if self.as_splats else ("glb",))

    def _check(self, kinds: Sequence[str]) -> None:
        """UsageError or ValueError for options that contradict each other or have no effect."""
        if self.force and self.skip_existing:
            raise UsageError("give --force or --skip-existing, not both")
        if self.fidelity is not None and self.fidelity < 1:
            raise ValueError(f"--fidelity must be a number of views, at least 1, got {self.fidelity}")
        if self.scale is not None and not 0 < self.scale < float("inf"):
            raise ValueError(f"--scale must be a number above 0, got {self.scale}")
        if self.up is not None:
            parse_up(self.up)
        if self.stream:
            self._check_stream(kinds)
        if self.as_splats:
            self._check_splat_options(kinds)
            return
        if self.with_mesh is not None or self.collider is not None:
            raise UsageError("--with-mesh and --collider go beside splats: --as-splats")
        if self.spz_version is not None or self.linear is not None:
            raise UsageError("--set spz_version and linear are for splats: --as-splats")
        glb, usd = "glb" in kinds, any(kind.startswith("usd") for kind in kinds)
        if self.lit and not (glb or usd):
            raise UsageError(f"--lit is for .glb and .usd files: .{kinds[0]} has no material")
        if self.smooth and not self.lit:
            raise UsageError("--smooth has no effect without --lit")
        only_glb = self.color_type != "uint16" or self.alpha in GLB_ALPHA or self.compression != "none"
        if not glb and only_glb:
            raise UsageError(
                "--alpha mask, hybrid or ordered, --compression and --set color_type are for .glb files"
            )
        if self.cutoff is not None:
            if self.alpha not in ("opaque", "mask"):
                raise UsageError("--set cutoff is for --alpha opaque or mask")
            checked_cutoff(self.cutoff)
        if self.alpha != "ordered" and (self.nodes is not None or self.quick):
            raise UsageError("--set nodes and quick are for --alpha ordered")
        if self.alpha == "ordered" and (self.lit or self.compression != "none"):
            raise UsageError("--alpha ordered goes with neither --lit nor --compression")
        if self.nodes is not None:
            check_nodes(self.nodes)
        check_data(self.data, self.missing, self.cameras)
        self._resolved(sources(self.input))  # checks the values before the work

    def resolved(self) -> dict[str, Any]:
        if self.as_splats or all(identify(path) == "mesh" for path in self.input):
            return {}
        return asdict(self._resolved(self.input))

    def _resolved(self, inputs: Sequence[Path]) -> ConversionOptions:
        beside = any((path / "cameras.json").is_file() for path in inputs if path.is_dir())
        has_cameras = bool(self.cameras or self.data) or beside
        return self.conversion.resolved(self.preset, has_cameras=has_cameras)

    def _check_splat_options(self, kinds: Sequence[str]) -> None:
        check_splat_endings(*kinds)
        splat_options(kinds, spz_version=self.spz_version, linear=self.linear)
        if meshes := [path for path in (self.with_mesh, self.collider) if path is not None]:
            if not all(f".{kind}" in SCENE_SUFFIXES for kind in kinds) or self.linear is not None:
                raise UsageError("--with-mesh and --collider are for .glb and USD, with display colours")
            check_outputs([self.output], True, inputs=meshes)
        standard = {f.name: f.default for f in fields(self) if f.name not in _FOR_SPLATS}
        idle = [name for name, value in standard.items() if getattr(self, name) != value]
        explicit = asdict(self.conversion)
        if self.conversion.budget == "drop" or self.conversion.max_splats is None:
            idle += [name for name in ("cameras", "data") if getattr(self, name) is not None]
        idle += [name for name, value in explicit.items() if value is not None and name not in _SELECTION]
        if idle:
            flags = ", ".join(spelled(type(self), name) for name in idle)
            raise UsageError(f"{flags}: for a mesh, no effect with --as-splats")
        self.conversion.resolved("paper", has_cameras=False)

    def _cameras(self) -> list[Camera] | None:
        """The cameras of the options, in the world; None: each input may have its own."""
        if self.data is not None:
            dataset = load_dataset(self.data, missing=self.missing, origin=(0, 0, 0))
            return [view.camera for view in dataset.train or dataset.views]
        return None if self.cameras is None else load_cameras(self.cameras)

    def _convert_all(self, todo: Sequence[Job], cameras: list[Camera] | None) -> int:
        """Does every job, also after failures; a full disk ends them. Returns the exit code: that of the
        failures if they are all of one kind."""
        codes, skipped = [], 0
        for job in track(todo, "converting", len(todo)):
            try:
                result = self._convert(job, cameras)
                skipped += result["skipped"]
                self._print_line(result, job)
            except BrokenPipeError:
                raise
            except (UsageError, ValueError, OSError, ImportError, MemoryError) as error:
                codes.append(exit_code(error))
                say(f"error: {one_line(error)}")
                if self.json:
                    print(json.dumps({"input": job.shown, "error": error_record(error)}), flush=True)
                if codes[-1] == NO_SPACE:
                    break
        if not self.json and NO_SPACE not in codes:
            made = len(todo) - len(codes) - skipped
            kept = f", {skipped} kept" if skipped else ""
            print(f"{made} of {len(todo)} converted{kept}: {self.output}/")
        return OK if not codes else codes[-1] if len(set(codes)) == 1 or codes[-1] == NO_SPACE else FAILED

    def _convert(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """Does ``job``; its result, for JSON."""
        import meshsplats

        with warnings_kept() as warned, job.claimed(self.force):
            plan = job.plan(
                force=self.force, skip_existing=self.skip_existing, changes=partial(self._changes, job)
            )
            for mesh in plan.kept:
                if remark := mesh.remark:
                    warnings.warn(remark, DataWarning, stacklevel=1)
            result = {} if plan.finished else self._made(plan.job, cameras)
        outputs = [{"path": str(path), "bytes": path.stat().st_size} for path in job.outputs]
        image = job.preview if job.preview and job.preview.exists() else None
        base = {"input": job.shown, "outputs": outputs, "preview": str(image) if image else None}
        more = {"skipped": plan.finished, "warnings": warned, "meshsplats": meshsplats.__version__}
        return base | result | more

    def _changes(self, job: Job, index: int) -> str | None:
        """How the record beside an output of ``job`` differs from the options of now: see ``Job.plan``."""
        path = job.outputs[index]
        return changes_since(beside(path, CONFIGURATION), "convert", self._alone(job, path), _IDLE)

    def _made(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """Writes the outputs of ``job``."""
        kind = identify(job.source)
        if kind == "cameras" or (kind == "mesh" and self.as_splats):
            raise FileFormatError(f"{job.source}: not splats; convert needs splats or a mesh")
        if self.stream and kind == "mesh":
            raise FileFormatError(f"{job.source}: a mesh; --stream is for splats")
        if self.stream:
            return self._stream_splats(job) if self.as_splats else self._stream_mesh(job, cameras)
        if self.as_splats:
            return self._save_splats(job, cameras)
        return self._save_again(job, cameras) if kind == "mesh" else self._save_mesh(job, cameras)

    @contextmanager
    def _recorded(self, job: Job) -> Iterator[None]:
        """The files that are written within the block appear together with their configurations: a mesh
        without one cannot be told from a stranger's. The preview, which takes longer, comes later."""
        with together():
            for path, config in zip(job.outputs, job.configs, strict=False):
                write_configuration(config, "convert", self._alone(job, path))
            yield

    def _save_mesh(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats of ``job`` as a mesh."""
        if self.alpha == "hybrid":
            raise UsageError(
                f"{job.shown} holds splats: --alpha hybrid is for a mesh with solid triangles, as finetune"
                " --opacity cutoff --soft-share makes"
            )
        start = time.perf_counter()
        cloud = self.reading.load(job.source, up=self.up)
        cameras = _seen_from(cameras, job.source, cloud.origin)
        read = time.perf_counter()
        up = None if self.up is None else parse_up(self.up)
        mesh = convert(cloud, self.conversion, preset=self.preset, cameras=cameras, up=up)
        mesh = self._files.prepared(mesh, cameras)
        times = {"read": read - start, "convert": time.perf_counter() - read}
        return {
            "splats": len(cloud),
            "converted": mesh.splat_count or 0,
            "merged": self._merges(),
            **self._finish(mesh, job, cameras, times, self._opening(cloud, cameras, job, up)),
            "fidelity": self._fidelity(cloud, mesh, cameras),
        }

    def _opening(
        self, cloud: GaussianCloud, cameras: Sequence[Camera], job: Job, up: np.ndarray | None
    ) -> Camera | None:
        """The camera of the preview of a place, from which the splats look right; None: one in front."""
        if cameras or not job.preview:
            return None
        found = views_of_a_place(cloud, 1, {"width": 800, "height": 800, "up": up})
        return found[0] if found else None

    def _check_stream(self, kinds: Sequence[str]) -> None:
        """UsageError or ValueError for what needs the whole scene in memory."""
        from meshsplats.conversion.streaming import refuse_whole

        if tuple(kinds) != ("ply",):
            raise UsageError("--stream writes .ply; for other programs, 'meshsplats tiles' makes .glb tiles")
        if self.fidelity is not None or self.alpha not in ("auto", "blend") or self.scale is not None:
            raise UsageError("--fidelity, --alpha and --scale need all in memory: leave out --stream")
        refuse_whole(self._resolved(sources(self.input)))

    def _stream_mesh(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats of ``job`` as a mesh, in blocks."""
        from meshsplats.conversion.streaming import convert_blocks
        from meshsplats.formats.meshes import save_mesh_blocks

        start = time.perf_counter()
        source = self._opened(job)
        cameras = _seen_from(cameras, job.source, source.origin)
        up = None if self.up is None else parse_up(self.up)
        blocks = convert_blocks(source, self.conversion, preset=self.preset, cameras=cameras, up=up)
        kept = self.origin == "keep"
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
        count, degree, kernels = 0, 0, set()
        for block in source:
            count += len(worth_drawing(block, self.conversion))
            degree = max(degree, block.sh_degree)
            kernels.add(block.kernel)
        if not count:
            raise ValueError(f"{job.source}: none of the {source.count:,} splats is left")
        kernel = kernels.pop() if len(kernels) == 1 else "3dgs"
        up = source.up if self.up is None else unit_up(parse_up(self.up))
        origin = source.origin if self.origin == "keep" else np.zeros(3)
        kept = (replace(block.take(worth_drawing(block, self.conversion)), origin=origin) for block in source)
        with self._recorded(job):
            save_gaussian_blocks(kept, job.outputs[0], count, degree=degree, kernel=kernel, up=up)
        seconds = round(time.perf_counter() - start, 4)
        return {"read": source.count, "written": count, "seconds": seconds}

    def _opened(self, job: Job) -> _Counted:
        """The splats of ``job`` in blocks, relative to the origin that is asked for."""
        given = None if isinstance(self.origin, str) else self.origin
        source = _Counted(self.reading.stream(job.source, given, up=self.up))
        say_origin(source.origin, self.origin, splats=self.as_splats)
        return source

    def _alone(self, job: Job, path: Path) -> Convert:
        """The command that writes ``path`` of ``job`` alone."""
        alone = replace(self, input=(job.source,), output=path, formats=())
        suffix = path.suffix.lower()
        if suffix != ".glb":
            alone = replace(alone, color_type="uint16", compression="none")
            if self.alpha in GLB_ALPHA:
                alone = replace(alone, alpha="auto", cutoff=None, nodes=None, quick=False)
        lit = suffix == ".glb" or suffix.startswith(".usd")
        return alone if lit else replace(alone, lit=False, smooth=False)

    def _merges(self) -> bool:
        """Whether splats are merged to keep a limit."""
        limits = (self.conversion.max_splats, self.conversion.max_triangles)
        return self.conversion.budget != "drop" and any(limit is not None for limit in limits)

    @property
    def _files(self) -> MeshFileOptions:
        """How meshes are saved."""
        return MeshFileOptions(
            self.alpha,
            self.cutoff,
            self.lit,
            self.smooth,
            self.color_type,
            self.compression,
            nodes=NODES if self.nodes is None else self.nodes,
            quick=self.quick,
        )

    def _fidelity(
        self, cloud: GaussianCloud, mesh: SplatMesh, cameras: Sequence[Camera]
    ) -> dict[str, Any] | None:
        """Scores of the mesh against its splats."""
        if self.fidelity is None:
            return None
        from meshsplats.evaluation.comparison import fidelity

        if self.conversion.crop is not None:
            cloud = choose_splats(cloud, crop=self.conversion.crop)
        return fidelity(cloud, mesh, cameras, self.fidelity, self._look)

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
        choice = self._files.choice(mesh, job.outputs, cameras)
        order = self._files.order(mesh, job.outputs, cameras)
        chosen = time.perf_counter()
        placed = written(scaled(mesh, self.scale), self.origin)
        with self._recorded(job):
            self._files.save(placed, job.outputs, choice, order)
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
        views = () if self.alpha == "ordered" else ("cameras", "data")
        idle = [name for name in (*views, "fidelity") if getattr(self, name) is not None]
        idle += ["preset"] if self.preset != "default" else []
        idle += [name for name, value in asdict(self.conversion).items() if value is not None]
        if idle:
            flags = ", ".join(spelled(type(self), name) for name in idle)
            raise UsageError(f"{job.shown} is a mesh: {flags} would have no effect, as they are for splats")
        self.reading.refuse_for(job.source)
        start = time.perf_counter()
        mesh = load_mesh(job.source)
        if self.up is not None:
            mesh = replace(mesh, up=unit_up(parse_up(self.up)))
        mesh = self._files.prepared(mesh)
        times = {"read": time.perf_counter() - start}
        seen = [camera.relative_to(mesh.origin) for camera in cameras or ()]
        return {**self._finish(mesh, job, seen, times), "fidelity": None}

    def _save_splats(self, job: Job, cameras: list[Camera] | None) -> dict[str, Any]:
        """The splats themselves."""
        from meshsplats.formats.gaussians import save_gaussians

        start = time.perf_counter()
        cloud = self.reading.load(job.source, up=self.up)
        if self.up is not None:
            cloud = replace(cloud, up=unit_up(parse_up(self.up)))
        options = self.conversion
        merging, count = options.budget != "drop", options.max_splats
        kept = choose_splats(
            cloud,
            crop=options.crop,
            min_opacity=options.min_opacity,
            max_splats=None if merging else count,
        )
        if merging and count is not None:
            seen = _seen_from(cameras, job.source, kept.origin)
            kept = simplify(kept, count, cameras=seen or None)
        result = written(scaled(kept, self.scale), self.origin)
        with self._recorded(job):
            kinds = [written_ending(path.name) for path in job.outputs]
            taken = splat_options(kinds, spz_version=self.spz_version, linear=self.linear)
            for path, own in zip(job.outputs, taken, strict=True):
                if self.with_mesh is None and self.collider is None:
                    save_gaussians(result, path, **own)
                else:
                    mesh, collider = self._part(self.with_mesh), self._part(self.collider)
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
        if self.up is not None:
            mesh = replace(mesh, up=unit_up(parse_up(self.up)))
        return written(scaled(mesh, self.scale), self.origin)

    def _print_result(self, result: dict[str, Any], job: Job, cameras: list[Camera] | None) -> None:
        """Prints the result of a single input."""
        if self.json:
            print(json.dumps(result))
            return
        if result["skipped"]:
            print(f"{self.output} ({size_of(self.output)}): kept")
            return
        if "written" in result:
            print(f"{result['written']:,} of {result['read']:,} splats in {result['seconds']:.2f} s")
            print(f"{self.output} ({size_of(self.output)})")
        else:
            print(_counts(result))
            seconds = result["seconds"]
            words = {"read": "read", "convert": "converted", "save": "saved", "choose alpha": "chose alpha"}
            words["solve order"] = "solved the order"
            timing = ", ".join(f"{words[name]} {value:.2f} s" for name, value in seconds.items() if value)
            print(f"{self.output} ({size_of(self.output)}): {timing}")
            if line := alpha_in_words(result.get("alpha")):
                print(line)
                if "splats" in result and job.shown != "-" and self.conversion.crop is None:
                    print(f"better there: {self._for_depth_buffers()}")
                    print(f"or, with an order in the file, --alpha ordered ({ORDER_GAIN})")
        if result["preview"]:
            print(f"preview: {result['preview']}")
        if result.get("converted") is not None and self.compression == "none":
            print(f"next: {self._next(_seen_from(cameras, job.source, np.zeros(3)))}")

    def _print_line(self, result: dict[str, Any], job: Job) -> None:
        """Prints the result of one of several inputs."""
        if self.json:
            print(json.dumps(result), flush=True)
            return
        if result["skipped"]:
            sizes = "kept"
        else:
            sizes = f"{result['written']:,} splats" if "written" in result else _counts(result)
        files = ", ".join(f"{path.name} ({size_of(path)})" for path in job.outputs)
        choice = result.get("alpha")
        print(f"{job.shown}: {sizes}: {files}" + (f", alpha {choice['alpha']}" if choice else ""), flush=True)

    @property
    def _look(self) -> Literal["area", "splats"]:
        """The look that the conversion is for."""
        return "splats" if self.conversion.footprint == "filter" else self.conversion.look or "area"

    def _next(self, cameras: Sequence[Camera] | None) -> str:
        """The command that compares the mesh with the splats in its cameras, or one that renders it if only a
        part of them was converted."""
        folder, source = self.output.with_suffix(""), shown_path(self.input[0])
        if self.conversion.crop is not None or source == "-" or self.scale is not None:
            return command_line(["meshsplats", "render", self.output, "-o", f"{folder}-images"])
        words: list[str | Path] = ["meshsplats", "compare", source, self.output]
        words += ["--look", self._look] if self._look != "area" else []
        if self.data is not None:
            words += ["--data", self.data]
            words += ["--missing", self.missing] if self.missing != "error" else []
        elif cameras:
            words += ["--cameras", source if self.cameras is None else self.cameras]
        return command_line([*words, *self.reading.again(), "-o", f"{folder}-compare"])

    def _for_depth_buffers(self) -> str:
        """The command that makes a mesh for viewers that do not sort, and what is gained by it."""
        words: list[str | Path] = ["meshsplats", "finetune", shown_path(self.input[0])]
        if self.data is not None:
            words += ["--data", self.data]
            words += ["--missing", self.missing] if self.missing != "error" else []
        words += [*self.reading.again(), "-o", self.output.with_suffix(".solid.glb")]
        command = command_line([*words, "--opacity", "cutoff", "--soft-share", "0.05"])
        return f"{command} ({ENGINE_GAIN})"


def _check_folder(output: Path) -> None:
    """UsageError if ``output`` names a mesh file, where a folder for several is wanted."""
    if output.suffix.lower() in MESH_SUFFIXES and not output.is_dir():
        raise UsageError(f"several inputs or formats need a folder: -o {output.with_suffix('')}, say")


def _check_file(output: Path) -> None:
    """UsageError if no mesh can be written as ``output``."""
    try:
        check_mesh_suffix(output)
    except UsageError as error:
        raise UsageError(f"{error}; for a folder, name the formats: --formats glb") from None


def _seen_from(cameras: list[Camera] | None, source: Path, origin: np.ndarray) -> list[Camera]:
    """``cameras``, which are in the world, relative to ``origin``; None: those of the model folder
    ``source``, if it is one."""
    if cameras is None:
        return cameras_beside(source, origin) or []
    return [camera.relative_to(origin) for camera in cameras]


class _Counted:
    """A stream of splats that counts them."""

    def __init__(self, stream: SplatStream) -> None:
        self._stream = stream
        self.origin, self.up = stream.origin, stream.up
        self.count = 0

    def __iter__(self) -> Iterator[GaussianCloud]:
        self.count = 0
        for block in self._stream:
            self.count += len(block)
            yield block


def _counts(result: dict[str, Any]) -> str:
    """Sizes before and after."""
    sizes = f"{result['triangles']:,} triangles, {result['vertices']:,} vertices"
    if "splats" in result:
        share = result["converted"] / result["splats"]
        kept = f", merged into {result['converted']:,} ({share:.1%})"
        if result["converted"] == result["splats"]:
            kept = ""
        elif not result["merged"]:
            kept = f", {result['converted']:,} of them converted ({share:.1%})"
        sizes = f"{result['splats']:,} splats{kept} -> {sizes}"
    fidelity = result["fidelity"]
    if fidelity is None:
        return sizes
    psnr = "equal" if fidelity["psnr"] is None else f"{fidelity['psnr']:.2f} dB"
    views = plural(fidelity["views"], "view")
    scores = f"{psnr}, SSIM {fidelity['ssim']:.4f} against the splats"
    return f"{sizes}; {scores}, {views}, look {fidelity['look']}"
