"""``meshsplats tiles``: splats of any number as a 3D Tiles tileset."""

from __future__ import annotations

import json
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from meshsplats._words import parse_up
from meshsplats.cli import option
from meshsplats.cli.arguments import Command
from meshsplats.cli.common import ClusterOptions, SplatOptions, alpha_in_words, say_origin
from meshsplats.cli.messages import Terminated, UsageError, say
from meshsplats.cli.progress import terminal_bar
from meshsplats.cli.records import write_configuration
from meshsplats.conversion import ConversionOptions
from meshsplats.errors import ClusterError
from meshsplats.formats.outputs import CONFIGURATION, beside, check_outputs

if TYPE_CHECKING:
    from meshsplats.tiles.options import TileOptions


@dataclass(frozen=True)
class Tiles(Command):
    """A 3D Tiles tileset of splats of any number: an octree of .glb files, fine ones for near and merged ones
    for far, that viewers and engines (CesiumJS, Unreal, Unity, Omniverse) load as they need them.

    Memory stays below 2 GB for any number of splats. An interrupted run is continued by --resume.
    """

    CONFIGURABLE = True

    input: tyro.conf.Positional[
        Annotated[tuple[Path, ...], tyro.conf.arg(metavar="INPUT...", help_behavior_hint="")]
    ]
    """Splat file, or the folder of a trained model; several of them; a folder of splat files."""
    output: option.Output
    """Folder for the tileset; it appears when it is complete. Until then, FOLDER.partial."""
    as_splats: bool = False
    """Tiles of splats (SPZ in glTF), as CesiumJS draws them, not of triangles."""
    max_triangles: int = 1 << 16
    """Maximum number of triangles of a tile. A splat of --as-splats counts as 2."""
    preset: Literal["default", "paper"] = "default"
    """default: calibrated to look like the splats; paper: the conversion of the MeshSplats paper."""
    look: option.LookOfSplats = None
    """area: for programs that take several samples a pixel; splats: as splat viewers show them. Default:
    area."""
    min_opacity: option.Number = None
    """Leave out splats of less opacity than this. Default: 1/255; paper: 0."""
    colors: Annotated[
        Literal["base", "view"] | None, tyro.conf.arg(metavar="{base,view}", help_behavior_hint="")
    ] = None
    """base: one colour for each splat, which every program shows; the default of meshes. view: also the
    harmonics of colours that depend on the view, for this program's images and for shaders; 1.6 to 2 times
    as large."""
    color_degree: option.Count = None
    """Harmonics of 'view' up to this degree, 1 to 3. Default: all that the splats have."""
    crop: option.Box = None
    """Only splats with their centre in this box, in the coordinates of the file."""
    up: option.Text = None
    """Direction that points up: an axis (-y, z, ...) or x,y,z. Default: that of the
    files, else -y."""
    lit: bool = False
    """A material that takes light and shadow, not one that shows the colours as they are."""
    alpha: Literal["auto", "blend", "mask", "opaque"] = "auto"
    """auto: blend or mask, whichever is nearer to the sorted image in viewers that do not sort, by a few
    images of both. blend: viewers blend true opacities; mask: they draw as solid what is at least 20 %
    opaque; opaque: solid triangles, cut there."""
    origin: option.Origin = "keep"
    resume: bool = False
    """Continue an interrupted run of the same command, from FOLDER.partial."""
    reading: SplatOptions = field(default_factory=SplatOptions)
    cluster: ClusterOptions = field(default_factory=ClusterOptions)
    threads: option.Threads = None
    json: option.AsJson = False
    force: bool = False
    """Replace an older tileset, and begin again where a partial one is left."""

    def execute(self) -> None:
        from meshsplats.tiles.building import JOURNAL, build_tiles, partial_folder

        options = self._checked()
        config = beside(self.output, CONFIGURATION)
        check_outputs([config], self.force or self.resume)
        start = time.perf_counter()
        origin = None if isinstance(self.origin, str) else self.origin
        source = self.reading.stream(self.input, origin, up=self.up)
        try:
            with self.cluster.workers(self.threads) as workers, terminal_bar() as bar:
                found = build_tiles(
                    source,
                    self.output,
                    options,
                    resume=self.resume,
                    replace_old=self.force,
                    threads=self.threads,
                    workers=workers,
                    on_progress=None if bar is None else lambda done, total: bar.phase("tiles", done / total),
                )
        except (KeyboardInterrupt, Terminated, OSError, ClusterError):
            if (partial_folder(self.output) / JOURNAL).is_file():
                say("what is done stays: the same command with --resume continues")
            raise
        write_configuration(config, "tiles", self)
        seconds = time.perf_counter() - start
        if self.json:
            result = {"tileset": str(self.output / "tileset.json"), **asdict(found)}
            print(json.dumps(result | {"seconds": round(seconds, 2)}, indent=1))
            return
        made = f" -> {found.triangles:,} triangles" if found.alpha else ""
        print(
            f"{found.splats:,} splats{made} in {found.tiles:,} tiles of {found.levels} levels,"
            f" {found.bytes / 1e6:,.1f} MB, in {seconds:.1f} s"
        )
        if found.alpha and (line := alpha_in_words(asdict(found.alpha))):
            print(line)
        if source.origin.any():
            say_origin(source.origin, self.origin)
        print(f"{self.output / 'tileset.json'}: geometric error of the root {found.error:.3g}")

    def resolved(self) -> dict[str, Any]:
        return asdict(self._checked().resolved())

    def _checked(self) -> TileOptions:
        """The options of the library; UsageError or ValueError where they are wrong."""
        from meshsplats.tiles.options import TileOptions

        if not self.input:
            raise UsageError("give a splat file or a folder of them")
        if self.output.suffix:
            raise UsageError(f"-o must name a folder, got {self.output.name!r}")
        if self.resume and self.force:
            raise UsageError("--resume continues, --force starts again: give one of them")
        names = ("look", "min_opacity", "crop", "colors", "color_degree")
        conversion = ConversionOptions(**{name: getattr(self, name) for name in names})
        up = None
        if self.up is not None:
            x, y, z = (float(u) for u in parse_up(self.up))
            up = (x, y, z)
        place: Literal["world", "local"] = "world" if self.origin == "keep" else "local"
        given = (self.preset, conversion, up, self.lit, self.alpha, place)
        options = TileOptions(self.max_triangles, self.as_splats, *given)
        options.resolved()
        return options
