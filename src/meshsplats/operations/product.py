"""Options of a conversion of files: what is made of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from meshsplats._common.choices import Look
from meshsplats._common.options import Advanced, changed, check_options
from meshsplats._common.words import optional_up
from meshsplats.conversion.options import ConversionOptions, Preset
from meshsplats.datasets.scene_views import MissingOfData, cameras_named, check_photographs
from meshsplats.errors import OptionsError, OptionValueError
from meshsplats.evaluation.mesh_files import MeshFileOptions
from meshsplats.formats.outputs import (
    WantedOrigin,
    check_mesh_endings,
    check_origin,
    check_outputs,
    check_splat_endings,
    splat_options,
)

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.datasets.scene_files import SceneReading
    from meshsplats.operations.batches import Job
    from meshsplats.scene.camera import Camera

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
    folder that has one. Default: those of the input if it is a model folder, else none; limits then keep what
    found views of a place show, or views from all around an object."""
    data: Path | None = None
    """Data set of photographs, in place of ``cameras``: the cameras of its training views."""
    missing: MissingOfData = "few"
    up: str | None = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the cameras, of the
    file, else -y, z of a survey, or as an object stands."""
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
    into a .ply of splats, without a preview. The result is the same where ``look`` is given."""
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
        from meshsplats.operations.batches import sources

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
        check_mesh_endings(*kinds)
        self.files.check(kinds)
        check_photographs(self.data, self.missing, self.cameras)
        self.resolved(sources(inputs))

    def _check_splats(self, kinds: Sequence[str], output: Path) -> None:
        from meshsplats.formats.scenes import SUFFIXES

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
        from meshsplats.formats.sniff import identify

        kind = identify(job.source)
        if kind == "splats" and self.files.alpha == "hybrid":
            raise OptionsError(
                f"{job.shown} holds splats: ``alpha`` hybrid is for a mesh with solid triangles, as finetune"
                " makes with ``opacity`` cutoff and ``soft_share``"
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
        from meshsplats.conversion.streaming import refuse_whole
        from meshsplats.operations.batches import sources

        if tuple(kinds) != ("ply",):
            raise OptionsError(
                "``stream`` writes .ply; for other programs, 'meshsplats tiles' makes .glb tiles"
            )
        if self.fidelity is not None or self.files.alpha not in ("auto", "blend") or self.scale is not None:
            raise OptionsError(
                "``fidelity``, ``alpha`` and ``scale`` need all in memory: leave out ``stream``"
            )
        refuse_whole(self.resolved(sources(inputs)))
