"""Scenes from files, as programs read them: splats or a mesh, whole or in blocks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar

from meshsplats._common.options import Advanced, Help, changed
from meshsplats._common.words import direction_in_words
from meshsplats._files.atomic import in_words
from meshsplats.errors import FileFormatError, OptionsError
from meshsplats.formats.splat_formats import listed, y_up_suffixes

if TYPE_CHECKING:
    import numpy as np

    from meshsplats.formats.streaming import SplatStream
    from meshsplats.scene.base_mesh import BaseMesh
    from meshsplats.scene.gaussians import GaussianCloud
    from meshsplats.scene.mesh import SplatMesh
    from meshsplats.viewpoints.finding import UnusualUp

Mesh = TypeVar("Mesh", bound="SplatMesh | BaseMesh")
_AXES = Help(
    "Direction of the y axis in the file; auto: as its format prescribes, up in"
    f" {listed(y_up_suffixes(), 'and')}, else down. After reading, y points down. Some programs write SPZ"
    " with y down: if the image is upside down, give y-down."
)


LARGE_BYTES = 50_000_000
"""Bytes of splats from which on reading takes seconds, and the rest minutes."""
LARGE_COUNT = 500_000
"""Splats from which on what is done with them takes many seconds."""


def _bytes_of(path: Path) -> int:
    """Size of the file ``path``, or of the images of the SOG whose meta.json it is; 0 for a folder."""
    # By pattern: what else is in the folder, such as a user's downloads, does not count.
    if images := {"meta.json": "*.webp", "lod-meta.json": "*/*.webp"}.get(path.name):
        return sum(file.stat().st_size for file in path.parent.glob(images) if file.is_file())
    return path.stat().st_size if path.is_file() else 0


@dataclass(frozen=True)
class SceneReading:
    """How splat files are read. Programs that show what headers say override ``tell``."""

    axes: Annotated[Literal["auto", "y-down", "y-up"], _AXES] = "auto"
    kernel: Literal["auto", "3dgs", "antialiased", "2dgs"] = "auto"
    """Kernel that the splats were trained with; auto: as the file says."""
    time: float | None = None
    """Splats that move in time: the instant to show, in the file's unit. Default: one in the middle."""
    activated: Annotated[tuple[Literal["scales", "opacities", "colors"], ...], Advanced] = ()
    """Values that a .ply stores as they are, where logarithms, logits and harmonics belong."""
    strict: Annotated[bool, Advanced] = False
    """Refuse files with splats that are not finite; by default these are left out with a warning."""

    def tell(self, text: str) -> None:
        """Gets what headers say that changes the scene, and what takes long when it begins."""

    def tell_of(self, work: str, count: int, more: str = "") -> None:
        """Tells that ``work`` on ``count`` splats begins, if there are many."""
        if count >= LARGE_COUNT:
            self.tell(f"{work} {count:,} splats{more}")

    def load(
        self,
        path: Path,
        origin: np.ndarray | None = None,
        *,
        up: str | None = None,
        find_up: bool = True,
        threads: int | None = None,
    ) -> GaussianCloud:
        """The splats of a file, relative to ``origin`` (3,). Tells what its header names; ``up``: the option
        that counts in its place. An object that would tip over the usual way up gets the one in which it
        stands, a place that in which its floors are level, and a survey z, unless ``find_up`` is False, or
        the folder has cameras, which know. ``threads``: at most this many. FileFormatError for a mesh, and
        what ``load_gaussians`` raises."""
        from meshsplats.cameras.files import model_folder
        from meshsplats.cameras.framing import warn_of_strays_in, warn_of_unseen
        from meshsplats.formats.gaussians import load_gaussians
        from meshsplats.formats.sniff import identify
        from meshsplats.viewpoints.finding import unusual_up
        from meshsplats.viewpoints.standing import thinned

        if (size := _bytes_of(path)) > LARGE_BYTES:
            self.tell(f"reading {in_words(size)}")
        try:
            cloud = load_gaussians(path, origin=origin, **self.arguments)
        except FileFormatError:
            if identify(path) == "mesh":
                raise FileFormatError(f"{path}: a mesh, not splats") from None
            raise
        warn_of_strays_in(cloud)
        warn_of_unseen(cloud)
        if up is None and cloud.up is not None:
            self.tell(f"up: {direction_in_words(cloud.up)}, from the file's header")
        looked_at = up is None and find_up and cloud.up is None and model_folder(path) is None
        if looked_at and (found := unusual_up(thinned([cloud]), threads)) is not None:
            cloud = replace(cloud, up=found.up)
            self._tell_found(found)
        if self.kernel == "auto" and cloud.kernel != "3dgs":
            self.tell(f"kernel: {cloud.kernel}, from the file")
        return cloud

    def stream(
        self,
        path: Path | Sequence[Path],
        origin: Sequence[float] | None = None,
        *,
        up: str | None = None,
        threads: int | None = None,
    ) -> SplatStream:
        """The splats of a file, or of several, in blocks, relative to ``origin``; ``up`` and
        ``threads`` as for ``load``."""
        from meshsplats.formats.streaming import stream_gaussians
        from meshsplats.viewpoints.finding import unusual_up
        from meshsplats.viewpoints.standing import thinned

        stream = stream_gaussians(path, origin=origin, **self.arguments)
        if up is None and (told := stream.up) is not None:
            self.tell(f"up: {direction_in_words(told)}, from the files' headers")
        elif up is None and (found := unusual_up(thinned(stream), threads)) is not None:
            stream.use_found(found.up)
            self._tell_found(found)
        return stream

    def _tell_found(self, found: UnusualUp) -> None:
        self.tell(
            f"up: {direction_in_words(found.up)}, {found.reason}; if that is wrong, name it by ``up``, which"
            " 'meshsplats convert' can write into a file"
        )

    def load_scene(
        self, path: Path, *, up: str | None = None, find_up: bool = True, threads: int | None = None
    ) -> GaussianCloud | SplatMesh:
        """The splats or the mesh at ``path``, textures as vertex colours; ``up``, ``find_up`` and
        ``threads`` as for ``load``. FileFormatError for cameras, and OptionsError as by ``refuse_for``."""
        from meshsplats.formats.base_meshes import load_vertex_colored

        return self._load(path, load_vertex_colored, up, find_up, threads)

    def load_shown(
        self, path: Path, *, up: str | None = None, threads: int | None = None
    ) -> GaussianCloud | SplatMesh | BaseMesh:
        """``load_scene``, but a surface with one texture on all faces as it is."""
        from meshsplats.formats.base_meshes import load_textured, vertex_colored
        from meshsplats.formats.surfaces.corners import has_whole_texture
        from meshsplats.scene.base_mesh import BaseMesh

        def load(path: Path) -> SplatMesh | BaseMesh:
            found = load_textured(path)
            whole = isinstance(found, BaseMesh) and has_whole_texture(found)
            return found if whole else vertex_colored(found, path)

        return self._load(path, load, up, True, threads)

    def _load(
        self,
        path: Path,
        load_mesh: Callable[[Path], Mesh],
        up: str | None,
        find_up: bool,
        threads: int | None,
    ) -> GaussianCloud | Mesh:
        from meshsplats.cameras.framing import warn_of_strays_in
        from meshsplats.formats.sniff import identify
        from meshsplats.scene.base_mesh import BaseMesh

        kind = identify(path)
        if kind == "cameras":
            raise FileFormatError(
                f"{path}: a JSON file; expected splats or a mesh (``cameras`` takes cameras)"
            )
        if kind == "splats":
            return self.load(path, up=up, find_up=find_up, threads=threads)
        self.refuse_for(path)
        mesh = load_mesh(path)
        if not isinstance(mesh, BaseMesh):
            warn_of_strays_in(mesh)
        return mesh

    def refuse_for(self, path: Path) -> None:
        """OptionsError for options that have no effect on ``path``, which is not a file of splats."""
        given = [name for name in ("kernel", "time", "activated") if name in changed(self)]
        if given:
            names = ", ".join(f"``{name}``" for name in given)
            raise OptionsError(f"{path} holds no splats: {names} would have no effect")

    @property
    def arguments(self) -> dict[str, Any]:
        """Those of ``load_gaussians``."""
        return {
            "strict": self.strict,
            "axes": self.axes,
            "kernel": None if self.kernel == "auto" else self.kernel,
            "time": self.time,
            "activated": self.activated,
        }


@dataclass(frozen=True)
class PartOfScene:
    """Part of the scene."""

    crop: tuple[float, float, float, float, float, float] | None = None
    """Only splats with their centre in this box, X0 Y0 Z0 X1 Y1 Z1, in the coordinates that ``info``
    prints."""
