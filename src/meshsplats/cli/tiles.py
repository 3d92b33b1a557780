"""``meshsplats tiles``: splats of any number as a 3D Tiles tileset."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any

import tyro

from meshsplats.cli import option
from meshsplats.cli.arguments import Command, Flat, as_cli_options
from meshsplats.cli.common import ClusterOptions, SplatOptions, resumable, say_origin
from meshsplats.cli.messages import UsageError, say
from meshsplats.cli.progress import progress_display
from meshsplats.cli.records import write_configuration
from meshsplats.formats.outputs import CONFIGURATION, beside, check_folder_name, check_outputs
from meshsplats.tiles.options import TileOptions, TilingOptions


@as_cli_options(presets=False)
class TileArguments(TilingOptions):
    """The tiles."""


@dataclass(frozen=True)
class Tiles(Command):
    """A 3D Tiles tileset of any number of splats: an octree of .glb files, fine ones nearby and merged ones
    far away, that viewers and engines (CesiumJS, Unreal, Unity, Omniverse) load as they need them.

    Memory stays below 2 GB for any number of splats in most formats (not SOG, glTF, USD, zipped SPZ: see
    docs/tiles.md). An interrupted run is continued by --resume.
    """

    CONFIGURABLE = True

    input: tyro.conf.Positional[option.Inputs]
    """Splat file, or the folder of a trained model; several of them; a folder of splat files."""
    output: option.Output
    """Folder for the tileset; it appears when it is complete. Until then, FOLDER.partial."""
    tiles: Annotated[TileArguments, Flat] = field(default_factory=TileArguments)
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
        source = self.reading.stream(self.input, origin, up=self.tiles.up, threads=self.threads)
        left = resumable(partial_folder(self.output) / JOURNAL, force=self.force)
        with left, self.cluster.workers(self.threads) as workers, progress_display() as show:
            how: dict[str, Any] = {"threads": self.threads, "workers": workers, "on_progress": show.phase}
            found = build_tiles(
                source, self.output, options, resume=self.resume, replace_old=self.force, **how
            )
        write_configuration(config, "tiles", self)
        seconds = time.perf_counter() - start
        if source.origin.any() and not self.json:
            say_origin(source.origin, self.origin)
            if self.origin == "keep" and not found.on_globe:
                say("coordinates of a map, not of the globe: docs/tiles.md says how CesiumJS can show them")
        table = self.output / "tileset.json"
        lines = [f"{found.in_words()}, in {seconds:.1f} s", found.alpha.in_words() if found.alpha else None]
        lines += [f"{table}: geometric error of the root {found.error:.3g}"]
        if not found.on_globe:
            lines += ["next: docs/tiles.md has a page that shows it in CesiumJS, without the globe around it"]
        result = {"tileset": str(table), **asdict(found), "seconds": round(seconds, 2)}
        self.finish(result, *filter(None, lines))

    def resolved(self) -> dict[str, Any]:
        return asdict(self._checked().resolved())

    def _checked(self) -> TileOptions:
        """The options of the library; UsageError or ValueError where they are wrong."""
        if not self.input:
            raise UsageError("give a splat file or a folder of them")
        check_folder_name(self.output)
        option.check_resumption(self.resume, self.force)
        return self.tiles.tile_options("world" if self.origin == "keep" else "local")
