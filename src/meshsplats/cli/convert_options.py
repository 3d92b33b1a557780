"""Options of ``convert``, what contradicts what, and what follows from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from meshsplats._options import changed
from meshsplats._words import optional_up
from meshsplats.camera import Camera
from meshsplats.cli import option
from meshsplats.cli.arguments import Command, as_cli_options, of_presets, spelled
from meshsplats.cli.common import SplatOptions
from meshsplats.cli.messages import UsageError
from meshsplats.conversion import ConversionOptions
from meshsplats.conversion.options import PRESETS
from meshsplats.datasets.scene_views import cameras_named, check_photographs
from meshsplats.evaluation.mesh_files import GLB_ALPHA, MeshFileOptions
from meshsplats.file_conversion import Product
from meshsplats.formats.mesh_formats import takes
from meshsplats.formats.outputs import Ending, check_outputs, check_splat_endings, splat_options
from meshsplats.formats.scenes import SUFFIXES as SCENE_SUFFIXES
from meshsplats.formats.sniff import identify
from meshsplats.jobs import Job, sources
from meshsplats.mesh import checked_cutoff
from meshsplats.rendering.ordering import check_nodes

_SELECTION = ("crop", "min_opacity", "max_splats", "budget")
"""Options of the conversion that select splats: they have an effect with --as-splats."""
_FOR_SPLATS = (
    *("input", "output", "cameras", "data", "formats", "as_splats", "stream", "no_preview", "no_sidecar"),
    *("conversion", "reading", "origin", "json", "force", "skip_existing", "spz_version", "linear"),
    *("up", "scale", "with_mesh", "collider", "files"),
)
"""Options of the command that have one."""


@as_cli_options(presets=False)
class FileOptions(MeshFileOptions):
    """How meshes are saved."""


@as_cli_options(metavars={"crop": "X0 Y0 Z0 X1 Y1 Z1"}, defaults=of_presets(PRESETS))
class ConvertOptions(ConversionOptions):
    """In parentheses: the values of the presets."""


@dataclass(frozen=True)
class ConvertCommand(Command):
    """The options of ``convert``."""

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
    output: option.Output
    """The mesh: .glb for engines, viewers and Blender; .npz or .ply, which keep everything; .usdc, .obj. Or
    splats: .spz, .sog, .splat, .compressed.ply, .usdz. Or a folder, for files named like the inputs."""
    formats: Annotated[tuple[Ending, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """With a folder: formats to write. Default: glb."""
    preset: Literal["default", "paper"] = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    cameras: option.File = None
    """Cameras that the mesh will be seen from: a JSON list, a cameras.json of a 3DGS trainer, or the model
    folder that has one. Default: those of the input if it is a model folder, else none."""
    data: option.Folder = None
    """Data set of photographs, in place of --cameras: the cameras of its training views."""
    missing: option.Missing = "few"
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, of the
    file, else -y."""
    scale: option.Number = None
    """Factor for all lengths of the result, of meshes and splats: metres in an output unit, say."""
    files: FileOptions = field(default_factory=FileOptions)
    as_splats: bool = False
    """Write splats, not a mesh, as .ply, .glb or .usdc, too: all of them, or those that --crop, --max-splats
    and min_opacity leave."""
    spz_version: tyro.conf.Fixed[Literal[3, 4] | None] = None
    """.spz: version. 4 is read by newer programs only. Default: 3."""
    linear: tyro.conf.Fixed[bool | None] = None
    """Splats as .usdc, .usda, .usdz: linear colours, for renderers that take all colours so."""
    with_mesh: option.File = None
    """Splats as .glb or USD: a mesh to put into the file, too, such as one converted of them."""
    collider: option.File = None
    """Splats as .glb or USD: a mesh that physics engines collide with and nobody draws, in the file."""
    fidelity: option.Count = None
    """Compare the mesh with its splats in N views, of the cameras or around it, and print PSNR and SSIM."""
    stream: bool = False
    """Convert in blocks, so that memory does not grow with the file: into a .ply mesh, or with --as-splats
    into a .ply of splats, without a preview. The result is the same."""
    origin: option.Origin = "keep"
    no_preview: bool = False
    """Write no preview."""
    no_sidecar: bool = False
    """Write neither preview nor configuration."""
    conversion: ConvertOptions = field(default_factory=ConvertOptions)
    reading: SplatOptions = field(default_factory=SplatOptions)
    json: bool = False
    """Print the results as JSON, a line for each input, errors too."""
    force: option.Force = False
    skip_existing: bool = False
    """Keep the meshes that are there, and make those that are missing. Says which of them are older than
    their input or were made with other options."""

    def check_options(self, kinds: Sequence[str]) -> None:
        """UsageError or ValueError for options that contradict each other or have no effect."""
        if self.force and self.skip_existing:
            raise UsageError("give --force or --skip-existing, not both")
        if self.fidelity is not None and self.fidelity < 1:
            raise ValueError(f"--fidelity must be a number of views, at least 1, got {self.fidelity}")
        if self.scale is not None and not 0 < self.scale < float("inf"):
            raise ValueError(f"--scale must be a number above 0, got {self.scale}")
        optional_up(self.up)
        if self.stream:
            self._check_stream(kinds)
        if self.as_splats:
            self._check_splat_options(kinds)
            return
        if self.with_mesh is not None or self.collider is not None:
            raise UsageError("--with-mesh and --collider go beside splats: --as-splats")
        if self.spz_version is not None or self.linear is not None:
            raise UsageError("--set spz_version and linear are for splats: --as-splats")
        names = [f"mesh.{kind}" for kind in kinds]
        files = self.files
        if files.lit and not any(takes(name, "lit") for name in names):
            raise UsageError(f"--lit is for .glb and .usd files: .{kinds[0]} has no material")
        if files.smooth and not files.lit:
            raise UsageError("--smooth has no effect without --lit")
        only_glb = files.color_type != "uint16" or files.alpha in GLB_ALPHA or files.compression != "none"
        if only_glb and not any(takes(name, "alpha") for name in names):
            raise UsageError(
                "--alpha mask, hybrid or ordered, --compression and --set color_type are for .glb files"
            )
        if files.cutoff is not None:
            if files.alpha not in ("opaque", "mask"):
                raise UsageError("--set cutoff is for --alpha opaque or mask")
            checked_cutoff(files.cutoff)
        if files.alpha != "ordered" and (files.nodes is not None or files.quick):
            raise UsageError("--set nodes and quick are for --alpha ordered")
        if files.alpha == "ordered" and (files.lit or files.compression != "none"):
            raise UsageError("--alpha ordered goes with neither --lit nor --compression")
        if files.nodes is not None:
            check_nodes(files.nodes)
        check_photographs(self.data, self.missing, self.cameras)
        self.options_for(sources(self.input))  # checks the values before the work

    def resolved(self) -> dict[str, Any]:
        if self.as_splats or all(identify(path) == "mesh" for path in self.input):
            return {}
        return asdict(self.options_for(self.input))

    def options_for(self, inputs: Sequence[Path]) -> ConversionOptions:
        beside = any((path / "cameras.json").is_file() for path in inputs if path.is_dir())
        has_cameras = bool(self.cameras or self.data) or beside
        return self.conversion.resolved(self.preset, has_cameras=has_cameras)

    def _check_stream(self, kinds: Sequence[str]) -> None:
        """UsageError or ValueError for what needs the whole scene in memory."""
        from meshsplats.conversion.streaming import refuse_whole

        if tuple(kinds) != ("ply",):
            raise UsageError("--stream writes .ply; for other programs, 'meshsplats tiles' makes .glb tiles")
        if self.fidelity is not None or self.files.alpha not in ("auto", "blend") or self.scale is not None:
            raise UsageError("--fidelity, --alpha and --scale need all in memory: leave out --stream")
        refuse_whole(self.options_for(sources(self.input)))

    def _check_splat_options(self, kinds: Sequence[str]) -> None:
        check_splat_endings(*kinds)
        splat_options(kinds, spz_version=self.spz_version, linear=self.linear)
        if meshes := [path for path in (self.with_mesh, self.collider) if path is not None]:
            if not all(f".{kind}" in SCENE_SUFFIXES for kind in kinds) or self.linear is not None:
                raise UsageError("--with-mesh and --collider are for .glb and USD, with display colours")
            check_outputs([self.output], True, inputs=meshes)
        idle = [name for name in (*changed(self), *changed(self.files)) if name not in _FOR_SPLATS]
        explicit = asdict(self.conversion)
        if self.conversion.budget == "drop" or self.conversion.max_splats is None:
            idle += [name for name in ("cameras", "data") if getattr(self, name) is not None]
        idle += [name for name, value in explicit.items() if value is not None and name not in _SELECTION]
        if idle:
            flags = ", ".join(spelled(type(self), name) for name in idle)
            raise UsageError(f"{flags}: for a mesh, no effect with --as-splats")
        self.conversion.resolved("paper", has_cameras=False)

    def seen_by(self) -> list[Camera] | None:
        """The cameras of the options, in the world; None: each input may have its own."""
        return cameras_named(self.cameras, self.data, self.missing)

    def alone(self, job: Job, path: Path) -> ConvertCommand:
        """The command that writes ``path`` of ``job`` alone."""
        return replace(self, input=(job.source,), output=path, formats=(), files=self.files.taken_by(path))

    def check_kind(self, job: Job) -> None:
        """UsageError for options that have no effect on the input of ``job``, which is to be a mesh."""
        kind = identify(job.source)
        if kind == "splats" and self.files.alpha == "hybrid":
            raise UsageError(
                f"{job.shown} holds splats: --alpha hybrid is for a mesh with solid triangles, as finetune"
                " --opacity cutoff --soft-share makes"
            )
        if kind != "mesh":
            return
        views = () if self.files.alpha == "ordered" else ("cameras", "data")
        idle = [name for name in (*views, "fidelity") if getattr(self, name) is not None]
        idle += ["preset"] if self.preset != "default" else []
        idle += [name for name, value in asdict(self.conversion).items() if value is not None]
        if idle:
            flags = ", ".join(spelled(type(self), name) for name in idle)
            raise UsageError(f"{job.shown} is a mesh: {flags} would have no effect, as they are for splats")
        self.reading.refuse_for(job.source)

    def product(self) -> Product:
        """What is made of each input."""
        return Product(
            preset=self.preset,
            conversion=self.conversion,
            files=self.files,
            up=optional_up(self.up),
            scale=self.scale,
            keeps_origin=self.origin == "keep",
            as_splats=self.as_splats,
            in_blocks=self.stream,
            of_splats={"spz_version": self.spz_version, "linear": self.linear},
            with_mesh=self.with_mesh,
            collider=self.collider,
            scored_views=self.fidelity,
            look=self.look_of_result,
        )

    @property
    def look_of_result(self) -> Literal["area", "splats"]:
        """The look that the conversion is for."""
        return "splats" if self.conversion.footprint == "filter" else self.conversion.look or "area"
